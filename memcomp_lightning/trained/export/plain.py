"""Networks in torch's own layers: what runs where this package is not installed."""

import copy
from collections.abc import Callable, Iterator
from itertools import islice
from typing import NamedTuple

import torch
from torch import Tensor, nn

from memcomp_lightning import rng
from memcomp_lightning.errors import UserError
from memcomp_lightning.models import (
    DBN,
    RBM,
    BatchNorm,
    BatchNormReluNetwork,
    BoltzmannMachine,
    Linear,
)
from memcomp_lightning.models.units import Bernoulli, Categorical, Gaussian, Spin, Units
from memcomp_lightning.trained.export.base import CLASSIFIER
from memcomp_lightning.trained.run import Run
from memcomp_lightning.trained.values import visible_of

TOLERANCE = 1e-4
"""Outputs of what was written differ from the network's by less, relative to them where they are above one."""

N_CHECKED = 32
"""Rows that outputs are compared on, in one batch and one alone."""


class Plain(NamedTuple):
    """A network of torch's own layers.

    Attributes:
        network: Values of the visible units, ``(n, n_visible)``, to outputs ``(n, n_outputs)``.
        own: The same by the run's own network.
        examples: Values that the visible units may have, ``(N_CHECKED, n_visible)``.
        inputs: Names of the visible units.
        outputs: Names of the outputs.
        output: What these are: "hidden_means" or "logits".
    """

    network: nn.Sequential
    own: Callable[[Tensor], Tensor]
    examples: Tensor
    inputs: list[str]
    outputs: list[str]
    output: str

    @property
    def inputs_in_words(self) -> str:
        """The inputs, for people."""
        return _in_words("v", self.examples, self.inputs)

    @property
    def outputs_in_words(self) -> str:
        """The outputs, for people."""
        return _in_words(self.output, self.examples, self.outputs)


def plain(run: Run, what: str) -> Plain:
    """The classifier of a run, or its feature map: the means of the hidden units of its top layer.

    Raises:
        UserError: There is no classifier; the means take an iteration.
    """
    own: Callable[[Tensor], Tensor]
    if what == CLASSIFIER:
        if run.classifier is None:
            raise UserError(f"{run.path} has no classifier: choose what=features, or train one with labels.")
        layers, own = list(_layers(run.classifier)), run.classifier.eval()
    else:
        layers = list(_feature_layers(run))
        own = run.network if isinstance(run.network, DBN) else run.model.hidden_mean
    network = nn.Sequential(*layers).cpu().eval().requires_grad_(False)
    examples = _examples(run, network)
    with torch.no_grad():
        n = own(examples).shape[-1]
    inputs = entry_names(run, examples.shape[-1])
    if what == CLASSIFIER:
        classes = run.schema.class_names if run.schema is not None else [str(k) for k in range(n)]
        return Plain(network, own, examples, inputs, classes, "logits")
    return Plain(network, own, examples, inputs, [f"h{k + 1}" for k in range(n)], "hidden_means")


def entry_names(run: Run, n: int) -> list[str]:
    """Names of the visible units, ``v1``, ``v2``, ... where there is no schema."""
    return run.schema.entry_names if run.schema is not None else [f"v{k + 1}" for k in range(n)]


@torch.no_grad()
def compared(own: Callable[[Tensor], Tensor], other: Callable[[Tensor], Tensor], examples: Tensor) -> str:
    """Compare what a run computes with what was made of it, in batches of several rows and of one.

    Raises:
        UserError: They differ by more than :data:`TOLERANCE`, or a number is NaN.
    """
    largest = 0.0
    for v in (examples, examples[:1]):
        expected = own(v).double()
        difference = (other(v).double() - expected).abs() / expected.abs().clamp(min=1.0)
        largest = max(largest, float(difference.nan_to_num(nan=torch.inf).max()))
    if largest > TOLERANCE:
        raise UserError(
            f"the outputs of what was written are off by {largest:.2g}, more than {TOLERANCE:g}, and was "
            "removed: choose format=safetensors, which keeps every bit."
        )
    return f"largest difference {largest:.1g} over {len(examples)} rows"


class Means(nn.Module):
    """Means of units that no layer of torch has."""

    def __init__(self, units: Units) -> None:
        super().__init__()
        self.units = units

    def forward(self, field: Tensor) -> Tensor:
        """E[x | field]."""
        return self.units.mean(field)


def _feature_layers(run: Run) -> Iterator[nn.Module]:
    network = run.network
    if isinstance(network, DBN | RBM):
        yield from _layers(network)
        return
    if not isinstance(network, BoltzmannMachine):
        raise UserError(
            f"{run.path} is a {type(network).__name__}, which has no hidden means: use what=classifier."
        )
    if not network.n_hidden:
        raise UserError(f"{run.path} has no hidden units, hence no features: use format=safetensors or couplings.")
    if bool((network.pairs >= network.n_visible).all(-1).any()):
        raise UserError(
            f"{run.path} is a {type(network).__name__} with couplings between hidden units: their means take an "
            "iteration, which no such file holds. Use memcomp-transform, or format=safetensors."
        )
    yield from _mean_layers(network.weight, network.c, network.hidden)


def _layers(module: nn.Module) -> Iterator[nn.Module]:
    """Torch's layers for a part of a network; parts that are no part of this package stay."""
    if isinstance(module, nn.Sequential):
        for part in module:
            yield from _layers(part)
    elif isinstance(module, BatchNormReluNetwork):
        yield from _layers(module.layers)
    elif isinstance(module, DBN):
        for rbm in module:
            yield from _layers(rbm)
    elif isinstance(module, RBM):
        yield from _mean_layers(module.weight, module.c, module.hidden)
    elif isinstance(module, Linear):
        yield _linear(module.weight, module.bias)
    elif isinstance(module, BatchNorm):
        yield _batch_norm(module)
    elif not isinstance(module, nn.Dropout):
        yield copy.deepcopy(module)


def _mean_layers(weight: Tensor, bias: Tensor, hidden: Units) -> Iterator[nn.Module]:
    if isinstance(hidden, Gaussian):
        yield _linear(weight / hidden.precision.unsqueeze(-1), bias / hidden.precision)
        return
    yield _linear(weight, bias)
    if isinstance(hidden, Bernoulli):
        yield nn.Sigmoid()
    elif isinstance(hidden, Spin):
        yield nn.Tanh()
    elif isinstance(hidden, Categorical) and len(set(hidden.sizes)) == 1:
        yield from (nn.Unflatten(-1, (hidden.n_sites, hidden.sizes[0])), nn.Softmax(-1), nn.Flatten(-2))
    else:
        yield Means(copy.deepcopy(hidden))


@torch.no_grad()
def _linear(weight: Tensor, bias: Tensor) -> nn.Linear:
    made = nn.Linear(weight.shape[-1], weight.shape[-2], device="meta").to_empty(device="cpu").to(weight.dtype)
    made.weight.copy_(weight)
    made.bias.copy_(bias)
    return made


@torch.no_grad()
def _batch_norm(layer: BatchNorm) -> nn.BatchNorm1d:
    made = nn.BatchNorm1d(layer.weight.shape[-1], eps=layer.eps, momentum=layer.momentum).to(layer.weight.dtype)
    for name in ("weight", "bias", "running_mean", "running_var"):
        getattr(made, name).copy_(getattr(layer, name))
    return made


@torch.no_grad()
def _examples(run: Run, network: nn.Module) -> Tensor:
    """Draw what the visible units are without any field; bits for a network that has none."""
    first = next(iter(network.parameters()))
    try:
        units = visible_of(run)
    except UserError:
        units = (run.schema.units() if run.schema else None) or Bernoulli(first.shape[-1])
    field = torch.zeros(N_CHECKED, units.n, dtype=first.dtype, device="cpu")
    return units.sample(field, generator=rng.stream(0, "export check"))


def _in_words(name: str, examples: Tensor, names: list[str]) -> str:
    shown = ", ".join(islice(names, 8)) + (", ..." if len(names) > 8 else "")
    return f"{name}, (rows, {len(names)}) {str(examples.dtype).removeprefix('torch.')}: {shown}"
