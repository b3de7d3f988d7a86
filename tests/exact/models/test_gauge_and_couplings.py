"""The zero-sum gauge changes no probability; couplings, effective ones and scores of contacts against loops."""

import copy
import itertools
import math

import pytest
import torch

from memcomp_lightning import rng
from memcomp_lightning.errors import SettingError
from memcomp_lightning.models import DBN, RBM, BoltzmannMachine, Normal, contact_scores, couplings, zero_sum
from memcomp_lightning.models.units import Bernoulli, Categorical, Gaussian, Mixed, Spin, all_states
from memcomp_lightning.objective import Offsets, contrast
from memcomp_lightning.samplers import Exact, PseudoLikelihood, positive_phase
from memcomp_lightning.training import L2, EnergyStep
from memcomp_lightning.training.step import StepState
from memcomp_lightning.types import Configurations, NoState

VISIBLE = {
    "categories": lambda: Categorical(3, q=3),
    "ragged": lambda: Categorical([2, 4, 1]),
    "mixed": lambda: Mixed(Spin(1), Categorical([3, 2]), Bernoulli(1)),
    "spins": lambda: Spin(4),
    "bits": lambda: Bernoulli(4),
}
HIDDEN = {"none": None, "bits": lambda: Bernoulli(2), "categories": lambda: Categorical([2, 3])}


def made(visible, hidden=None, replicas=(2,), std=0.7):
    generator = rng.stream(0, "test model")
    settings = {"replicas": replicas, "weight_init": Normal(std=std), "generator": generator}
    model = (
        BoltzmannMachine(visible=visible, n_hidden=0, **settings)
        if hidden is None
        else RBM(visible=visible, hidden=hidden, **settings)
    )
    with torch.no_grad():
        model.b.normal_(0.3, 0.5, generator=generator)
        model.c.normal_(-0.2, 0.5, generator=generator)
    return model.double()


def joint(model):
    """All joint states and their energies."""
    v = all_states(model.visible, model.b)
    h = all_states(model.hidden, model.b) if model.n_hidden else v.new_zeros(1, 0)
    v, h = v.repeat_interleave(len(h), 0), h.repeat(len(v), 1)
    v, h = (x.expand(*model.replicas, *x.shape) for x in (v, h))
    return model.energy(v, h)


def noise(*shape, seed):
    return torch.empty(*shape, dtype=torch.float64).normal_(generator=rng.stream(seed, "noise"))


def assert_in_gauge(x, units):
    sums = units.site_sums(units.zero_sum(x) - x)
    torch.testing.assert_close(sums, torch.zeros_like(sums), rtol=0, atol=1e-12)


@pytest.mark.parametrize("hidden", HIDDEN)
@pytest.mark.parametrize("visible", VISIBLE)
def test_gauge_changes_no_probability(visible, hidden):
    model = made(VISIBLE[visible](), hidden=HIDDEN[hidden] and HIDDEN[hidden]())
    before, old = joint(model), copy.deepcopy(model)
    gained = zero_sum(model)
    after = joint(model)
    torch.testing.assert_close(after, before + gained.unsqueeze(-1))
    torch.testing.assert_close(after.softmax(-1), before.softmax(-1))
    torch.testing.assert_close((-after).logsumexp(-1), (-before).logsumexp(-1) - gained)
    assert_in_gauge(model.b, model.visible)
    if isinstance(model, RBM):
        assert_in_gauge(model.weight, model.visible)
        assert_in_gauge(model.weight.mT, model.hidden)
    changed = any(not a.equal(b) for a, b in zip(old.parameters(), model.parameters(), strict=True))
    one_hot = any("categor" in name or name in ("ragged", "mixed") for name in (visible, hidden))
    assert changed == one_hot
    again = zero_sum(model)
    torch.testing.assert_close(again, torch.zeros_like(again), rtol=0, atol=1e-12)


def test_gauge_of_a_machine_with_hidden_units():
    model = BoltzmannMachine(
        visible=Categorical([2, 3]),
        hidden=Categorical([3]),
        connectivity=[(0, 1), (1, 2)],
        weight_init=Normal(std=0.7),
    ).double()
    before = joint(model)
    torch.testing.assert_close(joint(model), before)
    gained = zero_sum(model)
    torch.testing.assert_close(joint(model), before + gained)
    matrix = torch.zeros(8, 8).double()
    matrix[model.pairs[:, 0], model.pairs[:, 1]] = model.coupling.detach()
    for rows, columns in (((0, 2), (2, 5)), ((2, 5), (5, 8))):
        block = matrix[slice(*rows), slice(*columns)]
        assert block.any()
        for axis in (0, 1):
            torch.testing.assert_close(block.sum(axis), torch.zeros_like(block.sum(axis)), rtol=0, atol=1e-12)


def test_gauge_beside_real_units():
    model = RBM(visible=Mixed(Gaussian(2), Categorical([3])), hidden=Spin(2), weight_init=Normal(std=0.7))
    v = torch.cat((noise(6, 2, seed=0).float(), torch.eye(3).repeat(2, 1)), dim=-1)
    h = torch.tensor([[1.0, -1.0]]).repeat(6, 1)
    before = model.energy(v, h)
    gained = zero_sum(model)
    torch.testing.assert_close(model.energy(v, h), before + gained)


def test_gauge_is_that_of_the_least_squares():
    model = made(Categorical([2, 4, 3]), HIDDEN["categories"]())
    before = L2(1.0)(model)
    zero_sum(model)
    least = L2(1.0)(model)
    assert bool((least < before).all())


@pytest.mark.parametrize("hidden", ["none", "bits"])
def test_centred_training_keeps_the_gauge(hidden):
    """The gradient of a site's couplings adds up to zero with centring, and does not without it."""
    model = made(VISIBLE["ragged"](), hidden=HIDDEN[hidden] and HIDDEN[hidden]())
    zero_sum(model)
    field = torch.zeros(2, 9, 7, dtype=torch.float64)
    v = model.visible.sample(field, generator=rng.stream(1, "data"))
    positive = positive_phase(model, v)
    offsets = Offsets(v.mean(-2), positive.h.mean(-2))
    for sampler in (Exact(), PseudoLikelihood()):
        found = sampler.sample(model, NoState(), positive, generator=rng.stream(2, "x")).configurations
        kept = []
        for centres in (offsets, None):
            moved = copy.deepcopy(model)
            contrast(moved, positive, found, centres).sum().backward()
            with torch.no_grad():
                for parameter in moved.parameters():
                    if parameter.grad is not None:
                        parameter -= 0.1 * parameter.grad
            before = [parameter.detach().clone() for parameter in moved.parameters()]
            zero_sum(moved)
            pairs = zip(before, moved.parameters(), strict=True)
            kept.append(all(bool(((a - b).abs() < 1e-12).all()) for a, b in pairs))
        assert kept == [True, False]


# --- couplings --------------------------------------------------------------------------------------------


def values(units):
    """What entries are in J and h: spins, and states."""
    states = all_states(units, torch.empty(0, dtype=torch.float64))
    kinds = units.kinds if isinstance(units, Mixed) else [units]
    is_bit = torch.cat([torch.full((kind.n,), isinstance(kind, Bernoulli)) for kind in kinds])
    return torch.where(is_bit, 2 * states - 1, states), states


@pytest.mark.parametrize("visible", VISIBLE)
def test_couplings_of_a_machine_are_its_energy(visible):
    model = made(VISIBLE[visible]())
    kept = copy.deepcopy(model)
    found = couplings(model)
    x, states = values(model.visible)
    energy = -0.5 * torch.einsum("si,rij,sj->rs", x, found.J, x) - torch.einsum("si,ri->rs", x, found.h)
    wide = states.expand(2, *states.shape)
    true = model.energy(wide, wide[..., :0])
    constant = (energy - true)[:, :1]
    torch.testing.assert_close(energy - true, constant.expand_as(true))
    assert found.J.equal(found.J.mT)
    assert_in_gauge(found.J, model.visible)
    assert_in_gauge(found.h, model.visible)
    assert all(a.equal(b) for a, b in zip(kept.parameters(), model.parameters(), strict=True))


def test_couplings_of_spins_are_the_parameters():
    model = made(Spin(4))
    found = couplings(model)
    for number, (i, j) in enumerate(model.pairs.tolist()):
        assert found.J[:, i, j].equal(model.coupling[:, number])
    assert found.h.equal(model.b)


def test_blocks_and_tables():
    found = couplings(made(VISIBLE["ragged"]()))
    J, h = found.by_states()
    assert J.shape == (2, 3, 4, 3, 4)
    assert h.shape == (2, 3, 4)
    sizes = found.units.sizes
    for i, j in itertools.product(range(3), repeat=2):
        assert J[:, i, : sizes[i], j, : sizes[j]].equal(found.block(i, j))
        assert not J[:, i, sizes[i] :].any()
    assert torch.cat([h[:, i, :size] for i, size in enumerate(sizes)], dim=-1).equal(found.h)


def expansion(model):
    """J and h of log p(v) by sums over all states: means of log p with sites held, in zero-sum form."""
    units = model.visible
    x, states = values(units)
    log_p = -model.free_energy(states.expand(2, *states.shape))
    n, site_of = units.n, units.site_of().tolist()
    signs = [-1 if bool((x[:, i] < 0).any()) else 0 for i in range(n)]

    def mean(conditions):
        rows = torch.ones(len(x), dtype=torch.bool)
        for entry, value in conditions:
            rows &= x[:, entry] == value
        return log_p[:, rows].mean(-1)

    def single(i):
        centre = log_p.mean(-1)
        return mean([(i, 1)]) - centre

    h = torch.stack([single(i) for i in range(n)], dim=-1)
    J = torch.zeros(2, n, n).double()
    for i, j in itertools.product(range(n), repeat=2):
        if site_of[i] != site_of[j]:
            J[:, i, j] = mean([(i, 1), (j, 1)]) - single(i) - single(j) - log_p.mean(-1)
    assert set(signs) <= {-1, 0}
    return J, h


@pytest.mark.parametrize("visible", VISIBLE)
def test_effective_couplings_of_gaussian_hidden_units_are_exact(visible):
    """A Hopfield model: J = W^T W / precision."""
    model = made(VISIBLE[visible](), Gaussian(3, variance=0.7, learned=False))
    found = couplings(model)
    J, h = expansion(model)
    torch.testing.assert_close(found.J, J)
    torch.testing.assert_close(found.h, h)


@pytest.mark.parametrize("hidden", [Bernoulli(4), Spin(4)], ids=["bits", "spins"])
@pytest.mark.parametrize("visible", [Categorical([3, 2]), Spin(2), Mixed(Bernoulli(1), Categorical([3]))])
def test_effective_couplings_of_two_sites_are_exact(visible, hidden):
    model = made(visible, hidden, std=1.5)
    found = couplings(model)
    torch.testing.assert_close(found.J, expansion(model)[0])
    assert found.J.abs().max() > 0.05


@pytest.mark.parametrize("visible", [Categorical(4, q=3), Spin(8)], ids=["categories", "spins"])
def test_effective_couplings_of_many_sites_are_close(visible):
    """Within a few per cent; the formula for two sites by themselves is farther off."""
    model = made(visible, Spin(3), std=0.5)
    found, (J, h) = couplings(model), expansion(model)
    assert (found.J - J).norm() < 0.06 * J.norm()
    assert (found.h - h).norm() < 0.06 * h.norm()
    if isinstance(visible, Spin):
        field, w = model.c.detach(), model.weight.detach()
        alone = torch.zeros_like(J)
        for i, j in itertools.permutations(range(8), 2):
            for s, t in itertools.product((-1, 1), repeat=2):
                alone[:, i, j] += (
                    s * t * torch.log(2 * torch.cosh(field + s * w[..., i] + t * w[..., j])).sum(-1) / 4
                )
        assert (alone - J).norm() > 2 * (found.J - J).norm()


# --- contacts ---------------------------------------------------------------------------------------------


def scores_by_loops(found, gap=None, corrected=True):
    units, J = found.units, found.J[0].tolist()
    site_of, n = units.site_of().tolist(), units.n_sites
    begin = [site_of.index(site) for site in range(n)]
    norms = [[0.0] * n for _ in range(n)]
    for i, j in itertools.product(range(n), repeat=2):
        total = 0.0
        for a, b in itertools.product(range(units.n), repeat=2):
            here = site_of[a] == i and site_of[b] == j and i != j
            if here and a - begin[i] != gap and b - begin[j] != gap:
                total += J[a][b] ** 2
        norms[i][j] = math.sqrt(total)
    if not corrected:
        return norms
    of_site = [sum(row) / (n - 1) for row in norms]
    mean = sum(of_site) / n
    return [[0.0 if i == j else norms[i][j] - of_site[i] * of_site[j] / mean for j in range(n)] for i in range(n)]


@pytest.mark.parametrize("gap", [None, 0, 2])
@pytest.mark.parametrize("corrected", [True, False])
def test_scores_are_those_of_loops(corrected, gap):
    model = made(Categorical(5, q=3))
    scores = contact_scores(model, gap=gap, corrected=corrected)
    wanted = torch.tensor(scores_by_loops(couplings(model), gap, corrected)).double()
    torch.testing.assert_close(scores[0], wanted)
    assert scores.equal(scores.mT)
    assert not scores.diagonal(dim1=-2, dim2=-1).any()


@pytest.mark.parametrize("hidden", HIDDEN)
def test_scores_do_not_depend_on_the_gauge(hidden):
    """Norms of the couplings as they stand do."""
    model = made(Categorical([3, 4, 2]), hidden=None if hidden == "none" else Bernoulli(2))
    before = contact_scores(model)
    with torch.no_grad():
        parameter = model.weight if isinstance(model, RBM) else model.coupling
        raw = parameter.norm()
        if isinstance(model, RBM):
            shift = noise(2, 2, 3, seed=4)
            parameter += model.visible.over_sites(shift)
            model.c -= shift.sum(-1)
        else:
            shift = noise(2, 9, seed=4)  # from the couplings of each entry to a later site
            last = model.pairs[:, 1] >= 7
            parameter[:, last] += shift[:, model.pairs[last, 0]]
            model.b[:, :7] -= shift[:, :7]
    assert (parameter.norm() - raw).abs() > 0.1
    torch.testing.assert_close(contact_scores(model), before)


def test_scores_without_couplings_are_zero():
    model = BoltzmannMachine(visible=Categorical(3, q=2), n_hidden=0)
    with torch.no_grad():
        model.coupling.zero_()
    assert contact_scores(model).equal(torch.zeros(3, 3).double())


CONTACTS = [(0, 5), (1, 4), (2, 9), (3, 8), (6, 11), (7, 10), (0, 11), (4, 9), (2, 7)]


@pytest.fixture(scope="module")
def learned():
    """A Potts model of 12 sites learned by pseudo-likelihood from Gibbs samples of one with nine coupled pairs."""
    kind = Categorical(12, q=4)
    generator = rng.stream(0, "contacts")
    chain = [(i, i + 1) for i in range(11)]
    truth = BoltzmannMachine(visible=kind, n_hidden=0, connectivity=sorted({*CONTACTS, *chain}))
    with torch.no_grad():
        first, second = (
            model_site[truth.pairs[:, k]] for k, model_site in ((0, kind.site_of()), (1, kind.site_of()))
        )
        coupled = torch.tensor([pair in CONTACTS for pair in zip(first.tolist(), second.tolist(), strict=True)])
        truth.coupling.normal_(generator=generator).mul_(coupled)
        truth.b.normal_(std=0.5, generator=generator)
    chains = truth.chains()
    x = chains.random(1000, generator=generator)
    for _ in range(100):
        x = chains.sweep(x, generator=generator)
    model = BoltzmannMachine(visible=kind, n_hidden=0)
    step, state = EnergyStep(sampler=PseudoLikelihood(), penalties=[L2(0.02)]), StepState()
    optimizer = torch.optim.SGD(model.parameters(), lr=0.3)
    for _ in range(100):
        gap, _, state = step.contrast(model, Configurations(x, x[..., :0]), state, generator=generator)
        optimizer.zero_grad()
        step.loss(model, gap, 1.0).backward()
        optimizer.step()
        state = state.after_update()
    return model


def precision(scores):
    """Share of true contacts among as many of the highest scores."""
    n = scores.shape[-1]
    pairs = sorted(itertools.combinations(range(n), 2), key=lambda pair: -float(scores[pair]))
    return len({*pairs[: len(CONTACTS)]} & {*CONTACTS}) / len(CONTACTS)


def test_planted_contacts_are_found(learned):
    """By chance it would be one in seven."""
    assert precision(contact_scores(learned)) == 1.0


def test_planted_contacts_are_lost_in_another_gauge(learned):
    """Norms of a model that is equal to it, and not in the zero-sum gauge: the mutant that forgets to fix it."""
    other = copy.deepcopy(learned)
    site_of = other.visible.site_of()
    first, second = other.pairs.unbind(-1)
    shift = noise(48, 12, seed=1).float()
    with torch.no_grad():
        other.coupling += shift[first, site_of[second]]
        other.b -= torch.stack([shift[i, int(site_of[i]) + 1 :].sum() for i in range(48)])
    torch.testing.assert_close(contact_scores(other), contact_scores(learned), rtol=1e-4, atol=1e-4)
    matrix = torch.zeros(48, 48)
    matrix[first, second] = other.coupling.detach()
    norms = matrix.unflatten(0, (12, 4)).unflatten(-1, (12, 4)).square().sum((1, 3)).sqrt()
    assert precision(norms + norms.T) < 0.6


def test_correction_takes_away_what_sites_have_with_all(learned):
    """A site that is coupled to all others a little outweighs contacts, but for the correction."""
    noisy = couplings(learned)
    extra = noise(4, 48, seed=3)
    extra = learned.visible.zero_sum(extra - extra.mean(0)) * 0.45
    block = noisy.J.clone()
    block[:4, 4:] += extra[:, 4:]
    block[4:, :4] = block[:4, 4:].T
    mutated = type(noisy)(block, noisy.h, noisy.units)
    assert precision(contact_scores(mutated)) > precision(contact_scores(mutated, corrected=False)) + 0.1


# --- what is refused --------------------------------------------------------------------------------------


def test_what_is_refused():
    with pytest.raises(SettingError, match=r"model = 'DBN'.*Of a DBN give a layer"):
        zero_sum(DBN(4, [2]))
    with pytest.raises(SettingError, match=r"kind of the visible units = 'Gaussian'"):
        couplings(RBM(visible=Gaussian(2), hidden=Spin(2)))
    with pytest.raises(SettingError, match=r"kind of the hidden units = 'Categorical'"):
        couplings(made(Spin(3), Categorical(2, q=3)))
    with pytest.raises(SettingError, match=r"n_hidden = 1"):
        couplings(BoltzmannMachine(3, 1))
    with pytest.raises(SettingError, match=r"gap = 4.*from 0 to 2"):
        contact_scores(made(Categorical(3, q=3)), gap=4)
