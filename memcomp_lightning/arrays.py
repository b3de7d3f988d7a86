"""What numpy arrays and torch tensors do not share, so that problems and solvers are written once for both.

Most is the Python array API standard, see :func:`namespace`. Torch is not imported before a tensor comes.
"""

import math
from functools import cache
from importlib import import_module
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from torch import Tensor

    Array = Tensor
    """A numpy array or a tensor; what both have is checked as a tensor's."""
    AnyArray = Tensor | NDArray[Any]
    """The same where it comes from outside."""
else:
    Array = AnyArray = Any


def as_array(x: AnyArray) -> Array:
    """``x`` as it is; for type checkers."""
    return x  # type: ignore[return-value]


def namespace(x: Array) -> Any:
    """The functions of the array API for arrays like ``x``: numpy's, or those of torch."""
    return _functions_of(type(x))


@cache
def _functions_of(kind: type) -> Any:
    return np if issubclass(kind, np.ndarray | np.generic) else import_module("array_api_compat.torch")


def alike(x: AnyArray, like: AnyArray) -> Array:
    """``x`` as an array of the library and the device of ``like``, in its own dtype."""
    if type(x) is type(like) and x.device == like.device:
        return as_array(x)
    if isinstance(like, np.ndarray | np.generic):
        return as_array(to_numpy(x))
    if isinstance(x, np.ndarray) and not x.flags.writeable:
        x = x.copy()  # it would share its memory with the tensor
    return namespace(like).asarray(x, device=like.device)


def moved(x: Any, device: Any) -> Any:
    """A tensor of torch on a device. A copy from the host joins the device's queue, and nothing waits for it."""
    # A copy to the host would be read too early if it was not waited for. MPS is left as it was.
    queued = x.device.type == "cpu" and device.type not in ("cpu", "mps")
    return x.to(device, non_blocking=queued)


def to_numpy(x: AnyArray) -> NDArray[Any]:
    """``x`` as a numpy array, which shares its memory where it can."""
    return x.detach().cpu().numpy() if hasattr(x, "detach") else np.asarray(x)


def is_floating(x: Array) -> bool:
    """Whether ``x`` holds real numbers, of any precision."""
    return x.dtype.kind == "f" if isinstance(x, np.ndarray | np.generic) else x.is_floating_point()


def cast(x: Array, dtype: Any) -> Array:
    """``x`` in another dtype of its library; itself if it has that dtype."""
    return x.astype(dtype, copy=False) if isinstance(x, np.ndarray | np.generic) else x.to(dtype)


def double(x: Array) -> Array:
    """``x`` in float64."""
    return cast(x, namespace(x).float64)


def multiply_add(x: Array, a: Array, b: Array) -> Array:
    """``x + a b``, rounded once where the library can do so."""
    return x + a * b if isinstance(x, np.ndarray) else x.addcmul(a, b)


def sign(x: Array) -> Array:
    """-1, 0 or 1. NaN is not looked for, as the array API's does: an accelerator would be waited for."""
    return np.sign(x) if isinstance(x, np.ndarray | np.generic) else x.sign()


def sigmoid(x: Array) -> Array:
    """``1 / (1 + exp(-x))``."""
    return as_array(0.5 + 0.5 * np.tanh(x / 2)) if isinstance(x, np.ndarray) else x.sigmoid()


def add_up(values: Array, index: Array, n: int) -> Array:
    """The sum of the values of each place, ``(*leading, n)``.

    Args:
        values: ``(*leading, n_values)``.
        index: The place of each value, ``(n_values,)`` integers in [0, n).
        n: Number of places.
    """
    total: Array = namespace(values).zeros((*values.shape[:-1], n), dtype=values.dtype, device=values.device)
    if not isinstance(values, np.ndarray):
        return total.index_add_(-1, index, values)
    row = n * np.arange(math.prod(values.shape[:-1]))
    np.add.at(total.reshape(-1), (row[:, None] + index).reshape(-1), values.reshape(-1))
    return total
