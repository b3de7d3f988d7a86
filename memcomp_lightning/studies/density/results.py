"""What a comparison of density models found: of each model and peer the setting that held-out rows chose."""

import json
import math
import warnings
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import stats

from memcomp_lightning.files import read_json
from memcomp_lightning.studies.comparison import half_width
from memcomp_lightning.studies.density.peers import Peer
from memcomp_lightning.studies.density.settings import Density, Model
from memcomp_lightning.studies.records import Record, Records
from memcomp_lightning.studies.search import Setting
from memcomp_lightning.studies.verdicts import FAILS, HOLDS, Verdict
from memcomp_lightning.studies.worth import holm

WITHIN = 1.0
"""Nats by which AIS and reverse AIS may differ in a number that is given."""


class Found(NamedTuple):
    """What is reported of a model or a peer on a table; nats a row.

    Attributes:
        setting: That held-out rows chose.
        test: Log-likelihood of test rows, a number a seed: the lower of both estimates.
        highest: The same by the higher of both estimates.
        gap: By how much AIS is above reverse AIS, the largest of all seeds.
        standard_error: Of log Z, the largest of all seeds.
        valid: Of held-out rows, by which the pass was chosen, too.
        train: Of training rows after that pass, by the quick estimate; NaN of peers.
        independent: Of test rows by independent bits; NaN of peers.
        seconds: Of the processor, a seed; of training alone.
        tried: Settings.
    """

    setting: Setting
    test: NDArray[np.float64]
    highest: NDArray[np.float64]
    gap: float
    standard_error: float
    valid: float
    train: float
    independent: float
    seconds: float
    tried: int

    @property
    def known(self) -> bool:
        """Whether the likelihood is known well enough to be given as a number."""
        return bool(abs(self.gap) <= WITHIN) and bool(np.isfinite(self.test).all())

    @property
    def mean(self) -> float:
        """Over seeds."""
        return float(self.test.mean())

    @property
    def half_width(self) -> float:
        """Of the 95 % interval of the mean over seeds (t distribution); NaN of one seed."""
        return half_width(self.test)


class Densities:
    """The records of a comparison."""

    def __init__(self, plan: Density, peers: Mapping[str, Peer], records: Sequence[Record]) -> None:
        self.plan, self.peers = plan, peers
        self._records: dict[tuple[str, str], list[Record]] = {}
        for record in records:
            self._records.setdefault((record.data_set, record.method), []).append(record)

    @property
    def tables(self) -> list[str]:
        """Those of which something is reported."""
        return [table for table in self.plan.tables if self.of(table)]

    def label(self, method: str) -> str:
        """For people."""
        own: Model | Peer | None = self.plan.models.get(method) or self.peers.get(method)
        return method if own is None else own.label

    def reported(self, table: str, method: str) -> list[Record]:
        """Records of the setting that was chosen, not those that chose it; one of all seeds, or one a seed."""
        return [record for record in self._records.get((table, method), []) if "test" in record.measures]

    def of(self, table: str) -> dict[str, Found]:
        """What is reported on a table, models before peers."""
        names = [name for name in (*self.plan.models, *self.peers) if self.reported(table, name)]
        return {name: self._found(table, name) for name in names}

    def _found(self, table: str, method: str) -> Found:
        own = self.reported(table, method)

        def last(name: str) -> NDArray[np.float64]:
            found = [record.measured(name)[-1] for record in own if name in record.measures]
            return np.concatenate(found) if found else np.array([math.nan])

        up, down = last("test"), last("test_reverse")
        n_seeds = len(up)
        train = [_at_best(record, "train") for record in own if "train" in record.measures]
        tried = {record.setting for record in self._records[table, method] if record.choosing}
        return Found(
            setting=json.loads(own[0].setting),
            test=np.minimum(up, down),
            highest=np.maximum(up, down),
            gap=float((up - down)[np.abs(up - down).argmax()]),
            standard_error=float(last("standard_error").max()),
            valid=float(last("valid_best").mean()),
            train=float(np.concatenate(train).mean()) if train else math.nan,
            independent=float(last("independent").mean()),
            seconds=sum(record.seconds[-1] for record in own) / n_seeds,
            tried=len(tried),
        )

    def best_model(self, table: str) -> str | None:
        """The energy model that held-out rows like best, of those whose likelihood is known."""
        found = {name: own for name, own in self.of(table).items() if name in self.plan.models and own.known}
        return max(found, key=lambda name: found[name].valid, default=None)


DENSITY_RULE = (
    "Settings, passes and the energy model that speaks for a table are chosen by held-out rows; test rows are "
    "looked at once. The energy model is ahead of the peers if its mean over seeds is higher than that of the "
    "best of them. A negative phase is worth its time if its mean is higher than that of the best CD or PCD (by "
    "held-out rows) that takes at most a tenth more time (or of the quickest, where none does). Both by Welch's t "
    "over seeds, two-sided, p < .05 after Holm's correction for all these lines; intervals are those of one line "
    f"alone. A likelihood is given as a number where AIS and reverse AIS agree within {WITHIN:g} nat; a CD or PCD "
    "whose estimates do not agree stands against others by the higher of both."
)


class _Line(NamedTuple):
    """A claim that some seeds have a higher likelihood than others."""

    claim: str
    own: NDArray[np.float64]
    other: NDArray[np.float64]
    measured: str
    note: str = ""


def density_verdicts(results: Densities) -> list[Verdict]:
    """Against the peers, a line a table; of the negative phases, a line a table and phase."""
    lines = [*_against_peers(results), *_of_phases(results)]
    tests = [_welch(line) for line in lines]
    p_values = holm([math.nan if test is None else float(test.pvalue) for test in tests])
    return [_verdict(line, test, p) for line, test, p in zip(lines, tests, p_values, strict=True)]


def _welch(line: _Line) -> Any:
    """Welch's t test, with its interval; None of one seed, or where no seed differs from another."""
    if min(len(line.own), len(line.other)) < 2 or max(line.own.std(), line.other.std()) == 0:
        return None
    with warnings.catch_warnings():  # some peers draw nothing: their seeds are alike
        warnings.simplefilter("ignore", RuntimeWarning)
        return stats.ttest_ind(line.own, line.other, equal_var=False)


def _verdict(line: _Line, test: Any, p: float) -> Verdict:
    difference = float(line.own.mean() - line.other.mean())
    if test is None:
        tested = f"{difference:+.3f}, too few seeds: no test"
    else:
        low, high = test.confidence_interval()
        tested = f"{difference:+.3f} [{low:+.3f}, {high:+.3f}], p = {p:.2g}"
    return Verdict(line.claim, line.measured, line.note + tested, HOLDS if difference > 0 and p < 0.05 else FAILS)


def _against_peers(results: Densities) -> list[_Line]:
    lines = []
    for table in results.tables:
        found, name = results.of(table), results.best_model(table)
        peers = {peer: own for peer, own in found.items() if peer in results.peers and own.known}
        if name is None or not peers:
            continue
        first = max(peers, key=lambda peer: peers[peer].mean)
        place = 1 + sum(own.mean > found[name].mean for own in peers.values())
        lines.append(
            _Line(
                f"{table}: {results.label(name)} is ahead of all peers",
                found[name].test,
                peers[first].test,
                f"{found[name].mean:.3f} against {peers[first].mean:.3f} ({results.label(first)})",
                f"place {place} of {len(peers) + 1}; ",
            )
        )
    return lines


def _of_phases(results: Densities) -> list[_Line]:
    lines, baselines = [], results.plan.baselines
    for table in results.tables:
        found = results.of(table)
        basic = {name: found[name] for name in baselines if name in found}
        for name, own in found.items():
            model = results.plan.models.get(name)
            if model is None or not model.compared or not own.known or name in baselines or not basic:
                continue
            limit = max(1.1 * own.seconds, min(other.seconds for other in basic.values()))
            able = {other: one for other, one in basic.items() if one.seconds <= limit}
            against, other = max(able.items(), key=lambda item: item[1].valid)
            values, doubt = (other.test, "") if other.known else (other.highest, " at most")
            means = f"{own.mean:.3f} against{doubt} {values.mean():.3f}"
            lines.append(
                _Line(
                    f"{table}: {results.label(name)} beats {results.label(against)}",
                    own.test,
                    values,
                    f"{means}; {own.seconds:.0f} s and {other.seconds:.0f} s a seed",
                )
            )
    return lines


def density_table(results: Densities) -> list[list[str]]:
    """A row for each table and method, with a header."""
    header = ["table", "method", "test", "half of its 95 % interval", "seeds", "AIS less reverse AIS"]
    rows = [
        [*header, "standard error of log Z", "held out", "training", "seconds a seed", "chosen", "settings tried"]
    ]
    for table in results.tables:
        found = results.of(table)
        independent = [own.independent for own in found.values() if math.isfinite(own.independent)]
        if independent:
            rows.append([table, "independent bits", f"{independent[0]:.3f}", *[""] * 9])
        for name, own in found.items():
            cells = [_number(own.half_width), str(len(own.test)), _number(own.gap), _number(own.standard_error)]
            measured = [_number(own.valid), _number(own.train), f"{own.seconds:.1f}"]
            chosen = " ".join(f"{key}={value}" for key, value in own.setting.items())
            value = f"{own.mean:.3f}" if own.known else "not known"
            rows.append([table, results.label(name), value, *cells, *measured, chosen, str(own.tried)])
    return rows


def _number(value: float) -> str:
    return "" if math.isnan(value) else f"{value:.3f}"


def _at_best(record: Record, name: str) -> NDArray[np.float64]:
    """A measure of each seed where its held-out rows were most likely, whose weights are kept."""
    at = record.measured("valid").argmax(0)
    found: NDArray[np.float64] = record.measured(name)[at, np.arange(len(at))]
    return found


def read_densities(folder: Path) -> Densities:
    """Read the folder of a run of ``experiment=density``; a FileNotFoundError if it holds none."""
    path = folder / "density.json"
    if not path.exists():
        raise FileNotFoundError(f"{folder} holds no density.json: name the folder of experiment=density.")
    settings = read_json(path)
    peers = {name: Peer(**own) for name, own in settings.pop("found_peers").items()}
    models = {name: Model(**own) for name, own in settings.pop("models").items()}
    return Densities(Density(**settings, models=models), peers, Records(folder).all)
