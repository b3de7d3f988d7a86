"""Ground states of models of all units, by each solver and by annealing in blocks, against enumeration."""

from functools import partial
from itertools import pairwise

import pytest
import torch

from memcomp_lightning import rng
from memcomp_lightning.models import DBM, RBM, units
from memcomp_lightning.models.bit_form import at_real_means
from memcomp_lightning.samplers import BlockAnnealing, GroundState, ModeAssisted, ModeSchedule, one_hot
from memcomp_lightning.samplers.ground_state import posed_as
from memcomp_lightning.samplers.mode_assisted import _n_terms, mode_scale
from memcomp_lightning.samplers.one_hot import bits_of
from memcomp_lightning.solvers import (
    AlternatingDescent,
    BruteForce,
    CrossoverAnnealing,
    GibbsAnnealing,
    Portfolio,
    QuboSolution,
    Status,
    TabuSearch,
)
from memcomp_lightning.solvers.dmm import DmmSolver
from memcomp_lightning.testing import enumerated, small_dbm, small_machine, small_rbm
from memcomp_lightning.types import Configurations

VARIANCE = torch.tensor([0.5, 1.0, 2.0, 1.5, 0.7])
MIXED = units.Mixed(units.Spin(2), units.Categorical([3, 4]), units.Gaussian(2, variance=VARIANCE[:2]))
MODELS = {
    "Potts RBM": partial(small_rbm, visible=units.Categorical(3, q=3), hidden=units.Bernoulli(5)),
    "Potts RBM of several sizes": partial(
        small_rbm, visible=units.Categorical([2, 4, 3, 5]), hidden=units.Categorical([3, 2])
    ),
    "Potts machine": partial(small_machine, visible=units.Categorical([3, 4, 3]), hidden=units.Bernoulli(4)),
    "Potts DBM": partial(small_dbm, visible=units.Categorical(3, q=4)),
    "spins": partial(small_rbm, visible=units.Spin(9), hidden=units.Spin(7)),
    "Ising machine": partial(small_machine, visible=units.Spin(9), hidden=units.Spin(4)),
    "real units": partial(small_rbm, visible=units.Gaussian(5, variance=VARIANCE), hidden=units.Spin(12)),
    "real and categories": partial(small_rbm, visible=units.Gaussian(5), hidden=units.Categorical([3, 4, 2, 3])),
    "mixed RBM": partial(small_rbm, visible=MIXED, hidden=units.Bernoulli(6)),
    "mixed machine": partial(small_machine, visible=MIXED, hidden=units.Spin(3)),
}
SAMPLERS = {
    "brute force": GroundState(solver=BruteForce()),
    "the DMM": GroundState(solver=DmmSolver(n_restarts=16, max_steps=400)),
    "annealing": GroundState(solver=GibbsAnnealing(n_restarts=64)),
    "the portfolio": GroundState(solver=Portfolio()),
    "tabu search": GroundState(solver=TabuSearch(n_restarts=16)),
    "crossover": GroundState(solver=CrossoverAnnealing(n_restarts=16)),
    "descent": GroundState(solver=AlternatingDescent(n_restarts=200)),
    "blocks": BlockAnnealing(n_chains=64, n_sweeps=50),
}


def lowest(model, replicas=()):
    """The two lowest energies by enumeration, and the states of the lowest."""
    exact = enumerated(model)
    energy, order = exact.energy.sort()
    return exact, energy[:2], exact.x[order[0]]


def sample(sampler, model, seed=0):
    stream = rng.stream(seed, "negative_phase")
    return sampler.sample(model, sampler.init(model, 3, generator=stream), None, generator=stream)


@pytest.mark.parametrize("sampler", SAMPLERS.values(), ids=SAMPLERS)
@pytest.mark.parametrize("make", MODELS.values(), ids=MODELS)
def test_ground_state_is_the_one_of_the_list(make, sampler):
    model = make()
    exact, (first, second), x = lowest(model)
    assert second - first > 1e-3
    found = at_real_means(model, sample(sampler, model).configurations)
    states = torch.cat(found[:2], dim=-1)
    torch.testing.assert_close(states, x.expand_as(states), rtol=0, atol=1e-4)
    assert len(states) == (2 if exact.variance.any() else 1)
    energy = model.energy(found.v, found.h)
    torch.testing.assert_close(energy, first.expand_as(energy), rtol=0, atol=1e-4)


@pytest.mark.parametrize("sampler", ["annealing", "blocks"])
@pytest.mark.parametrize(
    "name", ["Potts RBM", "Potts machine", "mixed RBM", "mixed machine", "real and categories"]
)
def test_each_replica_has_its_own(name, sampler):
    several, one = MODELS[name](replicas=(2, 2)), MODELS[name]()
    state, own = several.state_dict(), one.state_dict()
    found = at_real_means(several, sample(SAMPLERS[sampler], several).configurations)
    for i, j in ((0, 0), (0, 1), (1, 0), (1, 1)):
        one.load_state_dict({k: x[i, j] if x.shape != own[k].shape else x for k, x in state.items()})
        x = lowest(one)[2]
        states = torch.cat(found[:2], dim=-1)[i, j]
        torch.testing.assert_close(states, x.expand_as(states), rtol=0, atol=1e-4)


def test_rectified_units_have_a_ground_state_by_blocks_alone():
    model = small_rbm(visible=units.Categorical(3, q=3), hidden=units.ReLU(4)).double()
    with torch.no_grad():
        model.c += 1.0
    v = units.all_states(model.visible, model.b)
    h = model.hidden_field(v).clamp(min=0)
    energy = model.energy(v, h)
    assert (h > 0).any()
    found = sample(BlockAnnealing(), model).configurations
    best = v[energy.argmin()]
    torch.testing.assert_close(found.v, best.expand(2, -1))
    # Two points that have the mean of the hidden units there, and their variance.
    torch.testing.assert_close(found.h.mean(0), model.hidden_mean(best.unsqueeze(0))[0])
    assert (found.h[0] > found.h[1]).all()


def test_without_the_factor_of_spins_without_constraints_or_integrals_another_state_is_found(monkeypatch):
    """What must be seen: each of these answers is another one than enumeration's."""
    solver = SAMPLERS["brute force"]

    def is_missed(name):
        seen = []
        for seed in range(3):
            model = MODELS[name](seed=seed)
            x = lowest(model)[2]
            found = at_real_means(model, sample(solver, model).configurations)
            seen.append(not torch.cat(found[:2], dim=-1)[0].allclose(x, atol=1e-4))
        return any(seen)

    assert not any(map(is_missed, ("spins", "Potts RBM", "real units")))
    right = units.Spin.bits
    with monkeypatch.context() as patch:
        patch.setattr(units.Spin, "bits", lambda self: right(self)._replace(low=torch.zeros(self.n)))
        assert is_missed("spins")
    with monkeypatch.context() as patch:
        patch.setattr(one_hot, "descend", lambda model, found: found)
        patch.setattr(one_hot.Constrained, "penalised", lambda self, penalties: self.objective)
        patch.setattr(one_hot, "safe_penalty", lambda problem: torch.zeros(()))
        assert is_missed("Potts RBM")
    with monkeypatch.context() as patch:
        patch.setattr(units.Gaussian, "mean", lambda self, field: field)
        patch.setattr(units.Gaussian, "mode", lambda self, field: field)
        assert is_missed("real units")


def test_penalties_leave_most_answers_in_one_state_a_site():
    """Those of a matrix of one state a site: 12 sites of 21 states, 30 hidden units, in weights of size 0.3."""
    model = small_rbm(visible=units.Categorical(12, q=21), hidden=units.Bernoulli(30), std=0.3)
    for solver in (GibbsAnnealing(n_restarts=16), DmmSolver(n_restarts=8, max_steps=2000)):
        info = sample(GroundState(solver=solver), model).info
        assert info["feasible_sites"] > 0.8
        blocks = sample(BlockAnnealing(), model).info["ground_state_energy"]
        assert info["ground_state_energy"] < 0.97 * blocks


def test_a_shift_and_penalties_change_no_energy_of_a_state():
    model = MODELS["Potts RBM of several sizes"]().double()
    form, exact = model.in_bits(), enumerated(model)
    n = model.n_visible
    y = bits_of(form, Configurations(exact.x[:, :n], exact.x[:, n:]))
    plain = one_hot.from_bit_form(form)
    rows = one_hot.Constraints.of(plain.n, [one_hot.exactly(1, group) for group in form.groups])
    objective, penalties = one_hot.shifted(plain, one_hot.table_of(rows), y[:50])
    problem = one_hot.Constrained(objective, rows)
    assert (objective.linear - plain.linear).abs().min() > 0.01
    torch.testing.assert_close(problem.penalised(penalties).energy(y), exact.energy, rtol=0, atol=1e-9)
    assert (penalties > 0).all()


@pytest.mark.parametrize("name", ["mixed RBM", "real units", "mixed machine"])
def test_both_samplers_of_ground_states_report_one_energy(name):
    """That with real units integrated out: the quadratic form of the bits has it, and so have the blocks."""
    model = MODELS[name]().double()
    of_bits = sample(SAMPLERS["brute force"], model)
    of_blocks = sample(BlockAnnealing(n_sweeps=30), model)
    energy = of_bits.info["ground_state_energy"]
    torch.testing.assert_close(of_blocks.info["ground_state_energy"], energy)
    at_means = at_real_means(model, of_bits.configurations)
    half_logs = 0.5 * (2 * torch.pi / model.visible.curvature[model.visible.real_entries()]).log().sum().detach()
    torch.testing.assert_close(model.energy(*at_means[:2]).min() - half_logs, energy, check_dtype=False)


def test_the_scale_of_the_mode_is_that_at_the_means_of_real_units():
    model = MODELS["mixed RBM"]().double()
    mode = sample(SAMPLERS["brute force"], model).configurations
    x = lowest(model)[2]
    v, h = x.view(1, -1).split((model.n_visible, model.n_hidden), dim=-1)
    third = torch.tensor([1 / 3] * 3 + [1 / 4] * 4, dtype=torch.float64)
    free = torch.cat((torch.zeros(2), third, torch.zeros(2)))[None]
    depth = model.energy(free, torch.full_like(h, 0.5)) - model.energy(v, h)
    expected = depth / (4 * (6 + 1) * (6 + 1))  # six visible sites
    torch.testing.assert_close(mode_scale(model, mode), expected.squeeze(), check_dtype=False)
    always = ModeSchedule(n_updates=1, p_max=1.0, delay=-1e3)
    blocks = ModeAssisted(inner=BlockAnnealing(), mode=BlockAnnealing(), schedule=always)
    positive = Configurations(v, h)
    stream = rng.stream(0, "negative_phase")
    found = blocks.sample(model, blocks.init(model, 1, generator=stream), positive, generator=stream)
    torch.testing.assert_close(found.info["mode_scale"], expected.squeeze(), check_dtype=False)


def test_terms_of_an_energy_are_counted_by_sites():
    for machine in (MODELS["Potts machine"](), small_machine()):
        assert _n_terms(machine) == 1 + 7 + 7 * 6 // 2 - 1  # one pair is not coupled
    assert _n_terms(MODELS["Potts RBM of several sizes"]()) == 1 + 6 + 4 * 2


def test_solvers_get_a_matrix_where_it_is_mostly_filled():
    dense = small_dbm()
    posed, order = posed_as(dense)
    assert isinstance(posed, RBM)
    x = rng.bernoulli(torch.full((5, dense.n_units), 0.5), generator=rng.stream(0, "states"))
    of_posed = posed.energy(*x.split((posed.n_visible, posed.n_hidden), dim=-1))
    of_dense = dense.energy(*x[:, order].split((dense.n_visible, dense.n_hidden), dim=-1))
    torch.testing.assert_close(of_posed - of_posed[0], of_dense - of_dense[0])
    for sparse in (DBM(2, [2] * 7), small_machine(), small_rbm()):  # 28 of 64 couplings; no two classes; a matrix
        assert posed_as(sparse) == (sparse, None)


def test_a_proof_of_a_state_in_groups_stays_one():
    model = MODELS["Potts RBM"]()
    answers = one_hot.minimise_in_groups(model, model.in_bits(), BruteForce(), generator=rng.stream(0, "solver"))
    assert (answers.solution.status == int(Status.OPTIMAL)).all()
    assert answers.info["feasible_sites"] == 1


def test_groups_that_an_answer_breaks_are_counted():
    class FirstGroup:
        """Has one bit in the first group, and none in the others."""

        def minimise(self, qubo, *, generator):
            state = torch.zeros(1, qubo.n)
            state[0, 0] = 1
            number = torch.zeros(1, dtype=torch.long)
            return QuboSolution(state, qubo.energy(state), number + int(Status.CONVERGED), number, 0.0)

    model = MODELS["Potts RBM"]()
    answers = one_hot.minimise_in_groups(model, model.in_bits(), FirstGroup(), generator=rng.stream(0, "solver"))
    torch.testing.assert_close(answers.info["feasible_sites"], torch.tensor(1 / 3))
    assert (answers.solution.status == int(Status.CONVERGED)).all()


@pytest.mark.parametrize("n_sweeps", [1, 2, 3, 4, 50])
def test_sweeps_get_colder_by_one_factor_from_first_to_last(n_sweeps):
    betas = BlockAnnealing(n_sweeps=n_sweeps, beta_first=0.2, beta_last=5.0).betas()
    assert len(betas) == n_sweeps
    assert betas[0] == pytest.approx(0.2)
    if n_sweeps > 1:
        assert betas[-1] == pytest.approx(5.0)
        assert [b / a for a, b in pairwise(betas)] == pytest.approx([25 ** (1 / (n_sweeps - 1))] * (n_sweeps - 1))
