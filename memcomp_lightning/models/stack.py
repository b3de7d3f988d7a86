"""Networks of one shape side by side on the replica axis."""

import copy
import math
from collections.abc import Sequence
from typing import TypeVar

import torch
from torch import nn

from memcomp_lightning.errors import require

ModuleT = TypeVar("ModuleT", bound=nn.Module)


def stacked(networks: Sequence[ModuleT], replicas: tuple[int, ...]) -> ModuleT:
    """Return a copy of all ``networks`` as one, with their replicas one after the other on a single axis.

    ``replicas`` are the leading axes of each of them.

    Raises:
        SettingError: There is none, or names, shapes or numbers of axes differ.

    >>> from memcomp_lightning.models import RBM
    >>> stacked([RBM(3, 2, replicas=(4,)), RBM(3, 2, replicas=(4,))], (4,)).replicas
    (8,)
    """
    require(len(networks) > 0, "networks", len(networks), "at least one network")
    whole = copy.deepcopy(networks[0])
    states = [network.state_dict() for network in networks]
    shapes = [{name: tuple(x.shape) for name, x in state.items()} for state in states]
    require(all(shape == shapes[0] for shape in shapes), "networks", shapes, "networks of one shape")
    parameters, n = dict(whole.named_parameters()), len(networks) * math.prod(replicas)
    for name, tensor in states[0].items():
        if not tensor.is_floating_point():  # indices of units, the same in all replicas
            alike = all(tensor.equal(state[name]) for state in states)
            require(alike, name, "different", "the same in all networks")
            continue
        own_axes = tensor.shape[len(replicas) :]
        together = torch.stack([state[name] for state in states]).reshape(n, *own_axes)
        owner, _, own_name = name.rpartition(".")
        if name in parameters:
            together = nn.Parameter(together, requires_grad=parameters[name].requires_grad)
        setattr(whole.get_submodule(owner), own_name, together)
    return whole
