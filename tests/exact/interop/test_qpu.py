"""A quantum annealer of D-Wave, on D-Wave's own mock of one: layout, gauges, chains, range, faults."""

import sys

import numpy as np
import pytest
import torch

dimod = pytest.importorskip("dimod")
pytest.importorskip("dwave.system")

from dwave.samplers import SimulatedAnnealingSampler  # noqa: E402
from dwave.system import EmbeddingComposite  # noqa: E402
from dwave.system.testing import MockDWaveSampler  # noqa: E402

from memcomp_lightning import rng  # noqa: E402
from memcomp_lightning.errors import SettingError  # noqa: E402
from memcomp_lightning.interop import QpuSampler  # noqa: E402
from memcomp_lightning.models import RBM, Normal  # noqa: E402
from memcomp_lightning.problems import Qubo, from_model, to_bqm  # noqa: E402
from memcomp_lightning.samplers import AnnealerSamples, positive_phase  # noqa: E402
from memcomp_lightning.solvers import BruteForce, DimodSolver  # noqa: E402
from memcomp_lightning.testing import check_sampler, small_dbm, small_machine, small_rbm  # noqa: E402

GRAPHS = {"chimera": [4, 4, 4], "pegasus": [3], "zephyr": [2, 4]}


class Annealer(MockDWaveSampler):
    """The mock with annealing in place of descent; keeps what it was given."""

    def __init__(self, kind="pegasus", shape=None, beta=(0.1, 5.0), sweeps=200, **given):
        super().__init__(
            topology_type=kind,
            topology_shape=shape or GRAPHS[kind],
            substitute_sampler=SimulatedAnnealingSampler(),
            substitute_kwargs={"beta_range": beta, "num_sweeps": sweeps, "seed": 1},
            parameter_warnings=False,
            exact_solver_cutoff=0,
            **given,
        )
        self.given = []

    def sample(self, bqm, **parameters):
        self.given.append((bqm.copy(), parameters))
        return super().sample(bqm, **parameters)


def rbm(n_visible=7, n_hidden=5, std=0.5):
    return RBM(n_visible, n_hidden, weight_init=Normal(std=std), generator=rng.stream(0, "weights"))


@pytest.mark.parametrize("faulty", ["avoid", "prune"])
@pytest.mark.parametrize("make", [small_rbm, small_dbm, small_machine])
def test_annealers_keep_the_contract_of_a_sampler(make, faulty):
    qpu = QpuSampler(Annealer(sweeps=20), n_gauges=2, faulty=faulty)
    check_sampler(AnnealerSamples(sampler=qpu, parameters={"num_reads": 6}, beta="estimate"), make=make)


def test_an_annealer_behind_the_composite_of_ocean_is_solver_and_sampler():
    behind = EmbeddingComposite(Annealer(sweeps=50), embedding_parameters={"random_seed": 1})
    given = {"num_reads": 6, "return_embedding": False}
    check_sampler(AnnealerSamples(sampler=behind, parameters=given, beta="estimate"))
    cold = Annealer(beta=(0.1, 50.0), sweeps=500)
    behind, given = EmbeddingComposite(cold, embedding_parameters={"random_seed": 1}), given | {"num_reads": 40}
    qubo, generator = from_model(rbm()), rng.stream(0, "solver")
    found = DimodSolver(sampler=behind, parameters=given).minimise(qubo, generator=generator)
    exact = BruteForce().minimise(qubo, generator=generator)
    torch.testing.assert_close(found.best_energy, exact.best_energy, rtol=1e-5, atol=0)


@pytest.mark.parametrize("kind", GRAPHS)
@pytest.mark.parametrize("make", [small_rbm, small_dbm, small_machine, rbm])
def test_ground_states_come_back_to_their_units(make, kind):
    """Units, spins and gauges are undone: the best read is the optimum, and each read has the energy it says."""
    qubo = from_model(make())
    exact = BruteForce().minimise(qubo, generator=rng.stream(0, "unused"))
    cold = Annealer(kind, beta=(0.1, 50.0), sweeps=500)
    found = QpuSampler(cold, n_gauges=4).sample(to_bqm(qubo), num_reads=40, seed=3)
    assert len(found) == 40
    assert found.first.energy == pytest.approx(float(exact.best_energy), abs=1e-5)
    best = torch.tensor([[float(found.first.sample[unit]) for unit in range(qubo.n)]])
    torch.testing.assert_close(qubo.energy(best).squeeze(), exact.best_energy, rtol=0, atol=1e-5)


def test_an_rbm_is_laid_out_once_as_a_biclique():
    sampler, bqm = QpuSampler(Annealer("chimera", [4, 4, 4]), seed=1), to_bqm(from_model(rbm(16, 16)))
    chains = sampler.layout(bqm).chains
    assert {len(chain) for chain in chains.values()} == {4}  # four cells in a row, four in a column
    assert len({qubit for chain in chains.values() for qubit in chain}) == 128
    assert sampler.layout(bqm).chains is chains


def test_reads_are_divided_among_gauges():
    """Each gauge programs the same magnitudes with other signs."""
    qpu, bqm = Annealer(), to_bqm(from_model(rbm()))
    QpuSampler(qpu, n_gauges=5).sample(bqm, num_reads=20, seed=0)
    assert [parameters["num_reads"] for _, parameters in qpu.given] == [4] * 5
    fields = np.array([[model.linear[qubit] for qubit in qpu.given[0][0].linear] for model, _ in qpu.given])
    np.testing.assert_allclose(np.abs(fields), np.abs(fields[:1]).repeat(5, 0))
    assert len({tuple(np.sign(row)) for row in fields}) == 5
    again = Annealer()
    QpuSampler(again, n_gauges=5).sample(bqm, num_reads=20, seed=0)
    assert [model for model, _ in again.given] == [model for model, _ in qpu.given]


def test_chains_are_as_strong_as_asked():
    qpu, bqm = Annealer("chimera", [4, 4, 4]), to_bqm(from_model(rbm(16, 16)))
    sampler = QpuSampler(qpu, chain_strength=1.5)
    sampler.sample(bqm, num_reads=1, seed=0)
    ((model, parameters),) = qpu.given
    assert parameters["auto_scale"] is False
    chain = next(iter(sampler.layout(bqm).chains.values()))
    inside = [abs(model.quadratic[pair]) for pair in model.quadratic if set(pair) <= set(chain)]
    largest = max(abs(value) for value in bqm.spin.quadratic.values())
    assert inside == pytest.approx([1.5 * largest] * 3)


def test_missing_qubits_are_avoided_or_cost_couplings():
    """A regular layout loses what is broken; around it there is another one, with longer chains or none."""
    whole = QpuSampler(Annealer("chimera", [4, 4, 4]))
    bqm = to_bqm(from_model(rbm(16, 16)))
    broken = whole.layout(bqm).chains[0][1]
    at = Annealer("chimera", [4, 4, 4], broken_nodes=[broken])
    pruned = QpuSampler(at, faulty="prune")
    chains, lost = pruned.layout(bqm)
    assert len({qubit for chain in chains.values() for qubit in chain}) <= 127
    assert all(broken not in chain for chain in chains.values())
    assert 0 < len(lost) <= 12
    assert len(pruned.sample(bqm, num_reads=3, seed=0)) == 3
    with pytest.raises(SettingError, match=r"of 32 units and 256 couplings.*no place for units.*faulty='prune'"):
        QpuSampler(at).sample(bqm, num_reads=3)
    smaller = to_bqm(from_model(rbm(12, 12)))
    avoided = QpuSampler(at).layout(smaller).chains
    assert all(broken not in chain for chain in avoided.values())


def test_what_is_pruned_is_not_coupled():
    """The annealer is given the couplings of the model without the lost ones, times one factor, in some gauge."""
    bqm = to_bqm(from_model(rbm(16, 16, std=2.0)))
    broken = QpuSampler(Annealer("chimera", [4, 4, 4])).layout(bqm).chains[0][1]
    annealer = Annealer("chimera", [4, 4, 4], broken_nodes=[broken])
    sampler = QpuSampler(annealer, faulty="prune")
    chains, uncoupled = sampler.layout(bqm)
    assert uncoupled
    sampler.sample(bqm, num_reads=1, seed=0)
    unit_of = {qubit: unit for unit, chain in chains.items() for qubit in chain}
    given = {frozenset(pair): 0.0 for pair in bqm.quadratic}
    for (one, other), strength in annealer.given[0][0].quadratic.items():
        if unit_of[one] != unit_of[other]:
            given[frozenset((unit_of[one], unit_of[other]))] += abs(strength)
    assert {pair for pair, strength in given.items() if strength == 0} == set(map(frozenset, uncoupled))
    factors = [given[frozenset(pair)] / abs(strength) for pair, strength in bqm.spin.quadratic.items()]
    kept = [factor for factor in factors if factor]
    assert max(kept) == pytest.approx(min(kept))


@pytest.mark.parametrize("rule", ["majority", "discard"])
def test_reads_with_broken_chains(rule):
    """Weak chains break; those reads are voted on or dropped, and never are there none."""
    bqm = to_bqm(from_model(rbm(16, 16)))
    weak = QpuSampler(Annealer("chimera", [4, 4, 4]), chain_strength=1e-3, chain_breaks=rule)
    found = weak.sample(bqm, num_reads=20, seed=0)
    assert len(found) == 20  # all broken: the majority decides after all
    assert found.record.chain_break_fraction.mean() > 0.2
    medium = QpuSampler(Annealer("chimera", [4, 4, 4]), chain_strength=1.5, chain_breaks=rule)
    found = medium.sample(bqm, num_reads=200, seed=0)
    assert (len(found) == 200) == (rule == "majority")
    assert (found.record.chain_break_fraction.max() == 0) == (rule == "discard")


def test_samples_follow_the_model_at_the_estimated_temperature():
    """An annealer at beta = 2: the mean gradient of the biases over its last reads is that of the model."""
    model = small_rbm(5, 3, std=0.7)
    sampler = AnnealerSamples(
        sampler=QpuSampler(Annealer(beta=(0.1, 2.0), sweeps=60), n_gauges=2),
        parameters={"num_reads": 600},
        beta="estimate",
    )
    generator = rng.stream(0, "negative_phase")
    positive = positive_phase(model, torch.zeros(1, 5))
    state = sampler.init(model, 1, generator=generator)
    for _ in range(20):
        negative = sampler.sample(model, state, positive, generator=generator)
        state = negative.state
    assert float(state.beta) == pytest.approx(2.0, rel=0.15)
    assert 0 <= float(negative.info["chain_break_fraction"]) < 0.1


def test_models_beyond_the_range_are_shrunk_and_said_to_be(caplog):
    qpu = Annealer()
    sampler = QpuSampler(qpu)
    for _ in range(2):
        sampler.sample(to_bqm(from_model(rbm(std=30.0))), num_reads=2, seed=0)
    for model, _ in qpu.given:
        assert (
            max(abs(value) for value in model.linear.values()) <= min(map(abs, qpu.properties["h_range"])) + 1e-9
        )
        assert max(abs(value) for value in model.quadratic.values()) == pytest.approx(1.0)
    (warning,) = [record for record in caplog.records if "beyond" in record.message]
    assert "hotter than beta says" in warning.message


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"n_gauges": 0}, "n_gauges = 0"),
        ({"chain_strength": 0.0}, "chain_strength = 0.0"),
        ({"chain_breaks": "vote"}, "chain_breaks = 'vote'.*'majority', 'discard'"),
        ({"faulty": "repair"}, "faulty = 'repair'.*'avoid', 'prune'"),
        ({"qpu": SimulatedAnnealingSampler()}, "qpu = 'SimulatedAnnealingSampler'.*structured"),
    ],
)
def test_wrong_settings_are_refused(settings, message):
    with pytest.raises(SettingError, match=message):
        QpuSampler(**{"qpu": Annealer(), **settings})


def test_reads_that_cannot_be_divided_are_refused():
    with pytest.raises(SettingError, match=r"num_reads = 7 .*a multiple of n_gauges = 2"):
        QpuSampler(Annealer(), n_gauges=2).sample(to_bqm(from_model(rbm())), num_reads=7)


def test_a_single_unit_and_units_alone_have_their_qubits():
    alone = Qubo.from_matrix(torch.diag(torch.tensor([1.0, -2.0, 3.0])))
    sampler = QpuSampler(Annealer())
    assert sampler.sample(to_bqm(alone), num_reads=2, seed=0).first.energy == -2.0
    more = Qubo.from_matrix(torch.diag(torch.tensor([1.0, -2.0, 3.0, -5.0])))
    assert sampler.sample(to_bqm(more), num_reads=2, seed=0).first.energy == -7.0


def test_without_a_token_the_error_says_what_to_set(monkeypatch, tmp_path):
    for name in ("DWAVE_API_TOKEN", "DWAVE_CONFIG_FILE", "DWAVE_PROFILE"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setattr("dwave.cloud.config.loaders.get_configfile_paths", lambda **_: [])
    with pytest.raises(SettingError, match="Set DWAVE_API_TOKEN, or run `dwave config create`; sampler=annealer"):
        QpuSampler()


def test_without_the_sdk_the_error_says_what_to_install(monkeypatch):
    import memcomp_lightning.interop as interop

    monkeypatch.setitem(sys.modules, "dwave.system", None)
    monkeypatch.delitem(sys.modules, "memcomp_lightning.interop.qpu")
    monkeypatch.delattr(interop, "qpu")
    with pytest.raises(ModuleNotFoundError, match=r"pip install 'memcomp-lightning\[dwave\]'"):
        _ = interop.QpuSampler
