"""Weight files: written whole or not at all, read without executing code, refused with the cause."""

from collections.abc import Mapping
from pathlib import Path
from typing import IO, Any

import torch
from lightning.pytorch.callbacks import ModelCheckpoint
from lightning.pytorch.plugins.io import TorchCheckpointIO
from torch import Tensor, nn

from memcomp_lightning.errors import Told
from memcomp_lightning.files import written_whole


class CheckpointError(Told, ValueError):
    """A checkpoint that cannot be used, and why."""


def save_weights(module: nn.Module, path: Path) -> None:
    """Write the module's state dict; an interruption leaves no half-written file."""
    write_tensors(module.state_dict(), path)


class AtomicCheckpointIO(TorchCheckpointIO):
    """Lightning's checkpoints, each written beside its place and then renamed.

    Lightning's own way goes through the system's temporary folder, which may be on another file system: there
    the last step is a copy that an interruption can truncate.
    """

    def save_checkpoint(
        self, checkpoint: dict[str, Any], path: str | Path, storage_options: object = None
    ) -> None:
        """Write a checkpoint, or leave the old one."""
        write_tensors(checkpoint, Path(path))


class LastCheckpoint(ModelCheckpoint):
    """Keeps the newest checkpoint, whatever paths the one that it goes on from holds.

    Lightning removes what stands there as the checkpoint before; in a stranger's file that may be anything.
    """

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Take nothing: the next checkpoint takes the place of this one."""


def write_tensors(content: Mapping[str, object], path: Path) -> None:
    """Write a file for :func:`torch.load`, whole or not at all, and its folder if there is none.

    What that lies in is there: a run folder that has vanished is not made anew.
    """
    path.parent.mkdir(exist_ok=True)
    with written_whole(path) as partial, partial.open("wb") as file:
        save_tensors(content, file)


def save_tensors(content: object, file: IO[bytes]) -> None:
    """:func:`torch.save`, which hides what the system says of a full disk.

    Raises:
        OSError: It cannot be written.
    """
    try:
        torch.save(content, file)
    except RuntimeError as error:
        cause: BaseException | None = error
        while cause is not None and not isinstance(cause, OSError):
            cause = cause.__context__
        raise (cause or error) from None


def read_checkpoint(path: Path) -> dict[str, Any]:
    """Return what a weight file or a Lightning checkpoint holds: tensors and plain values only.

    Raises:
        CheckpointError: The file is missing, truncated, or holds more than tensors and plain values.
    """
    if path.is_dir():
        raise CheckpointError(
            f"checkpoint {path} is a folder: name a file in it, as in {path}/weights/pretrain.pt."
        )
    if not path.is_file():
        raise CheckpointError(f"checkpoint {path} does not exist.")
    try:
        content = torch.load(path, map_location="cpu", weights_only=True)
    except Exception as error:  # torch raises half a dozen kinds for damaged files
        raise CheckpointError(
            f"checkpoint {path} ({path.stat().st_size} bytes) is truncated or damaged, or holds more than tensors "
            "and plain values, and code in checkpoints is never executed. In a run folder, delete it to train "
            "that stage again; elsewhere, use a file that memcomp-train wrote. "
            f"({type(error).__name__}: {str(error).partition(chr(10))[0]})"
        ) from error
    if not isinstance(content, dict):
        raise CheckpointError(f"checkpoint {path} holds a {type(content).__name__}, expected a dictionary.")
    return content


def check_fits(module: nn.Module, state_dict: dict[str, Any], path: Path) -> None:
    """Raise a CheckpointError unless a state dict is one of this module.

    It names the first tensor that differs in name, shape or dtype or is not finite, or units that are coupled
    otherwise, and says what to do.
    """
    own = module.state_dict()
    models: dict[str, Any] = dict(module.named_modules())
    couplings = {f"{name}.pairs".lstrip("."): m for name, m in models.items() if hasattr(m, "other_pairs")}
    if {"state_dict", "process_states"} <= state_dict.keys():
        raise CheckpointError(
            f"checkpoint {path} is one of a stage in training, not a weight file: use a file of the folder "
            "weights, which each stage leaves when it is done."
        )
    if missing := sorted(own.keys() - state_dict.keys() - couplings.keys()):
        raise CheckpointError(f"checkpoint {path} has no tensor {missing[0]!r}: it is of another kind of model.")
    if unknown := sorted(state_dict.keys() - own.keys()):
        raise CheckpointError(f"checkpoint {path} has a tensor {unknown[0]!r} that this model does not have.")
    for name, tensor in own.items():
        if name in state_dict and not isinstance(found := state_dict[name], Tensor):
            raise CheckpointError(f"checkpoint {path}: {name} is a {type(found).__name__}, expected a tensor.")
        if name in couplings:
            if reason := couplings[name].other_pairs(state_dict.get(name)):
                raise CheckpointError(f"checkpoint {path}: {reason} Use the model.connectivity it was made with.")
            continue
        found = state_dict[name]
        if tuple(found.shape) != tuple(tensor.shape):
            raise CheckpointError(
                f"checkpoint {path}: {name} has shape {tuple(found.shape)}, this model needs "
                f"{tuple(tensor.shape)}. Use the model.hidden_sizes, data and data.partitions it was made with."
            )
        if found.dtype != tensor.dtype and (
            not found.is_floating_point() or torch.promote_types(found.dtype, tensor.dtype) != tensor.dtype
        ):
            held, own_dtype = (str(dtype).removeprefix("torch.") for dtype in (found.dtype, tensor.dtype))
            raise CheckpointError(
                f"checkpoint {path}: {name} is {held}, which {own_dtype}, the dtype of this model, cannot hold. "
                "Use the trainer.precision it was made with."
            )
        if not bool(found.isfinite().all()):
            raise CheckpointError(
                f"checkpoint {path}: {name} has an entry that is NaN or infinite: it is of training that diverged."
            )


def check_checkpoint(module: nn.Module, path: Path) -> None:
    """Raise a CheckpointError unless a file is a checkpoint of a stage in training with this module."""
    content = read_checkpoint(path)
    if not {"state_dict", "process_states"} <= content.keys():
        raise CheckpointError(
            f"checkpoint {path} is no checkpoint of a stage in training: delete it to train the stage again."
        )
    check_fits(module, content["state_dict"], path)


def load_weights(module: nn.Module, path: Path) -> None:
    """Read a weight file into a module; raise a CheckpointError if it does not fit: see :func:`check_fits`."""
    state_dict = read_checkpoint(path)
    check_fits(module, state_dict, path)
    module.load_state_dict(state_dict)
