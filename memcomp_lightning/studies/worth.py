"""Comparisons of samplers by likelihood: each at its best learning rate, and what mode assistance brings."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import stats

from memcomp_lightning.errors import require, require_choice, require_count, require_some
from memcomp_lightning.files import read_json
from memcomp_lightning.studies.measures import MEASURES
from memcomp_lightning.studies.records import Record, Records, best
from memcomp_lightning.studies.verdicts import FAILS, HOLDS, Verdict


@dataclass(frozen=True, kw_only=True)
class DataSet:
    """A data set that methods are compared on; what is None here, the :class:`Comparison` says."""

    label: str
    overrides: list[str]
    passes: int
    measure: str
    methods: list[str] | None = None
    rates: list[float] | None = None
    replicas: int | None = None
    choosing: int | None = None
    points: int | None = None


@dataclass(frozen=True, kw_only=True)
class Method:
    """A sampler with its settings.

    Attributes:
        label: For people.
        overrides: Of its runs, as on the command line.
        longer: Times as many passes as usual, > 0.
        rates: Learning rates that are tried, unless the data set names some.
        greedy_start: Share of the passes that is spent on greedy pretraining first, in [0, 1).
    """

    label: str
    overrides: list[str]
    longer: float = 1.0
    rates: list[float] | None = None
    greedy_start: float = 0.0


@dataclass(frozen=True, kw_only=True)
class Comparison:
    """What is compared: the settings of ``conf/worth``, which explains them. Numbers are >= 1."""

    name: str
    title: str
    replicas: int
    choosing: int
    rates: list[float]
    points: int
    gradient_draws: int
    only: list[str] | None
    data_sets: dict[str, DataSet]
    methods: dict[str, Method]
    claimed: list[str]
    baselines: list[str]
    workers: int | str | None

    def __post_init__(self) -> None:
        for key in ("replicas", "choosing", "points", "gradient_draws"):
            require_count(f"worth.{key}", getattr(self, key))
        require_some("worth.rates", self.rates, "at least one learning rate")
        require_some("worth.only", self.only, "names of data sets, or null for all")
        for name in self.only or ():
            require_choice("worth.only", name, tuple(self.data_sets))
        for name in (*self.claimed, *self.baselines):
            require_choice("worth.claimed and worth.baselines", name, tuple(self.methods))
        for name, data_set in self.data_sets.items():
            at = f"worth.data_sets.{name}"
            require_choice(f"{at}.measure", data_set.measure, tuple(MEASURES))
            require_count(f"{at}.passes", data_set.passes)
            for key in ("replicas", "choosing", "points"):
                if getattr(data_set, key) is not None:
                    require_count(f"{at}.{key}", getattr(data_set, key))
            for key in ("methods", "rates"):
                require_some(f"{at}.{key}", getattr(data_set, key), "at least one, or leave it out")
            for known in data_set.methods or ():
                require_choice(f"{at}.methods", known, tuple(self.methods))
        for name, method in self.methods.items():
            at = f"worth.methods.{name}"
            require(method.longer > 0, f"{at}.longer", method.longer, "a number > 0")
            require(0 <= method.greedy_start < 1, f"{at}.greedy_start", method.greedy_start, "a share in [0, 1)")
            require_some(f"{at}.rates", method.rates, "at least one, or leave it out")

    def n_reported(self, data_set: str) -> int:
        """Replicas of a data set that are reported."""
        return self.data_sets[data_set].replicas or self.replicas

    def n_choosing(self, data_set: str) -> int:
        """Further replicas, which choose the learning rate."""
        return self.data_sets[data_set].choosing or self.choosing


class End(NamedTuple):
    """A method at its best learning rate after its last update: nats of the reported replicas, less is better.

    ``reverse`` is the median by reverse AIS, None where it is not estimated; seconds are those of all replicas.
    """

    rate: float
    median: float
    worst: float
    reverse: float | None
    seconds: float


class Worth:
    """The records of a comparison: each method at the learning rate that held-out data choose."""

    def __init__(self, plan: Comparison, records: Sequence[Record]) -> None:
        self.plan = plan
        self._records: dict[tuple[str, str], list[Record]] = {}
        for record in records:
            if record.data_set in plan.data_sets and record.method in plan.methods:
                self._records.setdefault((record.data_set, record.method), []).append(record)

    @property
    def data_sets(self) -> list[str]:
        """Those of which something was measured."""
        return [name for name in self.plan.data_sets if any(found == name for found, _ in self._records)]

    def methods(self, data_set: str) -> list[str]:
        """Those that were measured on a data set, in the order of the legend."""
        return [name for name in self.plan.methods if (data_set, name) in self._records]

    def rates(self, data_set: str, method: str) -> list[float]:
        """Learning rates that were tried."""
        return sorted(record.value or 0.0 for record in self._records[data_set, method])

    def best(self, data_set: str, method: str) -> Record:
        """The record of the learning rate that held-out data choose."""
        found = best(self._records[data_set, method])
        assert found is not None
        return found

    def values(self, record: Record, name: str = "score") -> NDArray[np.float64]:
        """A measure of the replicas that are reported, ``(n_points, replicas)``."""
        return record.measured(name)[:, : self.plan.n_reported(record.data_set)]

    def end(self, data_set: str, method: str) -> End:
        """What is reported of a method."""
        record = self.best(data_set, method)
        scores = self.values(record)[-1]
        reverse = float(np.median(self.values(record, "reverse")[-1])) if "reverse" in record.measures else None
        rate = record.value or 0.0
        return End(rate, float(np.median(scores)), float(scores.max()), reverse, record.seconds[-1])

    def opponent(self, data_set: str, method: str) -> str | None:
        """The best baseline, by the replicas that choose, of those that take at most a tenth more time.

        The quickest one always counts; None if no baseline was measured.
        """
        measured = [name for name in self.plan.baselines if name in self.methods(data_set)]
        seconds = {name: self.end(data_set, name).seconds for name in measured}
        if not seconds:
            return None
        limit = max(1.1 * self.end(data_set, method).seconds, min(seconds.values()))
        able = [name for name in seconds if seconds[name] <= limit]
        found = best(self.best(data_set, name) for name in able)
        return None if found is None else found.method


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
        for method in worth.plan.claimed
        if method in worth.methods(data_set) and (opponent := worth.opponent(data_set, method)) is not None
    ]
    scores = [tuple(worth.values(worth.best(pair[0], name))[-1] for name in pair[1:]) for pair in pairs]
    p_values = holm([float(stats.mannwhitneyu(*pair).pvalue) for pair in scores])
    return [_verdict(worth, *pair, p) for pair, p in zip(pairs, p_values, strict=True)]


def _verdict(worth: Worth, data_set: str, method: str, opponent: str, p: float) -> Verdict:
    mine, other = worth.end(data_set, method), worth.end(data_set, opponent)
    better = mine.median < other.median and p < 0.05 and mine.worst <= other.worst
    measured = f"{mine.median:.4g} (worst {mine.worst:.4g}) against {other.median:.4g} ({other.worst:.4g})"
    label, against = (worth.plan.methods[name].label for name in (method, opponent))
    return Verdict(
        f"{worth.plan.data_sets[data_set].label}: {label} beats {against}",
        f"median {measured}",
        f"{mine.seconds:.1f} s and {other.seconds:.1f} s, p = {p:.2g}",
        HOLDS if better else FAILS,
    )


def holm(p_values: Sequence[float]) -> list[float]:
    """Adjust p values for testing several hypotheses (Holm 1979): the family-wise error stays below the level.

    NaN stands for what was not tested: it stays NaN and does not count.

    >>> holm([0.01, 0.5, math.nan, 0.02])
    [0.03, 0.5, nan, 0.04]
    """
    adjusted, largest = [math.nan] * len(p_values), 0.0
    n_tested = len(p_values) - int(np.isnan(p_values).sum())
    for rank, index in enumerate(np.argsort(p_values)[:n_tested]):  # which puts NaN last
        largest = max(largest, min(1.0, (n_tested - rank) * p_values[index]))
        adjusted[index] = largest
    return adjusted


def worth_table(worth: Worth) -> list[list[str]]:
    """A row for each data set and method, with a header."""
    header = ["data set", "method", "best rate", "tried", "median", "worst", "median by reverse AIS", "seconds"]
    rows = [[*header, "us an update and replica"]]
    for data_set in worth.data_sets:
        for method in worth.methods(data_set):
            end, record = worth.end(data_set, method), worth.best(data_set, method)
            each = 1e6 * end.seconds / record.at[-1] / len(record.measures["score"][-1])
            tried = " ".join(f"{rate:g}" for rate in worth.rates(data_set, method))
            reverse = "" if end.reverse is None else f"{end.reverse:.4g}"
            cells = [tried, f"{end.median:.4g}", f"{end.worst:.4g}", reverse, f"{end.seconds:.1f}", f"{each:.1f}"]
            labels = (worth.plan.data_sets[data_set].label, worth.plan.methods[method].label)
            rows.append([*labels, f"{end.rate:g}", *cells])
    return rows


def read_worth(folder: Path) -> Worth:
    """Read the folder of a run of ``experiment=sampler_worth``; a FileNotFoundError if it holds none."""
    path = folder / "worth.json"
    if not path.exists():
        raise FileNotFoundError(f"{folder} holds no worth.json: name the folder of experiment=sampler_worth.")
    settings = read_json(path)
    data_sets = {name: DataSet(**values) for name, values in settings["data_sets"].items()}
    methods = {name: Method(**values) for name, values in settings["methods"].items()}
    plan = Comparison(**{**settings, "data_sets": data_sets, "methods": methods})
    return Worth(plan, Records(folder).all)
