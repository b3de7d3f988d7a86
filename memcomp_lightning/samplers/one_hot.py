"""Ground states of models with categorical units, from solvers that know no constraints."""

from dataclasses import replace
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Generator, Tensor

from memcomp_lightning.arrays import as_array
from memcomp_lightning.models.base import EnergyModel
from memcomp_lightning.models.bit_form import BitForm, descend, read_bits
from memcomp_lightning.models.units import side_by_side
from memcomp_lightning.problems.constrained import Constrained, Constraints, exactly
from memcomp_lightning.problems.from_model import from_bit_form
from memcomp_lightning.problems.maxsat import as_qubo
from memcomp_lightning.solvers.base import QuboSolution, QuboSolver, Status
from memcomp_lightning.solvers.constrained import safe_penalty
from memcomp_lightning.solvers.groups import N_GUIDES, shifted, table_of
from memcomp_lightning.types import Configurations


class Answers(NamedTuple):
    """What a solver found of a problem in groups of bits.

    Attributes:
        solution: Answers that keep all constraints: those of the solver, descended.
        best: The lowest configuration of all, one a replica, ``(*replicas, 1, n)``.
        info: ``ground_state_energy``, that of ``best``; ``feasible_sites``, the share of the groups that the
            solver's own answers have one bit in; ``gain_over_descents``, how far its best answer is below the best
            descent from a random state.
    """

    solution: QuboSolution
    best: Configurations
    info: dict[str, Tensor]


@torch.no_grad()
def minimise_in_groups(model: EnergyModel, form: BitForm, solver: QuboSolver, *, generator: Generator) -> Answers:
    """Minimise a model's energy over bits of which exactly one in each group is 1.

    The solver is given small penalties (:mod:`~memcomp_lightning.solvers.groups`). Its answers descend class by
    class in the model, which mends what is left; so do the states that the penalties are read from, and the lowest
    of all counts. Where the solver proves a minimum that breaks a constraint, it is called again with penalties
    with which that never pays.
    """
    plain, guides = from_bit_form(form), _descents(model, generator)
    constraints = Constraints.of(plain.n, [exactly(1, group) for group in form.groups])
    objective, penalties = shifted(plain, table_of(constraints), bits_of(form, guides))
    problem = Constrained(objective, constraints)
    solution = solver.minimise(as_qubo(problem.penalised(as_array(penalties))), generator=generator)
    broken = problem.n_broken(solution.assignments)
    proven = solution.status == int(Status.OPTIMAL)
    if bool((proven & (broken > 0)).any()):
        safe = torch.as_tensor(safe_penalty(problem), dtype=penalties.dtype, device=penalties.device)
        given = as_qubo(problem.penalised(as_array(safe.expand_as(penalties).contiguous())))
        solution = solver.minimise(given, generator=generator)
        broken = problem.n_broken(solution.assignments)
        proven = solution.status == int(Status.OPTIMAL)
    found = descend(model, read_bits(model, form, solution.assignments))
    assignments, was_run = bits_of(form, found), solution.status != int(Status.NOT_RUN)
    energies = torch.where(was_run, plain.energy(assignments), torch.inf)
    status = torch.where(proven & (broken > 0), int(Status.CONVERGED), solution.status)
    descended = replace(solution, assignments=assignments, energies=energies, status=status)
    of_guides = plain.energy(bits_of(form, guides))
    states = [torch.cat(pair, dim=-2) for pair in zip(found[:2], guides[:2], strict=True)]
    lowest = torch.cat((energies, of_guides), dim=-1).argmin(-1)[..., None, None]
    best = Configurations(*(x.take_along_dim(lowest, dim=-2) for x in states))
    share = (broken * was_run).sum(-1) / (was_run.sum(-1) * len(form.groups))
    of_solver, of_descents = energies.amin(-1), of_guides.amin(-1)
    info = {
        "ground_state_energy": torch.minimum(of_solver, of_descents),
        "feasible_sites": 1 - share.float(),
        "gain_over_descents": of_descents - of_solver,
    }
    return Answers(descended, best, info)


def bits_of(form: BitForm, configurations: Configurations) -> Float[Tensor, "*replicas n n_bits"]:
    """Bits of configurations in states of their units: the inverse of :func:`read_bits`."""
    x = torch.cat(configurations[:2], dim=-1)[..., form.at]
    return ((x - form.low) / form.width).round()


def _descents(model: EnergyModel, generator: Generator) -> Configurations:
    """Random states, descended."""
    layer = side_by_side(model.visible, model.hidden)
    x = layer.sample(model.b.new_zeros(*model.replicas, N_GUIDES, model.n_units), generator=generator)
    return descend(model, Configurations(x[..., : model.n_visible], x[..., model.n_visible :]))
