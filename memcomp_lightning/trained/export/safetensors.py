"""safetensors: all that a run holds, in tensors and a header of JSON; reading it runs no code."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from memcomp_lightning import __version__
from memcomp_lightning.data.schema import schema_of
from memcomp_lightning.errors import SettingError, UserError
from memcomp_lightning.files import written_whole
from memcomp_lightning.modules import CheckpointError
from memcomp_lightning.trained.described import described, made
from memcomp_lightning.trained.export.base import Written
from memcomp_lightning.trained.run import Run

HEADER = "memcomp_lightning"
"""The entry of the header that holds the JSON."""

_FORMAT = 1
_KEPT = ("seed", "model", "units", "sampler", "pretrain", "finetune")
"""Groups of settings that say how it was trained; what says where files lay stays at home."""


def write(run: Run, path: Path, what: str) -> Written:
    """Write the weights of the network and of the classifier, kinds and sizes, schema, settings of training."""
    from safetensors.torch import save

    parts = _parts(run.network, run.classifier)
    tensors = {
        f"{name}.{key}": x.detach().cpu().clone().contiguous()
        for name, part in parts.items()
        for key, x in part.state_dict().items()
    }
    content = {
        "format": _FORMAT,
        "version": __version__,
        "networks": {name: described(part) for name, part in parts.items()},
        "schema": None if run.schema is None else run.schema.as_json(),
        "pretrained": run.pretrained,
        "settings": {name: x for name, x in (run.settings or {}).items() if name in _KEPT},
    }
    with written_whole(path) as partial:
        partial.write_bytes(save(tensors, metadata={HEADER: json.dumps(content)}))
        again = read(partial)
        for name, part in _parts(again.network, again.classifier).items():
            for key, x in part.state_dict().items():
                if not x.equal(tensors[f"{name}.{key}"]):
                    raise UserError(f"{name}.{key} does not come back as it is: it was not written. Is it finite?")
    use = f'run = memcomp_lightning.load("{path}")'
    return Written(" and ".join(parts), check=f"{len(tensors)} tensors read back, the same to the bit", use=use)


def read(path: Path) -> Run:
    """Read a run that :func:`write` wrote; nothing in the file is executed.

    Raises:
        CheckpointError: The file is truncated, or is not one of these.
    """
    try:
        from safetensors import SafetensorError, safe_open
    except ImportError as error:
        raise UserError(f"{path}: to read it, safetensors is needed: pip install safetensors") from error
    if not path.is_file():
        raise CheckpointError(f"checkpoint {path} does not exist.")
    try:
        with safe_open(path, framework="pt", device="cpu") as file:
            header = (file.metadata() or {}).get(HEADER)
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118 (no mapping)
    except (SafetensorError, OSError) as error:
        raise CheckpointError(f"checkpoint {path} is truncated or damaged: {error}") from error
    if header is None:
        raise CheckpointError(
            f"checkpoint {path} does not say which network its tensors are of: memcomp-export did not write it."
        )
    try:
        content = json.loads(header)
        networks = {name: _network(name, kinds, tensors) for name, kinds in content["networks"].items()}
        schema = None if content["schema"] is None else schema_of(content["schema"])
        pretrained = bool(content.get("pretrained", True))
        return Run(path, networks["network"], networks.get("classifier"), schema, content["settings"], pretrained)
    except (KeyError, TypeError, ValueError, RuntimeError, AttributeError, SettingError) as error:
        raise CheckpointError(
            f"checkpoint {path} is damaged, or of a later version than {__version__}: "
            f"{type(error).__name__}: {str(error).partition(chr(10))[0]}"
        ) from error


def _parts(network: nn.Module, classifier: nn.Module | None) -> dict[str, nn.Module]:
    return {"network": network} | ({} if classifier is None else {"classifier": classifier})


@torch.no_grad()
def _network(name: str, description: Mapping[str, Any], tensors: Mapping[str, Tensor]) -> nn.Module:
    begin = f"{name}."
    return made(description, {key.removeprefix(begin): x for key, x in tensors.items() if key.startswith(begin)})
