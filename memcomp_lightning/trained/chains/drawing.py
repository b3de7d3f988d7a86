"""Draws rows from a model by the simplest method that is known to work for it."""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import torch
from torch import Generator, Tensor

from memcomp_lightning.errors import require
from memcomp_lightning.likelihood.missing.choice import MOST_HIDDEN_BITS
from memcomp_lightning.samplers.parallel_tempering import Ladder, betas
from memcomp_lightning.trained.chains.exact import MOST_BITS, exact, why_exact
from memcomp_lightning.trained.chains.measured import (
    N_RENEWALS,
    R_HAT,
    Measured,
    effective_share,
    measured,
    spacing_of,
)
from memcomp_lightning.trained.chains.processes import Gibbs, Process, Tempering, fitted
from memcomp_lightning.trained.chains.report import Exchanges, Mixing
from memcomp_lightning.trained.chains.starts import overdispersed
from memcomp_lightning.trained.chains.target import Target
from memcomp_lightning.trained.chains.watch import Watch

METHODS = ("auto", "exact", "gibbs", "tempering")
"""How rows are drawn."""

Kept = Callable[[Tensor], Tensor]
"""Numbers of the sites of values of the visible units."""

N_LOOKS, BETWEEN = 4, 32
"""Looks at the chains before they are judged, which say what to watch; and sweeps between them."""

N_CHAINS_OF_ROW = 8
"""Least number of chains that are compared in a row, where there are several rows."""

FEWEST_LADDERS = 16
"""Of temperatures, however few chains there are."""

AT_ONCE = 4096
"""Chains of all temperatures that run side by side at most."""

MOST_PARTS = 4
"""Sweeps in which rows are drawn, at most, over those by which the chains are judged."""

FORGOTTEN = 20
"""Autocorrelation times after which chains have forgotten their start."""


@dataclass(frozen=True)
class Effort:
    """How much work chains do.

    Attributes:
        n_chains: Side by side, >= 32; a quarter as many ladders of temperatures.
        most_sweeps: Of the part by which chains are judged, >= 256; there are as many before it.
    """

    n_chains: int = 128
    most_sweeps: int = 4096


def draw(
    target: Target, n: int, *, method: str, effort: Effort, kept: Kept, generator: Generator
) -> tuple[Tensor, Mixing]:
    """Draw n rows for each row of the target.

    Args:
        target: Model, and what is known.
        n: Rows of each.
        method: One of :data:`METHODS`.
        effort: Of the chains.
        kept: Makes the numbers that are returned.
        generator: Random stream.

    Returns:
        ``(n_rows * n, n_sites)``, row by row, and how they were drawn.

    Raises:
        SettingError: The model is too large for ``exact``.
    """
    reason = why_exact(target)
    if method == "exact":
        allowed = f"a model with a layer of up to {MOST_BITS} bits"
        if target.v is not None:
            allowed = f"a model with up to {MOST_HIDDEN_BITS} hidden bits, where values are known"
        require(reason is not None, "method", "exact", f"{allowed}, or method=auto")
    if reason is not None and method in ("auto", "exact"):
        found = kept(exact(target, n, generator=generator))
        return found, Mixing.of_independent(len(found), reason)
    tried: Measured[Any] | None = None
    if method != "tempering":
        judged = _gibbs(target, effort, generator)
        if judged.measured.mixed or method == "gibbs":
            return _taken(target, n, judged, effort, kept, generator)
        tried = judged.measured
    judged = _tempering(target, effort, generator)
    found, mixing = _taken(target, n, judged, effort, kept, generator)
    if tried is not None:
        mixing = replace(mixing, reason=f"plain Gibbs chains do not mix (R-hat {tried.r_hat:.2f})")
    return found, mixing


class _Judged(NamedTuple):
    """Chains whose mixing is known.

    Attributes:
        process: The chains.
        n_chains: Of them.
        measured: How they mix.
        n_sweeps: Sweeps before that.
    """

    process: Process[Any]
    n_chains: int
    measured: Measured[Any]
    n_sweeps: int


def _gibbs(target: Target, effort: Effort, generator: Generator) -> _Judged:
    """Plain chains of some of the rows."""
    some = target.some(effort.n_chains // N_CHAINS_OF_ROW)
    n_of_row = effort.n_chains // some.n_rows
    process = Gibbs(some.chains(n_of_row))
    start = overdispersed(target.model, process.chains, n_of_row * some.n_rows, generator=generator)
    return _judged(process, process.begin(start), target, n_of_row, 0, effort, generator)


def _tempering(target: Target, effort: Effort, generator: Generator) -> _Judged:
    """Ladders of some of the rows."""
    n_ladders = max(FEWEST_LADDERS, effort.n_chains // 4)
    some = target.some(n_ladders // N_CHAINS_OF_ROW)
    n_of_row = n_ladders // some.n_rows
    chains = some.chains(n_of_row)
    start = overdispersed(target.model, chains, n_of_row * some.n_rows, generator=generator)
    process, state, n_rounds = fitted(chains, start, generator=generator)
    return _judged(process, state, target, n_of_row, n_rounds, effort, generator)


def _judged(
    process: Process[Any],
    state: Any,
    target: Target,
    n_of_row: int,
    n_sweeps: int,
    effort: Effort,
    generator: Generator,
) -> _Judged:
    looks = []
    for _ in range(N_LOOKS):
        for _ in range(BETWEEN):
            state = process.advance(state, generator=generator)
        looks.append(process.x_of(state))
    watch = Watch.of(target.model, torch.stack(looks), n_of_row)
    found = measured(
        process,
        state,
        watch,
        n_chains_of_row=n_of_row,
        most_sweeps=effort.most_sweeps,
        generator=generator,
    )
    return _Judged(process, len(looks[0]), found, n_sweeps + N_LOOKS * BETWEEN)


def _taken(
    target: Target, n: int, judged: _Judged, effort: Effort, kept: Kept, generator: Generator
) -> tuple[Tensor, Mixing]:
    """Rows from chains that were judged, or from others of their kind."""
    process, known = judged.process, judged.measured
    if target.n_rows == 1:
        parts, n_of_row, warm_up = [target], judged.n_chains, 0
    else:
        n_of_row = max(1, min(n, judged.n_chains // target.n_rows))
        n_temperatures = process.n_temperatures if isinstance(process, Tempering) else 1
        parts = target.parts(max(1, AT_ONCE // (n_temperatures * n_of_row)))
        warm_up = min(effort.most_sweeps, max(64, math.ceil(FORGOTTEN * known.autocorrelation)))
    n_draws = math.ceil(n / n_of_row)
    # Chains that do not mix come no further if one waits.
    wanted = spacing_of(known.autocorrelation) if known.mixed else BETWEEN
    spacing = max(1, min(wanted, MOST_PARTS * effort.most_sweeps // n_draws))
    found, state = [], known.state
    for part in parts:
        if target.n_rows > 1:
            chains = part.chains(n_of_row)
            start = overdispersed(target.model, chains, n_of_row * part.n_rows, generator=generator)
            process = replace(process, chains=chains)  # type: ignore[type-var]
            state = process.begin(start)
        for _ in range(warm_up):
            state = process.advance(state, generator=generator)
        draws = []
        for _ in range(n_draws):
            for _ in range(spacing):
                state = process.advance(state, generator=generator)
            draws.append(kept(process.x_of(state)[:, : target.model.n_visible]))
        # Draws of a row in the order of time, so that the first ones are of different chains.
        by_row = torch.stack(draws).unflatten(1, (part.n_rows, n_of_row)).transpose(0, 1).flatten(1, 2)
        found.append(by_row[:, :n].flatten(0, 1))
    v = torch.cat(found)
    effective = len(v) * effective_share(known.autocorrelation, spacing, n_draws)
    if not known.mixed:  # all rows of a chain are of one mode, perhaps
        effective = min(effective, n_of_row * target.n_rows)
    mixing = Mixing(
        "tempering" if isinstance(process, Tempering) else "gibbs",
        len(v),
        known.r_hat,
        known.autocorrelation,
        effective,
        judged.n_sweeps + known.n_sweeps + warm_up + n_draws * spacing,
        exchanges=_exchanges(known.state, known.renewals) if isinstance(process, Tempering) else None,
    )
    return v, mixing if known.mixed else replace(mixing, warning=_warning(mixing))


def _exchanges(ladder: Ladder, round_trips: float) -> Exchanges:
    hottest, lowest = float(betas(ladder.gap)[-1]), float(ladder.swap_rate.min())
    return Exchanges(len(ladder.gap) + 1, hottest, lowest, round_trips)


def _warning(mixing: Mixing) -> str:
    """What is wrong with chains that do not mix, and what to do."""
    seen = f"R-hat {mixing.r_hat:.2f}, expected at most {R_HAT}"
    if mixing.r_hat <= R_HAT and mixing.exchanges is not None:
        seen = f"{mixing.exchanges.round_trips:.2g} round trips a ladder, expected at least {N_RENEWALS}"
    if mixing.method == "gibbs":
        return (
            f"the chains do not mix ({seen}): how often a mode comes up is how often chains began near it. "
            "Type method=tempering, or leave method at auto."
        )
    return (
        f"not even parallel tempering mixes ({seen}): how often a mode comes up is not known. Type "
        "most_sweeps=20000, or train with a penalty that keeps weights small (pretrain.penalties.l2)."
    )
