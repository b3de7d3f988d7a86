"""Simple models on the same data, to compare a network with."""

from pathlib import Path

import pytest
import torch
from sklearn import linear_model

from memcomp_lightning import rng
from memcomp_lightning.data import baselines, independent_log_likelihood, logistic_regression
from memcomp_lightning.models import RBM, start_at_means


@pytest.fixture(autouse=True)
def _own_cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))


def separable(n: int) -> tuple[torch.Tensor, torch.Tensor]:
    label = torch.arange(n) % 2
    return torch.stack((label, 1 - label, torch.full((n,), 0.5)), dim=-1).float(), label


def test_logistic_regression_separates_what_is_separable() -> None:
    assert logistic_regression(separable(40), separable(10)) == 1.0
    v, label = separable(10)
    assert logistic_regression(separable(40), (v, 1 - label)) == 0.0


def test_one_class_is_always_predicted() -> None:
    v, label = separable(10)
    assert logistic_regression((v, torch.ones_like(label)), (v, label)) == 0.5


def test_the_second_time_nothing_is_fitted(monkeypatch: pytest.MonkeyPatch) -> None:
    train, test = separable(40), separable(10)
    logistic_regression(train, test)

    def refuse(*arguments: object, **settings: object) -> None:
        raise AssertionError("fitted again")

    monkeypatch.setattr(linear_model, "LogisticRegression", refuse)
    assert logistic_regression(train, test) == 1.0
    with pytest.raises(AssertionError, match="fitted again"):
        logistic_regression(separable(42), test)


def test_a_cache_that_cannot_be_written_costs_a_second(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "file").touch()
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "file"))
    assert logistic_regression(separable(40), separable(10)) == 1.0


def test_large_data_are_fitted_in_part() -> None:
    assert baselines.n_fitted(torch.empty(60_000, 784)) < 5_000
    assert baselines.n_fitted(torch.empty(1_437, 32)) == 1_437
    assert baselines.n_fitted(torch.empty(3, 10_000_000)) == 1


def test_independent_units_are_an_rbm_without_couplings() -> None:
    generator = rng.stream(0, "test")
    train, v = (rng.bernoulli(torch.full((n, 4), 0.3), generator=generator) for n in (50, 20))
    rbm = RBM(4, 1).double()
    with torch.no_grad():
        rbm.weight.zero_()
        start_at_means(rbm, train.double())
        log_z = torch.nn.functional.softplus(rbm.b).sum() + torch.log(torch.tensor(2.0)).double()
        expected = (-rbm.free_energy(v.double()) - log_z).mean()
    assert independent_log_likelihood(train, v) == pytest.approx(float(expected), abs=1e-6)


def test_a_unit_that_is_always_on_costs_little_and_never_infinity() -> None:
    ones = torch.ones(100, 1)
    assert -0.02 < independent_log_likelihood(ones, ones) < 0
    assert independent_log_likelihood(ones, torch.zeros(1, 1)) == pytest.approx(-4.6, abs=0.1)


def test_images_are_judged_in_parts_that_count_by_their_size(monkeypatch: pytest.MonkeyPatch) -> None:
    generator = rng.stream(0, "images")
    train, v = (rng.bernoulli(torch.full((n, 4), 0.3), generator=generator) for n in (50, 7))
    known = rng.bernoulli(torch.full((7, 4), 0.8), generator=generator).bool()
    whole = [independent_log_likelihood(train, v, observed=mask) for mask in (None, known)]
    monkeypatch.setattr(baselines, "AT_ONCE", 3)
    parts = [independent_log_likelihood(train, v, observed=mask) for mask in (None, known)]
    assert parts == pytest.approx(whole)
