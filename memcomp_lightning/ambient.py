"""Keep what a caller has set in torch (no_grad, inference mode, autocast) from changing this package's numbers.

Models, their updates and their likelihoods must not depend on such settings; where torch alone would let them,
the code uses these helpers. Dtypes and devices of new tensors are named where they are made, so that torch's
defaults do not matter.
"""

from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext
from functools import wraps
from typing import ParamSpec, TypeVar

import torch

P = ParamSpec("P")
T = TypeVar("T")


@contextmanager
def with_gradient() -> Iterator[None]:
    """Record gradients, in the dtypes of the tensors, whatever is switched outside; also a decorator.

    >>> with torch.inference_mode(), with_gradient():
    ...     torch.is_grad_enabled()
    True
    """
    if torch.is_grad_enabled() and not torch.is_inference_mode_enabled() and not _autocasts():
        yield  # as it is: contexts would cost an update of a small network a tenth of its time
        return
    with torch.inference_mode(False), torch.enable_grad(), _in_own_dtypes():
        yield


def plain(x: torch.Tensor) -> torch.Tensor:
    """The tensor, or a copy of one that was made in inference mode, which no gradient could pass."""
    return x.clone() if x.is_inference() else x


def in_own_dtypes(function: Callable[P, T]) -> Callable[P, T]:
    """Compute a function in the dtypes of its tensors, under ``torch.autocast``, too."""

    @wraps(function)
    def computed(*arguments: P.args, **settings: P.kwargs) -> T:
        if not _autocasts():
            return function(*arguments, **settings)
        with _in_own_dtypes():
            return function(*arguments, **settings)

    return computed


def _autocasts() -> bool:
    return torch.is_autocast_enabled("cpu") or torch.is_autocast_enabled("cuda")


@contextmanager
def _in_own_dtypes() -> Iterator[None]:
    with torch.autocast("cpu", enabled=False), torch.autocast("cuda", enabled=False):
        yield


@contextmanager
def on_the_cpu() -> Iterator[None]:
    """As :func:`with_gradient`, and what is made without a device is made on the CPU."""
    # Where that is so already, the context would cost some microseconds in every operation.
    elsewhere = torch.get_default_device().type != "cpu"
    with with_gradient(), torch.device("cpu") if elsewhere else nullcontext():
        yield


@contextmanager
def in_one_thread() -> Iterator[None]:
    """Compute in one thread, and then in as many as before."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)
