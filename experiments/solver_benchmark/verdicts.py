"""The issue's targets, each with the numbers that decide it."""

import statistics
from collections.abc import Sequence
from typing import NamedTuple

import measure
import numpy as np
from report import Outcome, Record, interval
from sweep import Row

DMM, SA = "DMM", "SA (dwave)"


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
    large = [row for row in calls if row["family"].startswith("plain") and row["family"].endswith("784x500")]
    files = [row for row in calls if row["family"] in ("G-set", "Beasley")]
    return [
        _small(calls, best),
        _ratio("32x32 and 100x100: TTS99 at most half of best-tuned SA", table, ("32x32", "100x100"), 0.5),
        _ratio("250x200: TTS99 at most that of best-tuned SA", table, ("250x200",), 1.0),
        _gap("784x500, plain: within 1e-4 of the best known in the time of tabu, 28 x 20 ms", large, best, 1e-4),
        _gap("G-set, Beasley: within 2e-3 in the time of SA, 28 x 1,000 sweeps", files, best, 2e-3),
        _planted(outcomes, calls, best),
        _throughput(throughput),
        _linear(costs),
    ]


def _small(calls: Sequence[Row], best: dict[str, float]) -> Verdict:
    rows = [row for row in calls if "32x32" in row["family"]]
    text = "32x32, 28 restarts, defaults, warm: at most 5 ms; the optimum of every instance within 10 calls"
    if not rows:
        return Verdict(text, None, "not run")
    slowest = max(statistics.median(row["call_seconds"]) for row in rows)
    missed = [row["instance"] for row in rows if not measure.tally(row["energies"], 1.0, best[row["digest"]])[1]]
    numbers = (
        f"slowest instance's median {slowest * 1e3:.2f} ms; optimum: {len(rows) - len(missed)} of {len(rows)}"
    )
    numbers += f"; missed: {', '.join(missed)}" if missed else ""
    return Verdict(text, slowest <= 5e-3 and not missed, numbers)


def _ratio(text: str, table: Sequence[Record], sizes: tuple[str, ...], limit: float) -> Verdict:
    rows = [r for r in table if r["solver"] == DMM and "ratio" in r and r["family"].endswith(sizes)]
    if not rows:
        return Verdict(text, None, "not run")
    met = [r["ratio"].value <= limit and ">" not in r["ratio"].mark for r in rows]
    numbers = "; ".join(f"{r['family']}: {interval(r['ratio'], '{:.2g}')}" for r in rows)
    return Verdict(text, all(met), f"{sum(met)} of {len(met)} families. {numbers}")


def _gap(text: str, rows: Sequence[Row], best: dict[str, float], limit: float) -> Verdict:
    if not rows:
        return Verdict(text, None, "not run")
    met, numbers = [], []
    for row in rows:
        energy = best[row["digest"]]
        gap, theirs = ((max(row[name]) - energy) / abs(energy) for name in ("energies", "opponent_energies"))
        seconds, other = (statistics.median(row[name]) for name in ("call_seconds", "opponent_seconds"))
        met.append(gap <= limit and seconds <= other)
        numbers.append(f"{row['instance']}: {gap:.1e} in {seconds:.3g} s (theirs {theirs:.1e} in {other:.3g} s)")
    start = f"{sum(met)} of {len(met)} instances; gap of the worst of {len(rows[0]['energies'])} calls. "
    return Verdict(text, all(met), start + "; ".join(numbers))


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
    text = "cost and memory linear in the number of couplings up to 1,000,000"
    if len(costs) < 3:
        return Verdict(text, None, "not run")
    n, step, memory = (np.array([row[name] for row in costs]) for name in ("n_couplings", "step_seconds", "bytes"))
    exponents = [float(np.polyfit(np.log(n), np.log(np.maximum(y, 1e-12)), 1)[0]) for y in (step, memory)]
    numbers = [
        f"{k:,}: {s / k * 1e9:.3g} ns a coupling, step and restart, {m / k:.3g} bytes a coupling (4 restarts)"
        for k, s, m in zip(n, step, memory, strict=True)
    ]
    start = "time grows as couplings^{:.2f}, memory as couplings^{:.2f}. ".format(*exponents)
    return Verdict(text, max(exponents) <= 1.1, start + "; ".join(numbers))


def markdown(answers: Sequence[Verdict]) -> str:
    """A table."""
    words = {True: "met", False: "**not met**", None: "not measured"}
    lines = ["| target | verdict | numbers |", "| --- | --- | --- |"]
    lines += [f"| {answer.target} | {words[answer.met]} | {answer.numbers} |" for answer in answers]
    return "\n".join(lines) + "\n"
