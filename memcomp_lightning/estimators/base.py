"""What both estimators share: reading of inputs, seeds, the passes of ``fit`` and when they end."""

import copy
from abc import abstractmethod
from dataclasses import dataclass
from functools import partial
from typing import TypeVar

import numpy as np
import torch
from numpy.typing import ArrayLike
from sklearn.utils import Tags, check_random_state
from sklearn.utils.validation import check_is_fitted, validate_data
from torch import Generator, Tensor, nn
from torch.optim import SGD

from memcomp_lightning.data import Batches
from memcomp_lightning.defaults import BATCH_SIZE, CENTRING_RATE
from memcomp_lightning.errors import require, require_count
from memcomp_lightning.estimators.inputs import Array, Matrix, Samples, Scaling
from memcomp_lightning.estimators.settings import NestedSettings
from memcomp_lightning.models import DBN
from memcomp_lightning.objective import Centring
from memcomp_lightning.training import BestPass, OptimizerFactory, Sampler

RandomState = int | np.random.RandomState | np.random.Generator | None

ModuleT = TypeVar("ModuleT", bound=nn.Module)


@dataclass(kw_only=True, eq=False, repr=False)
class MemcompEstimator(NestedSettings):
    """Base of both estimators: reads dense and sparse inputs, float64 or float32; scales what leaves [0, 1]."""

    sampler: Sampler | None = None
    centred: bool = True
    batch_size: int | None = BATCH_SIZE
    early_stopping: bool = False
    validation_fraction: float = 0.1
    n_iter_no_change: int = 10
    tol: float = 1e-4
    verbose: bool = False
    random_state: RandomState = None

    def __sklearn_tags__(self) -> Tags:
        tags = super().__sklearn_tags__()
        tags.input_tags.sparse = True
        if tags.transformer_tags is not None:
            tags.transformer_tags.preserves_dtype = ["float64", "float32"]
        return tags

    @abstractmethod
    def _batches(self, samples: Samples) -> Batches:
        """The updates of a pass over scaled samples."""

    def _n_passes(self, samples: Samples) -> int:
        """Passes of ``fit``."""
        return int(self.n_iter)

    @abstractmethod
    def _score_held_out(self, samples: Samples) -> float:
        """What early stopping maximises."""

    def _read(self, X: ArrayLike, *, reset: bool, **of_labels: object) -> Matrix:
        precisions = (np.float64, np.float32)
        return validate_data(self, X, accept_sparse="csr", dtype=precisions, reset=reset, **of_labels)

    def _checked(self, X: ArrayLike) -> Matrix:
        """Scaled data for a fitted model."""
        check_is_fitted(self)
        return self._scaling.apply(self._read(X, reset=False))

    def _scaled(self, samples: Samples, *, begins: bool) -> Samples:
        if begins:
            self._scaling = Scaling.of(samples.X)
        return samples._replace(X=self._scaling.apply(samples.X))

    def _check_settings(self) -> None:
        if self.n_iter is not None:
            require_count("n_iter", self.n_iter)
        if self.batch_size is not None:
            require_count("batch_size", self.batch_size)
        self._optimizer()
        if self.early_stopping:
            fraction = self.validation_fraction
            require(0 < fraction < 1, "validation_fraction", fraction, "a number between 0 and 1")
            require_count("n_iter_no_change", self.n_iter_no_change)
            require(self.tol >= 0, "tol", self.tol, "a number >= 0")

    def _refuse_early_stopping(self) -> None:
        if self.early_stopping:
            raise ValueError("partial_fit sees a part of the data: set early_stopping=False for it, or use fit.")

    def _optimizer(self) -> OptimizerFactory:
        return sgd(self.learning_rate, getattr(self, "momentum", 0.0))

    def _centring(self) -> Centring | None:
        return Centring(rate=CENTRING_RATE) if self.centred else None

    def _run_pass(self, batches: Batches) -> None:
        batches.set_epoch(self.n_iter_)
        self._training.run_pass(batches)
        self.n_iter_ += 1

    def _run_passes(self, network: nn.Module, samples: Samples, held_out: Samples | None) -> None:
        """Do the passes of ``fit``; held-out samples say when to stop, and choose the weights."""
        batches, scores = self._batches(samples), list[float]()
        best = BestPass(patience=self.n_iter_no_change if self.early_stopping else None, tolerance=self.tol)
        n_passes = self._n_passes(samples)
        for _ in range(n_passes):
            self._run_pass(batches)
            score = None if held_out is None else self._score_held_out(held_out)
            if self.verbose:
                said = "" if score is None else f", score of held-out samples {score:.4f}"
                print(f"[{type(self).__name__}] pass {self.n_iter_} of {n_passes}{said}", flush=True)
            if score is not None:
                scores.append(score)
                best.offer(torch.tensor(score, dtype=torch.float64), network.state_dict())
                if best.over:
                    break
        if held_out is not None:
            network.load_state_dict(best.weights)
        self.validation_scores_ = None if held_out is None else scores

    def _go_on(self, network: nn.Module, samples: Samples) -> None:
        """Do the pass of ``partial_fit``, with the settings of now; data of another precision take the model's."""
        for group in self._training.optimizer.param_groups:
            group |= {"lr": self.learning_rate, "momentum": getattr(self, "momentum", 0.0)}
        if samples.X.shape[0]:  # none of them may have a label
            dtype = next(network.parameters()).detach().numpy().dtype
            self._run_pass(self._batches(samples.astype(dtype)))
        self.validation_scores_ = None


def seed_of(random_state: RandomState) -> int:
    """Return a seed drawn from a seed, one of NumPy's generators, or None for NumPy's global one."""
    if isinstance(random_state, np.random.Generator):
        return int(random_state.integers(2**31 - 1))
    return int(check_random_state(random_state).randint(2**31 - 1))


def sgd(learning_rate: float, momentum: float = 0.0, name: str = "learning_rate") -> OptimizerFactory:
    """Return what builds an optimiser."""
    require(learning_rate > 0, name, learning_rate, "a number > 0")
    require(0 <= momentum < 1, "momentum", momentum, "a number in [0, 1)")
    return partial(SGD, lr=learning_rate, momentum=momentum)


def drawn(shape: tuple[int, ...], *, std: float, dtype: torch.dtype, generator: Generator) -> Tensor:
    """Draw from N(0, std^2) in a given precision, whatever torch's default one is."""
    return torch.empty(shape, dtype=dtype).normal_(0.0, std, generator=generator)


def dbn_for(X: Matrix, sizes: list[int], *, std: float, generator: Generator) -> DBN:
    """Return an untrained network in the precision of the data."""
    dtype = torch.float64 if X.dtype == np.float64 else torch.float32
    return DBN(X.shape[1], sizes, weight_init=partial(drawn, std=std, dtype=dtype), generator=generator).to(dtype)


def in_precision_of(X: Matrix, module: ModuleT) -> tuple[Matrix, ModuleT]:
    """Return both in the higher of their precisions."""
    if next(module.parameters()).dtype == torch.float64:
        return X.astype(np.float64, copy=False), module
    return X, copy.deepcopy(module).double() if X.dtype == np.float64 else module


def array_of(values: Tensor, like: Matrix) -> Array:
    """Return an array in the precision of the input."""
    return np.asarray(values.detach().numpy().astype(like.dtype, copy=False))
