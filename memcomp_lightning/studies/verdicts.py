"""What the paper says of a figure, what was measured, and what the controls leave of it."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from memcomp_lightning.studies.comparison import Comparison, accounts_for, compare
from memcomp_lightning.studies.results import Claim, Results

HOLDS, FAILS, ONLY = "holds", "does not hold", "holds only without controls"

RULE = (
    "A claim holds if the paired difference is positive with p < .05 (two-sided t test over partitions and "
    "seeds). It holds only without a control if that control accounts for more than half of the gain: the upper "
    "end of the 95 % interval of the better curve less the control lies below half of it. A claim of fewer "
    "iterations holds only if the other method itself gains by more of them (p < .05)."
)


class Verdict(NamedTuple):
    """One row of the table: a claim, numbers, the test of their difference, and controls that explain it."""

    claim: str
    measured: str
    test: str
    verdict: str
    explained_by: tuple[str, ...] = ()


def verdicts(results: Results) -> list[Verdict]:
    """Judge the claims of a figure, those of which both curves were measured."""
    judge = _against_passes if results.plan.against == "passes" else _against_iterations
    return [
        verdict
        for claim in results.plan.claims
        if set(claim.curves) <= set(results.curves)
        for verdict in judge(results, claim)
    ]


def horizontal_arrow(results: Results, claim: Claim, passes: int) -> tuple[int, int] | None:
    """The least N at which the better curve reaches the other one's accuracy at its last N, and that last N.

    None if it never reaches it.
    """
    last = results.lengths(claim.than)[-1]
    goal = results.point(claim.than, last, passes).mean
    lengths = results.lengths(claim.better)
    return next(((n, last) for n in lengths if results.point(claim.better, n, passes).mean >= goal), None)


def gains_by_pretraining(results: Results, claim: Claim, passes: int) -> bool:
    """Whether the other curve is better at its last N than at its first; if not, iterations saved say nothing."""
    lengths = results.lengths(claim.than)
    last, first = (results.values(claim.than, n, passes) for n in (lengths[-1], lengths[0]))
    gain = compare(last, first)
    return gain.effect > 0 and not gain.p >= 0.05


def vertical_arrow(results: Results, claim: Claim, passes: int) -> Comparison:
    """Accuracy of the better curve less that of the other one, each at its last N."""
    return compare(_at_last(results, claim.better, passes), _at_last(results, claim.than, passes))


def _at_last(results: Results, curve: str, passes: int) -> NDArray[np.float64]:
    return results.values(curve, results.lengths(curve)[-1], passes)


def _against_iterations(results: Results, claim: Claim) -> list[Verdict]:
    judges = [_is_above]
    if len(results.lengths(claim.better)) > 1:
        judges.insert(0, _needs_fewer_iterations)
    return [judge(results, claim, passes) for passes in results.plan.passes for judge in judges]


def _needs_fewer_iterations(results: Results, claim: Claim, passes: int) -> Verdict:
    names, lengths = results.plan.labels, results.lengths(claim.than)
    arrow, last = horizontal_arrow(results, claim, passes), lengths[-1]
    goal = results.point(claim.than, last, passes).mean
    untrained = [curve for curve in results.plan.controls(claim) if results.lengths(curve) == [0]]
    free = [curve for curve in untrained if results.point(curve, 0, passes).mean >= goal]
    measured = f"N = {arrow[0]} instead of {last} for {goal:.3f}" if arrow else f"never {goal:.3f}"
    holds = arrow is not None and arrow[0] < arrow[1]
    if not gains_by_pretraining(results, claim, passes):
        measured = (
            f"{names[claim.than]}: {goal:.3f} at N = {last}, not significantly more than at N = {lengths[0]}"
        )
        holds = False
    claimed = f"{names[claim.better]} needs fewer pretraining iterations than {names[claim.than]}"
    return Verdict(f"{claimed} (after {passes} passes)", measured, "", *_verdict(results, holds, free))


def _is_above(results: Results, claim: Claim, passes: int) -> Verdict:
    names, last = results.plan.labels, results.lengths(claim.better)[-1]
    gain = vertical_arrow(results, claim, passes)
    better, than = results.last(claim.better, passes), results.last(claim.than, passes)
    return Verdict(
        f"{names[claim.better]} is above {names[claim.than]} at N = {last} (after {passes} passes)",
        f"{better} against {than}",
        str(gain),
        *_verdict(results, gain.is_gain, explaining(results, claim, passes, gain)),
    )


def _against_passes(results: Results, claim: Claim) -> list[Verdict]:
    first, second = claim.curves
    names = results.plan.labels
    passes = results.plan.passes[-1]
    gain = vertical_arrow(results, claim, passes)
    a, b = results.last(second, passes), results.last(first, passes)
    fewer = (a.mean - b.mean) / (1 - b.mean)
    measured = f"{a.mean:.4f} ± {a.error:.4f} against {b.mean:.4f} ± {b.error:.4f}"
    by_control = explaining(results, claim, passes, gain)
    best = max(results.plan.passes, key=lambda p: results.last(first, p).mean)
    at_best = compare(_at_last(results, second, passes), _at_last(results, first, best))
    return [
        Verdict(
            f"{names[second]} is more than 1 % above {names[first]} (after {passes} passes)",
            measured,
            str(gain),
            *_verdict(results, gain.is_gain and gain.low > 0.01, by_control),
        ),
        Verdict(
            f"{names[second]} makes 20 % fewer errors (after {passes} passes)",
            f"{100 * fewer:.1f} % fewer errors" if fewer >= 0 else f"{-100 * fewer:.1f} % more errors",
            "",
            *_verdict(results, gain.is_gain and fewer >= 0.2, by_control),
        ),
        Verdict(
            f"{names[second]} (after {passes} passes) is above {names[first]} at its best pass ({best})",
            f"{a.mean:.4f} against {results.last(first, best).mean:.4f}",
            str(at_best),
            *_verdict(results, at_best.is_gain, explaining(results, claim, passes, at_best)),
        ),
    ]


def explaining(results: Results, claim: Claim, passes: int, gain: Comparison) -> list[str]:
    """Controls that account for more than half of a gain."""
    best = _at_last(results, claim.better, passes)
    measured = [curve for curve in results.plan.controls(claim) if curve in results.curves]
    return [c for c in measured if accounts_for(_at_last(results, c, passes), best, gain)]


def _verdict(results: Results, holds: bool, controls: list[str]) -> tuple[str, tuple[str, ...]]:
    if not holds:
        return FAILS, ()
    return (ONLY, tuple(results.plan.labels[curve] for curve in controls)) if controls else (HOLDS, ())
