"""RBMs of the library rbms (Bereux, Decelle, Furtlehner, Rosset & Seoane): its objects, its files.

It has bits, ``BBRBM``, and categories of one number of states, ``PBRBM``; hidden units are bits. Its energies are
ours, with weights ``(n_visible, n_hidden)`` and ``(n_sites, q, n_hidden)``.
"""

import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from memcomp_lightning import rng
from memcomp_lightning.errors import UserError, require, require_count
from memcomp_lightning.interop.parameters import in_bits, rbm_of, tensor_of
from memcomp_lightning.models import RBM
from memcomp_lightning.models.units import Categorical

BITS, POTTS = "BBRBM", "PBRBM"

N_SWEEPS = 100
"""Of the chains of a file, from states at infinite temperature; rbms goes on with them."""

_NAMES = ("weight_matrix", "vbias", "hbias")


class RbmsForm(NamedTuple):
    """An RBM as rbms has it.

    Attributes:
        kind: Name of the class there.
        rbm: Of bits, or of categories, with hidden bits.
        parameters: Its arrays by name.
    """

    kind: str
    rbm: RBM
    parameters: dict[str, Tensor]


@dataclass(frozen=True)
class Hyperparameters:
    """What rbms goes on with, where its own settings say nothing else; the defaults are its own.

    Attributes:
        batch_size: Rows an update, >= 1.
        gibbs_steps: Sweeps an update, >= 1.
        learning_rate: > 0.
        n_chains: Chains that the file holds, >= 1.
        seed: Of these chains, and of the random states.
    """

    batch_size: int = 2000
    gibbs_steps: int = 100
    learning_rate: float = 0.01
    n_chains: int = 2000
    seed: int = 0

    def __post_init__(self) -> None:
        for name in ("batch_size", "gibbs_steps", "n_chains"):
            require_count(name, getattr(self, name))
        require(self.learning_rate > 0, "learning_rate", self.learning_rate, "a number > 0")


def from_rbms(rbm: Any) -> RBM:
    """The RBM of an object of rbms, a ``BBRBM`` or ``PBRBM``, in its precision.

    Args:
        rbm: It has ``weight_matrix``, ``vbias`` and ``hbias``.

    Raises:
        UserError: An RBM of other units, or something else.
    """
    missing = [name for name in _NAMES if not hasattr(rbm, name)]
    kind = getattr(rbm, "name", None)
    if missing:
        raise UserError(f"{type(rbm).__name__} has no {missing[0]}: expected a {BITS} or {POTTS} of rbms.")
    return _rbm_of(kind, {name: getattr(rbm, name) for name in _NAMES}, type(rbm).__name__)


def read_rbms(path: str | Path, update: int | None = None) -> RBM:
    """The RBM of an HDF5 file of rbms; reading it runs no code.

    Args:
        path: The file.
        update: Which of the updates that were saved; None is the last one.

    Raises:
        UserError: The file is damaged, or holds something else; there is no such update.
    """
    path = Path(path)
    try:
        file = _h5py(str(path)).File(path, "r")
    except OSError as error:
        raise UserError(f"{path} cannot be read as HDF5: {error}") from error
    with file:
        saved = sorted(int(found[1]) for name in file if (found := re.fullmatch(r"update_(\d+)", name)))
        if not saved:
            raise UserError(f"{path} has no group update_1, update_2, ...: it is no file of rbms.")
        if update is not None and update not in saved:
            shown = ", ".join(map(str, saved[:10])) + (", ..." if len(saved) > 10 else "")
            raise UserError(f"{path} has no update {update}: it has {shown}.")
        group = file[f"update_{saved[-1] if update is None else update}"]
        group = group.get("params", group)  # earlier versions had no group of their own
        missing = [name for name in _NAMES if name not in group]
        if missing:
            raise UserError(f"{path} has no {missing[0]} in {group.name}: it is no RBM of rbms.")
        kind = file["model_type"][()].decode() if "model_type" in file else None
        return _rbm_of(kind, {name: group[name][()] for name in _NAMES}, str(path))


def rbms_form(rbm: RBM) -> RbmsForm:
    """An RBM as rbms has it; spins become bits, -1 read as 0.

    Raises:
        SettingError: It has units that rbms has not: real ones, sites of different numbers of states.
    """
    form = in_bits(rbm, "rbms")
    weight, units = form.weight.detach().cpu().mT, form.visible
    b, c = form.b.detach().cpu(), form.c.detach().cpu()
    if not isinstance(units, Categorical):
        return RbmsForm(BITS, form, dict(zip(_NAMES, (weight, b, c), strict=True)))
    sizes = sorted(set(units.sizes))
    require(len(sizes) == 1, "numbers of states of the sites, for rbms", sizes, "the same at all sites")
    table = units.n_sites, sizes[0]
    return RbmsForm(
        POTTS, form, dict(zip(_NAMES, (weight.unflatten(0, table), b.unflatten(0, table), c), strict=True))
    )


def write_rbms(rbm: RBM, path: Path, hyperparameters: Hyperparameters | None = None) -> None:
    """Write a file that rbms loads, samples and goes on to train, as its update 1.

    Raises:
        SettingError: See :func:`rbms_form`.
        UserError: h5py is not installed.
    """
    h5py, form, settings = _h5py(str(path)), rbms_form(rbm), hyperparameters or Hyperparameters()
    generator = rng.stream(settings.seed, "rbms")
    chains = _chains(form.rbm, settings.n_chains, generator)
    n_visible, n_hidden = form.parameters["weight_matrix"].shape[0], rbm.n_hidden
    of_numpy = np.random.MT19937(settings.seed).state["state"]
    numpy_state = ("MT19937", of_numpy["key"], of_numpy["pos"], 0, 0.0)
    with h5py.File(path, "w") as file:
        group = file.create_group("hyperparameters")
        sizes = {"num_visibles": n_visible, "num_hiddens": n_hidden, "num_chains": settings.n_chains}
        trained = {"batch_size": settings.batch_size, "gibbs_steps": settings.gibbs_steps}
        rates = {"learning_rate": settings.learning_rate, "L1": 0.0, "L2": 0.0, "seed": settings.seed}
        for name, value in {**sizes, **trained, **rates}.items():
            group[name] = value
        update = file.create_group("update_1")
        parameters = update.create_group("params")
        for name, x in form.parameters.items():
            parameters[name] = x.contiguous().numpy()
            update[name] = parameters[
                name
            ]  # where earlier versions look for it: the same numbers, once on the disk
        update["torch_rng_state"] = generator.get_state().numpy()
        for number, part in enumerate(numpy_state):
            update[f"numpy_rng_arg{number}"] = part
        update["time"] = 0.0
        update.create_group("flags")["checkpoint"] = True
        file["parallel_chains"] = chains.numpy()
        file["model_type"] = form.kind


@torch.no_grad()
def _chains(rbm: RBM, n: int, generator: torch.Generator) -> Tensor:
    """Visible units of chains, of categories the numbers of their states."""
    rbm = rbm.cpu()
    chains = rbm.chains()
    v = chains.random(n, generator=generator)
    for _ in range(N_SWEEPS):
        v = chains.sweep(v, generator=generator)
    return rbm.visible.decode(v).to(v.dtype) if isinstance(rbm.visible, Categorical) else v


def _rbm_of(kind: str | None, arrays: Mapping[str, Any], source: str) -> RBM:
    weight, b, c = (tensor_of(arrays[name], name) for name in _NAMES)
    kind = kind or (POTTS if weight.ndim == 3 else BITS)
    if (kind, weight.ndim) not in ((BITS, 2), (POTTS, 3)):
        raise UserError(
            f"{source} is a {kind} with {weight.ndim} axes of weights: expected a {BITS} or {POTTS} of rbms."
        )
    if kind == BITS:
        return rbm_of(weight.mT, b, c)
    return rbm_of(weight.flatten(0, 1).mT, b.flatten(), c, Categorical(weight.shape[0], q=weight.shape[1]))


def _h5py(file: str) -> Any:
    try:
        import h5py
    except ImportError as error:
        raise UserError(f"{file}: HDF5 needs h5py, which is not installed: pip install h5py") from error
    return h5py
