"""Campaigns of random problems and models find nothing in a few cases, and see a solver and a model that lie."""

import sys
from pathlib import Path
from typing import Any

import pytest
import torch

sys.path.append(str(Path(__file__).parents[1] / "campaigns"))

import random_models
import random_problems

from memcomp_lightning.models import RBM, Normal
from memcomp_lightning.models.units import Bernoulli, Spin
from memcomp_lightning.solvers import BruteForce, QuboSolution


@pytest.fixture(autouse=True)
def few(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(random_problems, "AT_ONCE", 2)
    few = {name: random_problems.SOLVERS_HERE[name] for name in ("annealing", "brute_force")}
    monkeypatch.setattr(random_problems, "SOLVERS_HERE", few)


@pytest.mark.parametrize("kind", random_problems.KINDS)
def test_nothing_is_found_in_small_problems(kind: str) -> None:
    found = random_problems.attempt(f"{kind}/0")
    assert (found.kind, found.tried, found.findings) == (kind, 2, [])


class Flatters:
    """Proves the minimum, and tells one less."""

    def minimise(self, qubo: Any, *, generator: Any) -> QuboSolution:
        found = BruteForce().minimise(qubo, generator=generator)
        return QuboSolution(found.assignments, found.energies - 1, found.status, found.steps, 0.0)


@pytest.mark.parametrize("kind", ["dense, float64", "spins"])
def test_a_solver_that_flatters_is_seen(monkeypatch: pytest.MonkeyPatch, kind: str) -> None:
    monkeypatch.setattr(random_problems, "SOLVERS_HERE", {"flatters": Flatters()})
    assert any("in integers" in finding for finding in random_problems.attempt(f"{kind}/0").findings)


def test_kinds_are_shared_out_and_cases_are_named_apart() -> None:
    cases = random_problems.cases(20_000)
    assert len(set(cases)) == len(cases)
    assert {case.rpartition("/")[0] for case in cases} == set(random_problems.KINDS)


@pytest.mark.parametrize("number", [0, 1, 2])
def test_nothing_is_found_in_small_models(monkeypatch: pytest.MonkeyPatch, number: int) -> None:
    monkeypatch.setattr(random_models, "N_CHAINS", 500)
    assert random_models.attempt(f"model/{number}").findings == []


def test_a_kind_of_units_that_lies_is_seen(monkeypatch: pytest.MonkeyPatch) -> None:
    model = RBM(visible=Spin(3), hidden=Bernoulli(2), weight_init=Normal(std=0.5))
    assert list(random_models.check_exact(model, torch.Generator().manual_seed(0))) == []
    right = Bernoulli.cumulant
    monkeypatch.setattr(Bernoulli, "cumulant", lambda self, field: right(self, field) + 0.01)
    found = list(random_models.check_exact(model, torch.Generator().manual_seed(0)))
    assert any(finding.startswith("log p") for finding in found)
