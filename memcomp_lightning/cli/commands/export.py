"""``memcomp-export``: a trained run for other programs."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from memcomp_lightning.cli.output import say
from memcomp_lightning.cli.products import OfRun, Usage, carry_out
from memcomp_lightning.trained.export import check_export, export


@dataclass(frozen=True)
class Settings(OfRun):
    """Settings of ``memcomp-export``.

    Attributes:
        output: The file: .safetensors, .pt2, .onnx, .pt, .h5, or .csv and .parquet for couplings.
        format: safetensors, torch_export, onnx, sequential, rbms or couplings; null is that of the file's ending.
        what: classifier, features (means of the top hidden layer) or model; null is the classifier where there is
            one, else the features; safetensors, rbms and couplings hold the model.
        overwrite: Whether a file that is there is replaced.
    """

    output: str = "model.safetensors"
    format: str | None = None
    what: str | None = None
    overwrite: bool = False


USAGE = Usage(
    "memcomp-export",
    "write a trained run to a file for other programs, and check what was written.",
    ("RUN",),
    Settings,
    [
        (
            "memcomp-export runs/people",
            "all of it, in model.safetensors: every command takes that file in place of RUN",
        ),
        ("memcomp-export runs/people format=onnx output=people.onnx", "the classifier, for onnxruntime"),
        (
            "memcomp-export runs/people output=people.pt2 what=features",
            "hidden means, as a program of torch.export",
        ),
    ],
)


def act(places: Sequence[str], settings: Settings) -> None:
    """Export a run."""
    output, what, overwrite = Path(settings.output), settings.what, settings.overwrite
    format = check_export(output, format=settings.format, what=what, overwrite=overwrite)
    run = settings.load(places[0])
    written = export(run, output, format=format, what=what, overwrite=overwrite)
    say(f"{output}: {written.holds}")
    for name in ("inputs", "outputs", "check", "use"):
        if text := getattr(written, name):
            say(f"  {name}: {text}")


def main(arguments: Sequence[str] | None = None) -> None:
    """Entry point."""
    carry_out(USAGE, act, arguments)
