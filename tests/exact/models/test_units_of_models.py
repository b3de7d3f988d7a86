"""Models of all kinds of units against sums over all states and integrals, from the parameters alone."""

import copy

import pytest
import torch

from memcomp_lightning import rng
from memcomp_lightning.errors import SettingError
from memcomp_lightning.models import (
    DBM,
    DBN,
    RBM,
    BoltzmannMachine,
    hidden_blocks,
    machine,
    mean_field,
    stacked,
    start_at_means,
)
from memcomp_lightning.models.units import Bernoulli, Categorical, Gaussian, Mixed, ReLU, Spin, Units
from memcomp_lightning.objective import Centring, contrast
from memcomp_lightning.samplers import ExactPosterior, positive_phase
from memcomp_lightning.testing import brute_force, small_dbn, small_layers, small_machines, small_rbms
from memcomp_lightning.types import Configurations

RBMS, MACHINES = small_rbms(), small_machines()
MODELS = RBMS | MACHINES
of_all = pytest.mark.parametrize("name", MODELS)
of_rbms = pytest.mark.parametrize("name", RBMS)


def configurations(model, n=4):
    """Values of all units, drawn at random."""
    generator = rng.stream(0, "configurations")
    found = []
    for units in (model.visible, model.hidden):
        field = rng.uniform((*model.replicas, n, units.n), generator=generator, like=model.b) - 0.5
        found.append(units.sample(field, generator=generator))
    return found


def close(found, true, tolerance=1e-9):
    torch.testing.assert_close(found, true, rtol=tolerance, atol=tolerance)


def coupled_hidden(model):
    return any(bool((block.neighbours >= model.n_visible).any()) for block in hidden_blocks(model))


# --- energies ---------------------------------------------------------------------------------------------


def check_energy(name):
    model = MODELS[name]().double()
    v, h = configurations(model)
    x = torch.cat((v, h), dim=-1)
    true = torch.stack([brute_force.energy(model, row) for row in x])
    close(model.energy(v, h), true)
    measures = model.visible.energy(v) + model.hidden.energy(h)
    close(model.tempered_energy(v, h), true - measures)
    weight = rng.uniform((len(v),), generator=rng.stream(1, "weights"), like=v) - 0.5
    close(model.total_energy(v, h, weight), (weight * true).sum())
    parameters = list(model.parameters())
    found = torch.autograd.grad(model.total_energy(v, h, weight), parameters)
    close(found, torch.autograd.grad((weight * true).sum(), parameters))


@of_all
def test_energy_is_the_sum_over_pairs_units_and_squares(name):
    check_energy(name)


def check_free_energy(name):
    model = RBMS[name]().double()
    v, h = configurations(model)
    n = model.n_visible
    first = torch.arange(model.n_units) < n
    for given, known, function in ((v, first, model.free_energy), (h, ~first, model.hidden_free_energy)):
        x = torch.zeros(len(v), model.n_units, dtype=torch.float64)
        x[:, known] = given
        true = torch.stack([brute_force.log_sum(model, row, known) for row in x])
        close(function(given), -true)


@of_rbms
def test_free_energies_are_sums_over_the_other_layer(name):
    check_free_energy(name)


def check_conditionals(name):
    """Means are the derivatives by the biases."""
    model = MODELS[name]().double()
    v, h = configurations(model)
    first = torch.arange(model.n_units) < model.n_visible
    found = [(v, first, model.c, model.hidden_mean), (h, ~first, model.b, model.visible_mean)]
    for given, known, bias, function in found[: 1 if model.n_hidden == 0 or name not in RBMS else 2]:
        if not bias.numel():
            continue
        x = torch.zeros(len(v), model.n_units, dtype=torch.float64)
        x[:, known] = given
        true = [torch.autograd.grad(brute_force.log_sum(model, row, known), bias)[0] for row in x]
        close(function(given).detach(), torch.stack(true), 1e-8)


@pytest.mark.parametrize("name", [name for name in MODELS if not coupled_hidden(MODELS[name]())])
def test_conditional_means_are_those_of_all_states(name):
    check_conditionals(name)


# --- expectations, gradients ------------------------------------------------------------------------------


def check_expectations(name):
    """Of everything that the energy is linear in: pairs, units, squares of real units of any variance."""
    model = MODELS[name]().double()
    parameters = list(model.parameters())
    for kind in model.modules():
        if isinstance(kind, Gaussian) and not kind.learned:
            parameters.append(kind.precision.requires_grad_())
    found = torch.autograd.grad(model.mean_energy(model.all_configurations()), parameters)
    true = torch.autograd.grad(-brute_force.log_sum(model), parameters)
    close(found, true)


@of_all
def test_all_configurations_have_all_expectations(name):
    check_expectations(name)


def phases(model, v):
    if isinstance(model, RBM):
        positive = positive_phase(model, v)
    else:
        positive = ExactPosterior().sample(model, v, generator=rng.stream(0, "unused")).configurations
    return positive, model.all_configurations()


def check_gradient(name):
    model = MODELS[name]().double()
    v, _ = configurations(model)
    parameters = list(model.parameters())
    found = torch.autograd.grad(contrast(model, *phases(model, v)), parameters)
    true = torch.autograd.grad(-brute_force.log_likelihood(model, v).mean(), parameters)
    close(found, true)


@of_all
def test_gradient_is_that_of_the_likelihood(name):
    check_gradient(name)


def check_centred(name):
    """The energy of centred units, its gradient turned into a step of the model's own parameters."""
    model = MODELS[name]().double()
    v, _ = configurations(model)
    positive, negative = phases(model, v)
    offsets = Centring().follow(None, positive)
    generator = rng.stream(0, "offsets")
    offsets = type(offsets)(*(x + 0.3 * rng.uniform(x.shape, generator=generator, like=x) for x in offsets))
    names, parameters = zip(*model.named_parameters(), strict=True)
    surrogate = contrast(model, positive, negative, offsets)
    close(surrogate, contrast(model, positive, negative))
    found = dict(zip(names, torch.autograd.grad(surrogate, parameters), strict=True))

    offset = torch.cat(offsets)
    matrix, bias = brute_force.couplings(model), torch.cat((model.b, model.c))

    def centred_mean(configurations):
        x = torch.cat(configurations[:2], dim=-1)
        weight = torch.ones(len(x), dtype=x.dtype) if configurations.weight is None else configurations.weight
        moved = x - offset
        energy = -0.5 * ((moved @ matrix) * moved).sum(-1) - x @ bias
        for site in brute_force.all_sites(model):
            if site.precision is not None:
                energy = energy + site.precision * moved[:, site.entries[0]] ** 2 / 2
        return (weight * energy).sum() / weight.sum()

    loss = centred_mean(positive) - centred_mean(negative)
    true = dict(zip(names, torch.autograd.grad(loss, parameters), strict=True))
    change = copy.deepcopy(model)
    with torch.no_grad():
        for key, parameter in change.named_parameters():
            parameter.copy_(true[key])
        for kind in change.modules():
            if isinstance(kind, Gaussian) and not kind.learned:
                kind.precision.zero_()
        moves = brute_force.couplings(change) @ offset
        for site in brute_force.sites_of(change.visible):
            if site.precision is not None:
                moves[site.entries[0]] -= site.precision * offset[site.entries[0]]
    n = model.n_visible
    true["b"], true["c"] = true["b"] - moves[:n], true["c"] - moves[n:]
    close(found, true)


@of_all
def test_centred_gradient_is_that_of_centred_units(name):
    check_centred(name)


# --- machines ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", MACHINES)
def test_mean_field_of_machines_is_its_fixed_point(name):
    model = MACHINES[name]().double()
    v, _ = configurations(model)
    found = mean_field(model, v, max_iterations=2000, tolerance=1e-12)
    assert bool(found.converged.all())
    field = torch.cat((v, found.h), dim=-1) @ brute_force.couplings(model) + torch.cat((model.b, model.c))
    close(found.h, model.hidden.mean(field[:, model.n_visible :]).detach(), 1e-8)
    minus_log_sum = -(brute_force.log_likelihood(model, v) + brute_force.log_sum(model))
    gap = model.free_energy(v) - minus_log_sum
    assert bool((gap > -1e-9).all())
    if not coupled_hidden(model):
        close(model.free_energy(v), minus_log_sum)


def test_real_units_are_in_one_class():
    """Couplings that would split them: each real unit hangs on another end of a chain."""
    pairs = [(0, 2), (2, 3), (1, 3)]
    model = BoltzmannMachine(visible=Gaussian(2), hidden=Spin(2), connectivity=pairs)
    assert [units.tolist() for units in model.classes] == [[0, 1], [2], [3]] or len(model.classes) == 3
    largest, others, kind = model.outside_largest_class()
    assert (largest.units.tolist(), others.tolist(), kind.n_states) == ([0, 1], [2, 3], 4)
    assert sorted(torch.cat(model.classes).tolist()) == [0, 1, 2, 3]
    with pytest.raises(SettingError, match=r"coupled real units = \[0, 1\] is not allowed"):
        BoltzmannMachine(visible=Gaussian(2), hidden=Spin(2), connectivity=[(0, 1), (0, 2), (1, 3)])


@pytest.mark.parametrize("visible", small_layers().values(), ids=small_layers())
def test_a_dbn_and_its_dbm_have_one_energy(visible):
    dbn = small_dbn(visible).double()
    dbm = DBM.from_dbn(dbn)
    v, h = configurations(dbm)
    layers = (v, *dbm.hidden_layers(h))
    close(dbm.energy(v, h), sum(rbm.energy(*layers[at : at + 2]) for at, rbm in enumerate(dbn)))
    close(dbn(v), dbn[1].hidden_mean(dbn[0].hidden_mean(v)))
    other = DBN(hidden_sizes=[3, 2], visible=visible).double()
    dbm.give(other)
    close(DBM.from_dbn(other).energy(v, h), dbm.energy(v, h))
    assert dbn.images_of(1, h[:, :3]).shape == v.shape


# --- replicas, files --------------------------------------------------------------------------------------


def part(model, make, at):
    """The model of one replica."""
    alone = make().to(model.b)
    with torch.no_grad():
        state = model.state_dict()
        for key, tensor in alone.state_dict().items():
            if tensor.is_floating_point():
                tensor.copy_(state[key][at])
    return alone


@of_all
def test_replicas_are_models_of_their_own(name):
    make = MODELS[name]
    model = make(replicas=(2, 2)).double()
    v, h = configurations(model)
    parts = [part(model, make, (i, j)) for i in range(2) for j in range(2)]
    rows = list(zip(v.flatten(0, 1), h.flatten(0, 1), strict=True))

    def same(function):
        each = [function(some, *row) for some, row in zip(parts, rows, strict=True)]
        found = function(model, v, h)
        close(found.detach(), torch.stack(each).reshape(found.shape).detach())

    same(lambda some, v, h: some.energy(v, h))
    same(lambda some, v, h: some.free_energy(v))
    same(lambda some, v, h: some.hidden_mean(v))
    same(lambda some, v, h: some.visible_mean(h))
    same(lambda some, v, h: some.mean_energy(some.all_configurations()))
    of_data = Configurations(v, h)
    whole = torch.autograd.grad(model.mean_energy(of_data).sum(), list(model.parameters()))
    for at, (some, row) in enumerate(zip(parts, rows, strict=True)):
        own = torch.autograd.grad(some.mean_energy(Configurations(*row)), list(some.parameters()))
        close([gradient.flatten(0, 1)[at] for gradient in whole], list(own))


@of_all
def test_state_dicts_go_round_and_stack(name):
    make = MODELS[name]
    model, other = make(), make(replicas=(2,))
    fresh = make()
    with torch.no_grad():
        for parameter in fresh.parameters():
            parameter.add_(1.0)
    fresh.load_state_dict(model.state_dict())
    v, h = configurations(model)
    assert fresh.energy(v, h).equal(model.energy(v, h))
    together = stacked([model, fresh], ())
    assert together.replicas == (2,)
    close(together.energy(v.expand(2, -1, -1), h.expand(2, -1, -1))[1], model.energy(v, h), 1e-5)
    assert stacked([other, other], (2,)).replicas == (4,)
    assert {key for key, _ in together.named_parameters()} == {key for key, _ in model.named_parameters()}


def test_names_of_models_of_bits_are_the_old_ones():
    assert list(RBM(3, 2).state_dict()) == ["b", "c", "weight"] or set(RBM(3, 2).state_dict()) == {
        "b",
        "c",
        "weight",
    }
    assert set(BoltzmannMachine(3, 2).state_dict()) == {"b", "c", "coupling", "pairs"}
    added = set(RBM(visible=Gaussian(3), hidden=Spin(2)).state_dict()) - {"b", "c", "weight"}
    assert added == {"visible.precision", "visible.first_precision"}


# --- what follows from data -------------------------------------------------------------------------------


def data_of(visible, n=50):
    generator = rng.stream(3, "data")
    field = rng.uniform((n, visible.n), generator=generator, like=torch.empty(0, dtype=torch.float64)) - 0.3
    return visible.double().sample(field, generator=generator)


def smoothed(visible, total, n):
    """Means with one more row of each value."""
    found = []
    for site in brute_force.sites_of(visible):
        own = total[site.entries]
        if site.values is None:
            found.append(own / n[site.entries])
        elif len(site.entries) > 1:
            found.append((own + 1) / (n[site.entries] + len(site.entries)))
        else:
            low, high = (float(x) for x in site.values.flatten())
            n_high = (own - low * n[site.entries]) / (high - low)
            found.append(low + (high - low) * (n_high + 1) / (n[site.entries] + 2))
    return torch.cat(found)


@pytest.mark.parametrize("masked", [False, True])
@pytest.mark.parametrize("kind", small_layers())
def test_models_start_at_means_and_variances(kind, masked):
    visible = small_layers()[kind]
    v = data_of(visible)
    model = RBM(visible=visible, hidden=Bernoulli(2)).double()
    with torch.no_grad():
        model.weight.zero_()
    observed = torch.ones_like(v, dtype=torch.bool)
    if masked:
        of_sites = rng.uniform((len(v), visible.n_sites), generator=rng.stream(4, "mask")) < 0.7
        of_sites[:, 0] |= ~of_sites.any(-1)
        observed = visible.over_sites(of_sites)
    start_at_means(model, torch.where(observed, v, torch.nan), observed if masked else None)
    known, n = torch.where(observed, v, 0.0), observed.sum(0).double()
    expected = smoothed(model.visible, known.sum(0), n)
    close(model.visible_mean(torch.zeros(1, 2, dtype=v.dtype))[0].detach(), expected)
    for site in brute_force.sites_of(model.visible):
        at = site.entries[0]
        learned = site.precision is not None and site.precision.requires_grad
        if learned:
            close(1 / site.precision.detach(), v[observed[:, at], at].var(correction=0))
    by_kind = dict(model.named_buffers())
    for key, tensor in by_kind.items():
        if key.endswith("first_precision") and "precision" in dict(model.named_parameters()):
            assert tensor.equal(dict(model.named_parameters())[key.replace("first_", "")])


def test_precisions_stay_within_bounds():
    model = RBM(visible=Gaussian(3, variance=torch.tensor([1.0, 0.25, 4.0])), hidden=Bernoulli(2))
    with torch.no_grad():
        model.visible.precision.copy_(torch.tensor([-1.0, 1e9, 0.3]))
    model.project()
    close(model.visible.precision.detach(), torch.tensor([0.05, 4e4, 0.3]), 1e-6)


# --- what is refused --------------------------------------------------------------------------------------

NAN, INF = float("nan"), float("inf")
REFUSED = {
    "bit above 1": (
        Bernoulli(3),
        [[0, 1, 2]],
        r"v in column 2, row 0 = 2\.0 is not allowed: .*\[0, 1\] for Bernoulli",
    ),
    "missing bit": (Bernoulli(3), [[0, NAN, 0]], r"v in column 1, row 0 = nan"),
    "spin below -1": (Spin(2), [[1, 1], [1, -3]], r"v in column 1, row 1 = -3\.0 .*\[-1, 1\] for spins"),
    "two states at once": (
        Categorical([2, 3]),
        [[1, 0, 0, 1, 0], [1, 0, 0, 1, 1]],
        r"entries together in column 1, row 1 = 2\.0 .* add up to 1",
    ),
    "no state": (Categorical([2, 3]), [[0, 0, 0, 1, 0]], r"entries together in column 0, row 0 = 0\.0"),
    "state as a number": (Categorical([2, 3]), [[0, 1, 2, 0, 0]], r"v in column 1, row 0 = 2\.0 .* encode"),
    "infinite": (Gaussian(2), [[0.5, INF]], r"v in column 1, row 0 = inf .*finite values for Gaussian"),
    "missing": (Gaussian(2), [[0.5, 1.0], [NAN, 1.0]], r"v in column 0, row 1 = nan .*mask"),
    "negative": (ReLU(2), [[0.5, -1.0]], r"v in column 1, row 0 = -1\.0 .*>= 0 for ReLU"),
    "in the last part": (
        Mixed(Bernoulli(2), Categorical([3]), Spin(2)),
        [[0, 1, 0, 1, 0, 1, 5]],
        r"column 4, row 0 = 5",
    ),
    "in a part of categories": (
        Mixed(Bernoulli(2), Categorical([3])),
        [[0, 1, 0, 0, 0]],
        r"together in column 2, row 0",
    ),
}


@pytest.mark.parametrize(("visible", "v", "message"), REFUSED.values(), ids=REFUSED)
def test_values_are_refused_by_column_and_value(visible, v, message):
    v = torch.tensor(v, dtype=torch.float32)
    with pytest.raises(SettingError, match=message):
        visible.check(v)
    with pytest.raises(SettingError, match=message):
        start_at_means(RBM(visible=visible, hidden=Bernoulli(2)), v)


def test_states_beyond_q_are_refused():
    with pytest.raises(SettingError, match=r"state in column 1, row 0 = 3 is not allowed: .* 0 to q - 1 = 2"):
        Categorical([2, 3]).encode(torch.tensor([[1, 3]]))
    with pytest.raises(SettingError, match=r"state in column 0, row 1 = -1"):
        Categorical([2, 3]).encode(torch.tensor([[1, 2], [-1, 0]]))
    with pytest.raises(SettingError, match=r"state in column 0, row 0 = 0\.5"):
        Categorical([2, 3]).encode(torch.tensor([[0.5, 1.0]]))
    with pytest.raises(SettingError, match=r"shape of states = \(1, 3\)"):
        Categorical([2, 3]).encode(torch.zeros(1, 3))
    states = torch.tensor([[1, 2], [0, 0]])
    assert Categorical([2, 3]).decode(Categorical([2, 3]).encode(states)).equal(states)


def test_columns_are_sites_of_the_whole_table():
    mixed = Mixed(Bernoulli(2), Categorical([3, 4]), Spin(1), Categorical([2]))
    kept = torch.tensor([[0.0, 1, 2, 3, 1, 1], [1, 1, 0, 3, -1, 2]])
    with pytest.raises(SettingError, match=r"state in column 5, row 1 = 2\.0 is not allowed: .* = 1"):
        mixed.encode(kept)
    v = mixed.encode(kept.clamp(max=torch.tensor([1.0, 1, 2, 3, 1, 1])))
    mixed.check(v)
    v[1, 9] = 3.0  # the spin
    with pytest.raises(SettingError, match=r"v in column 4, row 1 = 3\.0"):
        mixed.check(v)
    with pytest.raises(SettingError, match=r"entries together in column 0 = 2\.0"):
        Categorical([3]).check(torch.tensor([1.0, 1.0, 0.0]))  # a single row


def test_variances_of_zero_and_constant_columns_are_refused():
    with pytest.raises(SettingError, match=r"variance of column 1 = 0\.0 is not allowed: .*> 0 for Gaussian"):
        Gaussian(2, variance=torch.tensor([1.0, 0.0]))
    with pytest.raises(SettingError, match=r"variance of column 0 = -1\.0"):
        Gaussian(2, variance=-1.0)
    with pytest.raises(SettingError, match=r"shape of variance = \(3,\)"):
        Gaussian(2, variance=torch.ones(3))
    v = torch.full((1000, 4), 0.1)  # its variance in float32 is above zero
    v[:, :3] = rng.uniform((1000, 3), generator=rng.stream(0, "data")).round()
    model = RBM(visible=Mixed(Bernoulli(2), Gaussian(2)), hidden=Bernoulli(2))
    message = r"variance of column 3 = 0\.0 is not allowed: .* Leave out columns that are constant"
    observed = torch.ones_like(v, dtype=torch.bool)
    observed[::3] = False
    observed[::3, 0] = True
    for mask in (None, observed):
        with pytest.raises(SettingError, match=message):
            start_at_means(model, v, mask)
    fixed = RBM(visible=Mixed(Bernoulli(2), Gaussian(2, learned=False)), hidden=Bernoulli(2))
    start_at_means(fixed, v)


def test_kinds_that_do_not_fit_are_refused():
    with pytest.raises(SettingError, match="kinds of visible and hidden units = 'Gaussian and ReLU'"):
        RBM(visible=Gaussian(3), hidden=ReLU(2))
    with pytest.raises(SettingError, match=r"precision of the hidden units = 'learned'.*learned=False"):
        RBM(visible=Bernoulli(3), hidden=Gaussian(2))
    with pytest.raises(SettingError, match="kind of the hidden units = 'ReLU'"):
        BoltzmannMachine(visible=Bernoulli(3), hidden=ReLU(2))
    with pytest.raises(SettingError, match="n_visible = 4 is not allowed: expected 3"):
        RBM(4, 2, visible=Spin(3))
    with pytest.raises(SettingError, match="visible units = 3"):
        RBM(visible=3, hidden=Spin(2))


# --- mutants ----------------------------------------------------------------------------------------------


def constant(shift):
    return lambda right: lambda *given, **settings: right(*given, **settings) + shift


def times(factor):
    return lambda right: lambda *given, **settings: factor * right(*given, **settings)


def of_means(right):
    return Units.points


MUTANTS = {
    "bits: energy of the other sign": (RBM, "tempered_energy", times(-1.0), check_energy, "bits x bits"),
    "bits: cumulant twice": (Bernoulli, "cumulant", times(2.0), check_free_energy, "bits x bits"),
    "spins: log 2 left out": (Spin, "cumulant", constant(-0.6931), check_free_energy, "bits x spins"),
    "spins: mean of the other sign": (Spin, "mean", times(-1.0), check_conditionals, "spins x spins"),
    "spins: gradient": (Spin, "mean", times(0.5), check_gradient, "spins x spins"),
    "categories: means of half": (Categorical, "mean", times(0.5), check_expectations, "categories x bits"),
    "categories: cumulant": (Categorical, "cumulant", constant(0.1), check_free_energy, "categories x categories"),
    "real: no spread": (Gaussian, "points", of_means, check_expectations, "real x bits"),
    "real: no spread in a machine": (Gaussian, "points", of_means, check_expectations, "DBM of real units"),
    "real: measure counted twice": (Gaussian, "energy", times(2.0), check_energy, "real x bits"),
    "real: gradient of precisions": (Gaussian, "total_energy", times(0.5), check_gradient, "real x spins"),
    "real: cumulant": (Gaussian, "cumulant", constant(0.9), check_free_energy, "real x spins"),
    "ReLU: mode in place of the mean": (ReLU, "mean", lambda _: ReLU.mode, check_gradient, "bits x ReLU"),
    "ReLU: measure left out": (ReLU, "energy", times(0.0), check_energy, "spins x ReLU"),
    "mixed: no spread": (Mixed, "points", of_means, check_expectations, "mixed x spins"),
    "mixed: measure left out": (Mixed, "total_energy", times(0.0), check_energy, "mixed x bits"),
    "machine: couplings counted twice": (
        BoltzmannMachine,
        "tempered_energy",
        times(2.0),
        check_energy,
        "categories, all pairs",
    ),
    "centred: a fixed precision moves": (
        machine,
        "_learned",
        lambda right: lambda units, device: torch.ones(units.n, dtype=torch.bool),
        check_centred,
        "mixed x bits",
    ),
    "centred: biases stand still": (
        machine,
        "_learned",
        lambda right: lambda units, device: torch.zeros(units.n, dtype=torch.bool),
        check_centred,
        "real x bits",
    ),
    "centred: not at all": (
        RBM,
        "_own_moments",
        lambda _: lambda s, centred, *o: s._plain_moments(centred, *o),
        check_centred,
        "spins x bits",
    ),
}


@pytest.mark.parametrize(("owner", "attribute", "change", "check", "name"), MUTANTS.values(), ids=MUTANTS)
def test_a_mutant_is_seen(owner, attribute, change, check, name, monkeypatch):
    check(name)
    monkeypatch.setattr(owner, attribute, change(getattr(owner, attribute)))
    with pytest.raises(AssertionError):
        check(name)
