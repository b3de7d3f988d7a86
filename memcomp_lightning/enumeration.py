"""All states of a few binary units."""

from jaxtyping import Float, Int

from memcomp_lightning.arrays import Array, cast, namespace


def binary_states(n: int, *, start: int = 0, stop: int | None = None, like: Array) -> Float[Array, "states n"]:
    """Return the binary numbers ``start .. stop - 1`` as rows of n bits, the first unit being the highest bit.

    Args:
        n: Number of units, 0 to 62.
        start: First number.
        stop: One past the last number; None is 2^n.
        like: Gives library, dtype and device.

    >>> import numpy as np
    >>> binary_states(2, like=np.zeros(())).tolist()
    [[0.0, 0.0], [0.0, 1.0], [1.0, 0.0], [1.0, 1.0]]
    """
    numbers = namespace(like).arange(start, 2**n if stop is None else stop, device=like.device)
    return bits(numbers, n, like=like)


def bits(numbers: Int[Array, "*axes"], n: int, *, like: Array) -> Float[Array, "*axes n"]:
    """Return the n lowest bits of each number, the highest of them first, in the dtype of ``like``."""
    shifts = namespace(like).arange(n - 1, -1, -1, device=like.device)
    return cast((numbers[..., None] >> shifts) & 1, like.dtype)
