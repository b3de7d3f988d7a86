"""What the paper says of a figure, what was measured, and what the controls leave of it."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from memcomp_lightning.report.comparison import Comparison, compare
from memcomp_lightning.report.results import Claim, Results

HOLDS, FAILS, ONLY = "holds", "does not hold", "holds only without controls"

RULE = (
    "A claim holds if the paired difference is positive with p < .05 (two-sided t test over partitions and "
    "seeds). It holds only without a control if that control accounts for more than half of the gain: the upper "
    "end of the 95 % interval of Mem-QUBO less the control lies below half of it."
)


class Verdict(NamedTuple):
    """One row of the table.

    Attributes:
        claim: The paper's, in one sentence.
        measured: Numbers.
        test: Paired difference, interval, p value.
        verdict: Holds, does not hold, or holds only without some controls.
        explained_by: These controls.
    """

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
    """Pretraining iterations of the better curve for what the other one reaches at its last N, and that N.

    None if it never gets there.
    """
    last = results.lengths(claim.than)[-1]
    goal = results.point(claim.than, last, passes).mean
    lengths = results.lengths(claim.better)
    return next(((n, last) for n in lengths if results.point(claim.better, n, passes).mean >= goal), None)


def vertical_arrow(results: Results, claim: Claim, passes: int) -> Comparison:
    """Accuracy of the better curve less that of the other one, each at its last N."""
    return compare(_at_last(results, claim.better, passes), _at_last(results, claim.than, passes))


def _at_last(results: Results, curve: str, passes: int) -> NDArray[np.float64]:
    return results.values(curve, results.lengths(curve)[-1], passes)


def _against_iterations(results: Results, claim: Claim) -> list[Verdict]:
    first, second = claim.curves
    names = results.plan.labels
    found = []
    for passes in results.plan.passes:
        last = results.lengths(second)[-1]
        after = f"after {passes} passes"
        arrow = horizontal_arrow(results, claim, passes)
        goal = results.point(first, results.lengths(first)[-1], passes)
        free = [
            curve
            for curve in results.plan.controls(claim)
            if results.lengths(curve) == [0] and results.point(curve, 0, passes).mean >= goal.mean
        ]
        saved = arrow is not None and arrow[0] < arrow[1]
        found.append(
            Verdict(
                f"{names[second]} needs fewer pretraining iterations than {names[first]} ({after})",
                f"N = {arrow[0]} instead of {arrow[1]} for {goal.mean:.3f}" if arrow else f"never {goal.mean:.3f}",
                "",
                *_verdict(results, saved, free),
            )
        )
        gain = vertical_arrow(results, claim, passes)
        found.append(
            Verdict(
                f"{names[second]} is above {names[first]} at N = {last} ({after})",
                f"{results.point(second, last, passes)} against {goal}",
                str(gain),
                *_verdict(results, gain.is_gain, explaining(results, claim, passes, gain)),
            )
        )
    return found


def _against_passes(results: Results, claim: Claim) -> list[Verdict]:
    first, second = claim.curves
    names = results.plan.labels
    passes = results.plan.passes[-1]
    gain = vertical_arrow(results, claim, passes)
    a, b = (results.point(curve, results.lengths(curve)[-1], passes) for curve in (second, first))
    fewer = (a.mean - b.mean) / (1 - b.mean)
    measured = f"{a.mean:.4f} ± {a.error:.4f} against {b.mean:.4f} ± {b.error:.4f}"
    by_control = explaining(results, claim, passes, gain)
    best = max(results.plan.passes, key=lambda p: results.point(first, results.lengths(first)[-1], p).mean)
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
            f"{a.mean:.4f} against {results.point(first, results.lengths(first)[-1], best).mean:.4f}",
            str(at_best),
            *_verdict(results, at_best.is_gain, by_control),
        ),
    ]


def explaining(results: Results, claim: Claim, passes: int, gain: Comparison) -> list[str]:
    """Controls that account for more than half of a gain."""
    best = _at_last(results, claim.better, passes)
    measured = [curve for curve in results.plan.controls(claim) if curve in results.curves]
    return [c for c in measured if compare(best, _at_last(results, c, passes)).high < gain.effect / 2]


def _verdict(results: Results, holds: bool, controls: list[str]) -> tuple[str, tuple[str, ...]]:
    if not holds:
        return FAILS, ()
    return (ONLY, tuple(results.plan.labels[curve] for curve in controls)) if controls else (HOLDS, ())
