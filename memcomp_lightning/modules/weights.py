"""Weight files: written whole or not at all, read without executing code, refused with the cause."""

import os
import pickle
import zipfile
from pathlib import Path
from typing import Any

import torch
from torch import nn


class CheckpointError(ValueError):
    """A checkpoint that cannot be used, and why."""


def save_weights(module: nn.Module, path: Path) -> None:
    """Write the module's state dict; an interruption leaves no half-written file."""
    path.parent.mkdir(parents=True, exist_ok=True)
    partial = path.with_name(f".{path.name}.{os.getpid()}.partial")
    try:
        torch.save(module.state_dict(), partial)
        partial.replace(path)
    finally:
        partial.unlink(missing_ok=True)


def read_checkpoint(path: Path) -> dict[str, Any]:
    """Return what a weight file or a Lightning checkpoint holds: tensors and plain values only.

    Raises:
        CheckpointError: The file is missing, truncated, or holds more than tensors and plain values.
    """
    if not path.is_file():
        raise CheckpointError(f"checkpoint {path} does not exist.")
    try:
        content = torch.load(path, map_location="cpu", weights_only=True)
    except pickle.UnpicklingError as error:
        raise CheckpointError(
            f"checkpoint {path} holds more than tensors and plain values, or is damaged; code in checkpoints "
            f"is never executed. Use a file that memcomp-train wrote. ({str(error).splitlines()[0]})"
        ) from error
    except (RuntimeError, EOFError, OSError, zipfile.BadZipFile, ValueError) as error:
        raise CheckpointError(
            f"checkpoint {path} ({path.stat().st_size} bytes) cannot be read, it seems truncated: delete it "
            f"and start from an earlier one. ({str(error).splitlines()[0]})"
        ) from error
    if not isinstance(content, dict):
        raise CheckpointError(f"checkpoint {path} holds a {type(content).__name__}, expected a dictionary.")
    return content


def check_fits(module: nn.Module, state_dict: dict[str, Any], path: Path) -> None:
    """Raise unless names and shapes are the module's.

    Raises:
        CheckpointError: Naming the first tensor that differs, both shapes, and what to do.
    """
    own = module.state_dict()
    if missing := sorted(own.keys() - state_dict.keys()):
        raise CheckpointError(f"checkpoint {path} has no tensor {missing[0]!r}: it is of another kind of model.")
    if unknown := sorted(state_dict.keys() - own.keys()):
        raise CheckpointError(f"checkpoint {path} has a tensor {unknown[0]!r} that this model does not have.")
    for name, tensor in own.items():
        if tuple(state_dict[name].shape) != tuple(tensor.shape):
            raise CheckpointError(
                f"checkpoint {path}: {name} has shape {tuple(state_dict[name].shape)}, this model needs "
                f"{tuple(tensor.shape)}. Use the model.hidden_sizes, data and data.partitions it was made with."
            )


def load_weights(module: nn.Module, path: Path) -> None:
    """Read a weight file into a module.

    Raises:
        CheckpointError: The file cannot be read, or its names or shapes are not the module's.
    """
    state_dict = read_checkpoint(path)
    check_fits(module, state_dict, path)
    module.load_state_dict(state_dict)
