"""Named random streams from one seed, and the draws that the package makes from them.

No function of this package touches torch's global generator, so switching a callback on cannot change
training.
"""

import hashlib
from collections.abc import Iterable

import torch
from torch import Generator, Tensor


def stream(seed: int, name: str, index: int = 0, device: torch.device | str = "cpu") -> Generator:
    """Return the generator of one named stream.

    Streams of different names or indices (a process rank, an epoch) are independent; the same three values
    give the same stream on every machine.

    >>> a, b = stream(0, "negative_phase"), stream(0, "negative_phase")
    >>> bool(uniform((3,), generator=a).equal(uniform((3,), generator=b)))
    True
    """
    digest = hashlib.sha256(f"{seed}/{name}/{index}".encode()).digest()
    generator = Generator(device=device)
    generator.manual_seed(int.from_bytes(digest[:8], "big", signed=True))
    return generator


def streams(seed: int, names: Iterable[str], index: int = 0) -> dict[str, Generator]:
    """Return one generator a name, see :func:`stream`."""
    return {name: stream(seed, name, index) for name in names}


def save(generators: dict[str, Generator]) -> dict[str, Tensor]:
    """Return the states of the generators as plain byte tensors."""
    return {name: generator.get_state() for name, generator in generators.items()}


def restore(generators: dict[str, Generator], states: dict[str, Tensor]) -> None:
    """Set the generators to states that :func:`save` returned.

    Raises:
        KeyError: A generator has no saved state.
    """
    for name, generator in generators.items():
        if name not in states:
            raise KeyError(f"no saved state of the random stream {name!r}; saved: {sorted(states)}")
        generator.set_state(states[name].cpu())


def uniform(shape: Iterable[int], *, generator: Generator, like: Tensor | None = None) -> Tensor:
    """Draw from U[0, 1), on the generator's device, then moved to the device of ``like``.

    In the dtype of ``like``, else float32.
    """
    dtype = torch.float32 if like is None else like.dtype  # of torch's default dtype draws would depend
    draw = torch.empty(tuple(shape), device=generator.device, dtype=dtype)
    draw.uniform_(generator=generator)
    return draw if like is None else draw.to(like.device)


def bernoulli(probability: Tensor, *, generator: Generator) -> Tensor:
    """Draw {0, 1} with the given probabilities, same shape, dtype and device."""
    return (uniform(probability.shape, generator=generator, like=probability) < probability).to(probability.dtype)
