"""What was measured for a figure: one line of JSON for each trained network and its replicas."""

import json
from collections.abc import Iterable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Generic, TypeVar

import numpy as np
from numpy.typing import NDArray

from memcomp_lightning.errors import require
from memcomp_lightning.files import write_text

LineT = TypeVar("LineT")


@dataclass(frozen=True, kw_only=True)
class Record:
    """One network of one curve, with its replicas.

    Attributes:
        curve: Name of the curve.
        choice: Value of the setting that is chosen on held-out images; None if nothing is.
        choosing: Whether this network was trained for the choice.
        iterations: Pretraining iterations N of each layer.
        seed: Of weights, chains and order.
        passes: Fine-tuning passes after which the network was tested.
        scores: For "test_accuracy", "test_loss" and, with held-out images, "validation_accuracy" and
            "validation_loss": a number for each pass and replica.
        pretrain_s: Seconds of pretraining.
        finetune_s: Seconds of fine-tuning and tests.
    """

    curve: str
    choice: float | None
    choosing: bool
    iterations: int
    seed: int
    passes: list[int]
    scores: dict[str, list[list[float]]]
    pretrain_s: float
    finetune_s: float

    @property
    def key(self) -> tuple[str, float | None, bool, int, int]:
        """What tells it from the other records."""
        return self.curve, self.choice, self.choosing, self.iterations, self.seed

    def score(self, name: str) -> NDArray[np.float64]:
        """``(n_passes, n_replicas)``."""
        return np.array(self.scores[name])

    def at_best_validation(self) -> NDArray[np.float64]:
        """Test accuracy at the tested pass of highest validation accuracy so far, ``(n_passes, n_replicas)``."""
        validation, test = self.score("validation_accuracy"), self.score("test_accuracy")
        best = np.array([validation[: k + 1].argmax(0) for k in range(len(validation))])
        return np.take_along_axis(test, best, axis=0)


class JsonLines(Generic[LineT]):
    """Records of one kind in a file, a line each, appended as soon as they exist.

    Args:
        path: The file; it need not exist.
        kind: Dataclass of a record.

    Raises:
        SettingError: A line of the file is damaged; an unfinished last line is dropped.
    """

    def __init__(self, path: Path, kind: type[LineT]) -> None:
        self.path = path
        self.all: list[LineT] = []
        lines = self.path.read_text(encoding="utf-8").splitlines() if self.path.exists() else []
        for number, line in enumerate(lines, start=1):
            try:
                self.all.append(kind(**json.loads(line)))
            except (json.JSONDecodeError, TypeError) as error:
                require(number == len(lines), f"{self.path}, line {number}", line[:40], f"a record ({error})")
                write_text(self.path, "".join(_line(record) for record in self.all))

    def append(self, records: Iterable[LineT]) -> None:
        """Add records to the list and to the file."""
        new = list(records)
        with self.path.open("a", encoding="utf-8") as file:
            file.write("".join(_line(record) for record in new))
        self.all += new


class Records(JsonLines[Record]):
    """Records of the folder of a figure, ``records.jsonl``."""

    def __init__(self, folder: Path) -> None:
        super().__init__(folder / "records.jsonl", Record)

    def has(self, curve: str, choice: float | None, choosing: bool, iterations: int, seed: int) -> bool:
        """Whether this network was measured already."""
        return (curve, choice, choosing, iterations, seed) in {record.key for record in self.all}

    def best_choice(self, curve: str) -> float | None:
        """The value with the highest accuracy on held-out training images, over all passes and replicas."""
        tried = [record for record in self.all if record.curve == curve and record.choosing]
        if not tried:
            return None
        return max(tried, key=lambda record: record.score("validation_accuracy").mean()).choice

    def of(self, curve: str) -> list[Record]:
        """The records of a curve that are reported, by N and seed; with a choice, those of the chosen value."""
        chosen = self.best_choice(curve)
        own = [r for r in self.all if r.curve == curve and not r.choosing and r.choice == chosen]
        return sorted(own, key=lambda record: (record.iterations, record.seed))


def _line(record: Any) -> str:
    return json.dumps(asdict(record)) + "\n"
