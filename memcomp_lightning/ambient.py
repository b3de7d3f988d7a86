"""Torch's settings of the surrounding code, which must not change what a computation gives."""

import contextlib
from collections.abc import Iterator

import torch


@contextlib.contextmanager
def with_gradients(device: torch.device | str = "cpu") -> Iterator[None]:
    """Let autograd record, in full precision, inside ``no_grad``, ``inference_mode`` and ``autocast`` as outside.

    Args:
        device: Where the parameters are; autocast is switched off there.
    """
    kind = torch.device(device).type
    is_on = torch.amp.is_autocast_available(kind) and torch.is_autocast_enabled(kind)
    autocast = torch.autocast(kind, enabled=False) if is_on else contextlib.nullcontext()
    with torch.inference_mode(False), torch.enable_grad(), autocast:
        yield


@contextlib.contextmanager
def on_the_cpu() -> Iterator[None]:
    """As :func:`with_gradients`, and what is made without a device is made on the CPU."""
    # Where that is so already, the context would cost some microseconds in every operation.
    elsewhere = torch.get_default_device().type != "cpu"
    with with_gradients(), torch.device("cpu") if elsewhere else contextlib.nullcontext():
        yield
