"""The paper's Fig. 2: the path of the machine on an RBM that it trains."""

import json
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import torch
from omegaconf import DictConfig

from memcomp_lightning import rng
from memcomp_lightning.cli.build import Plan, build
from memcomp_lightning.cli.commands.report import save
from memcomp_lightning.cli.figures import composed_for
from memcomp_lightning.cli.hydra_versions import instantiate
from memcomp_lightning.cli.units import pretrained
from memcomp_lightning.errors import SettingError, require
from memcomp_lightning.files import write_text
from memcomp_lightning.models import DBN
from memcomp_lightning.plotting import plot_trajectory
from memcomp_lightning.problems import from_model
from memcomp_lightning.solvers import Trajectory
from memcomp_lightning.solvers.dmm import DmmSolver, Recording


def prepare(config: DictConfig, overrides: Sequence[str]) -> tuple[Plan, DmmSolver]:
    """Build the network and the machine.

    Raises:
        SettingError: The solver is not the DMM, or nothing is pretrained.
    """
    composed = composed_for(tuple(overrides))
    plan, solver = build(composed), instantiate(composed.solver)
    if not isinstance(plan.network, DBN) or plan.pretraining is None:
        raise SettingError(f"{config.figure.name} needs pretraining: model=dbn and pretrain.iterations >= 1.")
    require(isinstance(solver, DmmSolver), "solver", type(solver).__name__, "the DMM (solver=dmm)")
    return plan, replace(solver, record=Recording(every=1))


def train_trajectory(config: DictConfig, overrides: Sequence[str], folder: Path) -> None:
    """Pretrain a DBN, let the machine solve its first RBM once more, and draw its path."""
    plan, solver = prepare(config, overrides)
    n = config.pretrain.iterations
    pretrained(plan, config.seed, torch.device("cpu"))
    assert isinstance(plan.network, DBN)
    assert plan.pretraining is not None
    rbm = plan.network[0]
    with torch.no_grad():
        solution = solver.minimise(from_model(rbm), generator=rng.stream(config.seed, "solver"))
    assert solution.trajectory is not None
    first = tuple(0 for _ in rbm.replicas)
    trajectory = Trajectory(*(values[first] for values in solution.trajectory))
    data = plan.pretraining.data.images.name
    title = f"{data}: {rbm.n_visible}x{rbm.n_hidden} RBM after {n} iterations"
    figure = plot_trajectory(trajectory, title=title)
    save(folder, "figure2", figure)
    reached = int((solution.energies[first] <= solution.energies[first].min() + 1e-6).sum())
    notes = [
        f"{solver.n_restarts} restarts in {solution.wall_time_s:.3f} s, every step recorded (the paper: about "
        f"0.5 s); {reached} of them reached the lowest energy, {float(solution.energies[first].min()):.6g}.",
    ]
    write_text(
        folder / "figure2.json", json.dumps({"title": f"figure2: {title}", "notes": notes}, indent=1) + "\n"
    )
