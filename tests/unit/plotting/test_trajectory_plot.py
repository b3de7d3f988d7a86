"""The picture of a trajectory: what stands where, and that nothing else is touched."""

import sys

import matplotlib as mpl
import numpy as np
import pytest
import torch

from memcomp_lightning import rng
from memcomp_lightning.errors import SettingError
from memcomp_lightning.plotting import plot_trajectory
from memcomp_lightning.problems import Qubo, from_qubo
from memcomp_lightning.solvers.dmm import DmmSolver, Recording, Trajectory


def trajectory_of(weight, dwell=None, found=None):
    """A record each unit of time."""
    weight = torch.tensor(weight, dtype=torch.float64)
    found = torch.full_like(weight, torch.inf) if found is None else torch.tensor(found, dtype=torch.float64)
    dwell = torch.ones_like(weight) if dwell is None else torch.tensor(dwell, dtype=torch.float64)
    assignments = torch.zeros(*weight.shape, 4, dtype=torch.bool)
    return Trajectory(dwell.cumsum(-1) * (dwell > 0), weight, assignments, dwell, found)


BEST = "best so far,\nwith descents"
FIVE = trajectory_of([[9, 5, 4], [8, 6, 5], [7, 3, 3], [9, 8, 7], [6, 2, 4]])


def lines(axes):
    return {line.get_label(): np.column_stack(line.get_data()) for line in axes.get_lines()}


def test_restarts_follow_one_another_and_the_best_never_rises():
    (axes,) = plot_trajectory(FIVE, last=5).axes
    machine, best = lines(axes)["machine"], lines(axes)[BEST]
    assert machine[:, 0].tolist() == list(range(1, 16))
    assert machine[:, 1].tolist() == [9, 5, 4, 8, 6, 5, 7, 3, 3, 9, 8, 7, 6, 2, 4]
    assert best[:, 1].tolist() == [9, 5, 4, 4, 4, 4, 4, 3, 3, 3, 3, 3, 3, 2, 2]


def test_the_best_counts_what_descents_have_found():
    inf = float("inf")
    (axes,) = plot_trajectory(trajectory_of([[9, 5, 4], [8, 6, 5]], found=[[inf, 3, 3], [inf, inf, 2]])).axes
    drawn = lines(axes)
    assert drawn["machine"][:, 1].tolist() == [9, 5, 4, 8, 6, 5]
    assert drawn[BEST][:, 1].tolist() == [9, 3, 3, 3, 3, 2]
    low, _ = axes.get_ylim()
    assert low < 2


@pytest.mark.parametrize("kernel", ["compiled", "reference"])
@pytest.mark.parametrize("patience", [None, 2])
@pytest.mark.parametrize("every", [1, 7, 40])
def test_the_best_ends_at_the_solvers_answer(kernel, patience, every):
    qubo = Qubo.from_matrix(np.random.default_rng(0).normal(size=(16, 16)))
    solver = DmmSolver(n_restarts=4, patience=patience, max_steps=40, record=Recording(every=every), kernel=kernel)
    solution = solver.minimise(qubo, generator=np.random.default_rng(1))
    (axes,) = plot_trajectory(solution.trajectory, last=4).axes
    best = lines(axes)[BEST][:, 1]
    assert best[-1] + from_qubo(qubo).offset == pytest.approx(solution.best_energy, rel=1e-12)
    assert (lines(axes)["machine"][:, 1] >= best - 1e-9).all()


def test_main_panel_has_the_last_restarts_and_the_inset_all_with_a_box_around_them():
    figure = plot_trajectory(FIVE, last=3, title="five")
    (axes,) = figure.axes
    (inset,) = axes.child_axes
    assert lines(axes)["machine"][:, 0].tolist() == list(range(7, 16))
    assert lines(axes)[BEST][0, 1] == 4, "the best of the restarts before counts"
    assert len(lines(inset)["machine"]) == 15
    (box,) = inset.patches
    assert (box.get_x(), box.get_x() + box.get_width()) == (6, 15)
    assert box.get_y() < 2
    assert box.get_y() + box.get_height() > 9
    assert axes.get_title(loc="left") == "five"
    assert "machine time" in axes.get_xlabel()
    assert "weight of unsatisfied clauses" in axes.get_ylabel()


@pytest.mark.parametrize("n_restarts", [1, 2, 3])
def test_no_inset_where_all_is_in_the_main_panel(n_restarts):
    (axes,) = plot_trajectory(Trajectory(*(field[:n_restarts] for field in FIVE))).axes
    assert axes.child_axes == []


def test_restarts_that_were_not_run_are_left_out():
    dwell = [[2, 2, 2], [0, 0, 0], [1, 1, 0]]
    (axes,) = plot_trajectory(trajectory_of([[9, 5, 4], [0, 0, 0], [8, 6, 0]], dwell)).axes
    machine = lines(axes)["machine"]
    assert machine.tolist() == [[2, 9], [4, 5], [6, 4], [7, 8], [8, 6]]


@pytest.mark.parametrize(
    ("weight", "kind"),
    [
        ([[3.0, 3.0]] * 4, "png"),
        ([[0.0]] * 4, "png"),
        ([[1e12, 1e9]] * 4, "png"),
        ([[3.0, 3.0]] * 4, "svg"),
        ([[3.0, 3.0]] * 4, "pdf"),
    ],
    ids=["flat", "zero", "large", "svg", "pdf"],
)
def test_any_range_is_drawn(tmp_path, weight, kind):
    plot_trajectory(trajectory_of(weight)).savefig(tmp_path / f"picture.{kind}")
    assert (tmp_path / f"picture.{kind}").stat().st_size > 1000


def test_recorded_by_the_machine(tmp_path):
    qubo = Qubo.from_matrix(torch.tensor([[1.0, -3.0, 2.0], [0.0, 1.0, -1.0], [0.0, 0.0, 0.5]]))
    solver = DmmSolver(n_restarts=7, patience=2, max_steps=40, record=Recording(every=2))
    solution = solver.minimise(qubo, generator=rng.stream(0, "solver"))
    figure = plot_trajectory(solution.trajectory)
    figure.savefig(tmp_path / "picture.png")
    assert len(lines(figure.axes[0])["machine"]) == 3 * 20


def test_pyplot_and_its_settings_are_not_touched():
    before, pyplot = dict(mpl.rcParams), sys.modules.get("matplotlib.pyplot")
    figure = plot_trajectory(FIVE)
    assert dict(mpl.rcParams) == before
    assert sys.modules.get("matplotlib.pyplot") is pyplot
    if pyplot is not None:
        assert figure not in [pyplot.figure(number) for number in pyplot.get_fignums()]


def test_what_cannot_be_drawn_is_refused():
    with pytest.raises(
        SettingError, match=r"\(1, 5, 3\) is not allowed: expected \(n_restarts, n_records\).*Take one"
    ):
        plot_trajectory(Trajectory(*(field[None] for field in FIVE)))
    with pytest.raises(SettingError, match="expected at least one record of dwell > 0"):
        plot_trajectory(trajectory_of([[0.0, 0.0]], [[0.0, 0.0]]))
    with pytest.raises(SettingError, match="last = 0 is not allowed: expected an integer >= 1"):
        plot_trajectory(FIVE, last=0)
