"""Missing values given the observed ones, of models of all kinds of units, against sums over all states."""

import itertools
import weakref
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode

from memcomp_lightning import rng
from memcomp_lightning.likelihood.missing import (
    Conditional,
    HiddenSums,
    MissingChains,
    MissingSums,
    ObservedAis,
    finders,
    of_observed,
)
from memcomp_lightning.likelihood.missing.base import SHARES, drawn, real_entries
from memcomp_lightning.likelihood.missing.chains import COMPONENTS, _swept
from memcomp_lightning.likelihood.missing.choice import missing_bits
from memcomp_lightning.likelihood.missing.ladders import Ladders
from memcomp_lightning.likelihood.missing.states import patterns
from memcomp_lightning.likelihood.values import has_free_energy
from memcomp_lightning.models import RBM, BoltzmannMachine
from memcomp_lightning.models.observed import visible_units_coupled
from memcomp_lightning.models.units import Bernoulli, Categorical, Gaussian, Mixed, Spin
from memcomp_lightning.testing import brute_force, enumerated, small_machines, small_rbm, small_rbms

MODELS = {**small_rbms(), **small_machines()}
OF_RELU = {name: make for name, make in small_rbms().items() if name.endswith("ReLU")}
FEW = {name: make for name, make in MODELS.items() if name not in OF_RELU}
CHAINS = MissingChains(n_chains=240, n_sweeps=40, most_sweeps=40)
EXACT, DRAWN = 1e-5, 0.03
N = 4


def rows_of(model: Any) -> tuple[Tensor, Tensor]:
    """Rows of which all, nothing, some and one of the values are missing."""
    generator = rng.stream(0, "rows")
    v = model.visible.sample(torch.zeros(N, model.n_visible), generator=generator).to(model.b.dtype)
    sites = torch.zeros(N, model.visible.n_sites, dtype=torch.bool)
    sites[1:] = True
    sites[2, ::2] = False
    sites[3, -1] = False
    return v, model.visible.over_sites(sites)


def find(way: Any, model: Any, v: Tensor, observed: Tensor, m: int = 0) -> Conditional:
    found: Conditional = way.find(model, v, observed, m=m, generator=rng.stream(0, "way"))
    return found


def check(model: Any, v: Tensor, observed: Tensor, found: Conditional, tolerance: float) -> None:
    real = real_entries(model.visible)
    scale = torch.ones(model.n_visible)
    if len(real):
        scale[real] = 3 * model.visible.curvature[real].rsqrt()
    for row in range(N):
        exact, missing = enumerated(model, v[row], observed[row]), ~observed[row]
        x, p = exact.x[:, : model.n_visible].double(), exact.probability
        mean = p @ x
        deviation = (p @ (x - mean).square() + exact.variance[: model.n_visible]).sqrt()
        off = (found.mean[row] - mean).abs() / scale
        assert bool((off[missing] < tolerance).all())
        for column, entry in enumerate(real.tolist()):
            if not missing[entry]:
                continue
            of_deviation, *ends = found.real[:, row, column].tolist()
            assert of_deviation == pytest.approx(float(deviation[entry]), rel=4 * tolerance)
            for end, share in zip(ends, SHARES, strict=True):
                below = p @ torch.special.ndtr((end - x[:, entry]) / exact.variance[entry].sqrt())
                assert float(below) == pytest.approx(share, abs=tolerance)


@pytest.mark.parametrize("make", FEW.values(), ids=FEW)
def test_chains_and_sums_give_the_probabilities_of_all_states(make: Any) -> None:
    model = make()
    v, observed = rows_of(model)
    check(model, v, observed, find(CHAINS, model, v, observed), DRAWN)
    if not model.hidden.real and not visible_units_coupled(model):
        check(model, v, observed, find(HiddenSums(), model, v, observed), EXACT)
    if has_free_energy(model) and not model.visible.real:
        check(model, v, observed, find(MissingSums(), model, v, observed), EXACT)


@pytest.mark.parametrize("name", ["mixed x bits", "spins x spins", "mixed", "DBM of categories", "bits x real"])
def test_chains_on_ladders_of_temperatures_do_so_too(name: str) -> None:
    """None of them agrees as closely as is asked for here, so that all go on with temperatures."""
    model = MODELS[name]()
    v, observed = rows_of(model)
    way = MissingChains(n_chains=100, n_sweeps=30, most_sweeps=60, r_hat=1 + 1e-9, n_temperatures=3)
    check(model, v, observed, find(way, model, v, observed), DRAWN)


@pytest.mark.parametrize("make", OF_RELU.values(), ids=OF_RELU)
def test_relu_units_are_integrated_out(make: Any) -> None:
    """Their integrals are those of a quadrature, because they have no list of states."""
    model = make()
    v, observed = rows_of(model)
    summed, drawn = (find(way, model, v, observed) for way in (MissingSums(), CHAINS))
    assert bool(((summed.mean - drawn.mean).abs() < DRAWN)[~observed].all())
    hidden = torch.zeros(model.n_hidden)
    for site in brute_force.sites_of(model.visible):
        if bool(observed[2, site.entries].all()) or site.values is None:
            continue
        weights = []
        for state in site.values:
            row, mask = v[2].clone(), observed[2].clone()
            row[site.entries], mask[site.entries] = state, True
            with torch.no_grad():
                weights.append(
                    brute_force.log_sum(model.double(), torch.cat((row, hidden)), torch.cat((mask, hidden.bool())))
                )
        mean = torch.softmax(torch.stack(weights), 0) @ site.values.double()
        assert summed.mean[2, site.entries].allclose(mean, atol=EXACT)


@pytest.mark.parametrize("way", [HiddenSums(), CHAINS], ids=["sums", "chains"])
def test_the_check_sees_what_is_wrong(way: Any) -> None:
    """Of what forgets the known values, and of real values that are taken for normal ones."""
    model = MODELS["mixed x bits"]()
    with torch.no_grad():
        model.weight.mul_(3)
    v, observed = rows_of(model)
    found = find(way, model, v, observed)
    check(model, v, observed, found, DRAWN)
    blind = find(way, model, v, torch.zeros_like(observed))
    with pytest.raises(AssertionError):
        check(model, v, observed, found._replace(mean=blind.mean), DRAWN)
    of_one = found.real.clone()
    of_one[0] = model.visible.curvature[real_entries(model.visible)].rsqrt()
    with pytest.raises(AssertionError):
        check(model, v, observed, found._replace(real=of_one), DRAWN)


@pytest.mark.parametrize(
    "way",
    [HiddenSums(), MissingSums(), MissingChains(n_chains=2, n_sweeps=40, most_sweeps=40)],
    ids=["hidden", "missing", "chains"],
)
def test_draws_are_joint_and_keep_what_is_known(way: Any) -> None:
    """Two bits that a hidden unit ties together are drawn alike, though each is 0 or 1 at even odds."""
    model = small_rbm(visible=Bernoulli(3), hidden=Bernoulli(1))
    with torch.no_grad():
        model.weight.fill_(0.0)
        model.weight[0, :2] = 12.0
        model.b.copy_(torch.tensor([-6.0, -6.0, 0.0]))
        model.c.fill_(-12.0)
    v, observed = torch.ones(400, 3), torch.tensor([[False, False, True]]).expand(400, 3)
    draws = find(way, model, v, observed, m=2).draws
    assert bool((draws[..., 2] == 1).all())
    assert bool(((draws[..., 0] == draws[..., 1]).double().mean(-1) > 0.95).all())
    assert bool(((draws[..., 0].mean(-1) - 0.5).abs() < 0.1).all())
    assert not draws[0].equal(draws[1])


def test_chains_that_stay_apart_say_so() -> None:
    """Two patterns that no chain leaves: R-hat is far above 1, unless known spins decide, or temperatures help."""
    model = small_rbm(visible=Spin(8), hidden=Spin(1))
    with torch.no_grad():
        model.weight.fill_(4.0)
        model.b.fill_(0.0)
        model.c.fill_(0.0)
    v, observed = torch.ones(2, 8), torch.zeros(2, 8, dtype=torch.bool)
    observed[1, :4] = True
    alone = find(MissingChains(n_temperatures=1, most_sweeps=400), model, v, observed)
    assert alone.r_hat[0] > 2
    tempered = find(MissingChains(), model, v, observed)
    assert tempered.r_hat[0] < 1.1
    assert bool((tempered.mean[0].abs() < 0.2).all())
    for found in (alone, tempered):
        assert found.r_hat[1] < 1.05
        assert bool((found.mean[1, 4:] > 0.99).all())


def test_each_row_is_found_by_the_shortest_way() -> None:
    observed = torch.ones(3, 6, dtype=torch.bool)
    observed[1, 0] = observed[2, 5] = False
    units = Mixed(Bernoulli(5), Gaussian(1))
    few, many = (small_rbm(visible=units, hidden=Bernoulli(n)) for n in (12, 13))
    assert [(type(way), rows.tolist()) for way, rows in finders(few, observed)] == [(HiddenSums, [1, 2])]
    ways = [(type(way), rows.tolist()) for way, rows in finders(many, observed)]
    assert ways == [(MissingSums, [1]), (MissingChains, [2])]
    categories = small_rbm(visible=Categorical([1, 2, 4]), hidden=Bernoulli(1))
    assert missing_bits(categories, torch.zeros(1, 7, dtype=torch.bool)).tolist() == [3.0]


@pytest.mark.parametrize("make", MODELS.values(), ids=MODELS)
def test_observed_values_are_as_likely_as_sums_say(make: Any) -> None:
    model = make().double()
    v, observed = rows_of(model)
    log_z = brute_force.log_sum(model)
    exact = brute_force.log_likelihood(model, v, observed) + log_z
    if visible_units_coupled(model):
        found = of_observed(model, v, observed, generator=rng.stream(0, "gaps"))
        few = missing_bits(model, observed) <= 10
        assert found.log_weight[few].allclose(exact[few], atol=1e-9)
        assert bool(found.log_weight[~few].isnan().all())
        return
    ais = ObservedAis(n_chains=200, n_betas=20)
    if not model.hidden.real or not model.visible.real:
        found = of_observed(model, v, observed, generator=rng.stream(0, "gaps"), annealing=ais)
        assert bool(((found.log_weight - exact).abs() <= 1e-6 + 4 * found.standard_error).all())
    if not model.hidden.real or has_free_energy(model):
        few = (missing_bits(model, observed) < 20).nonzero().flatten()
        for rows, _, _, log_weight in patterns(model, v[few], observed[few]):
            assert log_weight.logsumexp(-1).allclose(exact[few][rows], atol=1e-6)
    if has_free_energy(model):
        annealed = ais.estimate(model, v, observed, generator=rng.stream(0, "ais"))
        assert bool(((annealed.log_weight - exact).abs() <= 1e-6 + 4 * annealed.standard_error).all())
        assert bool((annealed.standard_error < 0.1).all())


def test_a_potts_model_tells_rows_with_few_gaps_and_has_no_number_for_those_with_many() -> None:
    machine = BoltzmannMachine(visible=Categorical(4, q=8), n_hidden=0).double()
    with torch.no_grad():
        machine.coupling.normal_(0, 0.5, generator=rng.stream(0, "couplings"))
    v = machine.visible.encode(torch.tensor([[0.0, 3, 7, 1], [2.0, 2, 2, 2], [1.0, 5, 0, 6]]).double())
    known = torch.tensor([[True, True, True, False], [True, False, False, False], [False, True, False, False]])
    known[2, 0] = True
    observed = machine.visible.over_sites(known)  # 3, 9 and 6 bits are missing
    found = of_observed(machine, v, observed, generator=rng.stream(0, "gaps"))
    exact = brute_force.log_likelihood(machine, v, observed) + brute_force.log_sum(machine)
    torch.testing.assert_close(found.log_weight, exact.detach())
    assert [type(way) for way, _ in finders(machine, observed)] == [MissingSums]
    observed[1] = False  # 12 bits
    found = of_observed(machine, v, observed, generator=rng.stream(0, "gaps"))
    assert found.log_weight.isnan().tolist() == [False, True, False]


class Held(TorchDispatchMode):
    """The most numbers that tensors made within hold at a time, in float64's."""

    def __init__(self) -> None:
        super().__init__()
        self.now, self.most = 0.0, 0.0
        self.known: set[int] = set()

    def __torch_dispatch__(self, function: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        made = function(*args, **(kwargs or {}))
        for tensor in made if isinstance(made, list | tuple) else [made]:
            if isinstance(tensor, Tensor) and (storage := tensor.untyped_storage())._cdata not in self.known:
                self.known.add(storage._cdata)
                self.now += storage.nbytes() / 8
                self.most = max(self.most, self.now)
                weakref.finalize(storage, self._gone, storage._cdata, storage.nbytes() / 8)
        return made

    def _gone(self, key: int, numbers: float) -> None:
        self.known.discard(key)
        self.now -= numbers


@pytest.mark.parametrize("m", [0, 10, 40])
@pytest.mark.parametrize(
    ("way", "model"),
    [
        (HiddenSums(), RBM(20, 6)),
        (HiddenSums(), RBM(40, 2)),
        (MissingSums(), RBM(20, 6)),
        (MissingChains(n_chains=8, n_sweeps=4, most_sweeps=4), RBM(20, 6)),
        (MissingChains(n_chains=8, n_sweeps=4, most_sweeps=4), RBM(visible=Gaussian(20), hidden=Bernoulli(6))),
    ],
    ids=["sums over 6 hidden", "sums over 2 hidden", "sums over missing", "chains", "chains of real values"],
)
def test_rows_take_about_the_memory_that_is_said(way: Any, model: Any, m: int) -> None:
    observed = torch.ones(300, model.n_visible, dtype=torch.bool)
    observed[:, :3] = False
    most = []
    for n in (100, 300):
        v = model.visible.sample(torch.zeros(n, model.n_visible), generator=rng.stream(0, "rows"))
        with Held() as held:
            find(way, model, v, observed[:n], m)
        most.append(held.most)
    a_row = (most[1] - most[0]) / 200
    assert way.numbers_a_row(model, m) / 8 < a_row < 4 * way.numbers_a_row(model, m)


def test_a_number_that_rounding_makes_the_whole_sum_draws_the_last(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(rng, "uniform", lambda size, **_: torch.ones(size))
    assert (
        drawn(torch.tensor([[0.25, 0.75], [1.0, 0.0]]), 3, generator=rng.stream(0, "draws")).tolist()
        == [[1, 1]] * 3
    )


@pytest.mark.parametrize("every", [1, 3, 4])
def test_components_are_spread_over_the_sweeps(every: int) -> None:
    number = itertools.count()
    ladders: Any = SimpleNamespace(
        model=SimpleNamespace(n_visible=1),
        n=1,
        n_chains=1,
        x=torch.zeros(1, 1),
        sweep=lambda *_, **__: torch.tensor([[next(number)]]),
    )
    sums = _swept(ladders, every * COMPONENTS, torch.tensor([0]), rng.stream(0, "sweeps"))
    assert sums.components.flatten().tolist() == [*range(0, every * COMPONENTS, every)]


def test_hidden_units_are_drawn_first() -> None:
    """They follow the start of the visible ones, which holds what is observed."""
    model = RBM(4, 3)
    known = torch.ones(1, 4, dtype=torch.bool)
    ladders = Ladders.begun(model, torch.zeros(1, 4), known, 2, rng.stream(0, "ladders"))
    assert ladders.blocks[0].units.tolist() == [4, 5, 6]
