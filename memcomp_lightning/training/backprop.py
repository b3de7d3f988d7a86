"""The gradient of a classifier's loss, in closed form where that is faster than autograd.

Autograd spends more time on its graph than on the numbers of a 32-32-32-10 network: networks of affine layers
with sigmoid units, or with batch normalisation and ReLU, get their gradient in closed form, the same to rounding,
in half the time or less. All others get it by autograd.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from typing import NamedTuple, Protocol

import torch
from torch import Tensor, nn
from torch.nn import Parameter

from memcomp_lightning.errors import require
from memcomp_lightning.models import DBN, RBM, BatchNorm, BatchNormReluNetwork, Linear
from memcomp_lightning.models.affine import affine
from memcomp_lightning.training.dropout import Dropout
from memcomp_lightning.training.losses import ClassWeighted, Loss, cross_entropy, squared_error
from memcomp_lightning.training.score import require_complete
from memcomp_lightning.types import Batch


class ClassifierStep:
    """The gradient of a network's mean loss, batch by batch.

    Args:
        network: Maps inputs ``(*replicas, n, n_visible)`` to logits ``(*replicas, n, n_classes)``.
        loss: Of each image.
        dropout: Leaves out activations of the hidden layers; None leaves out none.

    Raises:
        SettingError: Dropout for a network whose hidden layers are not known here.
    """

    def __init__(self, network: nn.Module, loss: Loss = cross_entropy, dropout: Dropout | None = None) -> None:
        self._network, self._loss, self._dropout = network, loss, dropout
        layers = _layers_of(network)
        of_logits = _OF_LOGITS.get(loss.loss if isinstance(loss, ClassWeighted) else loss)
        self._closed_form = (
            None
            if layers is None or of_logits is None
            else partial(_backward_all, layers, of_logits, loss, dropout)
        )
        if dropout is not None:
            known = all(type(module) in _KNOWN for module in _flat(network))
            allowed = "0 for a network of modules of your own"
            require(known, "finetune.dropout", dropout.share, allowed, "Drop units out in the network itself.")

    def add_gradient(self, batch: Batch) -> None:
        """Add the gradient of ``share * mean loss``, summed over the replicas, to the parameters' ``grad``."""
        require_complete(batch)
        if self._closed_form is None:
            self.loss(batch)[0].backward()
            return
        for parameter, gradient in self._closed_form(batch)[1]:
            parameter.grad = gradient if parameter.grad is None else parameter.grad + gradient

    def loss(self, batch: Batch) -> tuple[Tensor, Tensor, Tensor]:
        """Return ``share * mean loss``, summed over the replicas, to be differentiated once, losses and logits."""
        require_complete(batch)
        if self._closed_form is None:
            logits = self._logits(batch.v)
            losses = self._loss(logits, batch.label)
            return _total(losses, batch), losses.detach(), logits.detach()
        logits, found = self._closed_form(batch)
        losses = self._loss(logits, batch.label)
        parameters, gradients = zip(*found, strict=True)
        apply: Callable[..., Tensor] = _WithGradient.apply
        return apply(_total(losses, batch), gradients, *parameters), losses, logits

    def _logits(self, v: Tensor) -> Tensor:
        if self._dropout is None:
            logits: Tensor = self._network(v)
            return logits
        for module in _flat(self._network):
            v = module(v)
            if type(module) in _BENT:
                v = v * self._dropout.factor(v)
        return v


def _total(losses: Tensor, batch: Batch) -> Tensor:
    share = _share_of_each(batch)
    return losses.sum() * share if isinstance(share, float) else (losses * share.squeeze(-2)).sum()


class _Known(Protocol):
    gradients: Sequence[Tensor]


class _WithGradient(torch.autograd.Function):
    """A number whose gradient by some parameters is known already."""

    @staticmethod
    def forward(ctx: _Known, value: Tensor, gradients: Sequence[Tensor], *parameters: Parameter) -> Tensor:
        """Return the number."""
        ctx.gradients = gradients
        return value.clone()

    @staticmethod
    def backward(ctx: _Known, by_value: Tensor) -> tuple[Tensor | None, ...]:
        """Return the gradients."""
        return None, None, *(gradient * by_value for gradient in ctx.gradients)


def _of_cross_entropy(logits: Tensor, label: Tensor) -> Tensor:
    """Softmax less one-hot."""
    return _less_one_hot(logits.softmax(-2), label)


def _of_squared_error(logits: Tensor, label: Tensor) -> Tensor:
    """(s - y) s (1 - s) with the sigmoid s and one-hot y."""
    s = logits.sigmoid()
    gradient: Tensor = torch.ops.aten.sigmoid_backward(_less_one_hot(s.clone(), label), s)
    return gradient


def _less_one_hot(x: Tensor, label: Tensor) -> Tensor:
    label = label.unsqueeze(-2)
    return x.scatter_add_(-2, label, x.new_full((), -1.0).expand(label.shape))


_OF_LOGITS: dict[Loss, Callable[[Tensor, Tensor], Tensor]] = {
    cross_entropy: _of_cross_entropy,
    squared_error: _of_squared_error,
}
"""Gradient of a loss by its logits; logits are ``(*replicas, n_classes, n)``, labels ``(*replicas, n)``.

Classes before images: the softmax over a last axis of ten is twenty times slower.
"""


_BENT = (RBM, nn.ReLU)
"""Modules that end a hidden layer."""

_KNOWN = (*_BENT, Linear, BatchNorm)


@dataclass
class _Layer:
    """An affine map, batch normalisation or not, and what follows: nothing, the sigmoid or the ReLU."""

    weight: Parameter
    bias: Parameter
    units: str = "linear"
    norm: BatchNorm | None = None


def _layers_of(network: nn.Module) -> list[_Layer] | None:
    """The layers from the inputs up; None for a network that is not made of them alone, or does not end linear."""
    layers: list[_Layer] = []
    for module in _flat(network):
        if not module.training or module._forward_hooks or module._forward_pre_hooks:
            return None  # hooks, and statistics frozen by eval(), need the module's own forward pass
        if type(module) is RBM:
            layers.append(_Layer(module.weight, module.c, "sigmoid"))
        elif type(module) is Linear:
            layers.append(_Layer(module.weight, module.bias))
        elif not layers or layers[-1].units != "linear":
            return None
        elif type(module) is BatchNorm and layers[-1].norm is None:
            layers[-1].norm = module
        elif type(module) is nn.ReLU:
            layers[-1].units = "relu"
        else:
            return None
    hidden_are_bent = all(layer.units != "linear" for layer in layers[:-1])
    ends_linear = bool(layers) and layers[-1].units == "linear" and layers[-1].norm is None
    return layers if hidden_are_bent and ends_linear else None


def _flat(network: nn.Module) -> Iterator[nn.Module]:
    if type(network) is DBN or type(network) is nn.Sequential:
        for module in network:
            yield from _flat(module)
    elif type(network) is BatchNormReluNetwork:
        yield from _flat(network.layers)
    else:
        yield network


@torch.no_grad()
def _backward_all(
    layers: list[_Layer],
    of_logits: Callable[[Tensor, Tensor], Tensor],
    loss: Loss,
    dropout: Dropout | None,
    batch: Batch,
) -> tuple[Tensor, list[tuple[Parameter, Tensor]]]:
    r"""Logits, and the gradient of each parameter: ``\delta_{l-1} = \delta_l W_l \odot f'``."""
    below, passed = [batch.v], []
    for layer in layers[:-1]:
        activation, norm = _forward(layer, below[-1])
        factor = None if dropout is None else dropout.factor(activation)
        below.append(activation if factor is None else activation * factor)
        passed.append((activation, norm, factor))
    top, found = layers[-1], []
    logits = (top.weight @ below[-1].mT).add_(top.bias.unsqueeze(-1))
    delta = of_logits(logits, batch.label).mul_(_share_of_each(batch))
    if isinstance(loss, ClassWeighted):
        delta.mul_(loss.of(batch.label).unsqueeze(-2).to(delta.dtype))
    delta = delta.mT
    for number in range(len(layers) - 1, -1, -1):
        layer = layers[number]
        if number < len(layers) - 1:
            activation, norm, factor = passed[number]
            delta = delta if factor is None else delta.mul_(factor)
            delta, of_norm = _backward(layer, delta, activation, norm)
            found += of_norm
        found += [(layer.weight, delta.mT @ below[number]), (layer.bias, delta.sum(-2))]
        if number > 0:
            delta = delta @ layer.weight
    return logits.mT, found


class _Normalised(NamedTuple):
    """What batch normalisation needs on the way back; ``scale`` is weight / standard deviation."""

    z: Tensor
    scale: Tensor
    inverse_std: Tensor
    by_batch: bool


def _forward(layer: _Layer, x: Tensor) -> tuple[Tensor, _Normalised | None]:
    """Activations of a hidden layer, and what its normalisation needs on the way back."""
    z, norm, saved = affine(x, layer.weight, layer.bias), layer.norm, None
    if norm is not None:
        n, by_batch = z.shape[-2], z.shape[-2] > 1
        mean, variance = norm.running_mean, norm.running_var
        if by_batch:
            mean = z.mean(-2)
        z -= mean.unsqueeze(-2)
        if by_batch:
            variance = z.square().mean(-2)
            norm.running_mean.lerp_(mean, norm.momentum)
            norm.running_var.lerp_(variance * (n / (n - 1)), norm.momentum)
        inverse_std = (variance + norm.eps).rsqrt()
        scale = (norm.weight * inverse_std).unsqueeze(-2)
        saved = _Normalised(z, scale, inverse_std.unsqueeze(-2), by_batch)
        z = torch.addcmul(norm.bias.unsqueeze(-2), z, scale)
    return z.sigmoid_() if layer.units == "sigmoid" else z.relu_(), saved


def _backward(
    layer: _Layer, delta: Tensor, activation: Tensor, saved: _Normalised | None
) -> tuple[Tensor, list[tuple[Parameter, Tensor]]]:
    """From the gradient of a hidden layer's activations to that of its affine map, and of its normalisation."""
    if layer.units == "sigmoid":
        delta = torch.ops.aten.sigmoid_backward(delta, activation)
    else:
        delta = torch.ops.aten.threshold_backward(delta, activation, 0)
    if saved is None or layer.norm is None:
        return delta, []
    normalised = saved.z * saved.inverse_std
    shift, scale = delta.sum(-2), (delta * normalised).sum(-2)
    if saved.by_batch:
        n = delta.shape[-2]
        delta = delta.sub_((shift / n).unsqueeze(-2)).addcmul_(normalised, (scale / n).unsqueeze(-2), value=-1)
    return delta.mul_(saved.scale), [(layer.norm.bias, shift), (layer.norm.weight, scale)]


def _share_of_each(batch: Batch) -> float | Tensor:
    """What the loss of an image counts for in the step's mean: a number, or ``(*replicas, 1, n)``."""
    if batch.weight is None:
        return batch.share / batch.label.shape[-1]
    return (batch.share * batch.weight / batch.weight.sum(-1, keepdim=True)).unsqueeze(-2)
