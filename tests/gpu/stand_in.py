"""A second device on a machine that has none: tensors of a type of their own, computed on the CPU.

What an accelerator makes of a program shows here too: tensors of two devices in one operation are an error, and
each operation for which the host waits (a value that is read, a shape that depends on values, a copy between
memories) is noted by its name. What an accelerator's kernels compute, and how fast, does not show.
"""

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import torch
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves, tree_map

# PyTorch's device without memory: it lets tensors of any type claim to be there, autograd included.
NAME = "meta"
VALUES_DECIDE = (
    *("_local_scalar_dense", "equal", "nonzero", "masked_select", "_unique2", "unique_dim", "unique_consecutive"),
    *("repeat_interleave", "bincount", "histc", "multinomial"),
)
# The operations for which the host has waited, each with the line of the package that called it.
waits: list[str] = []


class OnDevice(Tensor):
    """A tensor of the device, around the tensor of the host that holds its values."""

    values: Tensor

    @staticmethod
    def __new__(cls, values: Tensor) -> "OnDevice":
        layout = {"strides": values.stride(), "storage_offset": values.storage_offset(), "dtype": values.dtype}
        made = Tensor._make_wrapper_subclass(cls, values.shape, **layout, device=NAME)
        made.values = values
        return made

    def __repr__(self) -> str:
        return f"on the device: {self.values}"

    def tolist(self) -> list:
        return self.cpu().tolist()

    @classmethod
    def __torch_dispatch__(cls, function, types, args=(), kwargs=None):
        return _run(function, args, kwargs or {})


HostGenerator = torch.Generator


class Generator(HostGenerator):
    """Draws on the device; the same numbers as on the host."""

    device = property(lambda self: torch.device(NAME))

    def __new__(cls, device: torch.device | str = "cpu") -> HostGenerator:
        return super().__new__(cls) if torch.device(device).type == NAME else HostGenerator()


class _Everything(TorchDispatchMode):
    """Sees what has no tensor of the device among its arguments: new tensors, and copies to it."""

    def __torch_dispatch__(self, function, types, args=(), kwargs=None):
        return _run(function, args, kwargs or {})


@contextmanager
def usable() -> Iterator[None]:
    """Make the device usable, and forget for what the host has waited."""
    waits.clear()
    with _Everything():
        yield


def _run(function, args, kwargs):
    name = function.overloadpacket.__name__
    tensors = [part for part in tree_leaves((args, kwargs)) if isinstance(part, Tensor)]
    of_device = [part for part in tensors if isinstance(part, OnDevice)]
    if any(part.device.type == NAME and not isinstance(part, OnDevice) for part in tensors):
        raise RuntimeError(f"{function}: torch.tensor(..., device=...) copies from the host; torch.full does not")
    asked = kwargs.get("device")
    to_device = bool(of_device) if asked is None else torch.device(asked).type == NAME
    is_copy = name in ("copy_", "_to_copy")
    if name == "copy_":
        to_device = isinstance(args[0], OnDevice)
    if of_device and not is_copy:
        hosts = [tuple(part.shape) for part in tensors if not isinstance(part, OnDevice) and part.dim()]
        if hosts:
            raise RuntimeError(f"{function}: tensors of two devices; on the host {hosts}")
    by_mask = name.startswith("index") and any(part.dtype == torch.bool for part in of_device[1:])
    queued = to_device and (kwargs.get("non_blocking", False) or (name == "copy_" and args[2:] == (True,)))
    crosses = is_copy and not queued and any(isinstance(part, OnDevice) != to_device for part in tensors)
    if (of_device and name in VALUES_DECIDE) or by_mask or crosses:
        waits.append(f"{name} at {_line()}")
    known = {id(part.values): part for part in of_device}
    on_host = tree_map(lambda part: part.values if isinstance(part, OnDevice) else part, (args, kwargs))
    result = function(*on_host[0], **on_host[1] | ({"device": torch.device("cpu")} if asked is not None else {}))
    if not to_device:
        return result
    return tree_map(
        lambda x: known[id(x)] if id(x) in known else OnDevice(x) if isinstance(x, Tensor) else x, result
    )


def shortened(file: str) -> str:
    """The path of a file within the package."""
    return file.rpartition("/memcomp_lightning/")[2]


def _line() -> str:
    """The innermost line of the package, or that of the caller of torch where none is."""
    frame = sys._getframe(1)
    first = None
    while frame is not None:
        file = frame.f_code.co_filename
        if "/memcomp_lightning/" in file:
            return f"{shortened(file)}:{frame.f_lineno}"
        if first is None and "/torch/" not in file and file != __file__:
            first = f"{Path(file).name}:{frame.f_lineno}"
        frame = frame.f_back
    return str(first)
