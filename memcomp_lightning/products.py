"""Which of torch's libraries multiplies matrices of float32 on a processor, and how it rounds."""

from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext
from functools import cache

import torch
from llvmlite.binding import get_host_cpu_name
from torch import nn

WORTH_ONEDNN = 2**22
"""Multiplications in a product of matrices, about, from which oneDNN's longer way to begin no longer counts."""

_TRIED = 256
"""Rows and columns; torch may leave small products as they are."""


def quick_products(n: int) -> AbstractContextManager[None]:
    """Make products of matrices, each of about ``n`` multiplications, in the quickest way that rounds to float32.

    On AMD's processors with AVX-512, MKL uses half of the width of their registers, and oneDNN takes half of its
    time. Sums are in float32 in both; their order is not the same, nor are the last bits. Elsewhere, and where a
    product has fewer than 2^22 multiplications, nothing changes.
    """
    return by_onednn() if n >= WORTH_ONEDNN and _onednn_is_quicker() else nullcontext()


def n_weights(network: nn.Module) -> int:
    """The weights of the largest layer of a network: multiplications of a row, but for replicas."""
    return max((weight.shape[-2:].numel() for weight in network.parameters() if weight.ndim > 1), default=0)


@contextmanager
def by_onednn() -> Iterator[None]:
    """Let oneDNN multiply, in bfloat16 where the processor has units for that: see ``multiplies_in_bfloat16``."""
    matmul = torch.backends.mkldnn.matmul  # type: ignore[attr-defined]
    before = matmul.fp32_precision
    matmul.fp32_precision = "bf16"
    try:
        yield
    finally:
        matmul.fp32_precision = before


@cache
def multiplies_in_bfloat16() -> bool:
    """Whether oneDNN does so on this processor, found by a product: instructions for it may lie unused."""
    if not _is_there():
        return False
    finer_than_bfloat16 = torch.full((_TRIED, _TRIED), 1 + 2.0**-12, dtype=torch.float32, device="cpu")
    one = torch.eye(_TRIED, dtype=torch.float32, device="cpu")
    with by_onednn():
        return not (finer_than_bfloat16 @ one).equal(finer_than_bfloat16)


@cache
def _onednn_is_quicker() -> bool:
    """By the name of the processor, not by a clock: the same run must have the same numbers."""
    return _is_there() and get_host_cpu_name().startswith("znver") and not multiplies_in_bfloat16()


def _is_there() -> bool:
    """Whether torch has oneDNN and lets it be chosen, as it does since 2.9."""
    return torch.backends.mkldnn.is_available() and hasattr(torch.backends.mkldnn, "matmul")
