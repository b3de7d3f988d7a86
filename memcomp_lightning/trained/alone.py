"""Weights that lie by themselves: what their tensors say of the network, and what somebody has to say."""

import warnings
from collections.abc import Mapping
from pathlib import Path

import torch
from torch import Tensor, nn

from memcomp_lightning.data.schema import Schema, schema_of
from memcomp_lightning.errors import SettingError, UserError, require, require_count
from memcomp_lightning.files import read_json
from memcomp_lightning.models import DBN, RBM, Linear
from memcomp_lightning.models.units import Bernoulli, Units
from memcomp_lightning.modules.weights import CheckpointError, check_fits, read_checkpoint

Tensors = dict[str, Tensor]

_BEGINNINGS = (b"PK", b"\x80\x02")
"""Of the files that torch writes, now and in the past."""


class LoadWarning(UserWarning):
    """What somebody who loads a model should know of how its file was read."""


def warn(text: str) -> None:
    """Say it."""
    warnings.warn(text, LoadWarning, stacklevel=5)


def tensors_of(path: Path) -> Tensors:
    """The tensors of a network: all of a weight file, of a checkpoint those of the network in training.

    Nothing in the file is executed.

    Raises:
        CheckpointError: It is missing or damaged, or holds something else.
    """
    with path.open("rb") as file:
        begins = file.read(2)
    if begins not in _BEGINNINGS:
        raise CheckpointError(
            f"{path} is no weight file and no checkpoint of memcomp-train: name a run folder, or a file of its "
            "folders weights and checkpoints."
        )
    content = read_checkpoint(path)
    if "state_dict" not in content:
        return content
    begin = "network."
    own = {name: x for name, x in content["state_dict"].items() if name.startswith(begin)}
    if not own:
        raise CheckpointError(f"checkpoint {path} has no tensor 'network....': memcomp-train did not write it.")
    return {name.removeprefix(begin): x for name, x in own.items()}


def schema_in(path: Path) -> Schema:
    """The schema that a run keeps as ``schema.json``.

    Raises:
        UserError: There is no such file, or it is something else.
    """
    try:
        return schema_of(read_json(path))
    except OSError as error:
        raise UserError(
            f"schema={path}: {error.strerror}. Name the file schema.json of the run folder."
        ) from error
    except (ValueError, KeyError, TypeError, AttributeError, SettingError) as error:
        raise UserError(
            f"schema={path} is no schema of a run: name the file schema.json of its folder."
        ) from error


def one_of(state: Tensors, own: Mapping[str, Tensor], replica: int | None, path: Path) -> Tensors:
    """The tensors of one replica, where a file has several of a network that has none.

    Raises:
        SettingError: There is no such replica.
    """
    several = [x for name, x in state.items() if name in own and x.ndim == own[name].ndim + 1]
    if not several:
        require(replica in (None, 0), "replica", replica, "0: this file has one network")
        return state
    at = replica_of(replica, len(several[0]), path)
    return {name: x[at] if name in own and x.ndim == own[name].ndim + 1 else x for name, x in state.items()}


def replica_of(replica: int | None, n: int, path: Path) -> int:
    """Which of n networks is taken, and say so where nobody chose.

    Raises:
        SettingError: There is no such replica.
    """
    if replica is None:
        warn(f"{path} has {n} networks, trained side by side: the first is taken. Choose by replica=0 to {n - 1}.")
        return 0
    require_count("replica", replica, 0)
    require(replica < n, "replica", replica, f"an integer from 0 to {n - 1}")
    return replica


def network_of(state: Tensors, path: Path, schema: Schema | None) -> nn.Module:
    """An RBM, a DBN, or a DBN with its output layer, as tensors say; a schema says what the visible units are.

    Hidden units are bits, and so are visible ones that no schema tells: of that there is a warning.

    Raises:
        UserError: The tensors are those of another network, or fit no such units.
    """
    units = None if schema is None else schema.units()
    made = _made(state, units)
    if made is None or made.state_dict().keys() != state.keys():
        held = ", ".join(sorted(state)[:6]) + (", ..." if len(state) > 6 else "")
        raise UserError(f"{path} lies by itself and holds {held}: {_needed(schema)}")
    if any(x.dtype == torch.float64 for x in state.values()):
        made.double()
    n_visible = next(state[name].shape[-1] for name in made.state_dict() if name.endswith("weight"))
    n = n_visible if schema is None else schema.n_sites if units is None else units.n
    if n_visible != n:
        raise UserError(f"{path} has {n_visible} visible units, and the schema {n}: it is that of another run.")
    assumed = ["visible"] * (units is None) + ["hidden"] * isinstance(made, RBM)
    if assumed:
        remedy = "" if schema is not None else "give schema=FOLDER/schema.json, or "
        warn(
            f"{path} lies by itself: its {' and '.join(assumed)} units are taken for bits, 0 and 1. If they are "
            f"not, name its run folder; {remedy}in Python load(PATH, network=RBM(...))."
        )
    if isinstance(made, nn.Sequential):
        warn(f"{path} lies by itself: its outputs are taken for logits of softmax. If not, name its run.")
    elif isinstance(made, DBN) and len(made) > 1:
        warn(f"{path} lies by itself: its layers are taken for trained one by one. If not, name its run folder.")
    return made


def _needed(schema: Schema | None) -> str:
    """What is needed beside tensors, in words."""
    if schema is None:
        return (
            "the kinds of its units do not follow from them. Name its run folder; give the schema of the run, "
            "schema=FOLDER/schema.json; or in Python give the network, load(PATH, network=RBM(...))."
        )
    return (
        "that is no DBN, RBM or classifier with the columns of the schema, which may be that of another run. Name "
        "the run folder; or in Python give the network, load(PATH, network=RBM(...), schema=...)."
    )


def _made(state: Tensors, units: Units | None) -> nn.Module | None:
    """A network of these sizes; None of tensors that are those of no such network."""
    weights = {name: x for name, x in state.items() if name.endswith("weight") and isinstance(x, Tensor)}
    if not weights or any(x.ndim not in (2, 3) for x in weights.values()):
        return None
    sizes = {name: tuple(x.shape[-2:]) for name, x in weights.items()}
    for begin in ("", "0."):
        layers = [sizes.get(f"{begin}rbms.{layer}.weight") for layer in range(len(sizes))]
        found = [size for size in layers if size is not None]
        if not found:
            continue
        dbn = DBN(hidden_sizes=[n for n, _ in found], visible=units or Bernoulli(found[0][1]))
        if not begin:
            return dbn
        return nn.Sequential(dbn, Linear(*reversed(sizes["1.weight"]))) if "1.weight" in sizes else None
    if "weight" in sizes:
        n_hidden, n_visible = sizes["weight"]
        return RBM(n_hidden=n_hidden, visible=units or Bernoulli(n_visible))
    return None


def taken(module: nn.Module, state: Tensors, path: Path) -> nn.Module:
    """A network with these tensors, in evaluation mode.

    Raises:
        CheckpointError: They do not fit it.
    """
    check_fits(module, state, path)
    module.load_state_dict(state)
    return module.eval()
