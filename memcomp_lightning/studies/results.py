"""The records of a figure as curves, points and tables."""

import math
from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from memcomp_lightning.errors import require_choice
from memcomp_lightning.files import as_csv, read_json
from memcomp_lightning.studies.records import Record, Records


@dataclass(frozen=True, kw_only=True)
class Claim:
    """One curve is said to be better than another.

    Attributes:
        better: Name of a curve.
        than: Name of the other.
        controls: Curves that may explain the difference; None for all that are in no claim and control no other.
    """

    better: str
    than: str
    controls: list[str] | None = None

    @property
    def curves(self) -> tuple[str, str]:
        """Both, as the legend has them."""
        return self.than, self.better


class Point(NamedTuple):
    """Mean accuracy over partitions and seeds, and its standard error sigma / sqrt(n) (NaN for a single one)."""

    mean: float
    error: float
    n: int

    def __str__(self) -> str:
        """For tables."""
        return f"{self.mean:.3f}" + (f" ± {self.error:.3f}" if self.n > 1 else "")


@dataclass(frozen=True, kw_only=True)
class FigurePlan:
    """What a figure shows.

    Attributes:
        name: "figure4" and so on; begins the names of its files.
        against: Axis of the curves, "iterations" or "passes".
        passes: Fine-tuning passes after which the networks were tested.
        labels: Names for people, by curve, in the order of the legend.
        chosen: The setting that is chosen on held-out images, by curve.
        stop_early: Curves that report the pass of best validation accuracy.
        scale: Sizes that a reader should know: partitions, training images, seeds.
    """

    name: str
    title: str
    data: str
    against: str
    passes: Sequence[int]
    claims: Sequence[Claim]
    labels: Mapping[str, str]
    chosen: Mapping[str, str]
    stop_early: Sequence[str]
    scale: str

    def __post_init__(self) -> None:
        require_choice("figure.against", self.against, ("iterations", "passes"))
        for curve in self.claimed:
            require_choice("figure.claims", curve, tuple(self.labels))
        for claim in self.claims:
            for curve in claim.controls or ():
                require_choice("controls of figure.claims", curve, tuple(self.labels))

    @classmethod
    def of(cls, settings: Mapping[str, Any]) -> "FigurePlan":
        """From the plain values of ``figure.json``."""
        return cls(**{**settings, "claims": [Claim(**claim) for claim in settings["claims"]]})

    @property
    def claimed(self) -> list[str]:
        """Curves of all claims, in the order of the legend."""
        return [curve for claim in self.claims for curve in claim.curves]

    def controls(self, claim: Claim) -> list[str]:
        """Curves that may explain a claim."""
        if claim.controls is not None:
            return list(claim.controls)
        taken = {curve for other in self.claims for curve in (*other.curves, *(other.controls or ()))}
        return [curve for curve in self.labels if curve not in taken]


class Results:
    """Accuracies of a figure by curve, pretraining iterations, pass, and pair of seed and partition."""

    def __init__(self, plan: FigurePlan, records: Records) -> None:
        self.plan = plan
        self.chosen: dict[str, float | None] = {curve: records.best_value(curve) for curve in plan.labels}
        self._values: dict[str, dict[int, dict[int, NDArray[np.float64]]]] = {}
        self.seconds = sum(record.seconds[-1] for record in records.all)
        seeds = {record.seed for record in records.all if not record.choosing}
        for curve in plan.labels:
            by_length = defaultdict(list)
            for record in records.of(curve):
                early = curve in plan.stop_early
                accuracy = at_best_validation(record) if early else record.measured("test_accuracy")
                by_length[record.iterations or 0].append(accuracy)
            # A point counts once all seeds have trained: differences are between pairs.
            whole = {n: parts for n, parts in by_length.items() if len(parts) == len(seeds)}
            if whole:
                self._values[curve] = {
                    n: dict(zip(plan.passes, np.concatenate(parts, axis=1), strict=True))
                    for n, parts in whole.items()
                }

    @property
    def curves(self) -> list[str]:
        """Curves of which something was measured, in the order of the legend."""
        return list(self._values)

    def lengths(self, curve: str) -> list[int]:
        """Pretraining iterations that were measured."""
        return sorted(self._values.get(curve, {}))

    def values(self, curve: str, iterations: int, passes: int) -> NDArray[np.float64]:
        """Test accuracies, ``(n_seeds * n_partitions,)``."""
        return self._values[curve][iterations][passes]

    def point(self, curve: str, iterations: int, passes: int) -> Point:
        """Mean and standard error."""
        values = self.values(curve, iterations, passes)
        n = len(values)
        error = float(values.std(ddof=1)) / math.sqrt(n) if n > 1 else math.nan
        return Point(float(values.mean()), error, n)

    def last(self, curve: str, passes: int) -> Point:
        """The point of most pretraining iterations."""
        return self.point(curve, self.lengths(curve)[-1], passes)

    def label(self, curve: str) -> str:
        """Name of a curve, with the value that was chosen for it."""
        value = self.chosen.get(curve)
        setting = self.plan.chosen.get(curve, "").rpartition(".")[2]
        return self.plan.labels[curve] + (f" ({setting} = {value:g})" if value is not None else "")

    def table(self) -> str:
        """Every point as CSV."""
        rows: list[list[object]] = [["curve", "label", "iterations", "passes", "mean", "standard_error", "n"]]
        for curve in self.curves:
            for iterations in self.lengths(curve):
                for passes in self.plan.passes:
                    point = self.point(curve, iterations, passes)
                    rows.append([curve, self.label(curve), iterations, passes, *point])
        return as_csv(rows)


def at_best_validation(record: Record) -> NDArray[np.float64]:
    """Test accuracy at the tested pass of highest validation accuracy so far, ``(n_passes, n_replicas)``."""
    validation, test = record.measured("validation_accuracy"), record.measured("test_accuracy")
    best = np.array([validation[: k + 1].argmax(0) for k in range(len(validation))])
    return np.take_along_axis(test, best, axis=0)


def read_results(folder: Path) -> Results:
    """Read the folder of a run of a figure; a FileNotFoundError if it holds none."""
    path = folder / "figure.json"
    if not path.exists():
        raise FileNotFoundError(
            f"{folder} holds no figure.json: name the folder of a run like memcomp-train experiment=figure4."
        )
    return Results(FigurePlan.of(read_json(path)), Records(folder))
