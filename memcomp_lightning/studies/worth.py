"""Courses of training by many samplers: the best learning rate of each, and what mode assistance brings."""

import json
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import stats

from memcomp_lightning.studies.records import JsonLines
from memcomp_lightning.studies.verdicts import FAILS, HOLDS, Verdict


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
        reverse: Scores by the partition function of reverse AIS, likewise; empty where it is not estimated.
        cosines: Cosine of the mean gradient with the exact one, likewise.
        errors: Relative error of the mean gradient, likewise.
    """

    data_set: str
    method: str
    rate: float
    updates: list[int] = field(default_factory=list)
    seconds: list[float] = field(default_factory=list)
    scores: list[list[float]] = field(default_factory=list)
    reverse: list[list[float]] = field(default_factory=list)
    cosines: list[list[float]] = field(default_factory=list)
    errors: list[list[float]] = field(default_factory=list)

    @property
    def key(self) -> tuple[str, str, float]:
        """What tells it from the others."""
        return self.data_set, self.method, self.rate

    def add(
        self, updates: int, seconds: float, scores: Sequence[list[float] | None], bias: Sequence[list[float]]
    ) -> None:
        """Append a measurement: the scores with those by reverse AIS, cosines and errors."""
        values, reverse = scores
        assert values is not None
        self.updates.append(updates)
        self.seconds.append(seconds)
        self.scores.append(values)
        if reverse is not None:
            self.reverse.append(reverse)
        for kept, new in zip((self.cosines, self.errors), bias, strict=True):
            kept.append(new)


class Courses(JsonLines[Course]):
    """Courses of a folder, ``courses.jsonl``."""

    def __init__(self, folder: Path) -> None:
        super().__init__(folder / "courses.jsonl", Course)


def weights_path(folder: Path, course: Course) -> Path:
    """Final weights of a course: a state dict of the RBM with its replicas, the reported ones first."""
    return folder / "weights" / f"{course.data_set}-{course.method}-{course.rate:g}.pt"


class End(NamedTuple):
    """A method at its best learning rate after its last update: nats, less is better.

    Attributes:
        rate: The learning rate.
        median: Over the reported replicas.
        worst: Of them.
        reverse: Median by reverse AIS; None where it is not estimated.
        seconds: Of training, all replicas.
    """

    rate: float
    median: float
    worst: float
    reverse: float | None
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

    def n_reported(self, data_set: str) -> int:
        """Replicas of a data set that are reported."""
        n: int = self.plan["data_sets"][data_set].get("replicas", self.plan["replicas"])
        return n

    def rates(self, data_set: str, method: str) -> list[float]:
        """Learning rates that were tried."""
        return sorted(course.rate for course in self._courses[data_set, method])

    def best(self, data_set: str, method: str) -> Course:
        """The course of lowest median at the end, by the replicas that choose."""
        return min(self._courses[data_set, method], key=self._chosen_by)

    def values(self, course: Course, name: str = "scores") -> NDArray[np.float64]:
        """``(n_points, replicas)`` of the replicas that are reported."""
        return np.array(getattr(course, name), dtype=float)[:, : self.n_reported(course.data_set)]

    def _chosen_by(self, course: Course) -> float:
        return float(np.median(course.scores[-1][self.n_reported(course.data_set) :]))

    def end(self, data_set: str, method: str) -> End:
        """What is reported of a method."""
        course = self.best(data_set, method)
        scores = self.values(course)[-1]
        reverse = float(np.median(self.values(course, "reverse")[-1])) if course.reverse else None
        return End(course.rate, float(np.median(scores)), float(scores.max()), reverse, course.seconds[-1])

    def opponent(self, data_set: str, method: str) -> str | None:
        """The best baseline, by the replicas that choose, of those that take at most a tenth more time.

        The quickest one always counts; None if no baseline was measured.
        """
        seconds = {
            name: self.end(data_set, name).seconds
            for name in self.plan["baselines"]
            if name in self.methods(data_set)
        }
        if not seconds:
            return None
        limit = max(1.1 * self.end(data_set, method).seconds, min(seconds.values()))
        able = [name for name in seconds if seconds[name] <= limit]
        best: str = min(able, key=lambda name: self._chosen_by(self.best(data_set, name)))
        return best


WORTH_RULE = (
    "Learning rates and opponents are chosen by replicas that are not reported. A method is better if its median "
    "is lower (Mann-Whitney, two-sided, p < .05 after Holm's correction for all lines of this table) and its "
    "worst replica no worse than that of the best baseline which takes at most a tenth more time (or, where none "
    "does, of the quickest)."
)


def worth_verdicts(worth: Worth) -> list[Verdict]:
    """Judge the claimed methods on each data set."""
    pairs = [
        (data_set, method, opponent)
        for data_set in worth.data_sets
        for method in worth.plan["claimed"]
        if method in worth.methods(data_set) and (opponent := worth.opponent(data_set, method)) is not None
    ]
    scores = [tuple(worth.values(worth.best(pair[0], name))[-1] for name in pair[1:]) for pair in pairs]
    p_values = holm([float(stats.mannwhitneyu(*pair).pvalue) for pair in scores])
    return [_verdict(worth, *pair, p) for pair, p in zip(pairs, p_values, strict=True)]


def _verdict(worth: Worth, data_set: str, method: str, opponent: str, p: float) -> Verdict:
    mine, other = worth.end(data_set, method), worth.end(data_set, opponent)
    better = mine.median < other.median and p < 0.05 and mine.worst <= other.worst
    measured = f"{mine.median:.4g} (worst {mine.worst:.4g}) against {other.median:.4g} ({other.worst:.4g})"
    label, against = (worth.plan["methods"][name]["label"] for name in (method, opponent))
    return Verdict(
        f"{worth.plan['data_sets'][data_set]['label']}: {label} beats {against}",
        f"median {measured}",
        f"{mine.seconds:.1f} s and {other.seconds:.1f} s, p = {p:.2g}",
        HOLDS if better else FAILS,
    )


def holm(p_values: Sequence[float]) -> list[float]:
    """Adjust p values for testing several hypotheses (Holm 1979): the family-wise error stays below the level.

    >>> holm([0.01, 0.5, 0.02])
    [0.03, 0.5, 0.04]
    """
    adjusted, largest = [0.0] * len(p_values), 0.0
    for rank, index in enumerate(np.argsort(p_values)):
        largest = max(largest, min(1.0, (len(p_values) - rank) * p_values[index]))
        adjusted[index] = largest
    return adjusted


def worth_table(worth: Worth) -> list[list[str]]:
    """A row for each data set and method, with a header."""
    header = ["data set", "method", "best rate", "tried", "median", "worst", "median by reverse AIS", "seconds"]
    rows = [[*header, "us an update and replica"]]
    for data_set in worth.data_sets:
        for method in worth.methods(data_set):
            end, course = worth.end(data_set, method), worth.best(data_set, method)
            each = 1e6 * end.seconds / course.updates[-1] / len(course.scores[-1])
            tried = " ".join(f"{rate:g}" for rate in worth.rates(data_set, method))
            reverse = "" if end.reverse is None else f"{end.reverse:.4g}"
            cells = [tried, f"{end.median:.4g}", f"{end.worst:.4g}", reverse, f"{end.seconds:.1f}", f"{each:.1f}"]
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
