"""The solver benchmark's opponents: what they report belongs to assignments, and small problems they solve."""

import sys
from pathlib import Path

import pytest

pytest.importorskip("dwave.samplers")
pytest.importorskip("simulated_bifurcation")

from memcomp_lightning import rng
from memcomp_lightning.enumeration import binary_states
from memcomp_lightning.errors import SettingError

sys.path.insert(0, str(Path(__file__).parents[3] / "experiments" / "solver_benchmark"))
from instances import beasley, random_max_sat, random_rbm
from side_by_side import SOLVERS, Dmm, DmmBond


def problems():
    stream = rng.stream(0, "opponent tests")
    return {
        "RBM": random_rbm(6, 4, 1.0, cancelled=1.0, bias_std=0.5, generator=stream),
        "sparse": beasley(10, generator=stream),
        "MAX-3-SAT": random_max_sat(9, 40, 3, generator=stream),
    }


@pytest.mark.parametrize("name", problems())
@pytest.mark.parametrize("kind", SOLVERS, ids=lambda kind: kind.name)
def test_every_variant_reports_energies_of_the_problem_itself(kind, name, allow_global_rng):
    problem = problems()[name]
    if kind is DmmBond and name == "MAX-3-SAT":
        with pytest.raises(SettingError, match="longest clause"):
            kind().run(problem, n_reads=1, budget=1, seed=1)
        return
    levels = problem.energy(binary_states(problem.n, like=problem.offset.float()))
    for variant in kind.variants:
        budget = 1 if kind.name.startswith("tabu") else kind.budgets[min(2, len(kind.budgets) - 1)]
        reads = kind(**variant).run(problem, n_reads=20, budget=budget, seed=1)
        assert reads.energies.shape == (20,)
        assert reads.seconds > 0
        distance = abs(levels[:, None].numpy() - reads.energies).min(0)
        assert distance.max() < 1e-9
        if kind.name not in ("descent", "simulated bifurcation"):
            assert reads.energies.min() <= levels.quantile(0.05)


def test_assignments_are_read_in_our_order_of_variables(allow_global_rng):
    # A problem whose states all differ in energy: a wrong order could not go unnoticed.
    problem = random_rbm(3, 2, 1.0, cancelled=0.0, bias_std=3.0, generator=rng.stream(1, "order"))
    best = problem.energy(binary_states(5, like=problem.linear)).min().item()
    for kind in SOLVERS:
        reads = kind().run(problem, n_reads=50, budget=kind.budgets[0] or 0, seed=1)
        assert reads.energies.min() == pytest.approx(best)


def test_the_dmm_is_called_with_its_own_number_of_restarts():
    problem = problems()["RBM"]
    assert Dmm().run(problem, n_reads=30, budget=0, seed=1).energies.shape == (30,)
