"""What a study of few labels found: accuracies by method and number of labels, and what they say of its claims."""

import json
import math
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from memcomp_lightning.files import read_json
from memcomp_lightning.studies.comparison import Comparison, accounts_for, compare, half_width
from memcomp_lightning.studies.few_labels.settings import BEST, Claim, FewLabels, Method, Pretraining, Search
from memcomp_lightning.studies.few_labels.trial import PRETRAINING, chosen_of
from memcomp_lightning.studies.records import Record, Records
from memcomp_lightning.studies.verdicts import FAILS, HOLDS, ONLY, Verdict
from memcomp_lightning.studies.worth import holm

Labels = int | None
"""A number of labels; None is all."""


class Found(NamedTuple):
    """What is reported of a method with so many labels.

    Attributes:
        accuracy: On test rows, by draw in rising order.
        cross_validated: Mean over draws of the accuracy by which settings were chosen.
        chosen: The settings chosen most often.
        tried: Settings a draw, mean.
        seconds: Of the processor, a draw, tuning included.
    """

    accuracy: NDArray[np.float64]
    cross_validated: float
    chosen: dict[str, float]
    tried: float
    seconds: float

    @property
    def mean(self) -> float:
        """Over draws."""
        return float(self.accuracy.mean())

    @property
    def half_width(self) -> float:
        """Of the 95 % interval of the mean over draws (t distribution); NaN of one draw."""
        return half_width(self.accuracy)


class Accuracies:
    """The records of a study of few labels."""

    def __init__(self, plan: FewLabels, records: Sequence[Record]) -> None:
        self.plan = plan
        self._records: dict[tuple[Labels, str], dict[int, Record]] = {}
        self.pretrainings = [record for record in records if record.data_set == PRETRAINING]
        for record in records:
            if record.data_set != PRETRAINING and record.method in plan.methods and record.labels in plan.labels:
                self._records.setdefault((record.labels, record.method), {})[record.seed or 0] = record

    @property
    def labels(self) -> list[Labels]:
        """Numbers of labels with which something was measured."""
        return [n for n in self.plan.labels if any(found == n for found, _ in self._records)]

    def n_labels(self, n: Labels) -> int:
        """The number, of all too."""
        record = next(record for (found, _), own in self._records.items() if found == n for record in own.values())
        return int(record.measures["labels"][0][0])

    def methods(self, n: Labels) -> list[str]:
        """Those that were measured with so many labels, in the order of the settings."""
        return [name for name in self.plan.methods if (n, name) in self._records]

    def of(self, n: Labels, method: str) -> Found:
        """What is reported of a method."""
        records = [record for _, record in sorted(self._records[n, method].items())]
        chosen = [json.dumps(chosen_of(record)) for record in records]
        return Found(
            accuracy=np.array([_accuracy(record) for record in records]),
            # Where every setting diverged nothing was judged: such a draw counts as chance would at best, 0.
            cross_validated=float(np.nan_to_num([_cross_validated(record) for record in records]).mean()),
            chosen=json.loads(max(chosen, key=chosen.count)),
            tried=float(np.mean([record.measures["tried"][0][0] for record in records])),
            seconds=float(np.mean([record.seconds[-1] for record in records])),
        )

    def best(self, n: Labels) -> str | None:
        """The pretraining that cross-validation likes best, of those whose networks were measured."""
        found = [name for name in self.plan.candidates if (n, name) in self._records]
        return max(found, key=lambda name: self.of(n, name).cross_validated, default=None)

    def paired(self, n: Labels, *methods: str) -> list[NDArray[np.float64]]:
        """Accuracies of the draws that all of the methods have; empty where one was not measured."""
        own = [self._records.get((n, method), {}) for method in methods]
        draws = sorted(set.intersection(*(set(records) for records in own)))
        return [np.array([_accuracy(records[draw]) for draw in draws]) for records in own]


def _cross_validated(record: Record) -> float:
    return record.measures["cross_validated"][0][0]


def _accuracy(record: Record) -> float:
    return record.measures["test_accuracy"][0][0]


FEW_LABELS_RULE = (
    "Every method is tuned by cross-validation inside the labels of a draw, which are the same for all "
    "methods; test rows are looked at once. The best pretraining is the one that cross-validation likes best, "
    "for each number of labels. A claim holds if the paired difference over draws is positive with p < .05 "
    "(two-sided t test, after Holm's correction for all lines of this table). It holds only without a control "
    "if that control accounts for more than half of the gain: the upper end of the 95 % interval of the "
    "better method less the control lies below half of it. Intervals are those of one comparison alone."
)


class _Line(NamedTuple):
    n: Labels
    claim: Claim
    better: str
    than: str
    gain: Comparison


def few_labels_verdicts(results: Accuracies) -> list[Verdict]:
    """A line for each number of labels and each claim whose methods were measured."""
    return [verdict for _, verdict in _judged(results)]


def worth_note(results: Accuracies) -> str:
    """Where the best pretraining is above all of ``worth`` by the rule of the verdicts."""
    judged = [
        (line, verdict)
        for line, verdict in _judged(results)
        if line.claim.better == BEST and line.claim.than in results.plan.worth
    ]
    worth, others = list[str](), list[str]()
    for n in results.labels:
        own = [verdict.verdict == HOLDS for line, verdict in judged if line.n == n]
        if not all(own):
            others.append(f"{results.n_labels(n):,}")
        elif len(own) == len(results.plan.worth):  # else some are not measured yet
            worth.append(f"{results.n_labels(n):,}")
    opponents = " and ".join(_label(results, name.replace(BEST, "its")) for name in results.plan.worth)
    rest = f"; it is not with {', '.join(others)}" if others else ""
    if not worth and not others:
        return f"Whether the best pretraining is above {opponents} is not measured yet."
    if not worth:
        return f"With no number of labels is the best pretraining above {opponents}."
    return f"With {', '.join(worth)} labels the best pretraining is above {opponents}{rest}."


def _judged(results: Accuracies) -> list[tuple[_Line, Verdict]]:
    lines = [line for n in results.labels for claim in results.plan.claims if (line := _line(results, n, claim))]
    p_values = holm([line.gain.p for line in lines])
    return [(line, _verdict(results, line, p)) for line, p in zip(lines, p_values, strict=True)]


def _line(results: Accuracies, n: Labels, claim: Claim) -> _Line | None:
    best = results.best(n)
    names = (claim.better, claim.than)
    if best is None and any(BEST in name for name in names):
        return None
    better, than = (name.replace(BEST, best or "") for name in names)
    first, second = results.paired(n, better, than)
    return _Line(n, claim, better, than, compare(first, second)) if len(first) else None


def _verdict(results: Accuracies, line: _Line, p: float) -> Verdict:
    holds = line.gain.effect > 0 and p < 0.05
    controls = [name.replace(BEST, results.best(line.n) or "") for name in line.claim.controls]
    explaining = [name for name in controls if holds and _explains(results, line, name)]
    values = (results.of(line.n, name).mean for name in (line.better, line.than))
    test = str(line.gain) if math.isnan(p) else f"{line.gain}, corrected {p:.2g}"
    return Verdict(
        f"{results.n_labels(line.n)} labels: {_label(results, line.better)} is above {_label(results, line.than)}",
        "{:.4f} against {:.4f}".format(*values),
        test,
        (ONLY if explaining else HOLDS) if holds else FAILS,
        tuple(_label(results, name) for name in explaining),
    )


def _explains(results: Accuracies, line: _Line, control: str) -> bool:
    better, own = results.paired(line.n, line.better, control)
    return len(own) > 1 and accounts_for(own, better, line.gain)


def _label(results: Accuracies, name: str) -> str:
    """For people."""
    method = results.plan.methods.get(name)
    return name.replace("_", " ") if method is None else method.label


def few_labels_table(results: Accuracies) -> list[list[str]]:
    """A row for each number of labels and method, with a header."""
    header = [
        "labels",
        "method",
        "test accuracy",
        "half of its 95 % interval",
        "draws",
        "cross-validated accuracy",
    ]
    rows = [[*header, "chosen most often", "settings tried", "seconds a draw"]]
    for n in results.labels:
        for name in results.methods(n):
            own = results.of(n, name)
            width = "" if math.isnan(own.half_width) else f"{own.half_width:.4f}"
            chosen = " ".join(f"{key}={value:g}" for key, value in own.chosen.items())
            numbers = [f"{own.mean:.4f}", width, str(len(own.accuracy)), f"{own.cross_validated:.4f}"]
            cost = [chosen, f"{own.tried:.1f}", f"{own.seconds:.1f}"]
            rows.append([str(results.n_labels(n)), results.plan.methods[name].label, *numbers, *cost])
    for record in results.pretrainings:
        rows.append(["none", f"pretraining: {record.method}", *[""] * 6, f"{record.seconds[-1]:.1f}"])
    return rows


def read_few_labels(folder: Path) -> Accuracies:
    """Read the folder of a run of ``experiment=few_labels``; a FileNotFoundError if it holds none."""
    path = folder / "few_labels.json"
    if not path.exists():
        raise FileNotFoundError(f"{folder} holds no few_labels.json: name the folder of experiment=few_labels.")
    settings = read_json(path)
    parts = {"pretraining": Pretraining, "searches": Search, "methods": Method}
    own = {name: {key: kind(**one) for key, one in settings[name].items()} for name, kind in parts.items()}
    claims = [Claim(**claim) for claim in settings["claims"]]
    return Accuracies(FewLabels(**{**settings, **own, "claims": claims}), Records(folder).all)
