"""Logistic regression and support vector machines, on pixels or on features that were learned without labels."""

import warnings
from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
import torch
from torch import Tensor

from memcomp_lightning.data.labels import labelled_at
from memcomp_lightning.studies.few_labels.data import Sets
from memcomp_lightning.studies.few_labels.learner import Context, Point
from memcomp_lightning.studies.search import Setting


class Features(Protocol):
    """What a classifier sees of a row."""

    def of(self, v: Tensor, context: Context, setting: Setting) -> Tensor:
        """Features of rows ``(n, n_visible)``, ``(n, n_features)``."""


@dataclass(frozen=True)
class Pixels:
    """The rows themselves."""

    def of(self, v: Tensor, context: Context, setting: Setting) -> Tensor:
        """See :class:`Features`."""
        return v


@dataclass(frozen=True)
class PrincipalComponents:
    """The first components of all training rows, each of variance one; a setting says how many."""

    def of(self, v: Tensor, context: Context, setting: Setting) -> Tensor:
        """See :class:`Features`."""
        mean, axes, variance = context.principal
        n = setting["components"]
        return ((v - mean) @ axes[:, :n]) / variance[:n].sqrt()


@dataclass(frozen=True, kw_only=True)
class HiddenMeans:
    """Means of the top hidden units of the pretrained DBN."""

    @torch.no_grad()
    def of(self, v: Tensor, context: Context, setting: Setting) -> Tensor:
        """See :class:`Features`."""
        found: Tensor = context.dbn()(v)
        return found


@dataclass(frozen=True, kw_only=True)
class Classical(ABC):
    """A classifier of scikit-learn.

    Attributes:
        features: What it sees.
        most: Rows that it is fitted to at most: the first ones of each class, as drawn; None is all.
    """

    features: Features
    most: int | None

    def learn(self, context: Context, sets: Sets, setting: Setting, passes: Sequence[int] | None) -> list[Point]:
        """See :class:`Learner`."""
        accuracy = []
        for at, label, judged_at, judged_label in zip(
            sets.at, sets.label, sets.judging_at, sets.judging_label, strict=True
        ):
            own = _spread(label, self.most)
            x = self.features.of(sets.rows[at[own]], context, setting).numpy()
            y = label[own].numpy()
            judged = self.features.of(sets.judging[judged_at], context, setting).numpy()
            if len(np.unique(y)) == 1:
                right = judged_label.numpy() == y[0]
            else:
                with warnings.catch_warnings():
                    warnings.simplefilter("ignore")  # of convergence: what it reaches is judged all the same
                    right = self.classifier(setting, x).fit(x, y).predict(judged) == judged_label.numpy()
            accuracy.append(float(right.mean()))
        found = torch.tensor(accuracy, dtype=torch.float64, device="cpu")
        return [Point(0, found, torch.zeros_like(found))]

    @abstractmethod
    def classifier(self, setting: Setting, x: Any) -> Any:
        """A new one, not fitted."""


@dataclass(frozen=True, kw_only=True)
class Regression(Classical):
    """Logistic regression with an L2 penalty; C is tuned."""

    def classifier(self, setting: Setting, x: Any) -> Any:
        """A new one, not fitted."""
        from sklearn.linear_model import LogisticRegression

        return LogisticRegression(C=setting["C"], max_iter=200)


@dataclass(frozen=True, kw_only=True)
class SupportVectors(Classical):
    """Support vectors with radial basis functions; C is tuned, and gamma in units of 1 / total variance."""

    def classifier(self, setting: Setting, x: Any) -> Any:
        """A new one, not fitted."""
        from sklearn.svm import SVC

        gamma = setting["gamma"] / max(x.shape[1] * float(x.var()), 1e-12)
        return SVC(C=setting["C"], gamma=gamma, random_state=0)


def _spread(label: Tensor, most: int | None) -> Tensor:
    """Places of at most so many rows, of each class its share."""
    return labelled_at(label, len(label) if most is None else min(most, len(label)))
