"""The path of a memcomputing machine that solves the model in training, as a figure in TensorBoard."""

import lightning.pytorch as pl
from torch import Tensor

from memcomp_lightning import rng
from memcomp_lightning.callbacks.base import EveryIterations, model_of, tensorboards, write_picture
from memcomp_lightning.errors import SettingError, require, require_count
from memcomp_lightning.plotting.rendering import rendered
from memcomp_lightning.plotting.trajectory import plot_trajectory
from memcomp_lightning.problems import Qubo, from_model
from memcomp_lightning.solvers import QuboSolver
from memcomp_lightning.solvers.dmm import DmmSolver, Recording, Trajectory


class TrajectoryFigure(EveryIterations):
    """Draws how a memcomputing machine finds the ground state of the first replica, as picture ``trajectory``.

    The picture is that of Manukian et al. 2019, Fig. 2, by :func:`memcomp_lightning.plotting.plot_trajectory`. The
    machine has a random stream of its own and the same start each time, so that pictures compare, and runs on the
    CPU; training does not see it. Spins are written in bits, real units are integrated out; of categories, whose
    machine repeats until their constraints hold, there is no one trajectory, and no picture, nor is there of units
    without a form in bits. A large model costs seconds a picture; without TensorBoard nothing is solved.

    Args:
        every: Passes between two pictures, >= 1.
        solver: Records its trajectory; None is ``DmmSolver(n_restarts=3, record=Recording(every=1))``.
        last: Restarts in the large panel, >= 1.
        seed: Seed of the machine's start.
    """

    def __init__(self, every: int = 100, solver: QuboSolver | None = None, last: int = 3, seed: int = 0) -> None:
        super().__init__(every)
        self.solver = DmmSolver(n_restarts=3, record=Recording(every=1)) if solver is None else solver
        records = getattr(self.solver, "record", None) is not None
        wanted, remedy = "a solver that records its trajectory", "Use DmmSolver(record=Recording(every=1))."
        require(records, "solver", type(self.solver).__name__, f"{wanted}, for TrajectoryFigure", remedy)
        require_count("last", last)
        self.last = last
        self.seed = seed

    def look(self, trainer: pl.Trainer, pl_module: pl.LightningModule, outputs: object) -> None:
        """Solve, and draw."""
        if not tensorboards(trainer):
            return
        model = model_of(pl_module)
        try:
            constrained = any(units.n and units.bits().groups for units in (model.visible, model.hidden))
            problem = _first(from_model(model))
        except SettingError as error:
            self.leave_out(str(error))
            return
        if constrained:
            self.leave_out("the ground state of categories is found by several runs of the machine")
            return
        solution = self.solver.minimise(problem, generator=rng.stream(self.seed, "trajectory"))
        if not isinstance(solution.trajectory, Trajectory):
            raise TypeError(f"{type(self.solver).__name__} returned no trajectory for TrajectoryFigure to draw.")
        title = f"lowest energy {solution.best_energy.item():.4g}"
        figure = plot_trajectory(solution.trajectory, last=self.last, title=title)
        write_picture(trainer, pl_module, "trajectory", rendered(figure))


def _first(problem: Qubo) -> Qubo:
    """The first of the problems, on the CPU."""
    n_axes = len(problem.problems)

    def first(tensor: Tensor) -> Tensor:
        return tensor.flatten(0, n_axes - 1)[0].cpu() if n_axes else tensor.cpu()

    return Qubo(problem.graph, first(problem.coupling), first(problem.linear), first(problem.offset))
