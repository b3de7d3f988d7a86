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
from memcomp_lightning.problems.constrained import Constrained, exactly
from memcomp_lightning.problems.from_model import from_bit_form
from memcomp_lightning.problems.maxsat import as_qubo
from memcomp_lightning.problems.qubo import Qubo
from memcomp_lightning.solvers.base import QuboSolution, QuboSolver, Status
from memcomp_lightning.solvers.constrained import safe_penalty
from memcomp_lightning.types import Configurations

N_GUIDES = 64
"""Descents from random states, from which the penalties are read."""

MARGIN = 0.1
"""What a penalty exceeds the largest gain by, as a share of the mean cost of a second state."""


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
    r"""Minimise a model's energy over bits of which exactly one in each group is 1.

    The energy :math:`t_g (\sum_{i \in g} y_i - 1)` of any number t is zero where the constraint of group g holds.
    t is chosen, from states of low energy, halfway between the cost of a second bit and the gain by the one there
    is: then a small penalty :math:`P_g (\sum y_i - 1)^2` suffices, and it hides the least of the objective.
    The answers descend class by class in the model, which mends what is left; so do the states that the penalties
    are read from, and the lowest of all counts. A minimum that the solver proves and that breaks a constraint is
    sought again with penalties with which that never pays.
    """
    plain = from_bit_form(form)
    guides = _descents(model, generator)
    shift, penalties = _penalties(form, plain, bits_of(form, guides))
    shifted = _shifted(plain, form, shift)
    problem = Constrained.of(shifted, [exactly(1, group) for group in form.groups])
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


def _penalties(form: BitForm, qubo: Qubo, y: Tensor) -> tuple[Tensor, Tensor]:
    """The number t and the penalty P of each group, ``(*replicas, n_groups)`` both, from states of low energy."""
    widest = max(map(len, form.groups))
    table = torch.tensor([[*group, *[-1] * (widest - len(group))] for group in form.groups], device=y.device)
    # Energy of the bit at 1 less that at 0: of the one that is on, and of the cheapest other one.
    cost, on = qubo.field(y)[..., table], y[..., table] > 0.5
    absent = table < 0
    there = torch.where(on & ~absent, cost, 0.0).sum(-1)
    second = torch.where(on | absent, torch.inf, cost).amin(-1)
    second = torch.where(second.isinf(), there, second)
    shift = -(there + second).mean(-2) / 2
    needed = torch.maximum(there + shift.unsqueeze(-2), -second - shift.unsqueeze(-2)).amax(-2).clamp(min=0)
    apart = (second - there).abs().mean((-2, -1), keepdim=True).squeeze(-1)
    return shift, needed + MARGIN * apart + torch.finfo(y.dtype).tiny


def _shifted(qubo: Qubo, form: BitForm, shift: Tensor) -> Qubo:
    """The problem with ``t (sum of the bits - 1)`` added for each group."""
    sizes = torch.tensor([len(group) for group in form.groups], device=shift.device)
    bits = torch.tensor([bit for group in form.groups for bit in group], device=shift.device)
    linear = qubo.linear.index_add(-1, bits, shift.repeat_interleave(sizes, dim=-1))
    return Qubo(qubo.graph, qubo.coupling, linear, qubo.offset - shift.sum(-1))
