"""The deep belief network as a classifier."""

from collections.abc import Sequence
from dataclasses import KW_ONLY, dataclass
from functools import partial
from numbers import Real
from typing import Literal, Self, cast

import numpy as np
import torch
from numpy.typing import ArrayLike
from sklearn.base import ClassifierMixin
from sklearn.model_selection import train_test_split
from sklearn.utils.multiclass import _check_partial_fit_first_call, check_classification_targets
from sklearn.utils.validation import column_or_1d
from torch import Tensor, nn

from memcomp_lightning import rng
from memcomp_lightning.ambient import on_the_cpu
from memcomp_lightning.data import Batches
from memcomp_lightning.defaults import (
    BATCH_SIZE,
    FINETUNING_LEARNING_RATE,
    FINETUNING_MOMENTUM,
    FINETUNING_PASSES,
    LEARNING_RATE,
    PASSES,
)
from memcomp_lightning.errors import require, require_choice, require_count
from memcomp_lightning.estimators.base import (
    MemcompEstimator,
    array_of,
    dbn_for,
    drawn,
    in_precision_of,
    seed_of,
    sgd,
)
from memcomp_lightning.estimators.inputs import Array, Matrix, Samples, batches_of, hidden_means, log_odds_of
from memcomp_lightning.models import DBN
from memcomp_lightning.modules import DBNClassifier
from memcomp_lightning.samplers import GroundState
from memcomp_lightning.solvers.dmm import DmmSolver
from memcomp_lightning.training import ClassifierTraining, Greedy, Joint, pretrain, require_finite

UNLABELLED = -1
"""Label of the samples that have none, where the other labels are numbers."""


@dataclass(eq=False, repr=False)
class MemcompDBNClassifier(ClassifierMixin, MemcompEstimator):  # type: ignore[misc]
    """Deep belief network: layers pretrained by any sampler, then back-propagation with an output layer.

    Inputs are scaled, and their precision is kept, as in :class:`MemcompRBM`.

    The label -1 marks samples without a label, as in scikit-learn's semi-supervised estimators: layers are
    pretrained on them as well, and -1 is no class. If -1 and 1 are the only labels, both are classes. Beside
    strings the mark is the number -1, in an array of objects; the string "-1" is a label.

    Args:
        hidden_layer_sizes: Units of each hidden layer; an integer for one layer.
        sampler: Supplies the negative phase of pretraining; None is the DMM's ground state, as in the paper. Its
            settings are ``sampler__solver__n_restarts`` and so on, for ``set_params`` and searches.
        pretrain: "greedy", one layer after the other, or "joint", all of them as a deep Boltzmann machine.
        n_iter_pretrain: Passes of pretraining for each layer, >= 0.
        pretrain_learning_rate: Of pretraining, > 0.
        pretrain_batch_size: Samples an update of pretraining, >= 1; None means all.
        centred: Follow the centred gradient in pretraining.
        n_iter: Passes of back-propagation, >= 1; with ``early_stopping`` at most so many.
        learning_rate: Of back-propagation, > 0.
        momentum: Of back-propagation, in [0, 1).
        batch_size: Samples an update of back-propagation, >= 1; None means all.
        weight_std: Standard deviation of the first weights, > 0.
        early_stopping: Hold out labelled samples, the same share of each class, stop once their accuracy no longer
            rises, and keep the weights of the best pass. Layers are not pretrained on them either.
        validation_fraction, n_iter_no_change, tol: As for :class:`MemcompRBM`, of the accuracy.
        verbose, random_state: As for :class:`MemcompRBM`.

    Attributes:
        classes_: Labels.
        network_: The trained network: inputs to logits.
        n_iter_: Passes of back-propagation done.
        validation_scores_: Accuracy on the held-out samples after each pass; None without ``early_stopping``.

    >>> import numpy as np
    >>> classifier = MemcompDBNClassifier([3], n_iter_pretrain=2, n_iter=200, learning_rate=1.0, random_state=0)
    >>> classifier.fit(np.eye(4), ["a", "b", "a", "b"]).predict(np.eye(4)).tolist()
    ['a', 'b', 'a', 'b']
    """

    hidden_layer_sizes: int | Sequence[int] = (32, 32)
    _: KW_ONLY
    pretrain: Literal["greedy", "joint"] = "greedy"
    n_iter_pretrain: int = PASSES
    pretrain_learning_rate: float = LEARNING_RATE
    pretrain_batch_size: int | None = BATCH_SIZE
    n_iter: int = FINETUNING_PASSES
    learning_rate: float = FINETUNING_LEARNING_RATE
    momentum: float = FINETUNING_MOMENTUM
    weight_std: float = 0.1

    def _default_sampler(self) -> GroundState:
        return GroundState(solver=DmmSolver())

    def fit(self, X: ArrayLike, y: ArrayLike, sample_weight: ArrayLike | None = None) -> Self:
        """Train from new weights.

        Args:
            X: ``(n_samples, n_features)``, dense or sparse.
            y: Labels, ``(n_samples,)``; the number -1 stands for none.
            sample_weight: How often each sample counts in both stages, >= 0, ``(n_samples,)``; None means once.

        Raises:
            SettingError: A setting is out of range.
            DivergedError: A parameter left the finite numbers.
        """
        self._check_settings()
        samples = self._read_labelled(X, y, sample_weight, reset=True)
        labelled = _has_label(samples.label)
        self.classes_ = np.unique(samples.label[labelled])
        if len(self.classes_) < 2:
            beside = "" if labelled.all() else f" beside {UNLABELLED}, which marks unlabelled samples"
            raise ValueError(
                f"y holds one class, {self.classes_.tolist()}{beside}: a classifier needs at least 2 classes."
            )
        seed = seed_of(self.random_state)
        samples = self._scaled(self._encoded(samples, labelled), begins=True)
        rows, others = np.flatnonzero(labelled), np.array([], dtype=np.int64)
        if self.early_stopping:
            rows, others = train_test_split(
                rows, test_size=self.validation_fraction, random_state=seed, stratify=samples.label[rows]
            )

        def part(of: Array) -> Samples:
            return samples if len(of) == len(labelled) else samples.take(of)

        with on_the_cpu():
            self._begin(part(np.setdiff1d(np.arange(len(labelled)), others)), seed)
            held_out = part(others) if self.early_stopping else None
            self._run_passes(self.network_, part(np.sort(rows)), held_out)
            require_finite(self.network_, "fine-tuning")
        return self

    def partial_fit(
        self,
        X: ArrayLike,
        y: ArrayLike,
        classes: ArrayLike | None = None,
        sample_weight: ArrayLike | None = None,
    ) -> Self:
        """Do one pass of back-propagation over these samples; the optimiser goes on from the last call.

        The first call, unless it follows ``fit``, draws the weights, settles the scaling and pretrains, all of it
        on its own samples. Errors are those of :meth:`fit`, and one more.

        Args:
            X: As in :meth:`fit`.
            y: As in :meth:`fit`; -1 stands for none unless the classes are -1 and 1.
            classes: All labels that will ever occur; needed in the first call.
            sample_weight: As in :meth:`fit`.

        Raises:
            ValueError: ``classes`` is missing, has changed or holds -1, or y holds another label.
        """
        self._check_settings()
        self._refuse_early_stopping()
        begins = not hasattr(self, "network_")
        if _check_partial_fit_first_call(self, classes) and not _has_label(self.classes_).all():
            given = self.classes_.tolist()
            del self.classes_
            raise ValueError(
                f"classes holds {UNLABELLED}, which marks unlabelled samples, among {given}: leave it out. It is "
                "a class only if the classes are -1 and 1."
            )
        samples = self._read_labelled(X, y, sample_weight, reset=begins)
        y = samples.label
        known = np.isin(y, self.classes_)
        labelled = known | ~_is_unlabelled(y)
        if not known[labelled].all():
            unknown = np.unique(y[labelled & ~known]).tolist()
            raise ValueError(f"y holds {unknown}, which is not among the classes {self.classes_.tolist()}.")
        samples = self._scaled(self._encoded(samples, labelled), begins=begins)
        with on_the_cpu():
            if begins:
                self._begin(samples, seed_of(self.random_state))
            self._go_on(self.network_, samples.take(labelled))
            require_finite(self.network_, "fine-tuning")
        return self

    def _check_settings(self) -> None:
        require_choice("pretrain", self.pretrain, ("greedy", "joint"))
        require_count("n_iter_pretrain", self.n_iter_pretrain, minimum=0)
        if self.pretrain_batch_size is not None:
            require_count("pretrain_batch_size", self.pretrain_batch_size)
        require(self.weight_std > 0, "weight_std", self.weight_std, "a number > 0")
        sgd(self.pretrain_learning_rate, name="pretrain_learning_rate")
        super()._check_settings()
        self._sizes()

    def _sizes(self) -> list[int]:
        sizes = np.atleast_1d(np.asarray(self.hidden_layer_sizes, dtype=object)).tolist()
        require(len(sizes) > 0, "hidden_layer_sizes", self.hidden_layer_sizes, "at least one layer")
        for size in sizes:
            require_count("hidden_layer_sizes", size)
        return [int(size) for size in sizes]

    def _read_labelled(
        self, X: ArrayLike, y: ArrayLike, sample_weight: ArrayLike | None, *, reset: bool
    ) -> Samples:
        X, label = self._read(X, y=y, multi_output=True, reset=reset)
        if label.ndim == 2 and label.shape[1] > 1:
            raise ValueError(
                f"y has the shape {label.shape}: expected one label a sample, y should be a 1d array. For several "
                "labels a sample use sklearn.multioutput.MultiOutputClassifier."
            )
        label = column_or_1d(label, warn=True)
        if len(known := label[~_is_unlabelled(label)]):
            check_classification_targets(known)
        return Samples.that_count(X, label, sample_weight)

    def _encoded(self, samples: Samples, labelled: Array) -> Samples:
        """Labels as indices of the classes; 0 for unlabelled samples, which is not looked at."""
        label = np.zeros(len(labelled), dtype=np.int64)
        label[labelled] = np.searchsorted(self.classes_, samples.label[labelled])
        return samples._replace(label=label)

    def _begin(self, samples: Samples, seed: int) -> None:
        """Draw and pretrain the layers, draw the output layer."""
        dbn = dbn_for(samples.X, self._sizes(), std=self.weight_std, generator=rng.stream(seed, "weights"))
        with torch.no_grad():
            dbn[0].b.copy_(log_odds_of(samples))
        sampler = self._negative_phase()
        passes = pretrain(
            Joint(dbn) if self.pretrain == "joint" else Greedy(dbn),
            batches_of(samples, batch_size=self.pretrain_batch_size, sampler=sampler, seed=seed),
            sampler,
            iterations=self.n_iter_pretrain,
            optimizer=sgd(self.pretrain_learning_rate),
            centring=self._centring(),
            seed=seed,
        )
        for _ in passes:
            pass
        init = partial(drawn, std=self.weight_std, dtype=dbn[0].weight.dtype)
        generator = rng.stream(seed, "output weights")
        module = DBNClassifier(dbn, n_classes=len(self.classes_), output_init=init, generator=generator)
        self.network_ = module.network
        self._seed, self.n_iter_ = seed, 0
        self._training = ClassifierTraining(self.network_, optimizer=self._optimizer())

    def _batches(self, samples: Samples) -> Batches:
        return batches_of(samples, batch_size=self.batch_size, seed=self._seed)

    def _score_held_out(self, samples: Samples) -> float:
        right = self._logits(self.network_, samples.X).argmax(-1).numpy() == samples.label
        return float(np.average(right, weights=samples.weight))

    @torch.no_grad()
    def _logits(self, network: nn.Module, X: Matrix) -> Tensor:
        dbn, output = network.children()
        lowest, *others = cast(DBN, dbn)
        h = hidden_means(lowest, X)
        for rbm in others:
            h = rbm(h)
        logits: Tensor = output(h)
        return logits

    def predict_proba(self, X: ArrayLike) -> Array:
        """Probability of each class, ``(n_samples, n_classes)``, in the precision of X."""
        X = self._checked(X)
        with on_the_cpu():
            data, network = in_precision_of(X, self.network_)
            return array_of(torch.softmax(self._logits(network, data), dim=-1), like=X)

    def predict(self, X: ArrayLike) -> Array:
        """Most probable label of each sample."""
        best = self.predict_proba(X).argmax(-1)
        return np.asarray(self.classes_[best])


def _is_unlabelled(y: Array) -> Array:
    """Where a label is the number -1."""
    if y.dtype.kind in "iuf":
        return np.asarray(y == UNLABELLED)
    if y.dtype.kind == "O":
        return np.array([isinstance(label, Real) and label == UNLABELLED for label in y], dtype=bool)
    return np.zeros(len(y), dtype=bool)


def _has_label(y: Array) -> Array:
    """Where a sample has a label: everywhere if -1 and 1 are all that there is."""
    unlabelled = _is_unlabelled(y)
    if unlabelled.any() and not unlabelled.all() and set(y.tolist()) == {-1, 1}:
        return np.ones(len(y), dtype=bool)
    return ~unlabelled
