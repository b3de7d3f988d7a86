"""torch.export: a program of the classifier or of the feature map, which torch runs without this package."""

import io
import json
import logging
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import torch

from memcomp_lightning.files import written_whole
from memcomp_lightning.trained.export.base import Written
from memcomp_lightning.trained.export.header import header
from memcomp_lightning.trained.export.plain import Plain, compared, plain
from memcomp_lightning.trained.run import Run


def write(run: Run, path: Path, what: str) -> Written:
    """Write a ``.pt2`` for batches of any size, with a file ``memcomp_lightning.json`` inside."""
    found, packed = plain(run, what), io.BytesIO()
    with quiet():
        extra = {"memcomp_lightning.json": json.dumps(header(run, found))}
        torch.export.save(program(found), packed, extra_files=extra)
        packed.seek(0)
        check = compared(found.own, torch.export.load(packed).module(), found.examples)
    with written_whole(path) as partial:
        partial.write_bytes(packed.getvalue())
    use = f'torch.export.load("{path}").module()(v)'
    return Written(what, found.inputs_in_words, found.outputs_in_words, check, use)


def program(found: Plain) -> Any:
    """The program of a network, whose number of rows is open."""
    shapes = ({0: torch.export.Dim("rows")},)
    return torch.export.export(found.network, (found.examples[:3],), dynamic_shapes=shapes)


@contextmanager
def quiet() -> Iterator[None]:
    """Without what torch says of its own insides, and of packages that it would know, too."""
    log = logging.getLogger("torch.onnx._internal.exporter._registration")
    before = log.level
    log.setLevel(logging.ERROR)
    try:
        with warnings.catch_warnings(action="ignore"):
            yield
    finally:
        log.setLevel(before)
