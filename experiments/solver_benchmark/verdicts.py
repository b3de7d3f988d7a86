"""The issue's targets, each with the numbers that decide it."""

import statistics
from collections.abc import Sequence
from typing import NamedTuple

import measure
import numpy as np
from report import Outcome, Record, interval
from sweep import Row

DMM, SA, TABU = "DMM", "SA (dwave)", "tabu (dwave)"
OURS = ("annealing", "tabu", "crossover", "best")
"""The package's solvers beside the DMM. A target counts the quickest of them, each at the setting tuned apart."""


class Verdict(NamedTuple):
    """One target; ``met`` is None where this run did not measure it."""

    target: str
    met: bool | None
    numbers: str


def verdicts(
    outcomes: Sequence[Outcome],
    table: Sequence[Record],
    calls: Sequence[Row],
    throughput: Row,
    costs: Sequence[Row],
) -> list[Verdict]:
    """Answer all targets that the measurements at hand allow."""
    best = {digest: energy for outcome in outcomes for digest, energy in outcome.best.items()}
    calls = [row for row in calls if row["digest"] in best]
    files = [row for row in calls if "opponent_seconds" in row]
    timed = [outcome for outcome in outcomes if outcome.family.horizon is None]
    rbms = [o for o in timed if "x" in o.family.size and o.family.group != "planted loops"]
    planted = [o for o in timed if o.family.group == "planted loops"]
    large = [o for o in outcomes if o.family.size == "784x500"]
    plain, cancelled = ([o for o in large if o.family.group.startswith(k)] for k in ("plain", "mean-cancelled"))
    cuts = [row for row in files if row["family"] == "G-set"]
    return [
        _faster("RBMs up to 250x200: TTS99 at most a fifth of the best of dwave-samplers' SA and tabu", rbms, 0.2),
        _faster("planted loops: TTS99 at most half of theirs", planted, 0.5),
        _within("784x500, plain: within 1e-6 of the best known in .1 s", plain, 0.1, 1e-6),
        _within("784x500, mean-cancelled: within 1e-3 in .2 s", cancelled, 0.2, 1e-3),
        _within("784x500, mean-cancelled: within 1e-4 in 1 s", cancelled, 1.0, 1e-4),
        _beside(
            "G-set: within 2e-3 in a quarter of the time of SA, 28 x 1,000 sweeps", cuts, "best", best, 2e-3, 0.25
        ),
        _beside("G-set: within 5e-4 in its time", cuts, "best, four times the effort", best, 5e-4, 1.0),
        _beasley([row for row in files if row["family"] == "Beasley" and row["solver"] == "best"], best),
        _small([row for row in calls if row["solver"] == DMM], best),
        _no_slower("DMM: TTS99 at most that of best-tuned SA", table),
        _planted(outcomes, [row for row in calls if row["solver"] == DMM], best),
        _throughput(throughput),
        _linear(costs),
    ]


def _faster(text: str, outcomes: Sequence[Outcome], limit: float) -> Verdict:
    """The quickest of ours, tuned apart, over the quicker of theirs, each at its best setting in hindsight."""
    met, numbers = [], []
    for outcome in outcomes:
        theirs = [
            outcome.tallies(name, outcome.hindsight(name)) for name in (SA, TABU) if name in outcome.settings
        ]
        ours = {
            name: outcome.tallies(name, outcome.settings[name][0]) for name in OURS if name in outcome.settings
        }
        if not theirs or not ours:
            continue
        name = min(ours, key=lambda name: measure.ranking(ours[name]))
        ratio = measure.family_ratio(ours[name], min(theirs, key=measure.ranking))
        met.append(ratio.value <= limit and ">" not in ratio.mark)
        numbers.append(f"{outcome.family.name}: {interval(ratio, '{:.2g}')} ({name})")
    return _counted(text, met, "families", numbers)


def _within(text: str, outcomes: Sequence[Outcome], horizon: float, limit: float) -> Verdict:
    """The expected gap of ours in a time, on each instance, at the best of the finalists."""
    met, numbers = [], []
    for outcome in outcomes:
        settings = [(name, label) for name in OURS if name in outcome.settings for label in outcome.settings[name]]
        gaps = {setting: outcome.gaps(*setting, horizon) for setting in settings}
        gaps = {setting: found for setting, found in gaps.items() if not np.isnan(found).any()}
        if gaps:
            setting = min(gaps, key=lambda setting: max(gaps[setting]))
            met += [gap <= limit for gap in gaps[setting]]
            listed = ", ".join(f"{gap:.1e}" for gap in gaps[setting])
            numbers.append(f"{outcome.family.name}: {listed} ({' '.join(setting)})")
    return _counted(text, met, "instances; expected gaps", numbers)


def _beside(
    text: str, rows: Sequence[Row], solver: str, best: dict[str, float], limit: float, share: float
) -> Verdict:
    """The worst of the calls, and the median of its time over SA's."""
    met, numbers = [], []
    for row in rows:
        if row["solver"] != solver:
            continue
        energy = best[row["digest"]]
        gap, theirs = ((max(row[name]) - energy) / abs(energy) for name in ("energies", "opponent_energies"))
        seconds, other = (statistics.median(row[name]) for name in ("call_seconds", "opponent_seconds"))
        met.append(gap <= limit and seconds <= share * other)
        numbers.append(
            f"{row['instance']}: {gap:.1e} in {seconds:.2g} s, {seconds / other:.2f} of SA's (theirs {theirs:.1e})"
        )
    return _counted(text, met, "instances; gap of the worst of 3 calls", numbers)


def _beasley(rows: Sequence[Row], best: dict[str, float]) -> Verdict:
    met, numbers = [], []
    for row in rows:
        found = measure.tally(row["energies"], 1.0, best[row["digest"]])
        seconds = statistics.median(row["call_seconds"])
        met.append(found.n_successes == found.n_reads and seconds <= 0.2)
        numbers.append(f"{row['instance']}: {found.n_successes} of {found.n_reads} calls in {seconds:.2g} s")
    return _counted("Beasley: the best known in .2 s", met, "instances", numbers)


def _counted(text: str, met: Sequence[bool], of: str, numbers: Sequence[str]) -> Verdict:
    if not met:
        return Verdict(text, None, "not run")
    return Verdict(text, all(met), f"{sum(met)} of {len(met)} {of}. {'; '.join(numbers)}")


def _small(calls: Sequence[Row], best: dict[str, float]) -> Verdict:
    rows = [row for row in calls if "32x32" in row["family"]]
    text = "DMM, 32x32, 28 restarts, defaults, warm: at most 2 ms; the optimum of every instance within 10 calls"
    if not rows:
        return Verdict(text, None, "not run")
    slowest = max(statistics.median(row["call_seconds"]) for row in rows)
    missed = [row["instance"] for row in rows if not measure.tally(row["energies"], 1.0, best[row["digest"]])[1]]
    numbers = (
        f"slowest instance's median {slowest * 1e3:.2f} ms; optimum: {len(rows) - len(missed)} of {len(rows)}"
    )
    numbers += f"; missed: {', '.join(missed)}" if missed else ""
    return Verdict(text, slowest <= 2e-3 and not missed, numbers)


def _no_slower(text: str, table: Sequence[Record]) -> Verdict:
    rows = [record for record in table if record["solver"] == DMM and "ratio" in record and "gap" not in record]
    met = [row["ratio"].value <= 1 and ">" not in row["ratio"].mark for row in rows]
    return _counted(text, met, "families", [f"{r['family']}: {interval(r['ratio'], '{:.2g}')}" for r in rows])


def _planted(outcomes: Sequence[Outcome], calls: Sequence[Row], best: dict[str, float]) -> Verdict:
    text = "planted 200x200: the planted energy; TTS99 against size"
    rows = [row for row in calls if row["family"] == "planted loops, 200x200"]
    reached = [measure.tally(row["energies"], 1.0, best[row["digest"]]) for row in rows]
    numbers = [", ".join(f"{t.n_successes} of {t.n_reads} calls" for t in reached) or "200x200 was not run"]
    planted = [outcome for outcome in outcomes if outcome.family.group == "planted loops"]
    for solver in (DMM, SA):
        for power in (True, False):
            fit = planted_fit(planted, solver, power=power)
            if fit is not None:
                law = "n^" if power else "exp(n x) with x = "
                numbers.append(f"{solver}: {law}{interval(fit.slope)}")
    met = all(t.n_successes > 0 for t in reached) if reached else None
    return Verdict(text, met, "; ".join(numbers))


def planted_fit(planted: Sequence[Outcome], solver: str, *, power: bool) -> measure.Fit | None:
    """Fit over the sizes at which every instance was solved, with the best setting of each; None below three."""
    found = [(o.family.n, o.tallies(solver, o.hindsight(solver))) for o in planted if solver in o.settings]
    found = [(n, tallies) for n, tallies in found if all(tally.n_successes for tally in tallies)]
    if len(found) < 3:
        return None
    return measure.scaling(*zip(*found, strict=True), power=power)


def _throughput(row: Row) -> Verdict:
    text = "500 problems of 32x32 x 28 restarts at once: 20 times the throughput of single reference calls"
    ratio = row["single_seconds"] / row["batch_seconds"]
    numbers = f"{row['n_problems']} problems in {row['batch_seconds']:.3g} s, singly {row['single_seconds']:.3g} s"
    return Verdict(text, ratio >= 20, f"{ratio:.1f} times: {numbers}")


def _linear(costs: Sequence[Row]) -> Verdict:
    text = "DMM: cost of a coupling and step within a factor 1.5 up to 1,000,000 couplings"
    if len(costs) < 3:
        return Verdict(text, None, "not run")
    n, step, memory = (np.array([row[name] for row in costs]) for name in ("n_couplings", "step_seconds", "bytes"))
    exponents = [float(np.polyfit(np.log(n), np.log(np.maximum(y, 1e-12)), 1)[0]) for y in (step, memory)]
    numbers = [
        f"{k:,}: {s / k * 1e9:.3g} ns a coupling, step and restart, {m / k:.3g} bytes a coupling (4 restarts)"
        for k, s, m in zip(n, step, memory, strict=True)
    ]
    start = "time grows as couplings^{:.2f}, memory as couplings^{:.2f}. ".format(*exponents)
    each = step / n
    return Verdict(text, float(each.max() / each.min()) <= 1.5, start + "; ".join(numbers))


def markdown(answers: Sequence[Verdict]) -> str:
    """A table."""
    words = {True: "met", False: "**not met**", None: "not measured"}
    lines = ["| target | verdict | numbers |", "| --- | --- | --- |"]
    lines += [f"| {answer.target} | {words[answer.met]} | {answer.numbers} |" for answer in answers]
    return "\n".join(lines) + "\n"
