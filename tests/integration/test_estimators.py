"""scikit-learn's own checks of the estimators, and what users do with them."""

import numpy as np
import pytest
from sklearn.datasets import load_digits
from sklearn.linear_model import LogisticRegression
from sklearn.model_selection import GridSearchCV, train_test_split
from sklearn.pipeline import make_pipeline
from sklearn.utils.estimator_checks import parametrize_with_checks

from memcomp_lightning.errors import SettingError
from memcomp_lightning.estimators import MemcompDBNClassifier, MemcompRBM
from memcomp_lightning.samplers import CD

SMALL = [
    MemcompRBM(n_components=3, n_iter=2),
    MemcompDBNClassifier([16], n_iter_pretrain=1, n_iter=200, learning_rate=0.5, batch_size=20),
]


@pytest.mark.usefixtures("allow_global_rng")  # which random_state=None means there
@parametrize_with_checks(SMALL)
def test_scikit_learns_own_checks(estimator, check):
    check(estimator)


def digits():
    images, labels = load_digits(return_X_y=True)
    return train_test_split(images, labels, test_size=0.25, random_state=0, stratify=labels)


@pytest.mark.parametrize("pretrain", ["greedy", "joint"])
def test_a_classifier_learns_digits(pretrain):
    train, test, labels, expected = digits()
    classifier = MemcompDBNClassifier(pretrain=pretrain, n_iter_pretrain=5, n_iter=60, random_state=0)
    classifier.fit(train, labels.astype(str))
    assert classifier.score(test, expected.astype(str)) > 0.9
    assert classifier.predict_proba(test).sum(-1) == pytest.approx(1.0)
    again = MemcompDBNClassifier(pretrain=pretrain, n_iter_pretrain=5, n_iter=60, random_state=0)
    np.testing.assert_array_equal(again.fit(train, labels).predict_proba(test), classifier.predict_proba(test))


def test_an_rbm_in_a_pipeline_and_a_grid_search():
    train, test, labels, expected = digits()
    rbm = MemcompRBM(n_components=100, learning_rate=0.1, n_iter=30, random_state=0)
    pipeline = make_pipeline(rbm, LogisticRegression(C=100.0, max_iter=5000, random_state=0)).fit(train, labels)
    assert pipeline.score(test, expected) > 0.9
    assert pipeline[:-1].get_feature_names_out()[:2].tolist() == ["memcomprbm0", "memcomprbm1"]
    search = GridSearchCV(MemcompRBM(16, n_iter=3, random_state=0), {"sampler": [None, CD(k=5)]}, cv=2)
    search.fit(train[:300])
    assert search.best_params_["sampler"] in (None, CD(k=5))


def test_likelihoods_rise_with_training():
    train, test, _, _ = digits()
    scores = []
    for n_iter in (1, 20):
        rbm = MemcompRBM(12, n_iter=n_iter, random_state=0).fit(train)
        scores.append((rbm.score(test), rbm.log_likelihood(test).mean()))
    assert np.all(np.diff(scores, axis=0) > 1.0)
    assert rbm.components_.shape == (12, 64)


@pytest.mark.parametrize(
    ("estimator", "message"),
    [
        (MemcompRBM(n_components=0), "n_components = 0"),
        (MemcompRBM(learning_rate=-1.0, random_state=0), "learning_rate = -1.0"),
        (MemcompDBNClassifier(pretrain="all"), "pretrain = 'all'"),
        (MemcompDBNClassifier(momentum=1.0, random_state=0), "momentum = 1.0"),
    ],
)
def test_wrong_settings_are_refused(estimator, message):
    with pytest.raises(SettingError, match=message):
        estimator.fit(np.eye(6), [0, 1, 0, 1, 0, 1])
