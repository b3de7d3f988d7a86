"""Courses of training by many samplers: the best learning rate of each, and what mode assistance brings."""

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import stats

from memcomp_lightning.report.records import JsonLines
from memcomp_lightning.report.verdicts import FAILS, HOLDS, Verdict


@dataclass(frozen=True)
class Course:
    """One method at one learning rate on one data set, all its replicas.

    Attributes:
        data_set: Name.
        method: Name.
        rate: Learning rate.
        updates: Updates done at each measurement.
        seconds: Seconds of training until then, of all replicas side by side.
        scores: Divergence or negative log-likelihood in nats, by measurement and replica: less is better.
        cosines: Cosine of the mean gradient with the exact one, likewise.
        errors: Relative error of the mean gradient, likewise.
    """

    data_set: str
    method: str
    rate: float
    updates: list[int]
    seconds: list[float]
    scores: list[list[float]]
    cosines: list[list[float]]
    errors: list[list[float]]

    @property
    def key(self) -> tuple[str, str, float]:
        """What tells it from the others."""
        return self.data_set, self.method, self.rate


class Courses(JsonLines[Course]):
    """Courses of a folder, ``courses.jsonl``."""

    def __init__(self, folder: Path) -> None:
        super().__init__(folder / "courses.jsonl", Course)


class End(NamedTuple):
    """A method at its best learning rate after its last update: nats, less is better."""

    rate: float
    median: float
    worst: float
    seconds: float


class Worth:
    """The courses of a folder, each method at the learning rate that other replicas than the reported chose."""

    def __init__(self, plan: dict[str, Any], courses: Sequence[Course]) -> None:
        self.plan = plan
        self._courses: dict[tuple[str, str], list[Course]] = {}
        for course in courses:
            if course.data_set in plan["data_sets"] and course.method in plan["methods"]:
                self._courses.setdefault((course.data_set, course.method), []).append(course)

    @property
    def data_sets(self) -> list[str]:
        """Those of which something was measured."""
        return [name for name in self.plan["data_sets"] if any(found == name for found, _ in self._courses)]

    def methods(self, data_set: str) -> list[str]:
        """Those that were measured on a data set, in the order of the legend."""
        return [name for name in self.plan["methods"] if (data_set, name) in self._courses]

    def best(self, data_set: str, method: str) -> Course:
        """The course of lowest median at the end, by the replicas that choose."""
        return min(self._courses[data_set, method], key=lambda course: float(np.median(self._choosing(course))))

    def values(self, course: Course, name: str = "scores") -> NDArray[np.float64]:
        """``(n_points, replicas)`` of the replicas that are reported."""
        return np.array(getattr(course, name), dtype=float)[:, : self.plan["replicas"]]

    def _choosing(self, course: Course) -> NDArray[np.float64]:
        return np.array(course.scores[-1], dtype=float)[self.plan["replicas"] :]

    def end(self, data_set: str, method: str) -> End:
        """What is reported of a method."""
        course = self.best(data_set, method)
        scores = self.values(course)[-1]
        return End(course.rate, float(np.median(scores)), float(scores.max()), course.seconds[-1])

    def opponent(self, data_set: str, method: str) -> str | None:
        """The best baseline that takes at most a tenth more time, by the replicas that choose."""
        limit = 1.1 * self.end(data_set, method).seconds
        measured = self.methods(data_set)
        able = [
            name
            for name in self.plan["baselines"]
            if name in measured and self.end(data_set, name).seconds <= limit
        ]
        return min(able, key=lambda n: float(np.median(self._choosing(self.best(data_set, n)))), default=None)


WORTH_RULE = (
    "Learning rates and opponents are chosen by replicas that are not reported. A method is better if its median "
    "is lower (Mann-Whitney, two-sided, p < .05) and its worst replica is no worse than that of the best baseline "
    "which takes at most a tenth more time."
)


def worth_verdicts(worth: Worth) -> list[Verdict]:
    """Judge the claimed methods on each data set."""
    found = []
    for data_set in worth.data_sets:
        for method in worth.plan["claimed"]:
            if method not in worth.methods(data_set) or (opponent := worth.opponent(data_set, method)) is None:
                continue
            mine, other = worth.end(data_set, method), worth.end(data_set, opponent)
            scores = [worth.values(worth.best(data_set, name))[-1] for name in (method, opponent)]
            p = float(stats.mannwhitneyu(*scores).pvalue)
            better = mine.median < other.median and p < 0.05 and mine.worst <= other.worst
            measured = f"{mine.median:.4g} (worst {mine.worst:.4g}) against {other.median:.4g} ({other.worst:.4g})"
            label, against = (worth.plan["methods"][name]["label"] for name in (method, opponent))
            found.append(
                Verdict(
                    f"{worth.plan['data_sets'][data_set]['label']}: {label} beats {against}",
                    f"median {measured}",
                    f"{mine.seconds:.1f} s and {other.seconds:.1f} s, p = {p:.2g}",
                    HOLDS if better else FAILS,
                )
            )
    return found


def worth_table(worth: Worth) -> list[list[str]]:
    """A row for each data set and method, with a header."""
    rows = [["data set", "method", "best rate", "median", "worst", "seconds", "us an update and replica"]]
    for data_set in worth.data_sets:
        for method in worth.methods(data_set):
            end, course = worth.end(data_set, method), worth.best(data_set, method)
            each = 1e6 * end.seconds / course.updates[-1] / len(course.scores[-1])
            cells = [f"{end.median:.4g}", f"{end.worst:.4g}", f"{end.seconds:.1f}", f"{each:.1f}"]
            labels = [
                worth.plan[kind][name]["label"] for kind, name in (("data_sets", data_set), ("methods", method))
            ]
            rows.append([*labels, f"{end.rate:g}", *cells])
    return rows


def read_worth(folder: Path) -> Worth:
    """Read the folder of a run of ``experiment=sampler_worth``.

    Raises:
        FileNotFoundError: It holds none.
    """
    path = folder / "worth.json"
    if not path.exists():
        raise FileNotFoundError(f"{folder} holds no worth.json: name the folder of experiment=sampler_worth.")
    return Worth(json.loads(path.read_text(encoding="utf-8")), Courses(folder).all)
