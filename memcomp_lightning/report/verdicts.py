"""What the paper says of a figure, what was measured, and what the controls leave of it."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from memcomp_lightning.report.comparison import Comparison, compare
from memcomp_lightning.report.results import Results

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
    """Judge the claims of a figure."""
    if any(curve not in results.curves for curve in results.plan.claim):
        return []
    return _passes_claims(results) if results.plan.against == "passes" else _iterations_claims(results)


def horizontal_arrow(results: Results, passes: int) -> tuple[int, int] | None:
    """Pretraining iterations of the second curve for what the first one reaches at its last N, and that N.

    None if it never gets there.
    """
    first, second = results.plan.claim
    last = results.lengths(first)[-1]
    goal = results.point(first, last, passes).mean
    return next(
        ((n, last) for n in results.lengths(second) if results.point(second, n, passes).mean >= goal), None
    )


def vertical_arrow(results: Results, passes: int) -> Comparison:
    """Accuracy of the second curve less that of the first one, each at its last N."""
    first, second = results.plan.claim
    return compare(_at_last(results, second, passes), _at_last(results, first, passes))


def _at_last(results: Results, curve: str, passes: int) -> NDArray[np.float64]:
    return results.values(curve, results.lengths(curve)[-1], passes)


def _iterations_claims(results: Results) -> list[Verdict]:
    first, second = results.plan.claim
    names = results.plan.labels
    found = []
    for passes in results.plan.passes:
        last = results.lengths(second)[-1]
        after = f"after {passes} passes"
        arrow, goal = horizontal_arrow(results, passes), results.point(first, results.lengths(first)[-1], passes)
        free = [
            curve
            for curve in results.curves
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
        gain = vertical_arrow(results, passes)
        a, b = results.point(second, last, passes), goal
        found.append(
            Verdict(
                f"a gap remains at N = {last} ({after})",
                f"{a.mean:.3f} ± {a.error:.3f} against {b.mean:.3f} ± {b.error:.3f}",
                str(gain),
                *_verdict(results, gain.is_gain, explaining(results, passes, gain)),
            )
        )
    return found


def _passes_claims(results: Results) -> list[Verdict]:
    first, second = results.plan.claim
    names = results.plan.labels
    passes = results.plan.passes[-1]
    gain = vertical_arrow(results, passes)
    a, b = (results.point(curve, results.lengths(curve)[-1], passes) for curve in (second, first))
    fewer = (a.mean - b.mean) / (1 - b.mean)
    measured = f"{a.mean:.4f} ± {a.error:.4f} against {b.mean:.4f} ± {b.error:.4f}"
    by_control = explaining(results, passes, gain)
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


def explaining(results: Results, passes: int, gain: Comparison) -> list[str]:
    """Controls that account for more than half of a gain; other names for the compared methods are none."""
    first, second = results.plan.claim
    best = _at_last(results, second, passes)
    found = []
    for curve in results.curves:
        if curve in (first, second) or curve.startswith(f"{second}_"):
            continue
        left = compare(best, _at_last(results, curve, passes))
        if left.high < gain.effect / 2:
            found.append(curve)
    return found


def _verdict(results: Results, holds: bool, controls: list[str]) -> tuple[str, tuple[str, ...]]:
    if not holds:
        return FAILS, ()
    return (ONLY, tuple(results.plan.labels[curve] for curve in controls)) if controls else (HOLDS, ())
