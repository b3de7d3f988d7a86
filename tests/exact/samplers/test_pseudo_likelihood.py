"""The contrast with PseudoLikelihood has the gradient of the enumerated log pseudo-likelihood."""

import itertools

import pytest
import torch

from memcomp_lightning import rng
from memcomp_lightning.errors import SettingError
from memcomp_lightning.likelihood import log_pseudo_likelihood
from memcomp_lightning.models import DBM, RBM, BoltzmannMachine, Normal
from memcomp_lightning.models.units import Bernoulli, Categorical, Gaussian, Mixed, ReLU, Spin, Units, all_states
from memcomp_lightning.objective import Centring, Offsets, contrast, shares
from memcomp_lightning.samplers import CD, PseudoLikelihood, positive_phase
from memcomp_lightning.training import EnergyStep
from memcomp_lightning.training.step import StepState
from memcomp_lightning.types import Configurations, NoState

INIT = Normal(std=0.6)
VISIBLE = {
    "bits": lambda: Bernoulli(5),
    "spins": lambda: Spin(5),
    "categories": lambda: Categorical(3, q=3),
    "ragged": lambda: Categorical([2, 4, 1, 3]),
    "mixed": lambda: Mixed(Spin(1), Categorical([3, 2]), Bernoulli(2)),
}
GRID = [(0, 1), (1, 2), (0, 2), (2, 3), (3, 4), (1, 4)]


def machine(name, replicas=(), hidden=None, connectivity=None, seed=0):
    generator = rng.stream(seed, "test model")
    settings = {"replicas": replicas, "weight_init": INIT, "generator": generator}
    model = BoltzmannMachine(
        visible=VISIBLE[name](), hidden=hidden or Bernoulli(0), connectivity=connectivity, **settings
    )
    return biased(model, generator)


def rbm(name, replicas=(), hidden=None, seed=0):
    generator = rng.stream(seed, "test model")
    hidden = hidden or Spin(3)
    model = RBM(visible=VISIBLE[name](), hidden=hidden, replicas=replicas, weight_init=INIT, generator=generator)
    return biased(model, generator)


def dbm(name, replicas=(), seed=0):
    generator = rng.stream(seed, "test model")
    return biased(DBM(5, [3, 2], replicas=replicas, weight_init=INIT, generator=generator), generator)


def biased(model, generator):
    with torch.no_grad():
        model.b.normal_(0.3, 0.5, generator=generator)
        model.c.normal_(-0.2, 0.5, generator=generator)
    return model.double()


def draws(model, n=6):
    """Rows of values of the units, all sites drawn uniformly."""
    field = torch.zeros(*model.replicas, n, model.n_visible, dtype=torch.float64)
    return model.visible.sample(field, generator=rng.stream(1, "data"))


def energies(model, v, h):
    """The energy of single states as a differentiable sum over all pairs."""
    form = model.quadratic_form()
    x = torch.cat((v, h), dim=-1)
    total = -(x * form.bias.unsqueeze(-2)).sum(-1)
    if form.pairs is None:
        return total - torch.einsum("...ij,...ni,...nj->...n", form.coupling, h, v) + own(model, h)
    first, second = form.pairs.unbind(-1)
    return total - (form.coupling.unsqueeze(-2) * x[..., first] * x[..., second]).sum(-1)


def own(model, h):
    curvature = model.hidden.curvature
    return 0.0 if curvature is None else 0.5 * (h.square() * curvature.unsqueeze(-2)).sum(-1)


def log_weight(model, v):
    """Log of the sum over the hidden states of exp(-E), by listing them; Gaussian ones in closed form."""
    if isinstance(model.hidden, Gaussian):
        field = torch.einsum("...ij,...nj->...ni", model.weight, v) + model.c.unsqueeze(-2)
        precision = model.hidden.precision.unsqueeze(-2)
        return (v * model.b.unsqueeze(-2)).sum(-1) + (
            field.square() / (2 * precision) - 0.5 * precision.log()
        ).sum(-1)
    if model.n_hidden == 0:
        return -energies(model, v, v[..., :0])
    each = [h.expand(*v.shape[:-1], -1) for h in all_states(model.hidden, v)]
    return torch.stack([-energies(model, v, h) for h in each]).logsumexp(0)


def site_states(units: Units):
    """For each site, in whatever order: its entries, and their values in each state."""
    everything = all_states(units, torch.empty(0, dtype=torch.float64))
    for site in range(units.n_sites):
        entries = (units.site_of() == site).nonzero().flatten()
        yield entries, everything[:, entries].unique(dim=0)


def loss(model, v, weight=None):
    """Minus the mean log pseudo-likelihood, by listing all states of each site; of means the cross-entropy."""
    total = 0.0
    for entries, states in site_states(model.visible):
        log_weights = []
        for state in states:
            moved = v.clone()
            moved[..., entries] = state
            log_weights.append(log_weight(model, moved))
        log_p = torch.stack(log_weights, dim=-1).log_softmax(-1)
        total = total - (probabilities(v[..., entries], states) * log_p).sum(-1)
    return total.mean(-1) if weight is None else (total * weight).sum(-1) / weight.sum(-1)


def probabilities(x, states):
    """Of the states of a site with these means: the solution of  sum_a p_a state_a = x, sum_a p_a = 1."""
    table = torch.cat((states, torch.ones(len(states), 1, dtype=x.dtype)), dim=-1)
    wanted = torch.cat((x, torch.ones_like(x[..., :1])), dim=-1)
    return wanted @ torch.linalg.pinv(table)


def gradients(model, of):
    parameters = [p for p in model.parameters() if p.numel()]
    return torch.autograd.grad(of, parameters, allow_unused=True, materialize_grads=True)


def ours(model, v, sampler=None, weight=None, offsets=None, seed=3):
    sampler = sampler or PseudoLikelihood()
    generator = rng.stream(seed, "negative_phase")
    state = sampler.init(model, v.shape[-2], generator=generator)
    positive = positive_phase(model, v)._replace(weight=weight)
    found = sampler.sample(model, state, positive, generator=generator)
    return contrast(model, positive, found.configurations, offsets), found


def assert_same_gradient(model, v, weight=None, **tolerances):
    gap, found = ours(model, v, weight=weight)
    true = loss(model, v, weight)
    for one, other in zip(gradients(model, gap.sum()), gradients(model, true.sum()), strict=True):
        torch.testing.assert_close(one, other, **{"rtol": 1e-9, "atol": 1e-11, **tolerances})
    torch.testing.assert_close(found.info["log_pseudo_likelihood"], -true.detach())
    return found


@pytest.mark.parametrize("replicas", [(), (2,), (2, 2)], ids=str)
@pytest.mark.parametrize("name", VISIBLE)
def test_gradient_without_hidden_units(name, replicas):
    model = machine(name, replicas)
    assert_same_gradient(model, draws(model))


@pytest.mark.parametrize("name", ["bits", "spins"])
def test_gradient_where_classes_have_several_sites(name):
    model = machine(name, (2,), connectivity=GRID)
    assert max(map(len, model.classes)) > 1
    assert_same_gradient(model, draws(model))


HIDDEN = {
    "bits": lambda: Bernoulli(3),
    "spins": lambda: Spin(2),
    "categories": lambda: Categorical([3, 2]),
    "real": lambda: Gaussian(2, variance=0.7, learned=False),
}


@pytest.mark.parametrize("hidden", HIDDEN)
@pytest.mark.parametrize("name", VISIBLE)
def test_gradient_of_an_rbm(name, hidden):
    model = rbm(name, (2,), HIDDEN[hidden]())
    assert_same_gradient(model, draws(model))


@pytest.mark.parametrize("name", VISIBLE)
def test_gradient_of_a_machine_with_hidden_units(name):
    n = VISIBLE[name]().n_sites
    assert_same_gradient(model := machine(name, (2,), Bernoulli(2)), draws(model))
    across = [(i, j) for i, j in itertools.combinations(range(n + 2), 2) if i < n]
    assert_same_gradient(model := machine(name, (2,), Spin(2), connectivity=across), draws(model))


def test_gradient_of_a_deep_machine():
    """The positive phase of coupled hidden units is a mean field: it cancels, whatever it is."""
    model = dbm("bits", (2,))
    assert_same_gradient(model, draws(model))


@pytest.mark.parametrize("make", [machine, rbm])
@pytest.mark.parametrize("name", VISIBLE)
def test_rows_count_by_their_weights(name, make):
    model = make(name, (2,))
    weight = rng.uniform((2, 6), generator=rng.stream(5, "weights")).double() + 0.1
    assert_same_gradient(model, draws(model), weight=weight)


@pytest.mark.parametrize("make", [machine, rbm])
@pytest.mark.parametrize("name", ["bits", "spins", "ragged", "mixed"])
def test_grey_values_count_as_cross_entropies(name, make):
    model = make(name)
    field = torch.empty(6, model.n_visible, dtype=torch.float64).normal_(generator=rng.stream(2, "data"))
    assert_same_gradient(model, model.visible.mean(field))


@pytest.mark.parametrize("make", [machine, rbm])
@pytest.mark.parametrize("name", VISIBLE)
def test_value_is_that_of_the_likelihood(name, make):
    model = make(name, (2,))
    v = draws(model)
    _, found = ours(model, v)
    wanted = log_pseudo_likelihood(model, v).sum(-1).mean(-1)
    torch.testing.assert_close(found.info["log_pseudo_likelihood"], wanted)


@pytest.mark.parametrize("name", VISIBLE)
def test_drawn_sites_are_right_in_expectation(name):
    """The mean over draws comes to the gradient, within five standard errors; a draw by itself does not."""
    model = rbm(name)
    v = draws(model, n=4)
    n_draws = 400
    wide = v.repeat(n_draws, 1)
    true = gradients(model, loss(model, v).sum())
    found = []
    for seed in range(10):
        gap, _ = ours(model, wide, PseudoLikelihood(n_sites=1), seed=seed)
        found.append(torch.cat([part.flatten() for part in gradients(model, gap.sum())]))
    found, true = torch.stack(found), torch.cat([part.flatten() for part in true])
    error = found.std(0) / 10**0.5
    assert ((found.mean(0) - true).abs() <= 8 * error + 1e-9).all()
    single, _ = ours(model, v, PseudoLikelihood(n_sites=1))
    flat = torch.cat([part.flatten() for part in gradients(model, single.sum())])
    assert (flat - true).abs().max() > 1e-3


def test_more_sites_than_there_are_is_all_of_them():
    model = rbm("ragged")
    v = draws(model)
    for one, other in zip(
        ours(model, v)[1].configurations,
        ours(model, v, PseudoLikelihood(n_sites=99))[1].configurations,
        strict=True,
    ):
        assert one.equal(other)


def test_values_are_those_of_means_and_weights_add_up():
    for make, name in itertools.product((machine, rbm), VISIBLE):
        model = make(name, (2,))
        _, found = ours(model, draws(model))
        v, _, weight = found.configurations
        model.visible.check(v)
        torch.testing.assert_close(weight.sum(-1), torch.ones(2, dtype=torch.float64))
        assert bool((weight < 0).any())


@pytest.mark.parametrize("name", VISIBLE)
def test_centred_gradient_is_the_same_step_in_centred_parameters(name):
    """It follows from the plain one: nabla b' = nabla b - nabla W^T lambda, and so on."""
    model = rbm(name)
    v = draws(model)
    offsets = Offsets(v.mean(0), model.hidden_mean(v).mean(0).detach())
    plain = dict(zip("wbc", gradients(model, ours(model, v)[0]), strict=True))
    centred = gradients(model, ours(model, v, offsets=offsets)[0])
    of_w = plain["w"] - torch.outer(plain["c"], offsets.visible) - torch.outer(offsets.hidden, plain["b"])
    torch.testing.assert_close(centred[0], of_w)
    torch.testing.assert_close(centred[1], plain["b"] - offsets.hidden @ of_w)
    torch.testing.assert_close(centred[2], plain["c"] - of_w @ offsets.visible)


def test_step_accepts_it():
    model = machine("spins", (2,))
    positive = positive_phase(model, draws(model))
    step = EnergyStep(sampler=PseudoLikelihood(), centring=Centring(rate=0.1))
    gap, _, state = step.contrast(model, positive, StepState(), generator=rng.stream(0, "negative_phase"))
    assert gap.shape == (2,)
    assert state.sampler == NoState()


# --- mutants ----------------------------------------------------------------------------------------------


def test_other_weights_have_another_gradient():
    """The three-point identity with weights of 3, -1 and -1, and CD, are told from it."""
    model = machine("ragged")
    v = draws(model)
    positive = positive_phase(model, v)
    _, found = ours(model, v)
    v_all, h_all, weight = found.configurations
    third = len(v)
    wrong = torch.cat((weight[:third] * 0.75, weight[third : 2 * third] * 0.5, weight[2 * third :]))
    torch.testing.assert_close(wrong.sum(), torch.tensor(1.0, dtype=torch.float64))
    true = gradients(model, loss(model, v))
    for negative in (
        Configurations(v_all, h_all, wrong),
        CD().sample(model, NoState(), positive, generator=rng.stream(0, "x")).configurations,
    ):
        other = gradients(model, contrast(model, positive, negative))
        assert max((a - b).abs().max() for a, b in zip(other, true, strict=True)) > 1e-2


def test_weights_of_the_data_alone_have_another_gradient():
    """p(v_j = a | rest) without the 1 where the data have it: the mean over states, the row not taken away."""
    model = rbm("ragged")
    v = draws(model)
    positive = positive_phase(model, v)
    _, found = ours(model, v)
    negative = found.configurations
    mutant = negative._replace(weight=negative.weight.clamp_min(0.0))
    true = gradients(model, loss(model, v))
    other = gradients(model, contrast(model, positive, mutant))
    assert max((a - b).abs().max() for a, b in zip(other, true, strict=True)) > 1e-2


# --- what is refused --------------------------------------------------------------------------------------


@pytest.mark.parametrize("visible", [Gaussian(2), Mixed(Bernoulli(2), Gaussian(1))], ids=["real", "mixed"])
def test_real_units_are_refused(visible):
    model = RBM(visible=visible, hidden=Bernoulli(2))
    with pytest.raises(SettingError, match=rf"{type(visible).__name__}.*discrete units for the pseudo-likelihood"):
        PseudoLikelihood().init(model, 1, generator=rng.stream(0, "x"))


def test_without_a_number_as_many_sites_are_drawn_as_fit_in_memory(monkeypatch):
    """Seven sites of three states, four rows and 23 units: 276 numbers a site."""
    model = RBM(visible=Categorical(7, q=3), hidden=Bernoulli(2), weight_init=INIT)
    v = model.visible.sample(model.b.expand(4, -1), generator=rng.stream(0, "rows"))
    for allowed, sites in ((2**27, 7), (276 * 5, 5), (1, 1)):
        monkeypatch.setattr("memcomp_lightning.samplers.pseudo_likelihood.MOST_NUMBERS", allowed)
        positive = positive_phase(model, v)
        found = PseudoLikelihood().sample(model, NoState(), positive, generator=rng.stream(0, "x"))
        assert found.configurations.v.shape[-2] == 4 + 4 * sites * 3


def test_hidden_units_that_rise_from_zero_are_taken():
    model = RBM(visible=Spin(4), hidden=ReLU(2))
    v = draws(model).float()
    gap, _ = ours(model, v)
    assert bool(gap.isfinite())


def test_many_coupled_hidden_units_are_refused():
    model = DBM(5, [6, 3])
    with pytest.raises(SettingError, match=r"number of hidden units = 9.*at most max_units = 8"):
        PseudoLikelihood().init(model, 1, generator=rng.stream(0, "x"))
    ragged = BoltzmannMachine(visible=Bernoulli(2), hidden=Categorical([3, 5, 7, 4]))
    with pytest.raises(SettingError, match=r"number of hidden units, in bits = 8.7 is not allowed"):
        PseudoLikelihood().init(ragged, 1, generator=rng.stream(0, "x"))
    PseudoLikelihood(max_units=9).init(model, 1, generator=rng.stream(0, "x"))
    PseudoLikelihood().init(RBM(5, 30), 1, generator=rng.stream(0, "x"))


def test_shares_keep_signed_weights():
    weight = torch.tensor([4.0, -2.0, -1.0])
    assert shares(Configurations(torch.zeros(3, 2), torch.zeros(3, 0), 2 * weight)).equal(weight)
