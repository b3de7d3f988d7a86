"""A state dict for a plain ``nn.Sequential`` of torch's own layers, and the line that builds it."""

import io
from pathlib import Path
from typing import Any

import torch
from torch import nn

from memcomp_lightning.errors import UserError
from memcomp_lightning.files import written_whole
from memcomp_lightning.trained.export.base import Written
from memcomp_lightning.trained.export.plain import compared, plain
from memcomp_lightning.trained.run import Run


def write(run: Run, path: Path, what: str) -> Written:
    """Write the state dict of the classifier or of the feature map; ``use`` is the line that builds the module."""
    found, packed = plain(run, what), io.BytesIO()
    layers = [(type(layer), *_arguments(layer)) for layer in found.network]
    torch.save(found.network.state_dict(), packed)
    packed.seek(0)
    with torch.device("meta"):  # no weights are drawn
        again = nn.Sequential(*(kind(*given, **named) for kind, given, named in layers))
    again.load_state_dict(torch.load(packed, weights_only=True), assign=True)
    check = compared(found.own, again.eval(), found.examples)
    with written_whole(path) as partial:
        partial.write_bytes(packed.getvalue())
    calls = [
        f"nn.{kind.__name__}({', '.join([*map(repr, given), *(f'{name}={x!r}' for name, x in named.items())])})"
        for kind, given, named in layers
    ]
    other = "" if found.examples.dtype == torch.float32 else f".to({found.examples.dtype})"
    line = f"nn.Sequential({', '.join(calls)}){other}"
    use = f'network = {line}; network.load_state_dict(torch.load("{path}")); network.eval()'
    return Written(what, found.inputs_in_words, found.outputs_in_words, check, use)


def _arguments(layer: nn.Module) -> tuple[tuple[Any, ...], dict[str, Any]]:
    """What a layer of torch is made with.

    Raises:
        UserError: A layer that torch does not have.
    """
    if isinstance(layer, nn.Linear):
        return (layer.in_features, layer.out_features), {}
    if isinstance(layer, nn.BatchNorm1d):
        return (layer.num_features,), {"eps": layer.eps, "momentum": layer.momentum}
    if isinstance(layer, nn.Unflatten):
        return (layer.dim, layer.unflattened_size), {}
    if isinstance(layer, nn.Flatten):
        return (layer.start_dim,), {}
    if isinstance(layer, nn.Softmax):
        return (layer.dim,), {}
    if type(layer) in (nn.Sigmoid, nn.Tanh, nn.ReLU):
        return (), {}
    name = type(getattr(layer, "units", layer)).__name__
    raise UserError(f"torch has no layer for {name}: choose format=torch_export or format=safetensors.")
