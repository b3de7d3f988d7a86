"""For what the host waits in a piece of work, counted by the line that causes it.

On a CPU a device that stands in for an accelerator counts the operations that would make the host wait: values
that are read, shapes that depend on values, copies between memories. On CUDA torch itself counts what does.
"""

import sys
import warnings
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import torch

ROOT = Path(__file__).parents[2]
sys.path.append(str(ROOT / "tests" / "gpu"))

import stand_in  # noqa: E402

STAND_IN = stand_in.NAME
"""Name of the device that stands in."""


@contextmanager
def usable() -> Iterator[None]:
    """Make the device that stands in usable, random numbers included."""
    generator = torch.Generator
    torch.Generator = stand_in.Generator
    try:
        with stand_in.usable():
            yield
    finally:
        torch.Generator = generator


def counted(piece: Callable[[], object], device: str) -> Counter[str]:
    """How often each line made the host wait, with its operation where that is known."""
    if device == STAND_IN:
        stand_in.waits.clear()
        piece()
        return Counter(stand_in.waits)
    torch.cuda.synchronize()
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        torch.cuda.set_sync_debug_mode("warn")
        try:
            piece()
        finally:
            torch.cuda.set_sync_debug_mode("default")
    return Counter(
        f"at {stand_in.shortened(warning.filename)}:{warning.lineno}"
        for warning in caught
        if "called a synchronizing" in str(warning.message)  # not what torch says of the mode itself
    )
