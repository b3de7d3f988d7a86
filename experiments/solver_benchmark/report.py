"""The merged table: one row a family and solver."""

import csv
import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import measure
from families import Family
from measure import Interval, Tally
from sweep import Row, Setting, Store

Record = dict[str, Any]


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class Outcome:
    """All reported measurements of a family.

    Attributes:
        family: The family.
        settings: Labels of a solver's finalists, best on the tuning instances first.
        runs: By solver and label, one row an instance.
        best: By instance's digest, the lowest energy known.
        how: In words, how these are known.
    """

    family: Family
    settings: Mapping[str, list[str]]
    runs: Mapping[tuple[str, str], list[Row]]
    best: Mapping[str, float]
    how: str

    def tallies(self, solver: str, label: str) -> list[Tally]:
        """Of each instance."""
        return [
            measure.tally(r["energies"], r["seconds"], self.best[r["digest"]]) for r in self.runs[solver, label]
        ]

    def gaps(self, solver: str, label: str, horizon: float) -> list[float]:
        """Expected relative gaps of each instance after a time."""
        rows = self.runs[solver, label]
        return [measure.expected_gap(r["energies"], r["seconds"], self.best[r["digest"]], horizon) for r in rows]

    def hindsight(self, solver: str) -> str:
        """The finalist that was best on the reported instances themselves."""

        def merit(label: str) -> float:
            if self.family.horizon is None:
                return measure.ranking(self.tallies(solver, label))
            total = sum(self.gaps(solver, label, self.family.horizon))
            return math.inf if math.isnan(total) else total

        return min(self.settings[solver], key=merit)


def outcome(store: Store, family: Family, chosen: Mapping[type, list[Setting]], rows: Iterable[Row]) -> Outcome:
    """Collect what :func:`sweep.report` yielded for a family."""
    rows = list(rows)
    runs: dict[tuple[str, str], list[Row]] = {}
    for row in rows:
        if row.get("energies"):
            runs.setdefault((row["solver"], row["label"]), []).append(row)
    settings = {kind.name: [setting.label for setting in options] for kind, options in chosen.items()}
    settings = {name: [label for label in labels if (name, label) in runs] for name, labels in settings.items()}
    proofs = [row for row in rows if row["purpose"] == "proof"]
    best = {row["digest"]: store.lowest(row["digest"], row["best_known"]) for row in proofs}
    n_proven = sum(bool(row.get("proven")) for row in proofs)
    how = proofs[0]["how"] if proofs else ""
    how += f", {n_proven} of {len(proofs)} proven by {proofs[0].get('prover')}" if n_proven else ""
    return Outcome(family=family, settings={n: s for n, s in settings.items() if s}, runs=runs, best=best, how=how)


def records(result: Outcome, against: str = "SA (dwave)") -> list[Record]:
    """One record a solver; times in seconds."""
    family, table = result.family, []
    for solver, labels in result.settings.items():
        tuned, hindsight = labels[0], result.hindsight(solver)
        tallies = result.tallies(solver, tuned)
        rows = result.runs[solver, tuned]
        record: Record = {
            "family": family.name,
            "solver": solver,
            "setting": tuned,
            "instances": len(tallies),
            "best known": result.how,
            "success": measure.success_rate(tallies),
            "solved": sum(tally.n_successes > 0 for tally in tallies),
            "read": sum(tally.seconds_per_read for tally in tallies) / len(tallies),
            "build": sum(row["build_seconds"] for row in rows) / len(rows),
            "TTS99": measure.family_tts(tallies),
            "hindsight setting": hindsight,
            "TTS99 in hindsight": measure.family_tts(result.tallies(solver, hindsight)),
        }
        if against in result.settings and solver != against:
            other = result.tallies(against, result.hindsight(against))
            if len(other) == len(tallies):
                record["ratio"] = measure.family_ratio(tallies, other)
        if family.horizon is not None:
            record["horizon"] = family.horizon
            record["gap"] = _mean(result.gaps(solver, tuned, family.horizon))
            record["gap in hindsight"] = _mean(result.gaps(solver, hindsight, family.horizon))
        table.append(record)
    return table


def _mean(values: list[float]) -> float:
    return sum(values) / len(values)


def write_csv(path: Path, table: list[Record]) -> None:
    """Everything, intervals as three columns and whether they are bounds from below."""
    flat = [
        {name: value for key, cell in record.items() for name, value in _columns(key, cell)} for record in table
    ]
    names = list(dict.fromkeys(name for record in flat for name in record))
    with path.open("w", newline="") as file:
        writer = csv.DictWriter(file, names, restval="")
        writer.writeheader()
        writer.writerows(flat)


def _columns(key: str, cell: object) -> list[tuple[str, object]]:
    if not isinstance(cell, Interval):
        return [(key, f"{cell:.6g}" if isinstance(cell, float) else cell)]
    values = [
        (f"{key}{suffix}", f"{value:.6g}") for suffix, value in zip(("", " low", " high"), cell[:3], strict=True)
    ]
    return [*values, (f"{key} bound", cell.mark)]


def markdown(table: list[Record]) -> str:
    """The columns that a reader wants, a line a record."""
    header = (
        "family", "solver", "setting (tuned apart)", "success a read", "ms a read", "TTS99, ms",
        "TTS99 over SA's best", "TTS99 in hindsight, ms", "gap", "solved",
    )  # fmt: skip
    lines = [f"| {' | '.join(header)} |", f"|{' --- |' * len(header)}"]
    previous = None
    for record in table:
        gap = f"{record['gap']:.1e} at {record['horizon']:g} s" if "gap" in record else ""
        cells = (
            f"{record['family']} ({record['best known']})" if record["family"] != previous else "",
            record["solver"],
            record["setting"],
            interval(record["success"], "{:.3f}"),
            f"{record['read'] * 1e3:.3g}",
            interval(record["TTS99"], scale=1e3),
            interval(record["ratio"]) if "ratio" in record else "",
            f"{bound(record['TTS99 in hindsight'], 1e3)} ({record['hindsight setting']})",
            gap,
            f"{record['solved']} / {record['instances']}",
        )
        lines.append(f"| {' | '.join(cells)} |")
        previous = record["family"]
    return "\n".join(lines) + "\n"


def bound(value: Interval, scale: float = 1.0, form: str = "{:.3g}") -> str:
    """The estimate, marked where it is a bound; a ratio of two bounds says nothing."""
    return "undecided" if value.mark == "><" else value.mark + form.format(value.value * scale)


def interval(value: Interval, form: str = "{:.3g}", scale: float = 1.0) -> str:
    """The estimate with its interval, or the bound alone."""
    if value.mark:
        return bound(value, scale, form)
    low, high = form.format(value.low * scale), form.format(value.high * scale)
    return f"{bound(value, scale, form)} [{low}, {high}]"
