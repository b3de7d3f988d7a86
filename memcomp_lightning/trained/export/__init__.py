"""A trained run for other programs: one file for each format."""

from collections.abc import Sequence
from importlib.util import find_spec
from pathlib import Path

from memcomp_lightning.data.written import check_output
from memcomp_lightning.errors import UserError, require, require_choice
from memcomp_lightning.trained.export import couplings, onnx, rbms, safetensors, sequential, torch_export
from memcomp_lightning.trained.export.base import CLASSIFIER, FEATURES, MODEL, Format, Written
from memcomp_lightning.trained.run import Run

__all__ = ["FORMATS", "Format", "Written", "check_export", "export"]

_NETWORKS = (CLASSIFIER, FEATURES)

FORMATS: dict[str, Format] = {
    "safetensors": Format(
        "weights, schema and kinds of units: load gives the run back",
        (".safetensors",),
        (MODEL,),
        ("safetensors",),
        safetensors.write,
    ),
    "torch_export": Format("a program for torch alone", (".pt2",), _NETWORKS, (), torch_export.write),
    "onnx": Format(
        "for onnxruntime and others", (".onnx",), _NETWORKS, ("onnx", "onnxscript", "onnxruntime"), onnx.write
    ),
    "sequential": Format(
        "weights for an nn.Sequential of torch", (".pt", ".pth"), _NETWORKS, (), sequential.write
    ),
    "rbms": Format("HDF5 of the library rbms", (".h5", ".hdf5"), (MODEL,), ("h5py",), rbms.write),
    "couplings": Format(
        "weights, biases, couplings and contacts by name",
        (".csv", ".csv.gz", ".tsv", ".parquet"),
        (MODEL,),
        (),
        couplings.write,
    ),
}
"""Every format by its name."""


def check_export(
    path: Path, *, format: str | None = None, what: str | None = None, overwrite: bool = False
) -> str:
    """The name of the format; refuse, before a run is read, what cannot be written.

    Raises:
        UserError, SettingError: The ending is none of the format's, a package is missing, the file is there.
    """
    if format is None:
        format = next((name for name, one in FORMATS.items() if path.name.lower().endswith(one.endings)), None)
    if format is None:
        endings = ", ".join(ending for one in FORMATS.values() for ending in one.endings)
        raise UserError(f"output={path}: expected a file that ends in {endings}.")
    require_choice("format", format, tuple(FORMATS))
    chosen = FORMATS[format]
    if what is not None:
        require(what in chosen.what, "what", what, f"{' or '.join(chosen.what)}, for format={format}")
    missing = [package for package in chosen.packages if find_spec(package) is None]
    if missing:
        raise UserError(
            f"format={format} needs {missing[0]}, which is not installed: pip install {' '.join(missing)}"
        )
    check_output(path, overwrite=overwrite, endings=chosen.endings)
    return format


def export(
    run: Run, path: str | Path, *, format: str | None = None, what: str | None = None, overwrite: bool = False
) -> Written:
    """Write a run to a file for other programs, and compare what was written with it.

    Args:
        run: A trained run.
        path: The file, which is written whole or not at all.
        format: A name of :data:`FORMATS`; None is that of the file's ending.
        what: "classifier", "features" (means of the top hidden layer) or "model"; None is what the format can
            hold, the classifier where there is one.
        overwrite: Whether a file that is there is replaced.

    Raises:
        UserError, SettingError: See :func:`check_export`; the run has no such thing, or the file cannot hold it.
    """
    path = Path(path)
    chosen = FORMATS[check_export(path, format=format, what=what, overwrite=overwrite)]
    return chosen.write(run, path, what or _default(run, chosen.what))


def _default(run: Run, choices: Sequence[str]) -> str:
    return FEATURES if choices == _NETWORKS and run.classifier is None else choices[0]
