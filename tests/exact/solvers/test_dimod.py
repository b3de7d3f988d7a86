"""dimod both ways: models, solvers, negative phases, and our solvers under dimod's own tests."""

import importlib
import sys
import time
import unittest
from functools import partial

import numpy as np
import pytest
import torch

dimod = pytest.importorskip("dimod")
pytest.importorskip("dwave.samplers")

from dwave.samplers import SimulatedAnnealingSampler, TabuSampler  # noqa: E402

import memcomp_lightning  # noqa: E402
from memcomp_lightning import rng  # noqa: E402
from memcomp_lightning.enumeration import binary_states  # noqa: E402
from memcomp_lightning.errors import SettingError  # noqa: E402
from memcomp_lightning.interop import MemcompSampler  # noqa: E402
from memcomp_lightning.models import RBM, Normal  # noqa: E402
from memcomp_lightning.problems import Qubo, from_bqm, from_model, to_bqm  # noqa: E402
from memcomp_lightning.samplers import AnnealerSamples, maximum_pseudo_likelihood_beta, positive_phase  # noqa: E402
from memcomp_lightning.solvers import AlternatingDescent, BruteForce, DimodSolver, Portfolio, Status  # noqa: E402
from memcomp_lightning.solvers.dmm import DmmSolver  # noqa: E402
from memcomp_lightning.testing import (  # noqa: E402
    check_sampler,
    check_solver,
    hidden_kinds,
    small_dbm,
    small_machine,
    small_rbm,
    visible_kinds,
)

SHORT = {"num_reads": 7, "num_sweeps": 50}


@pytest.mark.parametrize("problem", ["rbm", "machine", "matrix"])
def test_a_problem_as_a_model_has_its_energies(problem):
    matrix = torch.empty(5, 5).normal_(generator=rng.stream(0, "matrix"))
    qubo = {
        "rbm": from_model(small_rbm()),
        "machine": from_model(small_machine()),
        "matrix": Qubo.from_matrix(matrix, offset=torch.tensor(1.5)),
    }[problem]
    x = binary_states(qubo.n, like=qubo.linear)
    np.testing.assert_allclose(to_bqm(qubo).energies(x.numpy().astype(int)), qubo.energy(x).numpy(), atol=1e-6)


@pytest.mark.parametrize("vartype", ["BINARY", "SPIN"])
def test_a_model_of_any_labels_as_a_problem_has_its_energies(vartype):
    bqm = dimod.BinaryQuadraticModel(
        {"c": 1.0, 3: -2.0, "a": 0.5}, {("a", 3): 2.0, ("c", "a"): -1.5}, 0.25, vartype
    )
    qubo, variables = from_bqm(bqm)
    x = binary_states(3, like=qubo.linear)
    values = x if vartype == "BINARY" else 2 * x - 1
    expected = bqm.energies((values.astype(int), variables))
    np.testing.assert_allclose(qubo.energy(x), expected)
    with pytest.raises(SettingError, match="at least one variable"):
        from_bqm(dimod.BinaryQuadraticModel("SPIN"))


@pytest.mark.filterwarnings("ignore:All bqm biases are zero")
@pytest.mark.parametrize("sampler", [SimulatedAnnealingSampler(), TabuSampler()], ids=lambda s: type(s).__name__)
def test_samplers_of_dimod_keep_the_contract_of_a_solver(sampler):
    parameters = SHORT if isinstance(sampler, SimulatedAnnealingSampler) else {"num_reads": 3, "timeout": 20}
    check_solver(DimodSolver(sampler=sampler, parameters=parameters), finds_optimum=False)


class Fewer(dimod.Sampler):
    """Returns as many reads as there are variables set in its best answer, aggregated: lengths differ."""

    parameters, properties = {"num_reads": []}, {}

    def sample(self, bqm, num_reads=1):
        best = dimod.ExactSolver().sample(bqm).first.sample
        n = 1 + sum(best.values())
        return dimod.SampleSet.from_samples_bqm(best, bqm).copy() if n == 1 else _repeated(best, bqm, n)


def _repeated(sample, bqm, n):
    return dimod.SampleSet.from_samples_bqm(sample, bqm, num_occurrences=[n])


def test_reads_of_different_number_are_marked():
    qubo = Qubo.from_matrix(torch.stack((torch.eye(3), -torch.eye(3))))
    solution = DimodSolver(sampler=Fewer()).minimise(qubo, generator=rng.stream(0, "solver"))
    assert solution.status.tolist() == [
        [int(Status.STEP_BUDGET), *[int(Status.NOT_RUN)] * 3],
        [int(Status.STEP_BUDGET)] * 4,
    ]
    assert solution.best_energy.tolist() == [0.0, -3.0]


class OneAnswer(dimod.Sampler):
    """As LeapHybridSampler: a time limit, no reads, no seed; one state, in an order of its own."""

    parameters, properties = {"time_limit": ["parameters"], "label": []}, {}

    def sample(self, bqm, time_limit=None, label=""):
        assert (time_limit, label) == (3, "mine")
        best = dimod.ExactSolver().sample(bqm).first.sample
        return dimod.SampleSet.from_samples_bqm(dict(reversed(best.items())), bqm)


@pytest.mark.parametrize("make", [small_rbm, small_dbm, small_machine])
def test_a_hybrid_that_gives_one_answer_is_solver_and_sampler(make):
    given, generator = {"time_limit": 3, "label": "mine"}, rng.stream(0, "solver")
    machine = make(replicas=(2,))
    qubo = from_model(machine)
    found = DimodSolver(sampler=OneAnswer(), parameters=given).minimise(qubo, generator=generator)
    exact = BruteForce().minimise(qubo, generator=generator).best
    torch.testing.assert_close(found.best, exact, rtol=0, atol=0)
    sampler = AnnealerSamples(sampler=OneAnswer(), parameters=given)
    positive = positive_phase(machine, torch.zeros(2, 4, machine.n_visible))
    negative = sampler.sample(
        machine, sampler.init(machine, 4, generator=generator), positive, generator=generator
    )
    v, h, weight = negative.configurations
    torch.testing.assert_close(torch.cat((v, h), dim=-1), exact.unsqueeze(-2), rtol=0, atol=0)
    assert weight is None


@pytest.mark.parametrize("beta", [1.0, "estimate"])
@pytest.mark.parametrize("make", [small_rbm, small_dbm, small_machine])
def test_annealers_keep_the_contract_of_a_sampler(make, beta):
    check_sampler(AnnealerSamples(sampler=SimulatedAnnealingSampler(), parameters=SHORT, beta=beta), make=make)


@pytest.mark.parametrize("beta", [0.3, 1.0, 2.5])
def test_the_inverse_temperature_of_samples_is_found(beta):
    """Chains at a known temperature; a value off by a tenth would show."""
    rbm = RBM(7, 5, replicas=(2,), weight_init=Normal(std=1.0), generator=rng.stream(0, "weights"))
    generator = rng.stream(0, "chains")
    chains = rbm.chains()
    v = chains.random(4001, generator=generator)
    for _ in range(50):
        v = chains.sweep(v, beta=beta, generator=generator)
    h = rng.bernoulli(rbm.hidden_mean(v, beta=beta), generator=generator)
    x = torch.cat((v, h), dim=-1).detach()
    found = maximum_pseudo_likelihood_beta(from_model(rbm).field(x), x)
    torch.testing.assert_close(found, torch.full((2,), beta).double(), rtol=0.05, atol=0)
    ground = BruteForce().minimise(from_model(rbm), generator=generator).best.unsqueeze(-2)
    assert maximum_pseudo_likelihood_beta(from_model(rbm).field(ground), ground).tolist() == pytest.approx(
        [100, 100]
    )
    worst = 1 - ground
    assert maximum_pseudo_likelihood_beta(from_model(rbm).field(ground), worst).tolist() == pytest.approx(
        [0, 0], abs=1e-9
    )


def test_the_estimate_makes_an_annealer_of_another_temperature_sample_the_model():
    """The annealer works at beta = 2: given E / 2 it samples exp(-E)."""
    rbm = small_rbm(5, 3, std=0.7)
    cold = {"num_reads": 500, "num_sweeps": 60, "beta_range": [0.1, 2.0]}
    sampler = AnnealerSamples(sampler=SimulatedAnnealingSampler(), parameters=cold, beta="estimate")
    generator = rng.stream(0, "negative_phase")
    positive = positive_phase(rbm, torch.zeros(1, 5))
    state = sampler.init(rbm, 1, generator=generator)
    for _ in range(30):
        negative = sampler.sample(rbm, state, positive, generator=generator)
        state = negative.state
    assert float(state.beta) == pytest.approx(2.0, rel=0.1)
    assert float(negative.info["beta_effective"]) == float(state.beta)


@pytest.mark.parametrize("beta", [1.0, "estimate"])
def test_a_large_model_costs_little(beta, threads):
    """784 x 500: what is added to an annealer's own time, processor time, the least of eight updates."""

    class Instant(dimod.Sampler):
        parameters, properties = {"num_reads": []}, {}

        def sample(self, bqm, num_reads=100):
            return answer

    rbm, generator = RBM(784, 500), rng.stream(0, "negative_phase")
    x = rng.bernoulli(torch.full((100, 1284), 0.5), generator=generator).to(torch.int8).numpy()
    answer = dimod.SampleSet.from_samples((x, range(1284)), "BINARY", np.zeros(100))
    sampler = AnnealerSamples(sampler=Instant(), beta=beta)
    positive, state = positive_phase(rbm, torch.zeros(1, 784)), sampler.init(rbm, 1, generator=generator)
    times = []
    with threads(1):  # others would spin, which counts
        for _ in range(8):
            begin = time.process_time()
            sampler.sample(rbm, state, positive, generator=generator)
            times.append(time.process_time() - begin)
    assert min(times) < 0.1  # medians of 39 and 42 ms on a quiet machine; neighbours take its caches


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"sampler": object()}, "sampler = 'object'"),
        ({"parameters": {"num_reeds": 3}}, "parameter of SimulatedAnnealingSampler = 'num_reeds'"),
        ({"parameters": {"num_reads": 0}}, "num_reads = 0"),
        ({"beta": 0.0}, "beta = 0.0"),
        ({"beta": "guess"}, "beta = 'guess'"),
        ({"rate": 0.0}, "rate = 0.0"),
    ],
)
def test_wrong_settings_are_refused(settings, message):
    with pytest.raises(SettingError, match=message):
        AnnealerSamples(**{"sampler": SimulatedAnnealingSampler(), **settings})


def test_without_dimod_the_error_says_what_to_install(monkeypatch):
    monkeypatch.setitem(sys.modules, "dimod", None)
    for module in ("problems.bqm", "solvers.dimod", "samplers.annealer"):
        monkeypatch.delitem(sys.modules, f"memcomp_lightning.{module}")
    for name in ("problems.to_bqm", "solvers.DimodSolver", "samplers.AnnealerSamples"):
        package, _, name = f"memcomp_lightning.{name}".rpartition(".")
        with pytest.raises(ModuleNotFoundError, match=r"pip install 'memcomp-lightning\[dimod\]'"):
            getattr(importlib.import_module(package), name)
    with pytest.raises(AttributeError, match="no attribute 'Dimod'"):
        _ = memcomp_lightning.solvers.Dimod


# --- our solvers as a sampler of dimod --------------------------------------------------------------------


def test_our_sampler_keeps_the_interface_of_dimod():
    dimod.testing.assert_sampler_api(MemcompSampler())


@dimod.testing.load_sampler_bqm_tests(MemcompSampler)
class TestMemcompSampler(unittest.TestCase):
    """dimod's own tests of models of all vartypes and types of numbers."""


@dimod.testing.load_sampler_bqm_tests(MemcompSampler(DmmSolver()))
class TestDmmAsSampler(unittest.TestCase):
    """The same with the DMM."""


def model(vartype, n=14):
    bqm = dimod.generators.gnp_random_bqm(n, 0.6, vartype, random_state=0)
    bqm.relabel_variables({v: f"x{v}" for v in bqm.variables})
    return bqm


@pytest.mark.parametrize("solver", [Portfolio(), DmmSolver()])
@pytest.mark.parametrize("vartype", ["BINARY", "SPIN"])
def test_it_finds_the_optimum_of_models(vartype, solver):
    bqm, sampler = model(vartype), MemcompSampler(solver)
    answer = sampler.sample(bqm, num_reads=9, seed=3)
    dimod.testing.assert_response_energies(answer, bqm)
    assert answer.first.energy == pytest.approx(dimod.ExactSolver().sample(bqm).first.energy)
    assert answer.record.num_occurrences.sum() == 9
    assert answer.info["lower_bound"] <= answer.first.energy + 1e-9
    again = sampler.sample(bqm, num_reads=9, seed=3)
    assert np.array_equal(again.record.sample, answer.record.sample)


def test_a_time_limit_is_honoured_and_initial_states_are_improved_on():
    bqm = model("SPIN", n=40)
    weak = MemcompSampler(AlternatingDescent(n_restarts=1))
    best = MemcompSampler().sample(bqm).first
    assert weak.sample(bqm, time_limit=0.3).first.energy < weak.sample(bqm).first.energy
    for states in (best.sample, [best.sample, dict.fromkeys(best.sample, 1)], dimod.as_samples(best.sample)):
        answer = weak.sample(bqm, initial_states=states)
        assert answer.first.energy == pytest.approx(best.energy)
        dimod.testing.assert_response_energies(answer, bqm)
    bits = {label: (value + 1) // 2 for label, value in best.sample.items()}
    assert weak.sample(bqm, initial_states=bits).first.energy == pytest.approx(best.energy)


def test_restarts_that_were_not_run_are_left_out():
    answer = MemcompSampler(DmmSolver(n_restarts=28, patience=4)).sample(dimod.BQM({0: -1.0}, {}, "BINARY"))
    assert 0 < len(answer) < 28


def test_what_is_not_known_is_warned_of_or_refused():
    bqm = dimod.BQM({0: -1.0}, {}, "BINARY")
    with pytest.warns(dimod.exceptions.SamplerUnknownArgWarning):
        MemcompSampler().sample(bqm, annealing_time=20)
    with pytest.raises(ValueError, match="BruteForce has no n_restarts"):
        MemcompSampler(BruteForce()).sample(bqm, num_reads=3)
    with pytest.raises(SettingError, match="time_limit = 0"):
        MemcompSampler().sample(bqm, time_limit=0)


def test_reads_of_spins_and_of_no_other_units_than_those_of_two_values():
    sampler = AnnealerSamples(sampler=SimulatedAnnealingSampler(), parameters=SHORT, beta="estimate")
    visible, hidden = visible_kinds(), hidden_kinds()
    for make in (small_rbm, small_machine):
        check_sampler(sampler, make=partial(make, visible=visible["spins"], hidden=hidden["bits"]))
    for layer, kind in (
        ("visible", visible["categories"]),
        ("visible", visible["real"]),
        ("hidden", hidden["categories"]),
    ):
        message = f"{layer} units = '{type(kind).__name__}' is not allowed: expected units of two values"
        with pytest.raises(SettingError, match=message):
            sampler.init(small_rbm(**{layer: kind}), 3, generator=rng.stream(0, "negative_phase"))
