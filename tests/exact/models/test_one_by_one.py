"""Bits and spins that are all coupled, drawn one by one in few operations, against class by class."""

import pytest
import torch

from memcomp_lightning import rng
from memcomp_lightning.models import BoltzmannMachine, Normal
from memcomp_lightning.models.connectivity import full, grid, semi_restricted
from memcomp_lightning.models.one_by_one import OneByOne, in_runs
from memcomp_lightning.models.units import Bernoulli, Categorical, Mixed, Spin

LAYERS = {
    "bits": (Bernoulli(9), Bernoulli(5)),
    "spins": (Spin(9), Spin(5)),
    "spins above bits": (Bernoulli(9), Spin(5)),
    "bits and spins": (Mixed(Bernoulli(4), Spin(5)), Bernoulli(5)),
    "categories between": (Mixed(Bernoulli(4), Categorical([3]), Spin(4)), Bernoulli(5)),
}


def drawn(visible, hidden, pairs, replicas):
    generator = rng.stream(0, "machine")
    init = Normal(std=0.7)
    model = BoltzmannMachine(
        visible=visible,
        hidden=hidden,
        connectivity=pairs,
        replicas=replicas,
        weight_init=init,
        generator=generator,
    )
    with torch.no_grad():
        model.b.normal_(generator=generator)
        model.c.normal_(generator=generator)
    return model.double()


def swept(parts, x, beta, base):
    x, generator = x.clone(), rng.stream(3, "sweep")
    for _ in range(3):
        for part in parts:
            part.draw(x, beta, base, generator=generator)
    return x


@pytest.mark.parametrize("layers", LAYERS.values(), ids=LAYERS)
@pytest.mark.parametrize("replicas", [(), (2, 3)], ids=str)
@pytest.mark.parametrize("pairs", [full, None], ids=["all pairs", "semi-restricted"])
def test_draws_are_those_of_class_by_class(layers, replicas, pairs):
    visible, hidden = layers
    sites = visible.n_sites, hidden.n_sites
    model = drawn(*layers, full(sum(sites)) if pairs else semi_restricted(*sites), replicas)
    blocks = model.blocks()
    runs = in_runs(blocks)
    assert any(isinstance(run, OneByOne) for run in runs)
    assert len(runs) < len(blocks)
    assert torch.cat([run.units for run in runs]).equal(torch.cat([block.units for block in blocks]))
    x = model.chains().random(17, generator=rng.stream(1, "start"))
    base = torch.linspace(-1, 2, model.n_units).double().expand(*replicas, -1)
    ladder = torch.linspace(0, 1, 17).double().unsqueeze(-1)
    for beta in (1.0, 0.3, ladder, ladder.expand(*replicas, 17, 1)):
        for own in (None, base):
            assert swept(runs, x, beta, own).equal(swept(blocks, x, beta, own))
    x_of_chains = model.chains().sweep(x, beta=0.3, generator=rng.stream(3, "sweep"))
    assert x_of_chains.equal(swept_once(blocks, x, 0.3))
    assert not x_of_chains.equal(x)


def swept_once(parts, x, beta):
    x, generator = x.clone(), rng.stream(3, "sweep")
    for part in parts:
        part.draw(x, beta, None, generator=generator)
    return x


def test_extremes_of_temperature_and_field_are_no_nan():
    """At beta = 0 a unit follows its base alone; certain units stay certain."""
    model = drawn(Bernoulli(6), Bernoulli(2), full(8), ())
    x, base = torch.zeros(500, 8).double(), torch.tensor([-800.0, 800.0] * 4).double()
    expected = torch.tensor([0.0, 1.0] * 4).double().expand(500, -1)
    assert swept(in_runs(model.blocks()), x, 0.0, base).equal(expected)
    with torch.no_grad():
        model.b.fill_(800.0)
        model.c.fill_(-800.0)
    assert swept(in_runs(model.blocks()), x, 1.0, None).mean(0).tolist() == [1.0] * 6 + [0.0] * 2


def test_few_couplings_are_drawn_by_classes():
    blocks = drawn(Bernoulli(9), Bernoulli(0), grid(3, 3), ()).blocks()
    assert in_runs(blocks) == blocks


def test_energies_of_a_dense_machine_are_those_of_its_pairs():
    model = drawn(Spin(5), Bernoulli(4), semi_restricted(5, 4), (2,))
    x = model.chains().random(11, generator=rng.stream(1, "start"))
    first, second = model.pairs.unbind(-1)
    pairs = (x[..., first] * x[..., second] * model.coupling.unsqueeze(-2)).sum(-1)
    expected = -pairs - (x * torch.cat((model.b, model.c), dim=-1).unsqueeze(-2)).sum(-1)
    torch.testing.assert_close(model.tempered_energy(x[..., :5], x[..., 5:]), expected)


def test_autocast_changes_no_draw():
    model = drawn(Bernoulli(9), Bernoulli(5), semi_restricted(9, 5), (2,)).float()
    x, chains = model.chains().random(200, generator=rng.stream(1, "start")), model.chains()
    plain = chains.sweep(x, generator=rng.stream(3, "sweep"))
    with torch.autocast("cpu", dtype=torch.bfloat16):
        assert chains.sweep(x, generator=rng.stream(3, "sweep")).equal(plain)
