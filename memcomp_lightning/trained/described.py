"""Networks as plain values, kinds and sizes: files that hold no code and name no class are read by these alone."""

from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import torch
from torch import Tensor, nn

from memcomp_lightning.errors import UserError, require_choice
from memcomp_lightning.models import (
    DBM,
    DBN,
    RBM,
    BatchNorm,
    BatchNormReluNetwork,
    BoltzmannMachine,
    Linear,
)
from memcomp_lightning.models.units import Bernoulli, Categorical, Gaussian, Mixed, ReLU, Spin, Units

Description = Mapping[str, Any]
"""The kind of a part, ``{"kind": ...}``, and its sizes."""

Tensors = Mapping[str, Tensor]
"""The state dict of a part."""


class _Kind(NamedTuple):
    """How a class is told by sizes, and made from them.

    Attributes:
        of: The class; subclasses are other kinds.
        sizes: What must be known of an instance beside its tensors.
        make: An instance of these sizes; its tensors say the rest.
    """

    of: type[nn.Module]
    sizes: Callable[[Any], dict[str, Any]]
    make: Callable[[Description, Tensors], nn.Module]


def described(module: nn.Module) -> dict[str, Any]:
    """Kinds and sizes of a network and of its units.

    Raises:
        UserError: A class that is not one of the package's own.
    """
    for name, kind in _KINDS.items():
        if type(module) is kind.of:
            return {"kind": name, **kind.sizes(module)}
    raise UserError(
        f"{type(module).__name__} is not a class of memcomp_lightning, which such a file could name: keep the "
        "weight file, and give the network where it is loaded, load(PATH, network=...)."
    )


def made(description: Description, tensors: Tensors) -> nn.Module:
    """The network that was described, with these tensors, in their precision.

    Raises:
        SettingError: A kind that this version does not know.
        KeyError, RuntimeError: Sizes are missing, or are not those of the tensors.
    """
    module = _made(description, tensors)
    floating = next((x for x in tensors.values() if x.is_floating_point()), None)
    if floating is not None:
        module.to(floating.dtype)
    module.load_state_dict(dict(tensors))
    return module.eval()


def _made(description: Description, tensors: Tensors) -> nn.Module:
    require_choice("kind of a network or of units", description["kind"], tuple(_KINDS))
    return _KINDS[description["kind"]].make(description, tensors)


def _units(description: Description) -> Units:
    made = _made(description, {})
    assert isinstance(made, Units)
    return made


def _layers(model: Any) -> dict[str, Any]:
    return {"visible": described(model.visible), "hidden": described(model.hidden)}


def _stack(visible: Units, sizes: list[int]) -> dict[str, Any]:
    return {"visible": described(visible), "hidden_sizes": sizes}


def _site_pairs(visible: Units, hidden: Units, pairs: Tensor) -> Tensor:
    """The coupled sites, of coupled entries."""
    site_of = torch.cat((visible.site_of(), hidden.site_of() + visible.n_sites))
    found: Tensor = site_of[pairs].unique(dim=0)
    return found


def _machine(description: Description, tensors: Tensors) -> BoltzmannMachine:
    visible, hidden = _units(description["visible"]), _units(description["hidden"])
    pairs = _site_pairs(visible, hidden, tensors["pairs"]).tolist()
    return BoltzmannMachine(connectivity=pairs, visible=visible, hidden=hidden)


def _baseline_sizes(network: BatchNormReluNetwork) -> dict[str, Any]:
    linear = [layer for layer in network.layers if isinstance(layer, Linear)]
    sizes = [layer.weight.shape[-2] for layer in linear]
    return {"n_visible": linear[0].weight.shape[-1], "hidden_sizes": sizes[:-1], "n_classes": sizes[-1]}


def _part(tensors: Tensors, number: int) -> Tensors:
    begin = f"{number}."
    return {name.removeprefix(begin): x for name, x in tensors.items() if name.startswith(begin)}


_KINDS: dict[str, _Kind] = {
    "bernoulli": _Kind(Bernoulli, lambda x: {"n": x.n}, lambda d, _: Bernoulli(d["n"])),
    "spin": _Kind(Spin, lambda x: {"n": x.n}, lambda d, _: Spin(d["n"])),
    "categorical": _Kind(Categorical, lambda x: {"sizes": list(x.sizes)}, lambda d, _: Categorical(d["sizes"])),
    "gaussian": _Kind(
        Gaussian,
        lambda x: {"n": x.n, "learned": x.learned},
        lambda d, _: Gaussian(d["n"], learned=d["learned"]),
    ),
    "relu_units": _Kind(ReLU, lambda x: {"n": x.n}, lambda d, _: ReLU(d["n"])),
    "mixed": _Kind(
        Mixed,
        lambda x: {"parts": [described(part) for part in x.kinds]},
        lambda d, _: Mixed(*(_units(part) for part in d["parts"])),
    ),
    "rbm": _Kind(RBM, _layers, lambda d, _: RBM(visible=_units(d["visible"]), hidden=_units(d["hidden"]))),
    "boltzmann_machine": _Kind(BoltzmannMachine, _layers, _machine),
    "dbm": _Kind(
        DBM,
        lambda x: _stack(x.visible, list(x.sizes[1:])),
        lambda d, _: DBM(hidden_sizes=d["hidden_sizes"], visible=_units(d["visible"])),
    ),
    "dbn": _Kind(
        DBN,
        lambda x: _stack(x[0].visible, [rbm.n_hidden for rbm in x]),
        lambda d, _: DBN(hidden_sizes=d["hidden_sizes"], visible=_units(d["visible"])),
    ),
    "sequential": _Kind(
        nn.Sequential,
        lambda x: {"parts": [described(part) for part in x]},
        lambda d, t: nn.Sequential(*(_made(part, _part(t, k)) for k, part in enumerate(d["parts"]))),
    ),
    "linear": _Kind(
        Linear,
        lambda x: {"n_in": x.weight.shape[-1], "n_out": x.weight.shape[-2]},
        lambda d, _: Linear(d["n_in"], d["n_out"]),
    ),
    "batch_norm": _Kind(
        BatchNorm,
        lambda x: {"n": x.weight.shape[-1], "momentum": x.momentum, "eps": x.eps},
        lambda d, _: BatchNorm(d["n"], momentum=d["momentum"], eps=d["eps"]),
    ),
    "relu": _Kind(nn.ReLU, lambda _: {}, lambda d, _: nn.ReLU()),
    "batch_norm_relu_network": _Kind(
        BatchNormReluNetwork,
        _baseline_sizes,
        lambda d, _: BatchNormReluNetwork(d["n_visible"], d["hidden_sizes"], d["n_classes"]),
    ),
}
