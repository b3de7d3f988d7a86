"""Up-down training against enumeration: gradients of the wake and the sleep objective, bounds and samples."""

import itertools
from typing import ClassVar

import pytest
import torch

from memcomp_lightning import rng
from memcomp_lightning.errors import SettingError
from memcomp_lightning.likelihood import Ais, base_of, exact_samples, log_partition_function, recognition_bound
from memcomp_lightning.likelihood import log_likelihood as log_likelihood_of
from memcomp_lightning.models import DBN, RBM, GenerativeDBN, Normal
from memcomp_lightning.models.conditional import Conditional
from memcomp_lightning.models.units import Bernoulli, Categorical, Gaussian, Units
from memcomp_lightning.samplers import CD, PCD, PseudoLikelihood
from memcomp_lightning.training import EnergyStep, StepState, UpDownStep, up_down
from memcomp_lightning.training.updown import STREAMS
from memcomp_lightning.types import Batch, Configurations, NegativePhase, NoState

N, N_BELOW, N_TOP = 4, 3, 2


def states_of(*sizes):
    """All states of some bits, and of a class at the end, where its number is negative."""
    choices = []
    for size in sizes:
        own = torch.eye(-size).tolist() if size < 0 else list(itertools.product((0.0, 1.0), repeat=size))
        choices.append([list(one) for one in own])
    return [torch.tensor(list(itertools.chain(*parts))).double() for parts in itertools.product(*choices)]


def model_of(n_classes=0, scale=1.0, replicas=(), sizes=(N_BELOW, N_TOP)):
    """A network whose two directions differ, with weights of the labels."""
    generator = rng.stream(1, "weights")
    dbn = DBN(N, list(sizes), replicas=replicas, weight_init=Normal(std=scale), generator=generator).double()
    model = GenerativeDBN(dbn, n_classes=n_classes)
    for parameter in model.parameters():
        parameter.data += scale * (rng.uniform(parameter.shape, generator=generator, like=parameter) - 0.5)
    return model


def bernoulli_log(x, p):
    return (x * p.log() + (1 - x) * (1 - p).log()).sum(-1)


def joint(model):
    """All (v, h1, y) of two layers, by all states of all units, and the log of their probability."""
    labels = [-model.n_classes] if model.n_classes else []
    below = torch.stack(states_of(N_BELOW, *labels))
    top = torch.stack(states_of(N_TOP))
    energy = torch.stack([model.top.energy(below, h.expand(len(below), -1)) for h in top], dim=-1)
    log_p_below = (-energy).logsumexp(-1) - (-energy).flatten().logsumexp(0)
    layer, v = model.generative[0], torch.stack(states_of(N))
    states = torch.cat((v.repeat_interleave(len(below), 0), below.repeat(len(v), 1)), dim=-1)
    p = torch.sigmoid(states[:, N : N + N_BELOW] @ layer.weight.mT + layer.bias)
    return states, log_p_below.repeat(len(v)) + bernoulli_log(states[:, :N], p)


def log_likelihoods(model):
    """Log p(v) of all v, in the order of ``states_of``."""
    states, log_p = joint(model)
    return torch.stack([log_p[(states[:, :N] == v).all(-1)].logsumexp(0) for v in states_of(N)])


def recognition(model, h, v):
    layer = model.recognition[0]
    return bernoulli_log(h, torch.sigmoid(v @ layer.weight.mT + layer.bias))


ROWS = torch.tensor([[1.0, 0, 0, 1], [0, 1, 1, 1], [1, 1, 0, 0]]).double()
LABELS = torch.tensor([1, 0, 1])


def wake_objective(model):
    """Mean over rows of E_q[-log p(v | h)]."""
    h, layer = torch.stack(states_of(N_BELOW)), model.generative[0]
    p = torch.sigmoid(h @ layer.weight.mT + layer.bias)
    return -sum((recognition(model, h, v).exp() * bernoulli_log(v, p)).sum() for v in ROWS) / len(ROWS)


def sleep_objective(model):
    """E_p[-log q(h | v)]."""
    states, log_p = joint(model)
    return -(log_p.exp() * recognition(model, states[:, N : N + N_BELOW], states[:, :N])).sum()


def slope(objective, model, parameter):
    """The gradient by finite differences."""
    found, flat = torch.zeros_like(parameter), parameter.data.view(-1)
    for i in range(len(flat)):
        ends = []
        for sign in (1, -1):
            flat[i] += sign * 1e-4
            ends.append(objective(model))
            flat[i] -= sign * 1e-4
        found.view(-1)[i] = (ends[0] - ends[1]) / 2e-4
    return found


class Draws:
    """A sampler of independent draws from an RBM that can be enumerated."""

    uses_data: ClassVar[bool] = False
    shared: ClassVar[bool] = False

    def __init__(self, n):
        self.n = n

    def init(self, model, n_chains, *, generator):
        return NoState()

    def sample(self, model, state, positive, *, generator):
        v = exact_samples(model, self.n, generator=generator)
        return NegativePhase(Configurations(v, model.hidden_mean(v)), state, {})


def averaged(model, v, times):
    """The bound by so many draws a row, and its standard error: copies of rows are quicker than draws of one."""
    log_z = log_partition_function(model.top)
    some = v.repeat(times // 2, 1)
    found = recognition_bound(model, some, log_z, n_draws=2, generator=rng.stream(0, "bound")).value
    found = found.unflatten(0, (-1, len(v)))
    return found.mean(0), found.std(0) / len(found) ** 0.5


def streams():
    return {name: rng.stream(3, name) for name in STREAMS}


def gradient(model, step, *, times, share=1.0):
    """The gradients of one batch with so many copies of the rows, and its losses."""
    model.zero_grad()
    batch = Batch(ROWS.repeat(times, 1), LABELS.repeat(times), share, True)
    losses, _ = step.add_gradient(model, batch, StepState(), streams=streams())
    return {name: p.grad for name, p in model.named_parameters() if p.grad is not None}, losses


@pytest.mark.parametrize("n_classes", [0, 2])
def test_the_mean_step_is_down_the_wake_and_the_sleep_objective(n_classes):
    model, n = model_of(n_classes), 30_000
    step = UpDownStep(top=EnergyStep(sampler=Draws(n)), visible="sample")
    found, losses = gradient(model, step, times=n // len(ROWS))
    with torch.no_grad():
        wake, sleep = wake_objective(model), sleep_objective(model)
        torch.testing.assert_close(losses.wake, wake, atol=0.03, rtol=0)
        torch.testing.assert_close(losses.sleep, sleep, atol=0.03, rtol=0)
        for objective, layer in ((wake_objective, "generative"), (sleep_objective, "recognition")):
            for name in ("weight", "bias"):
                parameter = getattr(getattr(model, layer)[0], name)
                expected = slope(objective, model, parameter)
                # An entry is a mean of n numbers of size one: five standard errors.
                torch.testing.assert_close(found[f"{layer}.0.{name}"], expected, atol=0.015, rtol=0)


def test_the_top_follows_the_likelihood_of_what_the_recognition_model_draws():
    model, n = model_of(2), 60_000
    found, _ = gradient(model, UpDownStep(top=EnergyStep(sampler=Draws(n))), times=n // len(ROWS))

    def objective(model):
        total = log_partition_function(model.top)
        h = torch.stack(states_of(N_BELOW))
        for v, label in zip(ROWS, torch.eye(2)[LABELS].double(), strict=True):
            free = model.top.free_energy(torch.cat((h, label.expand(len(h), -1)), dim=-1))
            total = total + (recognition(model, h, v).exp() * free).sum() / len(ROWS)
        return total

    with torch.no_grad():
        for name in ("weight", "b", "c"):
            expected = slope(objective, model, getattr(model.top, name))
            torch.testing.assert_close(found[f"top.{name}"], expected, atol=0.015, rtol=0)


@pytest.mark.parametrize(
    "units", [Bernoulli(3), Categorical([3, 2]), Gaussian(3)], ids=lambda units: type(units).__name__
)
@pytest.mark.parametrize("replicas", [(), (2,)])
def test_the_gradient_of_a_layer_is_that_of_its_log_probability(units: Units, replicas):
    generator = rng.stream(0, "x")
    weight = rng.uniform((*replicas, units.n, 2), generator=generator).double()
    layer = Conditional(units.for_replicas(replicas), weight, weight.sum(-1)).double()
    y = rng.uniform((*replicas, 5, 2), generator=generator).double()
    x, share = layer.draw(y, generator=generator), rng.uniform((*replicas, 5), generator=generator).double()
    loss = -(share * layer.log_prob(x, y)).sum(-1)
    expected = torch.autograd.grad(loss.sum(), [layer.weight, layer.bias])
    torch.testing.assert_close(layer.add_gradient(x, y, share), loss.detach())
    layer.add_gradient(x, y, share)
    for parameter, once in zip((layer.weight, layer.bias), expected, strict=True):
        torch.testing.assert_close(parameter.grad, 2 * once)


def test_the_share_of_a_batch_scales_its_gradient_and_not_its_losses():
    model, step = model_of(2), UpDownStep()
    whole, losses = gradient(model, step, times=2)
    part, same = gradient(model, step, times=2, share=0.25)
    for name, found in whole.items():
        torch.testing.assert_close(part[name], 0.25 * found)
    torch.testing.assert_close(torch.stack(losses), torch.stack(same))


def test_weights_of_rows_are_copies_of_them():
    model = model_of(0)
    model.recognition[0].bias.data += 100.0  # nothing is left to chance
    step, weight = UpDownStep(top=EnergyStep(sampler=Draws(2))), torch.tensor([2.0, 1.0]).double()
    found = []
    for rows, own in ((ROWS[:2], weight), (ROWS[[0, 0, 1]], None)):
        model.zero_grad()
        label = torch.zeros(len(rows), dtype=torch.long)
        step.add_gradient(model, Batch(rows, label, 1.0, True, own), StepState(), streams=streams())
        found.append((model.generative[0].weight.grad, model.top.weight.grad))
    torch.testing.assert_close(found[0], found[1])


@pytest.mark.parametrize("n_classes", [0, 2])
def test_the_bound_is_the_likelihood_less_what_recognition_misses(n_classes):
    model = model_of(n_classes, scale=1.5)
    v = torch.stack(states_of(N))
    bound, error = averaged(model, v, 4000)
    exact, (states, log_p) = log_likelihoods(model), joint(model)
    divergences = []
    for row, log_p_row in zip(v, exact, strict=True):
        divergence = 0.0
        for h in states_of(N_BELOW):
            log_q, key = recognition(model, h, row), torch.cat((row, h))
            posterior = log_p[(states[:, : N + N_BELOW] == key).all(-1)].logsumexp(0) - log_p_row
            divergence += log_q.exp() * (log_q - posterior)
        divergences.append(divergence)
    missed = torch.stack(divergences).detach()
    assert missed.min() > 0.01  # otherwise nothing is tested
    assert ((bound - (exact.detach() - missed)) / error).abs().max() < 4
    assert (bound < exact).all()


def test_every_draw_is_the_likelihood_where_recognition_is_right():
    """Above an RBM stands its mirror image: together they are the RBM, whose posterior has factors."""
    rbm = RBM(N, N_BELOW, weight_init=Normal(std=1.0), generator=rng.stream(0, "weights")).double()
    rbm.b.data += torch.tensor([0.3, -0.5, 0.1, 1.0])
    rbm.c.data -= torch.tensor([0.2, 0.4, -0.7])
    dbn = DBN(N, [N_BELOW, N]).double()
    for own, other in zip((dbn[0].weight, dbn[0].b, dbn[0].c), (rbm.weight, rbm.b, rbm.c), strict=True):
        own.data.copy_(other)
    for own, other in zip((dbn[1].weight, dbn[1].b, dbn[1].c), (rbm.weight.mT, rbm.c, rbm.b), strict=True):
        own.data.copy_(other)
    model, v = GenerativeDBN(dbn), torch.stack(states_of(N))
    bound = recognition_bound(
        model, v, log_partition_function(model.top), n_draws=3, generator=rng.stream(0, "bound")
    )
    torch.testing.assert_close(bound.value, log_likelihood_of(rbm, v, log_partition_function(rbm)))
    assert bound.standard_error.max() < 1e-12


@pytest.mark.parametrize("n_draws", [2, 16])
def test_the_error_of_a_bound_is_its_spread_over_copies_of_a_row(n_draws):
    model = model_of(sizes=(3, 2, 2))
    rows = torch.stack(states_of(N)[:2]).repeat_interleave(2000, dim=0)
    log_z = log_partition_function(model.top)
    found = recognition_bound(model, rows, log_z, n_draws=n_draws, generator=rng.stream(0, "bound"))
    spread = found.value.view(2, 2000).std(-1)
    said = found.standard_error.view(2, 2000).square().mean(-1).sqrt()
    torch.testing.assert_close(said, spread, rtol=0.15, atol=0)


def test_only_the_visible_units_are_means_on_the_way_down():
    model = model_of(sizes=(3, 2, 2))
    x = torch.ones(50, 2, dtype=torch.float64)
    for visible in ("mean", "sample"):
        v, *hidden = model.down(x, visible=visible, generator=rng.stream(0, "down"))
        assert [((part == 0) | (part == 1)).all().item() for part in (v, *hidden)] == [
            visible == "sample",
            True,
            True,
        ]


def test_three_layers_have_a_bound_below_the_likelihood():
    model = model_of(sizes=(3, 2, 2))
    v = torch.stack(states_of(N))
    bound, error = averaged(model, v, 2000)
    lower, upper = model.downward
    below = torch.stack(states_of(2))
    log_p2 = -model.top.free_energy(below) - log_partition_function(model.top)
    exact = []
    for row in v:
        terms = [
            log_p + upper.log_prob(h1[None], h2[None]) + lower.log_prob(row[None], h1[None])
            for h1 in states_of(3)
            for h2, log_p in zip(below, log_p2, strict=True)
        ]
        exact.append(torch.stack(terms).logsumexp(0).squeeze())
    exact = torch.stack(exact).detach()
    torch.testing.assert_close(exact.exp().sum(), torch.tensor(1.0).double())
    assert (bound < exact + 3 * error).all()
    assert (bound < exact).float().mean() > 0.9


def test_annealing_of_the_top_gives_its_partition_function():
    top = model_of(2).top
    base = base_of(exact_samples(top, 100, generator=rng.stream(0, "v")), top.visible)
    estimate = Ais(n_betas=200).estimate(top, base=base, generator=rng.stream(0, "ais"))
    assert abs(estimate.log_z - log_partition_function(top)) < 4 * estimate.standard_error + 1e-3


def test_the_log_odds_of_labels_are_those_of_all_states():
    model = model_of(3)
    for h in states_of(N_BELOW):
        expected = []
        for label in torch.eye(3).double():
            x = torch.cat((h, label)).expand(2**N_TOP, -1)
            expected.append((-model.top.energy(x, torch.stack(states_of(N_TOP)))).logsumexp(0))
        torch.testing.assert_close(model.log_weights_of_labels(h[None])[0], torch.stack(expected))
        torch.testing.assert_close(model.log_weight(h[None])[0], torch.stack(expected).logsumexp(0))


def test_a_confident_recognition_model_is_a_classifier():
    model = model_of(3)
    for parameter in model.recognition.parameters():
        parameter.data *= 1e4
    v = torch.stack(states_of(N))
    h = (v @ model.recognition[0].weight.mT + model.recognition[0].bias > 0).double()
    torch.testing.assert_close(model.logits(v), model.log_weights_of_labels(h).detach())


@pytest.mark.parametrize("label", [None, 0, 1])
def test_samples_of_a_class_are_those_of_the_joint_distribution(label):
    model, n = model_of(2), 20_000
    # Classes that differ: each hidden unit likes one of them.
    model.top.weight.data[:] = torch.tensor([[2.0, 1, -2, 2, -2], [-2, 1, 2, -2, 2]])
    model.top.b.data[:] = torch.tensor([0, -1.0, 0, 0, 0.3])
    fixed = None if label is None else torch.full((n,), label)
    v = model.samples(n, sweeps=60, label=fixed, visible="sample", generator=rng.stream(0, "samples"))
    states, log_p = joint(model)
    kept = torch.ones(len(states), dtype=torch.bool) if label is None else states[:, N + N_BELOW + label] == 1
    powers = torch.tensor([8.0, 4, 2, 1]).double()
    p = torch.bincount((states[kept, :N] @ powers).long(), weights=log_p[kept].detach().exp(), minlength=2**N)
    p /= p.sum()
    number = (v @ powers).long()
    shares = torch.bincount(number, minlength=2**N) / n
    assert ((shares - p).abs() / (p / n).sqrt()).max() < 5


def test_means_are_shown_of_the_inputs_alone():
    model = model_of(2)
    states = model.down(torch.ones(5, N_BELOW + 2).double(), generator=rng.stream(0, "down"))
    assert [x.shape[-1] for x in states] == [N, N_BELOW]
    torch.testing.assert_close(states[0], model.generative[0].mean(states[1]))


def test_means_of_a_single_rbm_are_those_of_its_conditionals():
    model = model_of(2, sizes=(N_TOP,))
    label = torch.zeros(4000, dtype=torch.long)
    means, draws = (
        model.samples(4000, sweeps=5, label=label, visible=visible, generator=rng.stream(0, "samples"))
        for visible in ("mean", "sample")
    )
    assert means.shape == draws.shape == (4000, N)
    assert ((means > 0) & (means < 1)).all()
    # The last draws of both have the same hidden units.
    torch.testing.assert_close(means.mean(0), draws.mean(0), atol=0.03, rtol=0)


# Persistent chains lag behind a model of three rows that moves fast.
@pytest.mark.parametrize(
    ("sampler", "replicas", "rate", "iterations"),
    [(CD(k=2), (), 0.5, 120), (PCD(n_chains=100), (2,), 0.05, 500)],
    ids=["cd", "pcd"],
)
def test_training_makes_the_data_likelier(sampler, replicas, rate, iterations):
    dbn = DBN(N, [N_BELOW, N_TOP], replicas=replicas, generator=rng.stream(0, "weights")).double()
    model = GenerativeDBN(dbn, n_classes=2)
    rows = ROWS.repeat(10, 1).expand(*replicas, -1, -1)
    labels = LABELS.repeat(10).expand(*replicas, -1)
    batches = [Batch(rows, labels, 1.0, True)]
    *_, losses = up_down(
        model,
        batches,
        iterations=iterations,
        optimizer=lambda p: torch.optim.SGD(p, lr=rate, momentum=0.8),
        step=UpDownStep(top=EnergyStep(sampler=sampler)),
    )
    assert losses.wake.shape == replicas
    log_z = log_partition_function(model.top)
    rows = ROWS.expand(*replicas, -1, -1)
    bound = recognition_bound(model, rows, log_z, n_draws=100, generator=rng.stream(0, "bound"))
    assert bound.value.mean(-1).min() > -2.2  # -2.5 of independent bits, -1.1 of the rows themselves
    assert (model.logits(rows).argmax(-1) == LABELS).all()


def test_a_single_rbm_learns_with_its_labels():
    model = GenerativeDBN(DBN(N, [6], generator=rng.stream(0, "weights")).double(), n_classes=2)
    batches = [Batch(ROWS.repeat(10, 1), LABELS.repeat(10), 1.0, True)]
    *_, losses = up_down(model, batches, iterations=60, optimizer=lambda p: torch.optim.SGD(p, lr=1.0))
    assert losses.wake == losses.sleep == 0
    assert (model.logits(ROWS).argmax(-1) == LABELS).all()


def test_what_cannot_be_is_refused():
    model = model_of(2)
    batch = Batch(ROWS, torch.tensor([0, -1, 1]), 1.0, True)
    with pytest.raises(SettingError, match="label = -1"):
        UpDownStep().add_gradient(model, batch, StepState(), streams=streams())
    with pytest.raises(SettingError, match="sampler = 'PseudoLikelihood'"):
        UpDownStep(top=EnergyStep(sampler=PseudoLikelihood()))
    with pytest.raises(SettingError, match="label = 'a tensor' is not allowed: expected None"):
        model_of().samples(3, sweeps=1, label=torch.zeros(3, dtype=torch.long), generator=rng.stream(0, "x"))
    log_z = torch.tensor(0.0)
    with pytest.raises(SettingError, match="v in column"):
        recognition_bound(model, ROWS / 2, log_z, generator=rng.stream(0, "x"))
    with pytest.raises(SettingError, match="shape of v"):
        recognition_bound(model, ROWS[:, :2], log_z, generator=rng.stream(0, "x"))
    with pytest.raises(SettingError, match="length of label = 3"):
        model.samples(4, sweeps=1, label=torch.zeros(3, dtype=torch.long), generator=rng.stream(0, "x"))
    single = model_of(2, sizes=(N_TOP,))
    with pytest.raises(SettingError, match="v in column"):
        recognition_bound(single, ROWS / 2, log_z, generator=rng.stream(0, "x"))
