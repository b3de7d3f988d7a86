"""Uniform numbers of torch's CPU generators by a compiled Mersenne Twister: the same ones in a tenth of the time.

Torch draws them one by one; here blocks of 624 are made by vector instructions (Matsumoto & Nishimura 1998). The
generator ends where torch would have left it, so that it does not matter which of the two draws.
"""

from typing import Any

import numpy as np
import torch
from numba import njit
from torch import Generator, Tensor

U = np.uint32

_N, _M = 624, 397
_LEFT, _NEXT, _WORDS = 1, 2, slice(3, 3 + _N)
"""Where the state of a generator, as int64, has 1 + what is left of a block, the next word, and the words."""

_LOW = 0xFFFFFFFF


def fill(out: Tensor, generator: Generator) -> Tensor:
    """Do ``out.uniform_(generator=generator)``, for float32 that lies without gaps on the CPU."""
    if not out.numel():
        return out
    state = generator.get_state()
    fields = state.numpy().view(np.int64)
    words = fields[_WORDS].astype(U)
    at = _N if fields[_LEFT] & _LOW == 1 else int(fields[_NEXT])
    at = _fill(words, at, out.view(-1).numpy())
    fields[_WORDS], fields[_NEXT] = words, at
    fields[_LEFT] = fields[_LEFT] & ~_LOW | (_N + 1 - at)
    generator.set_state(state)
    return out


def agrees() -> bool:
    """Whether a few draws are those of this version of torch, and leave its generator in the same state."""
    ours, theirs = (Generator(device="cpu").manual_seed(1) for _ in range(2))
    for n in (1, 2 * _N, 300, _N - 1):
        found, wanted = (torch.empty(n, dtype=torch.float32, device="cpu") for _ in range(2))
        fill(found, ours)
        wanted.uniform_(generator=theirs)
        if not (found.equal(wanted) and ours.get_state().equal(theirs.get_state())):
            return False
    return True


@njit(nogil=True, cache=True)
def _fill(words: Any, at: int, out: Any) -> int:
    """Write uniform numbers from word ``at`` of the present block on; return where the next one begins."""
    done = 0
    while done < out.size:
        if at == _N:
            _next_block(words)
            at = 0
        n = min(out.size - done, _N - at)
        _tempered(words[at : at + n], out[done : done + n])
        done += n
        at += n
    return at


@njit(nogil=True)
def _tempered(words: Any, out: Any) -> None:
    """The last 24 bits of each word, as a number in [0, 1)."""
    for k in range(out.size):
        y = words[k]
        y = U(y ^ (y >> U(11)))
        y = U(y ^ (U(y << U(7)) & U(0x9D2C5680)))
        y = U(y ^ (U(y << U(15)) & U(0xEFC60000)))
        y = U(y ^ (y >> U(18)))
        out[k] = np.float32(np.int32(y & U(0xFFFFFF))) * np.float32(2.0**-24)


@njit(nogil=True)
def _next_block(words: Any) -> None:
    for k in range(_N - _M):
        words[k] = words[k + _M] ^ _twisted(words[k], words[k + 1])
    for k in range(_N - _M, _N - 1):
        words[k] = words[k + _M - _N] ^ _twisted(words[k], words[k + 1])
    words[_N - 1] = words[_M - 1] ^ _twisted(words[_N - 1], words[0])


@njit(nogil=True, inline="always")
def _twisted(high: Any, low: Any) -> Any:
    y = U((high & U(0x80000000)) | (low & U(0x7FFFFFFF)))
    return U((y >> U(1)) ^ (U(-np.int32(low & U(1))) & U(0x9908B0DF)))
