"""The paper's negative phase: the ground state of the model, from any QUBO solver."""

from dataclasses import dataclass
from typing import ClassVar, Literal

import torch
from torch import Generator, Tensor

from memcomp_lightning.errors import require, require_choice, require_parts
from memcomp_lightning.models.base import EnergyModel, as_two_layers
from memcomp_lightning.models.bit_form import read_bits, with_real_spread
from memcomp_lightning.problems.from_model import from_bit_form
from memcomp_lightning.samplers.one_hot import minimise_in_groups
from memcomp_lightning.solvers.base import QuboSolution, QuboSolver, Status
from memcomp_lightning.types import Configurations, NegativePhase, NoState


@dataclass(frozen=True, kw_only=True, slots=True)
class GroundState:
    """Takes the state of lowest energy as the negative phase (Manukian et al. 2019, section 3.2).

    Each update the solver gets the energy as a QUBO, and its answer stands for the expectation under the model.
    Of categorical units it gets a bit a state with a penalty a site, and its answers descend to where no class of
    units alone can improve them (:mod:`~memcomp_lightning.samplers.one_hot`). Real units are integrated out.

    Attributes:
        solver: Finds low energies of the QUBO.
        readout: "best" uses the best assignment x* as a one-point distribution, as the paper's figures do;
            "time_average" weights the assignments of the recorded trajectory by the time spent in them, over
            the low-energy stretch of each restart, the paper's <x(t)>, and needs a solver that records one.
    """

    uses_data: ClassVar[bool] = False
    shared: ClassVar[bool] = True

    solver: QuboSolver
    readout: Literal["best", "time_average"] = "best"

    def __post_init__(self) -> None:
        require_choice("readout", self.readout, ("best", "time_average"))
        require_parts("solver", self.solver, "solver of QUBOs", ("minimise",))
        if self.readout == "time_average":
            kind, records = type(self.solver).__name__, getattr(self.solver, "record", None) is not None
            allowed = "a solver that records its trajectory, for readout = 'time_average'"
            remedy = "Use DmmSolver(record=Recording(every=8)), or readout = 'best'."
            require(records, "solver", kind, allowed, remedy)

    def init(self, model: EnergyModel, n_chains: int, *, generator: Generator) -> NoState:
        """Nothing to remember: every update solves a new problem.

        Raises:
            SettingError: The model has units without a form in bits, or sites whose constraints a trajectory
                breaks.
        """
        form = model.in_bits()
        allowed = "'best' for categorical units: states on the way to an answer break their constraints"
        require(self.readout == "best" or not form.groups, "readout", self.readout, allowed)
        return NoState()

    @torch.no_grad()
    def sample(
        self, model: EnergyModel, state: NoState, positive: Configurations, *, generator: Generator
    ) -> NegativePhase[NoState]:
        """Return x* or the weighted trajectory; real units stand at two points around their means."""
        posed, order = posed_as(model)
        form = posed.in_bits()
        if form.groups:
            solution, found, info = minimise_in_groups(posed, form, self.solver, generator=generator)
        else:
            solution, info = self.solver.minimise(from_bit_form(form), generator=generator), {}
            bits, weight = self._read(solution, model.b.dtype)
            found = read_bits(posed, form, bits)._replace(weight=weight)
        v, h, weight = with_real_spread(posed, found)
        if order is not None:
            v, h = torch.cat((v, h), dim=-1)[..., order].split((model.n_visible, model.n_hidden), dim=-1)
        return NegativePhase(Configurations(v, h, weight), state, _diagnostics(solution) | info)

    def _read(self, solution: QuboSolution, dtype: torch.dtype) -> tuple[Tensor, Tensor | None]:
        """Bits that stand for the ground state, ``(*replicas, n, n_bits)``, and their weights."""
        if self.readout == "best":
            return solution.best.unsqueeze(-2), None
        visited = solution.trajectory
        if visited is None:
            raise ValueError(
                "readout = 'time_average' needs a trajectory, but the solver returned none: let it record one."
            )
        return visited.assignments.flatten(-3, -2), visited.weights().flatten(-2).to(dtype)


def posed_as(model: EnergyModel) -> tuple[EnergyModel, Tensor | None]:
    """The model that a solver is given, and where in its units the model's own are; None if in their places.

    A machine whose couplings fill most of the matrix between two classes, a DBM, is posed as an RBM: solvers are
    much faster on a matrix than on a list of pairs.
    """
    pairs, classes = model.quadratic_form().pairs, model.classes
    if pairs is not None and len(classes) == 2 and len(pairs) > 0.5 * len(classes[0]) * len(classes[1]):
        return as_two_layers(model).rbm, torch.cat(list(classes)).argsort()
    return model, None


def _diagnostics(solution: QuboSolution) -> dict[str, Tensor]:
    """Numbers worth a curve; infinite energies of restarts that were not run are left out."""
    was_run = solution.status != Status.NOT_RUN
    n_run = was_run.sum(-1)
    best = solution.best_energy
    reached = (solution.energies <= (best + 1e-6 * best.abs()).unsqueeze(-1)).sum(-1)
    return {
        "ground_state_energy": best,
        "restarts_run": n_run.double(),
        "restarts_at_best": reached.float() / n_run,
        "solver_seconds": torch.tensor(solution.wall_time_s, dtype=torch.float32, device="cpu"),
    }
