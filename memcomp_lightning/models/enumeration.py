"""All states of a few binary units."""

import torch
from jaxtyping import Float
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
    numbers = torch.arange(start, 2**n if stop is None else stop, device=like.device)
    shifts = torch.arange(n - 1, -1, -1, device=like.device)
    return ((numbers[:, None] >> shifts) & 1).to(like.dtype)
