"""Penalties: their values and gradients, what they leave alone, and the couplings that they leave."""

import math

import pytest
import torch

from memcomp_lightning import rng
from memcomp_lightning.errors import SettingError
from memcomp_lightning.models import RBM, BoltzmannMachine, Normal
from memcomp_lightning.models.units import Bernoulli, Categorical, Gaussian, Mixed, Spin
from memcomp_lightning.samplers import Exact, PseudoLikelihood, positive_phase
from memcomp_lightning.training import L1, L2, EnergyStep, GroupSparsity
from memcomp_lightning.training.step import StepState
from memcomp_lightning.types import Configurations

SETTINGS = {"weight_init": Normal(std=0.6), "replicas": (2,)}
MODELS = {
    "RBM of bits": lambda: RBM(4, 3, **SETTINGS),
    "RBM of categories": lambda: RBM(visible=Categorical([2, 3, 1]), hidden=Categorical([2, 2]), **SETTINGS),
    "RBM of real units": lambda: RBM(visible=Mixed(Gaussian(2), Categorical([3])), hidden=Spin(2), **SETTINGS),
    "machine of spins": lambda: BoltzmannMachine(visible=Spin(5), n_hidden=0, **SETTINGS),
    "ragged machine": lambda: BoltzmannMachine(
        visible=Categorical([2, 3, 4]),
        hidden=Bernoulli(1),
        connectivity=[(0, 1), (0, 2), (1, 3), (2, 3)],
        **SETTINGS,
    ),
}


def matrix(model):
    """Couplings between all units, ``(*replicas, n, n)`` in the upper triangle, and the site of each unit."""
    form, n = model.quadratic_form(), model.n_visible
    found = torch.zeros(*model.replicas, model.n_units, model.n_units)
    if form.pairs is None:
        found[..., :n, n:] = form.coupling.mT
    else:
        found[..., form.pairs[:, 0], form.pairs[:, 1]] = form.coupling
    return found, torch.cat((model.visible.site_of(), model.hidden.site_of() + model.visible.n_sites)).tolist()


def by_loops(penalty, model):
    """The penalty of each replica, one number at a time."""
    couplings, site_of = matrix(model)
    found = []
    for one in couplings.detach().tolist():
        total, groups = 0.0, {}
        for i, row in enumerate(one):
            for j, w in enumerate(row):
                if isinstance(penalty, L1):
                    total += abs(w)
                elif isinstance(penalty, L2):
                    total += w * w / 2
                pair = site_of[i], site_of[j]
                groups[pair] = groups.get(pair, 0.0) + w * w
        if isinstance(penalty, GroupSparsity):
            total = sum(math.sqrt(squares) for squares in groups.values())
        found.append(penalty.strength * total)
    return torch.tensor(found)


PENALTIES = [L1(0.3), L2(0.7), GroupSparsity(0.2)]


@pytest.mark.parametrize("penalty", PENALTIES, ids=lambda penalty: type(penalty).__name__)
@pytest.mark.parametrize("name", MODELS)
def test_value_is_that_of_loops(name, penalty):
    model = MODELS[name]()
    torch.testing.assert_close(penalty(model), by_loops(penalty, model))


@pytest.mark.parametrize("penalty", PENALTIES, ids=lambda penalty: type(penalty).__name__)
@pytest.mark.parametrize("name", MODELS)
def test_gradient_is_that_of_couplings_alone(name, penalty):
    """By differences; biases and precisions have none."""
    model = MODELS[name]().double()
    penalty(model).sum().backward()
    free = []
    for key, parameter in model.named_parameters():
        if key in ("weight", "coupling"):
            couplings = parameter
        else:
            free.append(parameter)
    assert all(parameter.grad is None or not bool(parameter.grad.any()) for parameter in free)
    wanted, step = torch.empty_like(couplings), 1e-6
    with torch.no_grad():
        flat, out = couplings.view(-1), wanted.view(-1)
        for k in range(flat.numel()):
            values = []
            for sign in (1, -1):
                flat[k] += sign * step
                values.append(penalty(model).sum())
                flat[k] -= sign * step
            out[k] = (values[0] - values[1]) / (2 * step)
    torch.testing.assert_close(couplings.grad, wanted, rtol=1e-6, atol=1e-8)


@pytest.mark.parametrize("penalty", PENALTIES, ids=lambda penalty: type(penalty).__name__)
def test_couplings_of_zero_stay(penalty):
    """The root of a group has no slope at zero, and is no NaN there."""
    model = RBM(visible=Categorical([2, 3]), hidden=Spin(2))
    with torch.no_grad():
        model.weight.zero_()
    penalty(model).backward()
    assert model.weight.grad.equal(torch.zeros_like(model.weight))


def test_replicas_stay_independent():
    model = MODELS["ragged machine"]()
    for penalty in PENALTIES:
        (gradient,) = torch.autograd.grad(penalty(model)[0], [model.coupling])
        assert bool(gradient[0].any())
        assert not bool(gradient[1].any())


def test_machine_without_pairs_costs_nothing():
    model = BoltzmannMachine(1, 0)
    for penalty in PENALTIES:
        assert penalty(model).item() == 0.0


def test_loss_of_chunks_is_that_of_the_update():
    """The penalty counts once, however many batches an update has; by itself each would count it anew."""
    model = RBM(visible=Categorical([3, 2]), hidden=Spin(2), weight_init=Normal(std=0.6)).double()
    v = model.visible.sample(torch.zeros(10, 5).double(), generator=rng.stream(0, "data"))
    step = EnergyStep(sampler=Exact(), penalties=[L1(0.3), GroupSparsity(0.1)])
    gradients = []
    for sizes in ([10], [3, 7]):
        state = StepState()
        for some in v.split(sizes):
            gap, _, state = step.contrast(
                model, positive_phase(model, some), state, generator=rng.stream(0, "negative_phase")
            )
            step.loss(model, gap, len(some) / 10).backward()
        gradients.append(model.weight.grad)
        model.zero_grad()
    torch.testing.assert_close(*gradients)
    plain = EnergyStep(sampler=Exact())
    gap, *_ = plain.contrast(model, positive_phase(model, v), StepState(), generator=rng.stream(0, "x"))
    (alone,) = torch.autograd.grad(plain.loss(model, gap, 1.0), [model.weight])
    (cost,) = torch.autograd.grad(L1(0.3)(model) + GroupSparsity(0.1)(model), [model.weight])
    torch.testing.assert_close(gradients[0], alone + cost)


def test_l2_is_the_weight_decay_of_the_couplings():
    models = [MODELS["machine of spins"]() for _ in range(2)]
    for model, penalty, decay in zip(models, (L2(0.3), L2(0.0)), (0.0, 0.3), strict=True):
        optimizer = torch.optim.SGD([model.coupling], lr=0.1, weight_decay=decay)
        penalty(model).sum().backward()
        optimizer.step()
    torch.testing.assert_close(models[0].coupling, models[1].coupling)


def planted(kind, pairs):
    """States with their counts in data of a machine of few couplings, and a machine of all pairs."""
    truth = BoltzmannMachine(visible=kind, n_hidden=0, connectivity=pairs, weight_init=Normal(std=1.0))
    with torch.no_grad():
        truth.coupling.copy_(0.5 * truth.coupling.sign())
    states = truth.visible.states(torch.arange(truth.visible.n_states), like=truth.b)
    p = torch.softmax(-truth.energy(states, states[:, :0]), -1).detach()
    numbers = torch.multinomial(p, 2000, replacement=True, generator=rng.stream(2, "data"))
    counts = torch.bincount(numbers, minlength=len(states))
    data = Configurations(states, states[:, :0], counts.to(states.dtype))
    return data, BoltzmannMachine(visible=kind, n_hidden=0)


def strengths(model):
    """Norm of each pair of sites."""
    couplings, site_of = matrix(model)
    couplings, n = couplings.detach(), model.visible.n_sites
    return {
        (i, j): float(
            couplings[site_of.index(i) :][: site_of.count(i), site_of.index(j) :][:, : site_of.count(j)].norm()
        )
        for i in range(n)
        for j in range(i + 1, n)
    }


def trained(model, data, penalties):
    step = EnergyStep(sampler=PseudoLikelihood(), penalties=penalties)
    optimizer = torch.optim.SGD(model.parameters(), lr=0.05)
    state = StepState()
    for _ in range(300):
        gap, _, state = step.contrast(model, data, state, generator=rng.stream(0, "x"))
        optimizer.zero_grad()
        step.loss(model, gap, 1.0).backward()
        optimizer.step()
        state = state.after_update()
    return strengths(model)


@pytest.mark.parametrize(
    ("kind", "penalty"), [(Spin(6), L1(0.15)), (Categorical(5, q=3), GroupSparsity(0.12))], ids=["L1", "groups"]
)
def test_sparse_couplings_are_found(kind, penalty):
    """The pairs that are not coupled fall to what two updates move; without the penalty some do not."""
    pairs = [(0, 1), (1, 2), (2, 3), (3, 4), *([(4, 5)] if kind.n_sites == 6 else [])]
    data, model = planted(kind, pairs)
    found = trained(model, data, [penalty])
    zero = 2 * 0.05 * penalty.strength
    assert {pair for pair, strength in found.items() if strength > zero} == set(pairs)
    free = trained(planted(kind, pairs)[1], data, [])
    assert {pair for pair, strength in free.items() if strength > zero} > set(pairs)


@pytest.mark.parametrize("kind", [L1, L2, GroupSparsity])
@pytest.mark.parametrize("strength", [-0.1, math.inf, math.nan])
def test_strength_is_checked(kind, strength):
    with pytest.raises(SettingError, match=rf"{kind.__name__} strength = .*a finite number >= 0"):
        kind(strength)
