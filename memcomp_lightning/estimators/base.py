"""What both estimators share: reading of inputs, seeds, waiting for a better score."""

import copy
from functools import partial
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from sklearn.utils import check_random_state
from sklearn.utils.validation import check_is_fitted, validate_data
from torch import Generator, Tensor, nn
from torch.optim import SGD

from memcomp_lightning.errors import require, require_count
from memcomp_lightning.estimators.inputs import Matrix, Scaling
from memcomp_lightning.estimators.settings import NestedSettings
from memcomp_lightning.models import DBN

PRECISIONS = (np.float64, np.float32)


class MemcompEstimator(NestedSettings):
    """Base of both estimators: reads dense and sparse inputs, float64 or float32; scales what leaves [0, 1]."""

    _scaling: Scaling

    def __sklearn_tags__(self) -> Any:
        tags = super().__sklearn_tags__()
        tags.input_tags.sparse = True
        if tags.transformer_tags is not None:
            tags.transformer_tags.preserves_dtype = ["float64", "float32"]
        return tags

    def _read(self, X: Any, y: Any = "no_validation", *, reset: bool, **checks: Any) -> Any:
        return validate_data(self, X, y, accept_sparse="csr", dtype=PRECISIONS, reset=reset, **checks)

    def _checked(self, X: Any) -> Matrix:
        """Scaled data for a fitted model."""
        check_is_fitted(self)
        return self._scaling.apply(self._read(X, reset=False))

    def _check_early_stopping(self) -> None:
        if not self.early_stopping:
            return
        fraction = self.validation_fraction
        require(0 < fraction < 1, "validation_fraction", fraction, "a number between 0 and 1")
        require_count("n_iter_no_change", self.n_iter_no_change)
        require(self.tol >= 0, "tol", self.tol, "a number >= 0")

    def _refuse_early_stopping(self) -> None:
        if self.early_stopping:
            raise ValueError("partial_fit sees a part of the data: set early_stopping=False for it, or use fit.")

    def _say(self, done: int, of: int, score: float | None) -> None:
        if self.verbose:
            held_out = "" if score is None else f", score of held-out samples {score:.4f}"
            print(f"[{type(self).__name__}] pass {done} of {of}{held_out}", flush=True)


class Patience:
    """Keeps the best weights of a model by a held-out score, and says when to stop.

    Args:
        module: The model.
        tol: By how much a score must be better to count, >= 0.
        n_iter_no_change: Passes in a row that may go by without such a score, >= 1.

    Attributes:
        scores: So far.
    """

    def __init__(self, module: nn.Module, *, tol: float, n_iter_no_change: int) -> None:
        self._module, self._tol, self._most = module, tol, n_iter_no_change
        self._best = -np.inf
        self._state: dict[str, Tensor] = copy.deepcopy(module.state_dict())
        self._waited = 0
        self.scores: list[float] = []

    def ends_with(self, score: float) -> bool:
        """Take the score of the newest pass; return whether it was the last one."""
        self._waited = 0 if score > self.best + self._tol else self._waited + 1
        if score > self._best:
            self._best, self._state = score, copy.deepcopy(self._module.state_dict())
        self.scores.append(score)
        return self._waited >= self._most

    @property
    def best(self) -> float:
        """The best score."""
        return float(self._best)

    def restore(self) -> None:
        """Give the model its best weights."""
        self._module.load_state_dict(self._state)


def seed_of(random_state: Any) -> int:
    """Return a seed drawn from a seed, one of NumPy's generators, or None for NumPy's global one."""
    if isinstance(random_state, np.random.Generator):
        return int(random_state.integers(2**31 - 1))
    return int(check_random_state(random_state).randint(2**31 - 1))


def sgd(learning_rate: float, momentum: float = 0.0, name: str = "learning_rate") -> Any:
    """Return what builds an optimiser."""
    require(learning_rate > 0, name, learning_rate, "a number > 0")
    require(0 <= momentum < 1, "momentum", momentum, "a number in [0, 1)")
    return partial(SGD, lr=learning_rate, momentum=momentum)


class Drawn:
    """N(0, std^2) in a given precision, whatever torch's default one is.

    Args:
        std: Standard deviation, >= 0.
        dtype: Of the weights.
    """

    def __init__(self, std: float, dtype: torch.dtype) -> None:
        self._std, self._dtype = std, dtype

    def __call__(self, shape: tuple[int, ...], *, generator: Generator) -> Tensor:
        """Return a tensor of this shape."""
        return torch.empty(shape, dtype=self._dtype).normal_(0.0, self._std, generator=generator)


def dbn_for(X: Matrix, sizes: list[int], *, std: float, generator: Generator) -> DBN:
    """Return an untrained network in the precision of the data."""
    dtype = torch.float64 if X.dtype == np.float64 else torch.float32
    return DBN(X.shape[1], sizes, weight_init=Drawn(std, dtype), generator=generator).to(dtype)


def in_precision_of(X: Matrix, module: Any) -> tuple[Matrix, Any]:
    """Return both in the higher of their precisions."""
    if next(module.parameters()).dtype == torch.float64:
        return X.astype(np.float64, copy=False), module
    return X, copy.deepcopy(module).double() if X.dtype == np.float64 else module


def array_of(values: Tensor, like: Matrix) -> NDArray[Any]:
    """Return an array in the precision of the input."""
    array: NDArray[Any] = values.detach().numpy()
    return array.astype(like.dtype, copy=False)
