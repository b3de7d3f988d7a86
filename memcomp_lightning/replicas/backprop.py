"""The gradient of the mean cross-entropy of a batch, by the shortest way.

Autograd spends more time on its graph than on the numbers of a 32-32-32-10 network: sigmoid networks get their
gradient in closed form, the same to rounding, in half the time. All others get it by autograd.
"""

from collections.abc import Callable
from functools import partial

import torch
import torch.nn.functional as F
from torch import Tensor, nn
from torch.nn import Parameter

from memcomp_lightning.models import DBN, Linear
from memcomp_lightning.models.affine import affine
from memcomp_lightning.types import Batch

AddGradient = Callable[[Batch], None]
"""Adds the gradient of ``share * mean cross-entropy``, summed over the replicas, to the parameters' ``grad``."""


def gradient_of(network: nn.Module) -> AddGradient:
    """Return what adds the gradient of a network's parameters."""
    if isinstance(network, nn.Sequential) and len(network) == 2:
        hidden, output = network
        if type(hidden) is DBN and type(output) is Linear:
            layers = [(rbm.weight, rbm.c) for rbm in hidden] + [(output.weight, output.bias)]
            return partial(_of_sigmoid_layers, layers)
    return partial(_by_autograd, network)


@torch.no_grad()
def _of_sigmoid_layers(layers: list[tuple[Parameter, Parameter]], batch: Batch) -> None:
    r"""Back-propagation: ``\delta_{l-1} = (\delta_l W_l) \odot h (1 - h)``, with softmax less one-hot on top."""
    activations = [batch.v]
    for weight, bias in layers[:-1]:
        activations.append(affine(activations[-1], weight, bias).sigmoid_())
    delta = affine(activations[-1], *layers[-1]).softmax(-1)
    delta.scatter_add_(-1, batch.label.unsqueeze(-1), delta.new_full((), -1.0).expand(*batch.label.shape, 1))
    delta *= batch.share / batch.label.shape[-1]
    for number in range(len(layers) - 1, -1, -1):
        weight, bias = layers[number]
        below = activations[number]
        _add(weight, delta.mT @ below)
        _add(bias, delta.sum(-2))
        if number > 0:
            delta = torch.ops.aten.sigmoid_backward(delta @ weight, below)


def _add(parameter: Parameter, gradient: Tensor) -> None:
    parameter.grad = gradient if parameter.grad is None else parameter.grad + gradient


def _by_autograd(network: nn.Module, batch: Batch) -> None:
    logits = network(batch.v)
    total = F.cross_entropy(logits.flatten(0, -2), batch.label.flatten(), reduction="sum")
    (total * (batch.share / batch.label.shape[-1])).backward()
