"""The solver benchmark's instances: what is said to be known of them is true."""

import os
import sys
from pathlib import Path

import pytest
import torch

from memcomp_lightning import rng
from memcomp_lightning.enumeration import binary_states
from memcomp_lightning.solvers import BruteForce

sys.path.insert(0, str(Path(__file__).parents[3] / "experiments" / "solver_benchmark"))
pytest.importorskip("numba")
from exact import branch_and_bound, highs
from families import families
from instances import max_cut, random_rbm, torus
from planted import frustrated_loops


@pytest.fixture
def stream():
    return rng.stream(0, "benchmark tests")


def minimum(qubo):
    return BruteForce().minimise(qubo, generator=rng.stream(0, "unused")).best_energy.item()


@pytest.mark.parametrize("density", [0.3, 0.75, 2.0])
def test_planted_state_is_a_minimum(density, stream):
    for _ in range(5):
        qubo, state, energy = frustrated_loops(8, 6, density, generator=stream)
        assert qubo.energy(state.unsqueeze(0)).item() == energy == minimum(qubo)


def test_planted_loops_are_frustrated(stream):
    qubo, _, energy = frustrated_loops(8, 6, 0.75, generator=stream)
    assert energy > -qubo.coupling.abs().sum().item() / 4  # not all bonds are satisfied


def test_mean_cancelled_fields_vanish_on_average(stream):
    qubo = random_rbm(6, 5, 1.0, cancelled=1.0, bias_std=0.0, generator=stream)
    states = binary_states(11, like=qubo.linear)
    torch.testing.assert_close(qubo.field(states).mean(0), torch.zeros(11), atol=1e-5, rtol=0)


def test_max_cut_counts_the_cut():
    pairs, weight = torch.tensor([[0, 1], [1, 2]]), torch.tensor([3.0, -2.0])
    energies = max_cut(3, pairs, weight).energy(torch.tensor([[0.0, 1, 1], [0, 1, 0], [1, 1, 1]]))
    assert energies.tolist() == [-3.0, -1.0, 0.0]


def test_torus_has_two_edges_a_node(stream):
    assert torus(4, generator=stream).coupling.shape == (32,)


@pytest.mark.parametrize("cancelled", [0.0, 1.0])
def test_proofs_agree_with_enumeration(cancelled, stream):
    qubo = random_rbm(7, 5, 1.0, cancelled=cancelled, bias_std=0.5, generator=stream)
    for proof in (
        branch_and_bound(qubo),
        branch_and_bound(qubo, incumbent=minimum(qubo)),
        highs(qubo, time_limit=20),
    ):
        assert proof.proven
        assert proof.energy == pytest.approx(minimum(qubo), abs=1e-4)


def test_branch_and_bound_without_time_proves_nothing(stream):
    qubo = random_rbm(7, 5, 1.0, cancelled=1.0, bias_std=0.5, generator=stream)
    assert not branch_and_bound(qubo, max_nodes=3).proven


def test_tuning_and_report_share_no_instance(tmp_path, monkeypatch):
    monkeypatch.delenv("MEMCOMP_DATA_DIR", raising=False)
    chosen = [family for family in families(tmp_path) if "trained" not in family.group and family.n <= 250]
    digests = {
        purpose: [instance.digest for family in chosen for instance in family.instances(purpose)]
        for purpose in ("tuning", "report")
    }
    assert len(set(digests["tuning"] + digests["report"])) == sum(map(len, digests.values()))


def test_sizes_that_are_not_tuned_on_have_a_tuned_size_in_their_group(tmp_path):
    chosen = families(tmp_path)
    assert len({family.name for family in chosen}) == len(chosen)
    for family in chosen:
        assert any(other.n_tuning for other in chosen if other.group == family.group)


@pytest.mark.needs_mnist
@pytest.mark.skipif(not os.environ.get("MEMCOMP_DATA_DIR"), reason="MEMCOMP_DATA_DIR is not set")
def test_files_are_read_with_their_published_values(tmp_path):
    groups = {family.group: family for family in families(tmp_path)}
    (first, *_) = groups["Beasley"].instances("report", 1)
    assert (first.name, first.best_known, first.problem.n) == ("bqp50-1", -2098.0, 50)
    (first, *_) = groups["G-set"].instances("report", 1)
    assert (first.name, first.best_known, first.problem.n) == ("G1", -11624.0, 800)
