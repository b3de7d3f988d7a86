"""A model's energy in bits, whatever its units are: what solvers of QUBOs are given, and how answers are read."""

import math
from collections.abc import Sequence
from typing import NamedTuple

import torch
from jaxtyping import Float, Shaped
from torch import Tensor

from memcomp_lightning.models.base import EnergyModel, QuadraticForm
from memcomp_lightning.models.units import Bernoulli, Bits
from memcomp_lightning.types import Configurations


class BitForm(NamedTuple):
    r"""``E = offset + form`` over the bits y, with x = low + width y for the entries that have bits.

    Real units are integrated out exactly: what is left is :math:`-\log \int e^{-E} dv` over them, a quadratic
    form of the units that they are coupled to.

    Attributes:
        form: Couplings and biases of the bits, those of visible entries first; ``pairs`` is None if each hidden
            bit is coupled to each visible one and there are no other couplings.
        offset: ``(*replicas,)``.
        n_first: Bits of visible entries.
        at: Entry of x = (v, h) that each bit stands for, ``(n_bits,)``.
        low: Values where bits are 0, ``(n_bits,)``.
        width: What they gain where bits are 1, ``(n_bits,)``.
        groups: Bits of which exactly one is 1.
    """

    form: QuadraticForm
    offset: Tensor
    n_first: int
    at: Tensor
    low: Tensor
    width: Tensor
    groups: Sequence[Sequence[int]]


@torch.no_grad()
def bit_form(model: EnergyModel) -> BitForm:
    """Write the energy of a model in bits.

    Raises:
        SettingError: The model has units without a form in bits.
    """
    if _in_bits_already(model):  # asked in each update of small models: nothing is looked up or changed
        zero, at = model.b.new_zeros(()), torch.arange(model.n_units, device=model.b.device)
        low, width, offset = zero.expand(at.shape), (zero + 1).expand(at.shape), zero.expand(model.replicas)
        return BitForm(model.quadratic_form(), offset, model.n_visible, at, low, width, [])
    visible, hidden = model.visible.bits(), model.hidden.bits()
    at = torch.cat((visible.at, hidden.at + model.n_visible)).to(model.b.device)
    low, width = (
        torch.cat(pair).to(model.b) for pair in ((visible.low, hidden.low), (visible.width, hidden.width))
    )
    n_first, shift = len(visible.at), len(visible.at)
    groups = [*visible.groups, *([bit + shift for bit in group] for group in hidden.groups)]
    zero = model.b.new_zeros(model.replicas)
    form = model.quadratic_form()
    if form.pairs is None and not _has_real(model):
        changed, offset = _of_layers(form, visible, hidden)
    else:
        changed, offset = _of_pairs(model, form, at, low, width)
    return BitForm(changed, offset, n_first, at, low, width, groups)


def _of_layers(form: QuadraticForm, visible: Bits, hidden: Bits) -> tuple[QuadraticForm, Tensor]:
    """Of an RBM without real units: still one matrix between two layers."""
    weight, n = form.coupling, form.coupling.shape[-1]
    b, c = form.bias[..., :n], form.bias[..., n:]
    low_v, width_v, low_h, width_h = (x.to(weight) for x in (visible.low, visible.width, hidden.low, hidden.width))
    of_v, of_h = b + low_h @ weight, c + weight @ low_v
    coupling = weight * width_h.unsqueeze(-1) * width_v
    bias = torch.cat((of_v * width_v, of_h * width_h), dim=-1)
    return QuadraticForm(None, coupling, bias), -(of_v * low_v).sum(-1) - (c * low_h).sum(-1)


def _of_pairs(
    model: EnergyModel, form: QuadraticForm, at: Tensor, low: Tensor, width: Tensor
) -> tuple[QuadraticForm, Tensor]:
    """Of any model, by its matrix of couplings; only pairs that may be other than zero are kept."""
    bias = form.bias
    real = _real_entries(model).nonzero().flatten()
    constant = bias.new_zeros(model.replicas)
    among, linked = _between(model, form, at, at)
    field = bias[..., at]
    if len(real):
        precision = _curvature(model)[..., real]
        (across, touches), own = _between(model, form, at, real), bias[..., real]
        over = across / precision.unsqueeze(-2)
        among = among + over @ across.mT
        field = field + (over @ own.unsqueeze(-1)).squeeze(-1)
        linked = linked | (touches.float() @ touches.float().mT > 0)
        constant = -0.5 * (own.square() / precision + torch.log(2 * math.pi / precision)).sum(-1)
    # E = constant - field.x - x'Ax / 2 with x = low + width y, and y^2 = y on the diagonal.
    pull = (among @ low.unsqueeze(-1)).squeeze(-1)
    offset = constant - (field * low).sum(-1) - 0.5 * (pull * low).sum(-1)
    of_bits = width * (field + pull) + 0.5 * among.diagonal(dim1=-2, dim2=-1) * width.square()
    pairs = linked.triu(diagonal=1).nonzero()
    first, second = pairs[:, 0], pairs[:, 1]
    return QuadraticForm(pairs, among[..., first, second] * width[first] * width[second], of_bits), offset


def _between(
    model: EnergyModel, form: QuadraticForm, rows: Tensor, columns: Tensor
) -> tuple[Float[Tensor, "*replicas rows columns"], Tensor]:
    """Couplings of some entries, visible ones first, to others, and which of them there are."""
    n, n_visible = model.n_units, model.n_visible
    matrix = form.coupling.new_zeros(*model.replicas, len(rows), len(columns))
    adjacent = torch.zeros(len(rows), len(columns), dtype=torch.bool, device=matrix.device)
    if form.pairs is None:
        v, w = (int((entries < n_visible).sum()) for entries in (rows, columns))
        hidden_rows, hidden_columns = rows[v:] - n_visible, columns[w:] - n_visible
        matrix[..., v:, :w] = form.coupling[..., hidden_rows, :][..., columns[:w]]
        matrix[..., :v, w:] = form.coupling[..., hidden_columns, :][..., rows[:v]].mT
        adjacent[v:, :w] = adjacent[:v, w:] = True
        return matrix, adjacent
    row_of, column_of = (_place_in(entries, n) for entries in (rows, columns))
    for pairs in (form.pairs, form.pairs.flip(-1)):
        first, second = row_of[pairs[:, 0]], column_of[pairs[:, 1]]
        inside = (first >= 0) & (second >= 0)
        matrix[..., first[inside], second[inside]] = form.coupling[..., inside]
        adjacent[first[inside], second[inside]] = True
    return matrix, adjacent


def _place_in(entries: Tensor, n: int) -> Tensor:
    """The place of each unit among some of them, ``(n,)``; -1 of the others."""
    place = torch.full((n,), -1, device=entries.device)
    place[entries] = torch.arange(len(entries), device=entries.device)
    return place


def _in_bits_already(model: EnergyModel) -> bool:
    return type(model.visible) is Bernoulli and type(model.hidden) is Bernoulli


@torch.no_grad()
def read_bits(model: EnergyModel, form: BitForm, y: Shaped[Tensor, "*replicas n n_bits"]) -> Configurations:
    """Configurations of a model at bits; real units stand at their means given the others."""
    if _in_bits_already(model):
        x = y.to(form.low)
        return Configurations(x[..., : model.n_visible], x[..., model.n_visible :])
    x = form.low.new_zeros(*y.shape[:-1], model.n_units)
    x[..., form.at] = form.low + form.width * y.to(form.low)
    return at_real_means(model, Configurations(x[..., : model.n_visible], x[..., model.n_visible :]))


@torch.no_grad()
def at_real_means(model: EnergyModel, configurations: Configurations) -> Configurations:
    """Configurations with real units at their likeliest values given the others."""
    if not _has_real(model):
        return configurations
    x, n = torch.cat(configurations[:2], dim=-1), model.n_visible
    _set_real(model, x)
    return configurations._replace(v=x[..., :n], h=x[..., n:])


@torch.no_grad()
def descend(model: EnergyModel, configurations: Configurations) -> Configurations:
    """Set each class of units to its likeliest values given the others, in turn, until no energy falls.

    No configuration ends with a higher energy; one with a site in no state or in several gets a state there first.
    """
    x = torch.cat(configurations[:2], dim=-1)
    blocks, n = model.blocks(), model.n_visible
    energy = torch.full(x.shape[:-1], torch.inf, dtype=x.dtype, device=x.device)
    while True:
        for block in blocks:
            x[..., block.units] = block.kind.mode(block.field(x))
        now = model.energy(x[..., :n], x[..., n:])
        if not bool((now < energy - 1e-6 * energy.abs().nan_to_num(posinf=0.0)).any()):
            break
        energy = now
    return configurations._replace(v=x[..., :n], h=x[..., n:])


@torch.no_grad()
def with_real_spread(model: EnergyModel, configurations: Configurations) -> Configurations:
    """Configurations whose real units stand for their distribution given the others: two points each.

    The first points of all configurations come first, then the second ones.
    """
    if not _has_real(model):
        return configurations
    x, found, n = torch.cat(configurations[:2], dim=-1), [], model.n_visible
    n_points = _n_points(model, x)
    for number in range(n_points):
        moved = x.clone()
        _set_real(model, moved, number)
        found.append(moved)
    x, weight = torch.cat(found, dim=-2), configurations.weight
    return Configurations(
        x[..., :n], x[..., n:], None if weight is None else torch.cat([weight] * n_points, dim=-1)
    )


@torch.no_grad()
def integrated_energy(model: EnergyModel, configurations: Configurations) -> Float[Tensor, "*replicas n"]:
    r"""``-\log \int e^{-E}`` over the real units, which are not coupled to each other; E where there are none.

    It is what the form in bits has as its energy. Of normally distributed units it is E at their means less
    ``log(2 pi / precision) / 2`` each.
    """
    x, n = torch.cat(configurations[:2], dim=-1), model.n_visible
    if not _has_real(model):
        return model.energy(x[..., :n], x[..., n:])
    x = x.masked_fill(_real_entries(model), 0.0)
    energy = model.energy(x[..., :n], x[..., n:])
    for block in model.blocks():
        if block.kind.real:
            at = block.kind.site_of()[block.kind.real_entries()].to(x.device)
            energy = energy - block.kind.cumulant(block.field(x))[..., at].sum(-1)
    return energy


def _has_real(model: EnergyModel) -> bool:
    return model.visible.real or model.hidden.real


def _curvature(model: EnergyModel) -> Float[Tensor, "*replicas n"]:
    """Precision of each unit, zero for those that are not real."""
    layers = (model.visible, model.n_visible), (model.hidden, model.n_hidden)
    return torch.cat(
        [
            model.b.new_zeros(*model.replicas, n) if (own := units.curvature) is None else own
            for units, n in layers
        ],
        dim=-1,
    )


def _real_entries(model: EnergyModel) -> Tensor:
    """Which units are real numbers, ``(n_units,)`` bool."""
    return torch.cat([units.real_entries() for units in (model.visible, model.hidden)]).to(model.b.device)


def _n_points(model: EnergyModel, x: Tensor) -> int:
    """Points that real units have at one state of the others."""
    real = [block for block in model.blocks() if block.kind.real]
    return math.lcm(*(len(block.kind.points(block.field(x[..., :1, :]))) for block in real))


def _set_real(model: EnergyModel, x: Tensor, point: int | None = None) -> None:
    """Set the real units to their modes given the others, or to one of their points, in place."""
    for block in model.blocks():
        if block.kind.real:
            field = block.field(x)
            points = [block.kind.mode(field)] if point is None else block.kind.points(field)
            values = points[(point or 0) % len(points)]
            at = block.kind.real_entries().to(x.device)
            x[..., block.units[at]] = values[..., at]
