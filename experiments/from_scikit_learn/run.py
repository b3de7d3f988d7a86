"""BernoulliRBM beside MemcompRBM on scikit-learn's own example, and by exact likelihood.

    python experiments/from_scikit_learn/run.py

prints the tables of docs/scikit_learn.md. Both classes have their default settings, but for the number of hidden
units and of passes, which is the same, and the learning rate. That is chosen on held-out training images: by
accuracy for features, by log-likelihood for the density. Test images decide nothing.
"""

import time

import numpy as np
import torch
from scipy.ndimage import shift
from sklearn.datasets import load_digits
from sklearn.linear_model import LogisticRegression
from sklearn.metrics import accuracy_score, f1_score
from sklearn.model_selection import train_test_split
from sklearn.neural_network import BernoulliRBM
from sklearn.pipeline import make_pipeline
from sklearn.preprocessing import StandardScaler

from memcomp_lightning.estimators import MemcompRBM
from memcomp_lightning.likelihood import log_likelihood, log_partition_function
from memcomp_lightning.models import RBM

RATES = (0.02, 0.06, 0.2)
SEEDS = (0, 1, 2, 3, 4)
FEATURES = {"n_components": 100, "n_iter": 20}
DENSITY = {"n_components": 16, "n_iter": 20}


def nudged(rows, y):
    """Each image, and it moved by one pixel in each direction, as in scikit-learn's example."""
    moves = [(0, 0), (-1, 0), (1, 0), (0, -1), (0, 1)]
    images = rows.reshape(-1, 8, 8)
    moved = [np.stack([shift(image, move, order=0) for image in images]).reshape(len(rows), -1) for move in moves]
    return np.concatenate(moved), np.tile(y, len(moves))


def logistic():
    return make_pipeline(StandardScaler(), LogisticRegression(tol=1e-3, max_iter=1000))


def made(kind, settings, rate, seed):
    return kind(**settings, learning_rate=rate, random_state=seed)


def on_features(make, rate, seed):
    return make_pipeline(made(make, FEATURES, rate, seed), logistic())


def likelihood(fitted, rows):
    """Mean log-likelihood in nats, exact; the weights of either class go into the same model."""
    model = RBM(rows.shape[1], len(fitted.components_)).double()
    for parameter, values in (
        (model.weight, fitted.components_),
        (model.b, fitted.intercept_visible_),
        (model.c, fitted.intercept_hidden_),
    ):
        parameter.data.copy_(torch.from_numpy(np.asarray(values)))
    return float(log_likelihood(model, torch.from_numpy(rows), log_partition_function(model)).mean())


def chosen(score_of):
    scores = {rate: score_of(rate) for rate in RATES}
    return max(scores, key=scores.get)


def spread(values):
    return f"{np.mean(values):.3f} ± {np.std(values, ddof=1) / len(values) ** 0.5:.3f}"


def features():
    X, y = load_digits(return_X_y=True)
    X = (X / 16).astype(np.float32)
    # Images are split before they are nudged: of a test image no nudged copy is among the training images.
    train, test, label, expected = train_test_split(X, y, test_size=0.2, random_state=0, stratify=y)
    fit, held, fit_label, held_label = train_test_split(
        train, label, test_size=0.2, random_state=0, stratify=label
    )
    (train, label), (test, expected) = nudged(train, label), nudged(test, expected)
    (small, small_label), (held_out, held_out_label) = nudged(fit, fit_label), nudged(held, held_label)

    print("| features | learning rate | accuracy | macro F1 | seconds of fitting |")
    print("| --- | --- | --- | --- | --- |")
    predicted = logistic().fit(train, label).predict(test)
    accuracy, f1 = accuracy_score(expected, predicted), f1_score(expected, predicted, average="macro")
    print(f"| raw pixels | | {accuracy:.3f} | {f1:.3f} | |")
    for make in (BernoulliRBM, MemcompRBM):
        rate = chosen(
            lambda rate, make=make: (
                on_features(make, rate, 0).fit(small, small_label).score(held_out, held_out_label)
            )
        )
        predictions, begun = [], time.process_time()
        for seed in SEEDS:
            predictions.append(on_features(make, rate, seed).fit(train, label).predict(test))
        seconds = (time.process_time() - begun) / len(SEEDS)
        accuracies = [accuracy_score(expected, prediction) for prediction in predictions]
        scores = [f1_score(expected, prediction, average="macro") for prediction in predictions]
        print(
            f"| {make.__name__} | {rate} | {spread(accuracies)} | {spread(scores)} | {seconds:.0f} |", flush=True
        )


def densities():
    X, y = load_digits(return_X_y=True)

    def density(make, rate, seed):
        return made(make, DENSITY, rate, seed)

    binary = (X > 8).astype(np.float64)
    train, test = train_test_split(binary, test_size=0.2, random_state=0, stratify=y)
    fit, held = train_test_split(train, test_size=0.2, random_state=0)
    print("| density | learning rate | held-out images | test images |")
    print("| --- | --- | --- | --- |")
    for make in (BernoulliRBM, MemcompRBM):
        rate = chosen(lambda rate, make=make: likelihood(density(make, rate, 0).fit(fit), held))
        of_held = likelihood(density(make, rate, 0).fit(fit), held)
        of_test = [likelihood(density(make, rate, seed).fit(train), test) for seed in SEEDS]
        print(f"| {make.__name__} | {rate} | {of_held:.2f} | {spread(of_test)} |", flush=True)


if __name__ == "__main__":
    features()
    print()
    densities()
