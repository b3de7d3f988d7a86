"""All states of a few binary units."""

import torch
from jaxtyping import Float, Int
from torch import Tensor


def binary_states(n: int, *, start: int = 0, stop: int | None = None, like: Tensor) -> Float[Tensor, "states n"]:
    """Return the binary numbers ``start .. stop - 1`` as rows of n bits, the first unit being the highest bit.

    Args:
        n: Number of units, 0 to 62.
        start: First number.
        stop: One past the last number; None is 2^n.
        like: Gives dtype and device.

    >>> binary_states(2, like=torch.zeros(())).tolist()
    [[0.0, 0.0], [0.0, 1.0], [1.0, 0.0], [1.0, 1.0]]
    """
    return bits(torch.arange(start, 2**n if stop is None else stop, device=like.device), n, like=like)


def bits(numbers: Int[Tensor, "*axes"], n: int, *, like: Tensor) -> Float[Tensor, "*axes n"]:
    """Return the n lowest bits of each number, the highest of them first, in the dtype of ``like``."""
    shifts = torch.arange(n - 1, -1, -1, device=like.device)
    return ((numbers.unsqueeze(-1) >> shifts) & 1).to(like.dtype)
