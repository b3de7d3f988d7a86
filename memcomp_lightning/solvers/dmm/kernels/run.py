"""What every kernel takes and returns."""

from typing import NamedTuple

from memcomp_lightning.arrays import Array


class Visited(NamedTuple):
    """Digital states at intervals.

    Attributes:
        time: Machine time, ``(n_problems, n_restarts, n_records)`` float64.
        states: ``(n_problems, n_restarts, n_records, n)`` bool.
    """

    time: Array
    states: Array


class Start(NamedTuple):
    """Where a run begins.

    Attributes:
        voltage: ``(n_problems, n_restarts, n)`` in [-1, 1].
        kept: Long-term memories less their rest value 1, as an earlier run of the same kernel returned them;
            empty for memories at rest.
        seed: Of the noise, ``(n_problems, n_restarts)`` int64 in [0, 2^32).
    """

    voltage: Array
    kept: tuple[Array, ...]
    seed: Array


class Stall(NamedTuple):
    """When a restart has gone long enough without a better assignment.

    It ends at the first reading at or after step ``min_steps + factor found_at``.

    Attributes:
        min_steps: Steps that a restart gets in any case.
        factor: Steps that it gets for each step that its best assignment took.
    """

    min_steps: int
    factor: float


class Run(NamedTuple):
    """Outcome of one run of all restarts.

    Attributes:
        best: Best assignment a restart, ``(n_problems, n_restarts, n)`` bool.
        found_at: Step at which it was met, ``(n_problems, n_restarts)`` int64; 0 is the start.
        steps: Steps done, likewise.
        voltage: Final voltages.
        kept: Final long-term memories less 1, for a warm restart; empty if not asked for.
        visited: The records, if asked for.
    """

    best: Array
    found_at: Array
    steps: Array
    voltage: Array
    kept: tuple[Array, ...]
    visited: Visited | None
