"""What was measured in a study: one line of JSON for each trial and its replicas."""

import json
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass, fields
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from memcomp_lightning.errors import require
from memcomp_lightning.files import made_of, naming, write_text

Measures = dict[str, list[list[float]]]
Key = tuple[str, str, float | None, str, int | None, int | None, bool, int | None]


@dataclass(frozen=True, kw_only=True)
class Named:
    """What tells trials from each other, and their records.

    Attributes:
        method: What was trained: a curve of a figure, a method of a comparison.
        data_set: Name of the data set; "" in a study of one.
        value: Of the setting that held-out data choose; None if nothing is chosen.
        setting: All of them where they choose several, as JSON.
        iterations: Pretraining iterations N of each layer; None where the method says how many.
        seed: Of weights, chains and order; None where each replica has its own.
        choosing: Whether the trial only serves the choice: held-out data then judge it.
        labels: How many rows have a label; None where the data set says how many.
    """

    method: str
    data_set: str = ""
    value: float | None = None
    setting: str = ""
    iterations: int | None = None
    seed: int | None = None
    choosing: bool = False
    labels: int | None = None

    @property
    def key(self) -> Key:
        """All of it."""
        chosen = self.value, self.setting, self.iterations
        return self.data_set, self.method, *chosen, self.seed, self.choosing, self.labels


@dataclass(frozen=True, kw_only=True)
class Record(Named):
    """What one trial left.

    Attributes:
        at: Passes of fine-tuning, or updates, after which it was measured.
        seconds: Of training until each measurement.
        measures: By name, a number for each measurement and replica.
        held_out: What held-out data say of the trial, more is better; None where they do not judge it.
    """

    at: list[int]
    seconds: list[float]
    measures: Measures
    held_out: float | None = None

    @classmethod
    def of(cls, trial: Named, *, at: list[int], seconds: list[float], measures: Measures) -> "Record":
        """What a trial leaves, not judged yet."""
        names = {field.name: getattr(trial, field.name) for field in fields(Named)}
        return cls(**names, at=at, seconds=seconds, measures=measures)

    def measured(self, name: str) -> NDArray[np.float64]:
        """A measure, ``(n_measurements, n_replicas)``."""
        return np.array(self.measures[name], dtype=float)


def best(records: Iterable[Record]) -> Record | None:
    """The record that held-out data judge best, the first of equals; None where they judge none."""
    judged = [record for record in records if record.held_out is not None]
    return max(judged, key=lambda record: record.held_out or 0.0, default=None)


class Records:
    """The records of a folder, each a line of a file, appended as soon as it exists; there may be no file yet.

    Raises:
        SettingError: A line of the file is damaged; an unfinished last line is dropped.
    """

    def __init__(self, folder: Path, file: str = "records.jsonl") -> None:
        self.path = folder / file
        self.all: list[Record] = []
        # Bytes that are no UTF-8 damage the line that they are in.
        text = self.path.read_text(encoding="utf-8", errors="replace") if self.path.exists() else ""
        lines = text.removesuffix("\n").split("\n") if text else []
        for number, line in enumerate(lines, start=1):
            try:
                self.all.append(made_of(Record, json.loads(line)))
            except (ValueError, RecursionError) as error:
                require(number == len(lines), f"{self.path}, line {number}", line[:40], f"a record ({error})")
        if len(self.all) < len(lines) or (
            text and not text.endswith("\n")
        ):  # the next record is a line of its own
            write_text(self.path, "".join(_line(record) for record in self.all))

    def append(self, records: Sequence[Record]) -> None:
        """Add records to the list and to the file."""
        with naming(self.path), self.path.open("a", encoding="utf-8") as file:
            file.write("".join(_line(record) for record in records))
        self.all += records

    @property
    def keys(self) -> set[Key]:
        """Of all that was measured."""
        return {record.key for record in self.all}

    def best_value(self, method: str) -> float | None:
        """The value that held-out data choose for a method; None where nothing is chosen, or was tried."""
        found = best(record for record in self.all if record.method == method)
        return None if found is None else found.value

    def of(self, method: str) -> list[Record]:
        """The records of a method that are reported, by N and seed; with a choice, those of the chosen value."""
        chosen = self.best_value(method)
        own = [r for r in self.all if r.method == method and not r.choosing and r.value == chosen]
        return sorted(own, key=lambda record: (record.iterations or 0, record.seed or 0))


def _line(record: Record) -> str:
    return json.dumps(asdict(record)) + "\n"
