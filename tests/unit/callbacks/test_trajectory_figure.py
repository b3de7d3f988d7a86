"""The machine that draws solves the first replica of the model in training."""

from pathlib import Path
from typing import Any

import pytest
import torch
from foreign import TheirChains, events_in, fit, tensorboard

from memcomp_lightning import rng
from memcomp_lightning.callbacks import TrajectoryFigure, trajectory_figure
from memcomp_lightning.errors import SettingError
from memcomp_lightning.models import RBM
from memcomp_lightning.problems import from_model
from memcomp_lightning.solvers import AlternatingDescent
from memcomp_lightning.solvers.dmm import DmmSolver, Recording

pytestmark = [
    pytest.mark.filterwarnings("ignore:.*does not have many workers.*"),
    pytest.mark.usefixtures("allow_global_rng"),  # torch's DataLoader draws a base seed
]
SOLVER = DmmSolver(n_restarts=2, max_steps=30, record=Recording(every=1))


def test_figure_is_the_path_through_the_first_replica(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    drawn: list[Any] = []
    original = trajectory_figure.plot_trajectory

    def spy(trajectory: Any, **settings: Any) -> Any:
        drawn.append((trajectory, settings["title"]))
        return original(trajectory, **settings)

    monkeypatch.setattr(trajectory_figure, "plot_trajectory", spy)
    callback = TrajectoryFigure(every=2, solver=SOLVER, seed=3)
    module, _ = fit(tmp_path, [callback], tensorboard(tmp_path), TheirChains())
    assert len(events_in(tmp_path).Images("TheirChains/trajectory")) == len(drawn) == 2
    first = RBM(6, 5)
    first.load_state_dict({name: tensor[0] for name, tensor in module.model.state_dict().items()})
    solution = SOLVER.minimise(from_model(first), generator=rng.stream(3, "trajectory"))
    assert solution.trajectory is not None
    trajectory, title = drawn[-1]
    assert all(torch.equal(a, b) for a, b in zip(trajectory, solution.trajectory, strict=True))
    assert title == f"lowest energy {solution.best_energy.item():.4g}"


def test_without_tensorboard_nothing_is_solved(tmp_path: Path) -> None:
    class Never:
        record = Recording()

        def minimise(self, *_: Any, **__: Any) -> Any:
            raise AssertionError("solved for nobody")

    fit(tmp_path, [TrajectoryFigure(every=1, solver=Never())], module=TheirChains())


@pytest.mark.parametrize("solver", [DmmSolver(), AlternatingDescent()])
def test_a_solver_that_records_nothing_is_refused(solver: Any) -> None:
    with pytest.raises(SettingError, match=r"solver = '\w+' .*records its trajectory.*Recording"):
        TrajectoryFigure(solver=solver)
