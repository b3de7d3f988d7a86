"""scikit-learn estimators: an RBM as a transformer, a deep belief network as a classifier."""

from collections.abc import Sequence
from functools import partial
from typing import Any, Literal

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from sklearn.base import BaseEstimator, ClassifierMixin, ClassNamePrefixFeaturesOutMixin, TransformerMixin
from sklearn.preprocessing import LabelEncoder, MinMaxScaler
from sklearn.utils import check_random_state
from sklearn.utils.multiclass import check_classification_targets
from sklearn.utils.validation import check_is_fitted, validate_data
from torch import Tensor
from torch.optim import SGD

from memcomp_lightning import rng
from memcomp_lightning.data import Batches
from memcomp_lightning.dmm import DmmSolver
from memcomp_lightning.errors import require, require_choice, require_count
from memcomp_lightning.likelihood import (
    Ais,
    base_of,
    log_likelihood,
    log_partition_function,
    log_pseudo_likelihood,
)
from memcomp_lightning.models import DBN, Gaussian
from memcomp_lightning.modules import DBNClassifier
from memcomp_lightning.objective import Centring
from memcomp_lightning.replicas import Rates, finetune, pretrain, pretrain_jointly
from memcomp_lightning.samplers import PCD, GroundState, MeanField

MOST_ENUMERATED = 20
"""Units of the smaller layer up to which a log-likelihood is exact."""


class _OnUnitInterval(BaseEstimator):  # type: ignore[misc]
    """Inputs are scaled to [0, 1] by the range of the training data, and clipped there later on."""

    _scaler: Any

    def _fitted(self, X: ArrayLike, y: ArrayLike | None = None) -> tuple[Tensor, Any]:
        if y is None:
            X, target = validate_data(self, X, dtype=np.float64), None
        else:
            X, target = validate_data(self, X, y, dtype=np.float64)
        self._scaler = MinMaxScaler(clip=True).fit(X)
        return self._scaled(X), target

    def _checked(self, X: ArrayLike) -> Tensor:
        check_is_fitted(self)
        return self._scaled(validate_data(self, X, dtype=np.float64, reset=False))

    def _scaled(self, X: Any) -> Tensor:
        return torch.as_tensor(self._scaler.transform(X).astype(np.float32))


def _batches(v: Tensor, label: Tensor, batch_size: int | None, seed: int) -> Batches:
    size = None if batch_size is None else min(batch_size, len(v))
    return Batches(v, label, batch_size=size, chunk_size=max(10_000, size or 0), shuffle=True, seed=seed)


class MemcompRBM(ClassNamePrefixFeaturesOutMixin, TransformerMixin, _OnUnitInterval):  # type: ignore[misc]
    """Bernoulli RBM whose negative phase is any sampler of this package.

    Inputs are scaled to [0, 1] by their range in ``fit`` and stand for probabilities.

    Args:
        n_components: Hidden units, >= 1.
        sampler: Supplies the negative phase; None is ``PCD(n_chains=100)``.
        learning_rate: Of plain gradient descent, > 0.
        batch_size: Samples an update, >= 1; None means all.
        n_iter: Passes over the data, >= 1.
        centred: Follow the centred gradient.
        random_state: Seed, generator or None, as everywhere in scikit-learn.

    Attributes:
        rbm_: The trained :class:`memcomp_lightning.models.RBM`.
        components_: Its weights, ``(n_components, n_features)``.
        intercept_hidden_: Hidden biases.
        intercept_visible_: Visible biases.
        n_iter_: Passes done.

    >>> import numpy as np
    >>> MemcompRBM(n_components=2, n_iter=3, random_state=0).fit_transform(np.eye(4)).shape
    (4, 2)
    """

    def __init__(
        self,
        n_components: int = 64,
        *,
        sampler: Any = None,
        learning_rate: float = 0.05,
        batch_size: int | None = 20,
        n_iter: int = 10,
        centred: bool = True,
        random_state: Any = None,
    ) -> None:
        self.n_components = n_components
        self.sampler = sampler
        self.learning_rate = learning_rate
        self.batch_size = batch_size
        self.n_iter = n_iter
        self.centred = centred
        self.random_state = random_state

    def fit(self, X: ArrayLike, y: Any = None) -> "MemcompRBM":
        """Train on ``(n_samples, n_features)``; y is not used.

        Raises:
            SettingError: A setting is out of range.
            DivergedError: A parameter left the finite numbers.
        """
        require_count("n_components", self.n_components)
        require_count("n_iter", self.n_iter)
        v, _ = self._fitted(X)
        seed = _seed(self.random_state)
        dbn = DBN(v.shape[-1], [self.n_components], generator=rng.stream(seed, "weights"))
        pretrain(
            dbn,
            _batches(v, torch.zeros(len(v), dtype=torch.long), self.batch_size, seed),
            PCD(n_chains=100) if self.sampler is None else self.sampler,
            iterations=self.n_iter,
            rates=Rates(_sgd(self.learning_rate)),
            centring=Centring() if self.centred else None,
            seed=seed,
        )
        self.rbm_, self.n_iter_ = dbn[0], self.n_iter
        self._base = base_of(v)
        return self

    @property
    def components_(self) -> NDArray[np.float32]:
        """Weights, ``(n_components, n_features)``."""
        return _array(self.rbm_.weight)

    @property
    def intercept_hidden_(self) -> NDArray[np.float32]:
        """Hidden biases, ``(n_components,)``."""
        return _array(self.rbm_.c)

    @property
    def intercept_visible_(self) -> NDArray[np.float32]:
        """Visible biases, ``(n_features,)``."""
        return _array(self.rbm_.b)

    @property
    def _n_features_out(self) -> int:
        return self.n_components

    def transform(self, X: ArrayLike) -> NDArray[np.float64]:
        """Hidden means given the data, ``(n_samples, n_components)``."""
        v = self._checked(X)
        return _array(self.rbm_(v).double())

    def score_samples(self, X: ArrayLike) -> NDArray[np.float64]:
        """Log pseudo-likelihood of each sample in nats, features rounded to 0 or 1, ``(n_samples,)``."""
        v = self._checked(X).round()
        return _array(log_pseudo_likelihood(self.rbm_, v).sum(-1))

    def score(self, X: ArrayLike, y: Any = None) -> float:
        """Mean of :meth:`score_samples`: what a grid search maximises."""
        return float(self.score_samples(X).mean())

    def log_likelihood(self, X: ArrayLike) -> NDArray[np.float64]:
        """Log-likelihood of each sample in nats, features rounded to 0 or 1, ``(n_samples,)``.

        Exact with up to 20 hidden units or features, otherwise by annealed importance sampling.
        """
        v = self._checked(X).round()
        if min(self.rbm_.n_visible, self.rbm_.n_hidden) <= MOST_ENUMERATED:
            log_z = log_partition_function(self.rbm_)
        else:
            log_z = Ais().estimate(self.rbm_, generator=rng.stream(0, "ais"), base=self._base).log_z
        return _array(log_likelihood(self.rbm_, v, log_z))


class MemcompDBNClassifier(ClassifierMixin, _OnUnitInterval):  # type: ignore[misc]
    """Deep belief network: layers pretrained by any sampler, then back-propagation with an output layer.

    Inputs are scaled to [0, 1] by their range in ``fit``.

    Args:
        hidden_layer_sizes: Units of each hidden layer.
        sampler: Supplies the negative phase of pretraining; None is the DMM's ground state, as in the paper.
        pretrain: "greedy", one layer after the other, or "joint", all of them as a deep Boltzmann machine.
        n_iter_pretrain: Full-batch updates of pretraining, >= 0.
        pretrain_learning_rate: Of pretraining, > 0.
        n_iter: Passes of back-propagation, >= 1.
        learning_rate: Of back-propagation, > 0.
        momentum: Of back-propagation, in [0, 1).
        batch_size: Samples an update of back-propagation, >= 1; None means all.
        weight_std: Standard deviation of the first weights, > 0.
        random_state: Seed, generator or None, as everywhere in scikit-learn.

    Attributes:
        classes_: Labels.
        network_: The trained network: inputs to logits.
        n_iter_: Passes of back-propagation done.

    >>> import numpy as np
    >>> classifier = MemcompDBNClassifier([3], n_iter_pretrain=2, n_iter=200, learning_rate=1.0, random_state=0)
    >>> classifier.fit(np.eye(4), ["a", "b", "a", "b"]).predict(np.eye(4)).tolist()
    ['a', 'b', 'a', 'b']
    """

    def __init__(
        self,
        hidden_layer_sizes: Sequence[int] = (32, 32),
        *,
        sampler: Any = None,
        pretrain: Literal["greedy", "joint"] = "greedy",
        n_iter_pretrain: int = 20,
        pretrain_learning_rate: float = 0.1,
        n_iter: int = 100,
        learning_rate: float = 0.1,
        momentum: float = 0.9,
        batch_size: int | None = 20,
        weight_std: float = 0.1,
        random_state: Any = None,
    ) -> None:
        self.hidden_layer_sizes = hidden_layer_sizes
        self.sampler = sampler
        self.pretrain = pretrain
        self.n_iter_pretrain = n_iter_pretrain
        self.pretrain_learning_rate = pretrain_learning_rate
        self.n_iter = n_iter
        self.learning_rate = learning_rate
        self.momentum = momentum
        self.batch_size = batch_size
        self.weight_std = weight_std
        self.random_state = random_state

    def fit(self, X: ArrayLike, y: ArrayLike) -> "MemcompDBNClassifier":
        """Train on ``(n_samples, n_features)`` and their labels.

        Raises:
            SettingError: A setting is out of range.
            DivergedError: A parameter left the finite numbers.
        """
        require_choice("pretrain", self.pretrain, ("greedy", "joint"))
        require_count("n_iter_pretrain", self.n_iter_pretrain, minimum=0)
        require_count("n_iter", self.n_iter)
        v, target = self._fitted(X, y)
        check_classification_targets(target)
        encoder = LabelEncoder().fit(target)
        self.classes_ = encoder.classes_
        if len(self.classes_) < 2:
            raise ValueError(
                f"y holds one class, {self.classes_.tolist()}: a classifier needs at least 2 classes."
            )
        label, seed = torch.as_tensor(encoder.transform(target)).long(), _seed(self.random_state)
        dbn = DBN(
            v.shape[-1],
            list(self.hidden_layer_sizes),
            weight_init=Gaussian(std=self.weight_std),
            generator=rng.stream(seed, "weights"),
        )
        settings: dict[str, Any] = {
            "iterations": self.n_iter_pretrain,
            "rates": Rates(_sgd(self.pretrain_learning_rate)),
            "seed": seed,
        }
        sampler = GroundState(solver=DmmSolver()) if self.sampler is None else self.sampler
        whole = _batches(v, label, None, seed)
        if self.pretrain == "joint":
            pretrain_jointly(dbn, whole, sampler, MeanField(), **settings)
        else:
            pretrain(dbn, whole, sampler, **settings)
        self.network_ = DBNClassifier(
            dbn,
            n_classes=len(self.classes_),
            output_init=Gaussian(std=self.weight_std),
            generator=rng.stream(seed, "output weights"),
        ).network
        batches = _batches(v, label, self.batch_size, seed)
        rates = Rates(_sgd(self.learning_rate, self.momentum))
        for _ in finetune(self.network_, batches, iterations=self.n_iter, rates=rates):
            pass
        self.n_iter_ = self.n_iter
        return self

    @torch.no_grad()
    def predict_proba(self, X: ArrayLike) -> NDArray[np.float64]:
        """Probability of each class, ``(n_samples, n_classes)``."""
        v = self._checked(X)
        return _array(torch.softmax(self.network_(v).double(), dim=-1))

    def predict(self, X: ArrayLike) -> NDArray[Any]:
        """Most probable label of each sample."""
        best = self.predict_proba(X).argmax(-1)
        labels: NDArray[Any] = self.classes_[best]
        return labels


def _seed(random_state: Any) -> int:
    return int(check_random_state(random_state).randint(2**31 - 1))


def _sgd(learning_rate: float, momentum: float = 0.0) -> Any:
    require(learning_rate > 0, "learning_rate", learning_rate, "a number > 0")
    require(0 <= momentum < 1, "momentum", momentum, "a number in [0, 1)")
    return partial(SGD, lr=learning_rate, momentum=momentum)


def _array(values: Tensor) -> NDArray[Any]:
    array: NDArray[Any] = values.detach().cpu().numpy()
    return array
