"""scikit-learn's own checks of the estimators, and what users do with them."""

import contextlib
import copy
import inspect
import pickle
import warnings
from pathlib import Path

import numpy as np
import pytest
import scipy.sparse as sp
import torch
from hydra import compose, initialize_config_dir
from sklearn.base import clone
from sklearn.datasets import load_digits
from sklearn.exceptions import NotFittedError
from sklearn.linear_model import LogisticRegression
from sklearn.model_selection import GridSearchCV, train_test_split
from sklearn.pipeline import make_pipeline
from sklearn.utils.estimator_checks import parametrize_with_checks

from memcomp_lightning import defaults
from memcomp_lightning.data import SparseRows
from memcomp_lightning.errors import SettingError
from memcomp_lightning.estimators import MemcompDBNClassifier, MemcompRBM, inputs
from memcomp_lightning.models import DBN
from memcomp_lightning.modules import DBNClassifier, EnergyPretraining
from memcomp_lightning.samplers import (
    CD,
    PCD,
    AnnealerSamples,
    Exact,
    GroundState,
    ModeAssisted,
    ModeSchedule,
    ParallelTempering,
    Quench,
)
from memcomp_lightning.solvers.dmm import DmmSolver
from memcomp_lightning.training import Greedy

ROOT = Path(__file__).parents[2]
SMALL = [
    MemcompRBM(n_components=3, n_iter=2),
    MemcompDBNClassifier([16], n_iter_pretrain=1, n_iter=200, learning_rate=0.5, batch_size=20),
]
ASSISTED = ModeAssisted(
    inner=CD(), mode=GroundState(solver=DmmSolver(n_restarts=1)), schedule=ModeSchedule(n_updates=4, p_max=1.0)
)


@pytest.mark.usefixtures("allow_global_rng")  # which random_state=None means there
@parametrize_with_checks(SMALL)
def test_scikit_learns_own_checks(estimator, check):
    check(estimator)


def binary(n=40, n_features=6, seed=0):
    """Two kinds of rows with some noise, and their labels."""
    draws = np.random.default_rng(seed)
    label = draws.integers(0, 2, n)
    X = np.where(np.arange(n_features) % 2, label[:, None], 1 - label[:, None])
    return np.where(draws.random(X.shape) < 0.1, 1 - X, X).astype(np.float64), label


def rbm(**settings):
    return MemcompRBM(**{"n_components": 3, "n_iter": 3, "random_state": 0, **settings})


def classifier(**settings):
    quick = {"sampler": CD(), "n_iter_pretrain": 2, "n_iter": 5, "random_state": 0}
    return MemcompDBNClassifier(**{"hidden_layer_sizes": [4, 3], **quick, **settings})


def outcome(estimator, X):
    return estimator.transform(X) if isinstance(estimator, MemcompRBM) else estimator.predict_proba(X)


BOTH = [pytest.param(rbm, id="rbm"), pytest.param(classifier, id="classifier")]


def digits():
    images, labels = load_digits(return_X_y=True)
    return train_test_split(images, labels, test_size=0.25, random_state=0, stratify=labels)


@pytest.mark.parametrize("pretrain", ["greedy", "joint"])
def test_a_classifier_learns_digits(pretrain):
    train, test, labels, expected = digits()
    made = MemcompDBNClassifier(pretrain=pretrain, n_iter_pretrain=5, n_iter=60, random_state=0)
    made.fit(train, labels.astype(str))
    assert made.score(test, expected.astype(str)) > 0.9
    assert made.predict_proba(test).sum(-1) == pytest.approx(1.0)


def test_a_seed_repeats_a_fit_whatever_the_labels_are_called():
    X, label = binary()
    first, again = classifier().fit(X, label.astype(str)), classifier().fit(X, label)
    np.testing.assert_array_equal(first.predict_proba(X), again.predict_proba(X))
    assert not np.array_equal(first.predict_proba(X), classifier(random_state=1).fit(X, label).predict_proba(X))


def test_an_rbm_in_a_pipeline_and_a_grid_search():
    train, test, labels, expected = digits()
    features = MemcompRBM(n_components=100, learning_rate=0.1, n_iter=20, random_state=0)
    pipeline = make_pipeline(features, LogisticRegression(C=100.0, max_iter=5000, random_state=0))
    assert pipeline.fit(train / 16, labels).score(test / 16, expected) > 0.9
    assert pipeline[:-1].get_feature_names_out()[:2].tolist() == ["memcomprbm0", "memcomprbm1"]
    search = GridSearchCV(MemcompRBM(16, n_iter=3, random_state=0), {"sampler": [None, CD(k=5)]}, cv=2)
    search.fit(train[:300])
    assert search.best_params_["sampler"] in (None, CD(k=5))


def test_likelihoods_rise_with_training():
    train, test, _, _ = digits()
    scores = []
    for n_iter in (1, 200):
        made = MemcompRBM(12, n_iter=n_iter, random_state=0).fit(train)
        scores.append((made.score(test), made.log_likelihood(test).mean()))
    assert np.all(np.diff(scores, axis=0) > 1.0)
    assert made.components_.shape == (12, 64)


# Precision


@pytest.mark.parametrize("make", BOTH)
@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_the_precision_of_the_input_is_kept(make, dtype):
    X, label = binary()
    made = make().fit(X.astype(dtype), label)
    module = made.rbm_ if make is rbm else made.network_
    assert {str(p.dtype) for p in module.parameters()} == {f"torch.{np.dtype(dtype)}"}
    for given in (np.float32, np.float64):
        assert outcome(made, X.astype(given)).dtype == given
    if dtype == np.float64:  # rows one by one: equal far beyond what float32 holds
        one_by_one = np.concatenate([outcome(made, row[None]) for row in X])
        np.testing.assert_allclose(outcome(made, X), one_by_one, rtol=1e-13)


def test_a_float64_input_is_not_rounded_by_a_float32_model():
    X, label = binary()
    made = rbm(n_iter=1).fit(X.astype(np.float32), label)
    X[0, 0] = 0.1234567890123
    expected = 1 / (1 + np.exp(-(X @ made.components_.astype(np.float64).T + made.intercept_hidden_)))
    np.testing.assert_allclose(made.transform(X), expected, rtol=1e-13)


@pytest.mark.parametrize(
    "sampler",
    [
        CD(k=2),
        PCD(n_chains=None),
        Exact(),
        ParallelTempering(n_temperatures=3, n_chains=5),
        Quench(),
        ASSISTED,
        GroundState(solver=DmmSolver(n_restarts=1)),
        AnnealerSamples,
    ],
    ids=lambda sampler: getattr(sampler, "__name__", type(sampler).__name__),
)
def test_every_sampler_trains_in_float64(sampler):
    if sampler is AnnealerSamples:
        sampler = AnnealerSamples(sampler=pytest.importorskip("dwave.samplers").SteepestDescentSampler())
    X, label = binary(20)
    assert rbm(sampler=sampler).fit(X).components_.dtype == np.float64
    made = classifier(sampler=sampler, hidden_layer_sizes=3, n_iter=1).fit(X, label)
    assert made.predict_proba(X).dtype == np.float64


# What surrounds a call


@contextlib.contextmanager
def default_dtype():
    torch.set_default_dtype(torch.float64)
    try:
        yield
    finally:
        torch.set_default_dtype(torch.float32)


@contextlib.contextmanager
def deterministic():
    torch.use_deterministic_algorithms(True)
    try:
        yield
    finally:
        torch.use_deterministic_algorithms(False)


AMBIENT = {
    "float64": default_dtype,
    "no_grad": torch.no_grad,
    "inference_mode": torch.inference_mode,
    "autocast": lambda: torch.autocast("cpu", dtype=torch.bfloat16),
    "device": lambda: torch.device("meta"),
    "deterministic": deterministic,
}


def everything(dtype):
    """Results of both estimators by all of their methods."""
    X, label = binary()
    X = X.astype(dtype)
    made = rbm(sampler=ASSISTED, early_stopping=True).fit(X)
    results = [made.transform(X), made.score_samples(X), made.log_likelihood(X), made.gibbs(X), made.sample(3)]
    made = rbm(n_components=21, n_iter=1).partial_fit(X).partial_fit(X[:7])
    results += [made.transform(X), made.sample(3, n_steps=2)]
    for pretrain in ("greedy", "joint"):
        made = classifier(pretrain=pretrain, batch_size=7).fit(X, label).partial_fit(X, label)
        results += [made.predict_proba(X), made.predict(X)]
    made = classifier(sampler=GroundState(solver=DmmSolver(n_restarts=2)), n_iter_pretrain=1).fit(X, label)
    return [*results, made.predict_proba(X)]


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_nothing_ambient_changes_a_result(dtype):
    expected = everything(dtype)
    for name, context in AMBIENT.items():
        with context():
            found = everything(dtype)
        for number, (a, b) in enumerate(zip(expected, found, strict=True)):
            np.testing.assert_array_equal(a, b, err_msg=f"{name}, result {number}")
        assert torch.is_grad_enabled()


# Sparse inputs


@pytest.mark.parametrize("container", [sp.csr_array, sp.csr_matrix, sp.csc_array, sp.coo_array, sp.lil_array])
@pytest.mark.parametrize("shift", [0.0, 2.0, -2.0])
@pytest.mark.parametrize("make", BOTH)
def test_sparse_and_dense_inputs_give_the_same(make, container, shift):
    X, label = binary()
    X[:, 1] = 5 * X[:, 1] + shift  # with a shift its zeros become other numbers
    dense, sparse = make(batch_size=7).fit(X, label), make(batch_size=7).fit(container(X), label)
    np.testing.assert_allclose(outcome(sparse, container(X)), outcome(dense, X), rtol=1e-10)
    np.testing.assert_allclose(outcome(sparse, X), outcome(dense, container(X)), rtol=1e-10)
    if make is rbm:
        np.testing.assert_allclose(sparse.score_samples(container(X)), dense.score_samples(X), rtol=1e-10)
        np.testing.assert_allclose(sparse.log_likelihood(container(X)), dense.log_likelihood(X), rtol=1e-10)
        np.testing.assert_array_equal(sparse.gibbs(container(X)), dense.gibbs(X))


def test_duplicate_entries_of_a_sparse_matrix_add_up():
    X = sp.csr_array((np.full(4, 0.5), [0, 0, 1, 1], [0, 2, 4]), shape=(2, 3))
    np.testing.assert_array_equal(rbm().fit(X).transform(X), rbm().fit(X.toarray()).transform(X.toarray()))


def test_a_sparse_matrix_is_never_dense_as_a_whole(monkeypatch):
    n, n_features = 60, 3000
    X = sp.random_array(
        (n, n_features), density=0.005, format="csr", rng=np.random.default_rng(0), dtype=np.float32
    )
    X.data[:] = 1.0
    monkeypatch.setattr(inputs, "MOST_NUMBERS", 10 * n_features)
    most = []

    def limited(original):
        def function(self, *args, **kwargs):
            dense = original(self, *args, **kwargs)
            if dense.ndim == 2:
                most.append(np.prod(dense.shape))
            return dense

        return function

    for kind in (sp.csr_array, sp.csr_matrix, sp.csc_array, sp.coo_array):
        for name in ("toarray", "todense"):
            monkeypatch.setattr(kind, name, limited(getattr(kind, name)))
    monkeypatch.setattr(SparseRows, "dense", limited(SparseRows.dense))
    label = np.arange(n) % 2
    made = rbm(n_iter=1, batch_size=8).fit(X)
    made.transform(X), made.score_samples(X[:20]), made.log_likelihood(X), made.gibbs(X), made.partial_fit(X)
    classifier(hidden_layer_sizes=3, n_iter_pretrain=1, n_iter=1).fit(X, label).predict(X)
    assert 0 < max(most) <= 20 * n_features  # parts are of 10 rows here, the classifier's batches of 20


# Scaling


def test_columns_within_the_unit_interval_are_left_as_they_are():
    X = np.column_stack([np.linspace(0, 0.25, 9), np.full(9, 0.5), np.ones(9), np.zeros(9), np.arange(9) % 2])
    np.testing.assert_array_equal(inputs.Scaling.of(X).apply(X), X)


def test_columns_that_leave_it_are_scaled_by_their_range_and_clipped():
    X = np.column_stack([np.arange(5.0), np.linspace(-1, 1, 5), np.full(5, 7.0), np.full(5, -7.0)])
    scaling = inputs.Scaling.of(X)
    quarters = np.linspace(0, 1, 5)
    np.testing.assert_allclose(scaling.apply(X), np.column_stack([quarters, quarters, np.ones(5), np.zeros(5)]))
    later = np.array([[9.0, -9.0, 0.25, 3.0]])
    np.testing.assert_allclose(scaling.apply(later), [[1.0, 0.0, 0.25, 1.0]])
    np.testing.assert_allclose(scaling.apply(sp.csr_array(later)).toarray(), [[1.0, 0.0, 0.25, 1.0]])


@pytest.mark.parametrize("value", [1.0, 7.0])
def test_a_column_of_ones_is_modelled_as_ones(value):
    X, _ = binary(200)
    X[:, 2] = value
    made = rbm(n_iter=10).fit(X)
    off = np.where(np.arange(6) == 2, 0.0, X)
    assert np.mean(made.sample(2000)[:, 2] == 1) > 0.95
    assert np.all(made.log_likelihood(X) - made.log_likelihood(off) > 3.0)


# Weights


def test_a_whole_weight_is_so_many_repeats():
    X, label = binary()
    weight = np.random.default_rng(1).integers(0, 4, len(X))
    repeated, labels = X.repeat(weight, axis=0), label.repeat(weight)
    for batch_size in (None, 7):
        for sampler in (CD(), PCD(n_chains=5)):
            kwargs = {"batch_size": batch_size, "sampler": sampler}
            a, b = rbm(**kwargs).fit(X, sample_weight=weight), rbm(**kwargs).fit(repeated)
            if sampler != CD() or batch_size is not None:  # full-batch CD draws a chain a row
                np.testing.assert_allclose(a.components_, b.components_, rtol=1e-9, atol=1e-12)
        kwargs = {"batch_size": batch_size, "pretrain_batch_size": batch_size, "sampler": PCD(n_chains=5)}
        a = classifier(**kwargs).fit(X, label, sample_weight=weight)
        b = classifier(**kwargs).fit(repeated, labels)
        np.testing.assert_allclose(a.predict_proba(X), b.predict_proba(X), rtol=1e-9)
        plain = classifier(**kwargs).fit(X, label)
        assert np.abs(a.predict_proba(X) - plain.predict_proba(X)).max() > 1e-6


def test_weights_of_the_contrast_reach_both_phases_of_cd():
    """A heavy row is learnt as if it were the only one."""
    X = np.array([[1.0, 0.0, 1.0, 0.0]] + [[0.0, 1.0, 0.0, 1.0]] * 9)
    weight = np.array([1e6] + [1e-3] * 9)
    made = rbm(sampler=CD(), batch_size=None, n_iter=50).fit(X, sample_weight=weight)
    likelihood = made.log_likelihood(X[:2])
    assert likelihood[0] > -0.5
    assert likelihood[1] < -10


def test_fractional_weights_keep_steps_even():
    X, _ = binary(30)
    weight = np.ones(30)
    weight[0] = 300.0
    batches = list(
        inputs.batches_of(inputs.Samples(X, np.zeros(30, dtype=int), weight + 0.5), batch_size=10, seed=0)
    )
    heavy = [
        float((b.weight * torch.from_numpy((b.v.numpy() == X[0]).all(1).astype(float))).sum()) for b in batches
    ]
    assert len(batches) >= 3
    assert sum(value > 0 for value in heavy) >= 2  # not in one step alone
    total = sum(float(b.weight.sum()) for b in batches)
    assert total == pytest.approx(30.0)


def test_fractional_weights_keep_the_precision_of_the_data():
    X, _ = binary(30)
    weight = np.random.default_rng(1).uniform(0.1, 9.0, 30)
    made = rbm(batch_size=10, n_iter=1).fit(X.astype(np.float32), sample_weight=weight)
    assert made.components_.dtype == np.float32


@pytest.mark.parametrize("make", BOTH)
@pytest.mark.parametrize(
    ("weight", "message"),
    [(-np.ones(40), "[Nn]egative"), (np.zeros(40), "zero"), (np.ones(3), "sample_weight"), ([np.nan] * 40, "NaN")],
)
def test_wrong_weights_are_refused(make, weight, message):
    X, label = binary()
    with pytest.raises(ValueError, match=message):
        make().fit(X, label, sample_weight=weight)


# partial_fit, Gibbs sampling


def test_passes_one_by_one_are_those_of_a_fit():
    X, _ = binary()
    whole, parts = rbm(n_iter=4, batch_size=7, last_rate=1.0).fit(X), rbm(batch_size=7)
    for _ in range(4):
        parts.partial_fit(X)
    np.testing.assert_array_equal(parts.components_, whole.components_)
    assert parts.n_iter_ == whole.n_iter_ == 4
    further, longer = rbm(n_iter=3, batch_size=7, last_rate=1.0).fit(X).partial_fit(X), whole
    np.testing.assert_array_equal(further.components_, longer.components_)


def test_a_classifier_goes_on_with_its_optimiser():
    X, label = binary()
    whole, parts = classifier(n_iter=4).fit(X, label), classifier(n_iter=3).fit(X, label).partial_fit(X, label)
    np.testing.assert_array_equal(whole.predict_proba(X), parts.predict_proba(X))
    begun = classifier()
    with pytest.raises(ValueError, match="classes must be passed"):
        begun.partial_fit(X, label)
    for _ in range(4):
        begun.partial_fit(X, label, classes=[0, 1])
    np.testing.assert_array_equal(whole.predict_proba(X), begun.predict_proba(X))
    with pytest.raises(ValueError, match=r"y holds \[2\], which is not among the classes \[0, 1\]"):
        begun.partial_fit(X, label + 1)
    begun.partial_fit(X, np.full(len(X), -1))
    assert begun.n_iter_ == 4  # nothing to learn from
    with pytest.raises(ValueError, match="marks unlabelled samples"):
        classifier().partial_fit(X, label, classes=[-1, 0, 1])
    assert classifier().partial_fit(X, 2 * label - 1, classes=[-1, 1]).classes_.tolist() == [-1, 1]


def test_settings_can_change_between_parts():
    X, _ = binary()
    made = rbm().partial_fit(X)
    made.set_params(sampler=CD(), learning_rate=1e-9).partial_fit(X)
    before = made.components_.copy()
    made.partial_fit(X)
    assert np.abs(made.components_ - before).max() < 1e-6
    with pytest.raises(ValueError, match="early_stopping"):
        made.set_params(early_stopping=True).partial_fit(X)


def test_gibbs_samples_follow_the_model():
    X, _ = binary(200)
    made = rbm(n_iter=10, learning_rate=0.2).fit(X)
    states = X
    for _ in range(20):
        states = made.gibbs(states)
    assert states.dtype == X.dtype
    assert set(np.unique(states)) == {0.0, 1.0}
    drawn = made.sample(2000)
    assert np.abs(states.mean(0) - drawn.mean(0)).max() < 0.2
    np.testing.assert_array_equal(made.sample(5, random_state=3), made.sample(5, random_state=3))
    assert not np.array_equal(made.sample(5), made.sample(5))
    again = rbm(n_iter=10, learning_rate=0.2).fit(X)
    np.testing.assert_array_equal(again.gibbs(X), rbm(n_iter=10, learning_rate=0.2).fit(X).gibbs(X))


def test_states_are_in_the_units_of_the_data():
    X, _ = binary()
    X[:, 0] = 3 + 4 * X[:, 0]
    made = rbm().fit(X)
    assert set(np.unique(made.gibbs(X)[:, 0])) <= {3.0, 7.0}
    assert set(np.unique(made.sample(50)[:, 0])) <= {3.0, 7.0}


# Labels


@pytest.mark.parametrize("dtype", [int, float])
def test_minus_one_marks_samples_without_a_label(dtype):
    X, label = binary()
    few = np.where(np.arange(len(X)) < 10, label, -1).astype(dtype)
    made = classifier(pretrain_batch_size=7).fit(X, few)
    assert made.classes_.tolist() == [0, 1]
    assert set(made.predict(X)) <= {0, 1}
    labelled_alone = classifier(pretrain_batch_size=7).fit(X[:10], label[:10])
    assert np.abs(made.predict_proba(X) - labelled_alone.predict_proba(X)).max() > 1e-6  # pretraining saw them
    untrained = {"n_iter_pretrain": 0}
    np.testing.assert_array_equal(  # and back-propagation did not
        classifier(**untrained).fit(X, few).predict_proba(X),
        classifier(**untrained).fit(X[:10], label[:10]).predict_proba(X),
    )


def test_minus_one_and_one_are_two_classes():
    X, label = binary()
    assert classifier().fit(X, 2 * label - 1).classes_.tolist() == [-1, 1]
    assert classifier().fit(X, np.where(label, "1", "-1")).classes_.tolist() == ["-1", "1"]
    names = np.where(np.arange(len(X)) < 10, np.array(["no", "yes"], dtype=object)[label], -1)
    assert classifier().fit(X, names).classes_.tolist() == ["no", "yes"]
    with pytest.raises(ValueError, match=r"one class, \[0\] beside -1"):
        classifier().fit(X, label - 1)


def test_several_labels_a_sample_are_refused_in_one_line():
    X, label = binary()
    with pytest.raises(ValueError, match="MultiOutputClassifier") as refusal:
        classifier().fit(X, np.column_stack([label, 1 - label]))
    assert "\n" not in str(refusal.value)


@pytest.mark.parametrize("values", [["no", "yes"], [False, True], [10, 20], [0.0, 2.0]])
def test_labels_of_any_type_come_back(values):
    X, label = binary()
    y = np.array(values)[label]
    made = classifier(hidden_layer_sizes=8, n_iter=40, learning_rate=0.5).fit(X, y)
    assert made.classes_.tolist() == values
    assert made.predict(X).dtype == y.dtype
    assert made.score(X, y) > 0.9


# Early stopping


@pytest.mark.parametrize("make", BOTH)
def test_training_stops_when_held_out_samples_no_longer_gain(make):
    X, label = binary(100)
    made = make(early_stopping=True, n_iter=500, n_iter_no_change=3, learning_rate=0.5, tol=1e-3).fit(X, label)
    scores = made.validation_scores_
    assert made.n_iter_ == len(scores) < 500
    assert max(scores[-3:]) <= max(scores[:-3]) + 1e-3
    held_out = train_test_split(
        np.arange(100), test_size=0.1, random_state=made._seed, stratify=None if make is rbm else label
    )[1]
    assert made.score(X[held_out], label[held_out]) == pytest.approx(max(scores))
    assert make(n_iter=2).fit(X, label).validation_scores_ is None


# Settings of samplers by name


def test_settings_of_a_sampler_have_names():
    pipeline = make_pipeline(MemcompRBM(2, n_iter=1, random_state=0))
    assert pipeline.get_params()["memcomprbm__sampler__k"] == 1
    pipeline.set_params(memcomprbm__sampler__k=5)
    assert pipeline[0].sampler == ParallelTempering(n_chains=20, n_temperatures=5, k=5)
    made = MemcompRBM(sampler=ASSISTED)
    names = {name for name in made.get_params() if name.startswith("sampler__")}
    assert {"sampler__inner__k", "sampler__schedule__p_max", "sampler__mode__solver__n_restarts"} <= names
    assert not any("__" in name for name in made.get_params(deep=False))
    copied = clone(made).set_params(sampler__inner__k=3, sampler__schedule__p_max=0.5)
    assert (copied.sampler.inner.k, copied.sampler.schedule.p_max) == (3, 0.5)
    assert made.sampler.inner.k == 1
    made.set_params(sampler=CD(), sampler__k=4, n_iter=2)
    assert made.sampler == CD(k=4)
    made = MemcompDBNClassifier().set_params(sampler__solver__n_restarts=3)
    assert made.sampler == GroundState(solver=DmmSolver(n_restarts=3))


@pytest.mark.parametrize(
    "name", ["sampler__kk", "sampler__k__k", "samplr__k", "sampler__inner__k", "samplr", "n_iter__k"]
)
def test_a_setting_that_does_not_exist_is_named(name):
    with pytest.raises(ValueError, match=f"nvalid parameter.*{name.partition('__')[0]}"):
        MemcompRBM().set_params(**{name: 3})


def test_a_wrong_value_is_refused_by_the_sampler():
    with pytest.raises(SettingError, match="k = 0"):
        MemcompRBM().set_params(sampler__k=0)


def test_a_grid_search_over_a_setting_of_the_sampler():
    X, _ = binary()
    search = GridSearchCV(rbm(), {"sampler__k": [1, 3], "n_components": [2]}, cv=2).fit(X)
    assert search.best_estimator_.sampler.k == search.best_params_["sampler__k"]


# Everything else


def test_an_integer_is_one_hidden_layer():
    X, label = binary()
    a, b = (
        classifier(hidden_layer_sizes=4).fit(X, label),
        classifier(hidden_layer_sizes=np.array([4])).fit(X, label),
    )
    np.testing.assert_array_equal(a.predict_proba(X), b.predict_proba(X))


def test_pretraining_in_mini_batches_does_more_updates():
    X, label = binary()
    whole, parts = (
        classifier(pretrain_batch_size=size, pretrain_learning_rate=0.5).fit(X, label) for size in (None, 5)
    )
    lengths = [float(made.network_[0][0].c.detach().norm()) for made in (whole, parts)]
    assert lengths[1] > 2 * lengths[0] > 0


@pytest.mark.parametrize("make", BOTH)
def test_fitted_estimators_are_pickled_and_go_on(make):
    X, label = binary()
    made = make().fit(X, label)
    copies = [pickle.loads(pickle.dumps(made)), copy.deepcopy(made)]
    expected = outcome(made.partial_fit(X, label), X)
    for other in copies:
        np.testing.assert_array_equal(outcome(other.partial_fit(X, label), X), expected)


@pytest.mark.parametrize("make", BOTH)
def test_any_kind_of_random_state(make):
    X, label = binary()
    for state in (np.random.RandomState(3), np.random.default_rng(3)):
        first, again = copy.deepcopy(state), copy.deepcopy(state)
        a, b = (outcome(make(random_state=one).fit(X, label), X) for one in (first, again))
        np.testing.assert_array_equal(a, b)
        assert not np.array_equal(a, outcome(make(random_state=first).fit(X, label), X))


@pytest.mark.parametrize("make", BOTH)
def test_inputs_are_not_changed_and_may_be_read_only(make):
    X, label = binary()
    X[:, 0] *= 3
    X.flags.writeable = False
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        outcome(make().fit(X, label), X)
    sparse = sp.csr_array(X)
    before = sparse.copy()
    outcome(make().fit(sparse, label), sparse)
    assert (sparse != before).nnz == 0


def test_names_of_columns_are_kept():
    pandas = pytest.importorskip("pandas")
    X, label = binary()
    frame = pandas.DataFrame(X, columns=list("abcdef"))
    for make in (rbm, classifier):
        made = make().fit(frame, label)
        assert made.feature_names_in_.tolist() == list("abcdef")
        with pytest.raises(ValueError, match="feature names"):
            outcome(made, frame[list("fedcba")])


def test_one_line_a_pass_is_printed(capsys):
    X, label = binary()
    rbm(verbose=True, n_iter=2).fit(X)
    classifier(verbose=True, n_iter=2, early_stopping=True).fit(X, label)
    lines = capsys.readouterr().out.splitlines()
    assert lines[:2] == ["[MemcompRBM] pass 1 of 2", "[MemcompRBM] pass 2 of 2"]
    assert len(lines) == 4
    assert "held-out" in lines[-1]


def test_the_number_of_features_out_is_the_fitted_one():
    X, _ = binary()
    made = rbm().fit(X).set_params(n_components=9)
    assert len(made.get_feature_names_out()) == made.transform(X).shape[1] == 3
    with pytest.raises(NotFittedError):
        rbm().sample()


@pytest.mark.parametrize(
    ("estimator", "message"),
    [
        (MemcompRBM(n_components=0), "n_components = 0"),
        (MemcompRBM(learning_rate=-1.0), "learning_rate = -1.0"),
        (MemcompRBM(batch_size=0), "batch_size = 0"),
        (MemcompRBM(last_rate=0.0), "last_rate = 0.0"),
        (MemcompRBM(n_iter=0), "n_iter = 0"),
        (MemcompRBM(early_stopping=True, validation_fraction=1.0), "validation_fraction = 1.0"),
        (MemcompRBM(sampler="pcd"), "sampler = 'pcd'"),
        (MemcompDBNClassifier(pretrain="all"), "pretrain = 'all'"),
        (MemcompDBNClassifier(momentum=1.0), "momentum = 1.0"),
        (MemcompDBNClassifier(hidden_layer_sizes=()), "hidden_layer_sizes = \\(\\)"),
        (MemcompDBNClassifier(hidden_layer_sizes=[3, 0]), "hidden_layer_sizes = 0"),
        (MemcompDBNClassifier(pretrain_batch_size=0), "pretrain_batch_size = 0"),
        (MemcompDBNClassifier(pretrain_learning_rate=0), "pretrain_learning_rate = 0"),
        (MemcompDBNClassifier(early_stopping=True, n_iter_no_change=0), "n_iter_no_change = 0"),
    ],
)
def test_wrong_settings_are_refused(estimator, message):
    with pytest.raises(SettingError, match=message):
        estimator.set_params(random_state=0).fit(np.eye(6), [0, 1, 0, 1, 0, 1])


def test_the_command_line_trains_by_the_same_defaults():
    with initialize_config_dir(str(ROOT / "conf"), version_base=None):
        config = compose("config", overrides=["sampler=pcd"])
        of_table = compose("config", overrides=["data=table"])
    signature = {name: p.default for name, p in inspect.signature(MemcompRBM).parameters.items()}
    pretrain = of_table.pretrain
    assert pretrain.batch_size == signature["batch_size"]
    assert pretrain.optimizer.lr == signature["learning_rate"]
    assert pretrain.iterations == signature["n_iter"]
    assert pretrain.updates == defaults.TABLE_UPDATES
    assert pretrain.schedules.decay.final == signature["last_rate"]
    assert of_table.model.hidden_sizes == [signature["n_components"]]
    tempering = MemcompRBM()._default_sampler()
    assert (of_table.sampler.n_chains, of_table.sampler.n_temperatures) == (20, 5)
    assert (tempering.n_chains, tempering.n_temperatures) == (20, 5)
    pretrain = config.pretrain
    assert pretrain.initial_bias == "data"
    assert pretrain.centring.rate == defaults.CENTRING_RATE
    assert config.sampler.n_chains == defaults.N_CHAINS
    assert config.model.weight_init.std == defaults.WEIGHT_STD
    signature = {name: p.default for name, p in inspect.signature(MemcompDBNClassifier).parameters.items()}
    assert pretrain.iterations == signature["n_iter_pretrain"]
    assert pretrain.batch_size == signature["pretrain_batch_size"]
    assert pretrain.optimizer.lr == signature["pretrain_learning_rate"]
    assert config.finetune.iterations == signature["n_iter"]
    assert config.finetune.batch_size == signature["batch_size"]
    assert config.finetune.optimizer.lr == signature["learning_rate"]
    assert config.finetune.optimizer.momentum == signature["momentum"]
    assert signature["centred"]


def test_modules_train_by_the_same_defaults():
    parameter = [torch.nn.Parameter(torch.zeros(1))]
    pretraining = EnergyPretraining(Greedy(DBN(3, [2])), PCD(n_chains=5))
    assert pretraining.iterations == defaults.PASSES
    assert pretraining.centring.rate == defaults.CENTRING_RATE
    assert pretraining.make_optimizer(parameter).defaults["lr"] == defaults.LEARNING_RATE
    classifier = DBNClassifier(DBN(3, [2]))
    assert classifier.iterations == defaults.FINETUNING_PASSES
    settings = classifier.make_optimizer(parameter).defaults
    assert settings["lr"] == defaults.FINETUNING_LEARNING_RATE
    assert settings["momentum"] == defaults.FINETUNING_MOMENTUM


@pytest.mark.parametrize(("n", "early", "passes"), [(50, False, 200), (50, True, 10_000), (10_000, False, 100)])
def test_passes_follow_from_updates(n, early, passes):
    samples = inputs.Samples(np.zeros((n, 2)), np.zeros(n), None)
    assert MemcompRBM(early_stopping=early)._n_passes(samples) == passes
    assert MemcompRBM(n_iter=3)._n_passes(samples) == 3
