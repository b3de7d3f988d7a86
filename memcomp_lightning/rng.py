"""Named random streams from one seed, and the draws that the package makes from them.

No function of this package touches a global generator, so switching a callback on cannot change training. Streams
are torch's for models, and numpy's for problems from files, which are solved without torch.
"""

import hashlib
from collections.abc import Callable, Iterable
from functools import cache
from typing import TYPE_CHECKING

import numpy as np

from memcomp_lightning.arrays import AnyArray, Array, alike, as_array, cast, is_floating, moved, namespace

if TYPE_CHECKING:
    import torch
    from torch import Tensor

    Generator = torch.Generator | np.random.Generator
    """A source of random numbers of either library."""


_MANY = 2**12
"""From so many numbers on a call of compiled code is quicker than torch's own draw."""

_PAYS_AFTER = 2**25
"""Numbers drawn by large calls until compiled code is loaded: a short run would lose half a second to it."""

_drawn = [0]


def stream(seed: int, name: str, index: int = 0, device: "torch.device | str" = "cpu") -> "torch.Generator":
    """Return the generator of one named stream.

    Streams of different names or indices (a process rank, an epoch) are independent; the same three values
    give the same stream on every machine.

    >>> a, b = stream(0, "negative_phase"), stream(0, "negative_phase")
    >>> bool(uniform((3,), generator=a).equal(uniform((3,), generator=b)))
    True
    """
    from torch import Generator

    generator = Generator(device=device)
    generator.manual_seed(int.from_bytes(_digest(seed, name, index), "big", signed=True))
    return generator


def numpy_stream(seed: int, name: str, index: int = 0) -> np.random.Generator:
    """Return a generator of numpy, as :func:`stream` does of torch."""
    return np.random.default_rng(int.from_bytes(_digest(seed, name, index), "big"))


def _digest(seed: int, name: str, index: int) -> bytes:
    return hashlib.sha256(f"{seed}/{name}/{index}".encode()).digest()[:8]


def streams(
    seed: int, names: Iterable[str], index: int = 0, device: "torch.device | str" = "cpu"
) -> "dict[str, torch.Generator]":
    """Return one generator a name, see :func:`stream`."""
    return {name: stream(seed, name, index, device) for name in names}


def save(generators: "dict[str, torch.Generator]") -> "dict[str, Tensor]":
    """Return the states of the generators as plain byte tensors."""
    return {name: generator.get_state() for name, generator in generators.items()}


def restore(generators: "dict[str, torch.Generator]", states: "dict[str, Tensor]") -> None:
    """Set the generators to states that :func:`save` returned.

    Raises:
        KeyError: A generator has no saved state.
    """
    for name, generator in generators.items():
        if name not in states:
            raise KeyError(f"no saved state of the random stream {name!r}; saved: {sorted(states)}")
        generator.set_state(states[name].cpu())


def uniform(shape: Iterable[int], *, generator: "Generator", like: Array | None = None) -> Array:
    """Draw from U[0, 1), as an array of the library of ``like`` on its device, or else of the generator's library.

    It is in the dtype of ``like``, or in float32 where that holds whole numbers.
    """
    if isinstance(generator, np.random.Generator):
        double = like is not None and like.dtype == namespace(like).float64
        draw = as_array(generator.random(tuple(shape), dtype=np.float64 if double else np.float32))
        if like is None or not is_floating(like):
            return draw if like is None else alike(draw, like)
        return cast(alike(draw, like), like.dtype)
    import torch

    if isinstance(like, np.ndarray):
        wanted = torch.empty(0, dtype=torch.float64 if like.dtype == np.float64 else torch.float32)
        return alike(uniform(shape, generator=generator, like=wanted), like)
    dtype = like.dtype if like is not None and like.is_floating_point() else torch.float32
    draw = torch.empty(tuple(shape), device=generator.device, dtype=dtype)
    compiled = _compiled_for(draw)
    draw = draw.uniform_(generator=generator) if compiled is None else compiled(draw, generator)
    return draw if like is None else moved(draw, like.device)


def _compiled_for(draw: "Tensor") -> "Callable[[Tensor, torch.Generator], Tensor] | None":
    """Compiled code that draws the same numbers, where it is quicker; else None."""
    import torch

    n = draw.numel()
    if n < _MANY or draw.dtype != torch.float32 or draw.device.type != "cpu":
        return None
    _drawn[0] += n
    return _twister() if _drawn[0] >= _PAYS_AFTER else None


@cache
def _twister() -> "Callable[[Tensor, torch.Generator], Tensor] | None":
    try:
        from memcomp_lightning import twister
    except (ImportError, RuntimeError):  # the second: no folder to keep compiled code in
        return None
    return twister.fill if twister.agrees() else None


def bernoulli(probability: Array, *, generator: "Generator") -> Array:
    """Draw {0, 1} with the given probabilities, same shape, dtype and device."""
    return cast(uniform(probability.shape, generator=generator, like=probability) < probability, probability.dtype)


def integers(n: int, shape: Iterable[int], *, generator: "Generator", like: AnyArray) -> Array:
    """Draw int64 from 0 to n - 1, as an array of the library of ``like`` on its device."""
    if isinstance(generator, np.random.Generator):
        return alike(generator.integers(n, size=tuple(shape)), like)
    import torch

    draw = torch.randint(n, tuple(shape), generator=generator, device=generator.device)
    return alike(draw if isinstance(like, np.ndarray | np.generic) else moved(draw, like.device), like)
