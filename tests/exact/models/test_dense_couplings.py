"""Machines with most pairs coupled keep their couplings in one matrix: the same numbers as sums over the pairs."""

import pytest
import torch

from memcomp_lightning import rng
from memcomp_lightning.models import RBM, BoltzmannMachine
from memcomp_lightning.models.init import Normal
from memcomp_lightning.models.units import Bernoulli, Categorical, Spin, side_by_side

KINDS = {
    "bits": lambda: Bernoulli(5),
    "spins": lambda: Spin(4),
    "categories": lambda: Categorical([2, 3, 4]),
    "both": lambda: side_by_side(Categorical([3, 2]), Spin(2)),
}


def machine_of(kind, replicas=(), connectivity=None):
    visible = KINDS[kind]()
    machine = BoltzmannMachine(
        visible=visible, n_hidden=2, connectivity=connectivity, replicas=replicas, weight_init=Normal(std=1.0)
    ).double()
    with torch.no_grad():
        for bias in (machine.b, machine.c):
            bias.copy_(Normal(std=1.0)(bias.shape, generator=rng.stream(0, "bias")))
    return machine


def rows_of(machine, n=7):
    generator = rng.stream(1, "rows")
    parts = [
        units.sample(torch.zeros(*machine.replicas, n, units.n, dtype=torch.float64), generator=generator)
        for units in (machine.visible, machine.hidden)
    ]
    weight = rng.uniform((*machine.replicas, n), generator=generator, like=parts[0]) - 0.5
    return *parts, weight - weight.mean(-1, keepdim=True)


@pytest.mark.parametrize("replicas", [(), (2,)])
@pytest.mark.parametrize("kind", KINDS)
def test_fields_are_sums_over_the_pairs(kind, replicas):
    machine = machine_of(kind, replicas)
    assert machine._dense
    v, h, _ = rows_of(machine)
    x = torch.cat((v, h), dim=-1)
    expected = machine.bias.unsqueeze(-2).expand_as(x).clone()
    for number, (i, j) in enumerate(machine.pairs.tolist()):
        coupling = machine.coupling[..., number].unsqueeze(-1)
        expected[..., i] += coupling * x[..., j]
        expected[..., j] += coupling * x[..., i]
    for block in machine.blocks():
        torch.testing.assert_close(block.field(x), expected[..., block.units])
        assert block.to_all
        alone = block._replace(couplings=block.weight)
        assert not alone.to_all
        torch.testing.assert_close(alone.field(x), expected[..., block.units])


@pytest.mark.parametrize("replicas", [(), (2,)])
@pytest.mark.parametrize("kind", KINDS)
def test_sums_of_energies_are_those_of_each_row(kind, replicas):
    machine = machine_of(kind, replicas)
    v, h, weight = rows_of(machine)
    total = machine.total_energy(v, h, weight)
    torch.testing.assert_close(total, (weight * machine.energy(v, h)).sum(-1))
    given = torch.autograd.grad(total.sum(), list(machine.parameters()))
    expected = torch.autograd.grad((weight * machine.energy(v, h)).sum(), list(machine.parameters()))
    for one, other in zip(given, expected, strict=True):
        torch.testing.assert_close(one, other)


@pytest.mark.parametrize("make", [lambda: machine_of("both", (2,)), lambda: machine_of("bits", (), ring()), "rbm"])
def test_the_value_of_the_centred_energy_is_the_plain_one(make):
    machine = RBM(4, 3, replicas=(2,), weight_init=Normal(std=1.0)).double() if make == "rbm" else make()
    v, h, weight = rows_of(machine)
    offsets = v.mean(-2) + 0.3, h.mean(-2) - 0.2
    value = machine.centred_total_energy(v, h, weight, *offsets)
    torch.testing.assert_close(value, machine.total_energy(v, h, weight))


def ring():
    """Seven units, each coupled to the next one: no matrix."""
    return [(i, (i + 1) % 7) for i in range(7)]


def test_few_pairs_stand_in_no_matrix():
    machine = machine_of("bits", (), ring())
    assert not machine._dense
    assert not any(block.to_all for block in machine.blocks())
