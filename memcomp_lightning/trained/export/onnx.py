"""ONNX: the classifier or the feature map, checked against onnxruntime."""

import json
from pathlib import Path

import torch
from torch import Tensor

from memcomp_lightning.errors import UserError
from memcomp_lightning.files import written_whole
from memcomp_lightning.trained.export.base import Written
from memcomp_lightning.trained.export.header import header
from memcomp_lightning.trained.export.plain import Plain, compared, plain
from memcomp_lightning.trained.export.torch_export import program, quiet
from memcomp_lightning.trained.run import Run


def write(run: Run, path: Path, what: str) -> Written:
    """Write one file with its weights inside, for batches of any size; its metadata say what the inputs are."""
    import onnxruntime

    found = plain(run, what)
    with written_whole(path) as partial:
        _write(run, found, partial)
        session = onnxruntime.InferenceSession(partial.read_bytes(), providers=["CPUExecutionProvider"])

        def by_onnxruntime(v: Tensor) -> Tensor:
            return torch.from_numpy(session.run(None, {"v": v.numpy()})[0])

        check = f"onnxruntime: {compared(found.own, by_onnxruntime, found.examples)}"
    use = f'onnxruntime.InferenceSession("{path}").run(None, {{"v": v}})'
    return Written(what, found.inputs_in_words, found.outputs_in_words, check, use)


def _write(run: Run, found: Plain, path: Path) -> None:
    with quiet():
        try:
            made = torch.onnx.export(
                program(found), dynamo=True, input_names=["v"], output_names=[found.output], verbose=False
            )
        except torch.onnx.OnnxExporterError as error:
            raise UserError(
                f"{run.path}: ONNX has no operation for the means of its hidden units "
                f"({type(run.model.hidden).__name__}). Choose format=torch_export."
            ) from error
    assert made is not None
    made.model.metadata_props["memcomp_lightning"] = json.dumps(header(run, found))
    made.save(path, external_data=False)
