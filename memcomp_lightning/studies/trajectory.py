"""The path of the machine on an RBM that it trains: Fig. 2 of the paper."""

import json
from pathlib import Path

import torch

from memcomp_lightning import rng
from memcomp_lightning.files import write_text
from memcomp_lightning.models import DBN
from memcomp_lightning.plotting import plot_trajectory
from memcomp_lightning.problems import from_model
from memcomp_lightning.solvers.dmm import DmmSolver, Trajectory
from memcomp_lightning.studies.accuracy import pretrained
from memcomp_lightning.studies.plan import Plan
from memcomp_lightning.studies.report import save


def draw_trajectory(plan: Plan, solver: DmmSolver, *, seed: int, folder: Path) -> None:
    """Pretrain a DBN, let the machine solve its first RBM once more, and draw its path.

    Args:
        plan: The run, with pretraining of a DBN.
        solver: The machine, which records its path.
        seed: Of the pretraining and of the machine.
        folder: Where the picture goes.
    """
    pretrained(plan, seed, torch.device("cpu"))
    assert isinstance(plan.network, DBN)
    assert plan.pretraining is not None
    rbm, n = plan.network[0], plan.pretraining.module.iterations
    with torch.no_grad():
        solution = solver.minimise(from_model(rbm), generator=rng.stream(seed, "solver"))
    assert isinstance(solution.trajectory, Trajectory)
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
