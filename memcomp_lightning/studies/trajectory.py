"""The path of the machine on an RBM that it trains: Fig. 2 of the paper."""

from pathlib import Path

import torch

from memcomp_lightning import rng
from memcomp_lightning.files import write_json
from memcomp_lightning.models import DBN
from memcomp_lightning.plotting import plot_trajectory
from memcomp_lightning.problems import from_model
from memcomp_lightning.solvers.dmm import DmmSolver, Trajectory
from memcomp_lightning.studies.accuracy import pretrained
from memcomp_lightning.studies.plan import Plan
from memcomp_lightning.studies.report import save


def draw_trajectory(plan: Plan, solver: DmmSolver, *, seed: int, folder: Path) -> None:
    """Pretrain the DBN of a plan, let the machine, which records its path, solve its first RBM, and draw the path.

    The folder gets the picture and what the report says of it.
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
    data = plan.pretraining.data.data_name
    title = f"{data}: {rbm.n_visible}x{rbm.n_hidden} RBM after {n} iterations"
    save(folder, "figure2", plot_trajectory(trajectory, title=title))
    energies = solution.energies[first]
    reached = int((energies <= energies.min() + 1e-6).sum())
    notes = [
        f"{solver.n_restarts} restarts in {solution.wall_time_s:.3f} s, every step recorded (the paper: about "
        f"0.5 s); {reached} of them reached the lowest energy, {float(energies.min()):.6g}."
    ]
    write_json(folder / "figure2.json", {"title": f"figure2: {title}", "notes": notes})
