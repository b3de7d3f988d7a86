"""Which vector fields have compiled passes: one row each."""

from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

from memcomp_lightning.arrays import Array, namespace
from memcomp_lightning.solvers.dmm.bond import BondField
from memcomp_lightning.solvers.dmm.clause import ClauseField, ClauseMachine
from memcomp_lightning.solvers.dmm.kernels import lanes
from memcomp_lightning.solvers.dmm.kernels.common import CONSTANTS


class Listed(NamedTuple):
    """A machine as arrays of its pairs, units and longer clauses.

    Attributes:
        weight: A number a pair, ``(n_problems, ..., n_pairs)`` in the order of the graph's edges.
        unit: A number a variable, ``(n_problems, ..., n)``.
        polarity: Two numbers a pair, ``(n_problems, n_pairs, 2)``; None for zeros.
        longer: Variables, polarities and weights of longer clauses; None where there are none.
    """

    weight: Array
    unit: Array
    polarity: Array | None = None
    longer: tuple[Array, Array, Array] | None = None


class Compiled(NamedTuple):
    """What the kernel for listed pairs needs of a field.

    ``start`` and ``advance`` are compiled by ``njit(nogil=True, forceinline=True)``. Arrays are float32, with the
    lanes, which are restarts, on the last axis. They get

    * ``problem``: (kind, pairs, weight, polarity, unit, longer): the variables of each pair, ``(n_pairs, 2)``, and
      the numbers of :class:`Listed`;
    * ``memories``: of pairs, short- and long-term, ``(2, n_pairs, lanes)``; short- and long-term ones of units,
      ``(n, lanes)`` each; of longer clauses, ``(2, n_longer, lanes)``. Long-term ones, less 1, are set;
    * ``voltage``, ``(n, lanes)``, and ``c``, the row of constants.

    Attributes:
        kind: Chooses the passes when the kernel is compiled: an instance of a NamedTuple class of the field's own.
        constants: Settings of the field, in the order of ``c``.
        listed: From the field's machine to its arrays.
        of_problem: From field and machine to the settings that differ from problem to problem, ``(n_problems,)``.
        start: ``start(problem, memories, voltage, c)`` writes the short-term memories.
        advance: ``advance(problem, memories, voltage, rate, scratch, c, dt)`` moves the memories by ``dt``, one
            number a lane, at the present voltages, and adds the rate of the voltages to ``rate[0]``. The shape of
            ``rate`` is ``(2, n, lanes)``, and ``rate[1]`` is scratch, at first 0.
        obstacle: Why some settings of the field have no compiled passes, and what to do; None if these have.
    """

    kind: Any
    constants: tuple[str, ...]
    listed: Callable[[Any], Listed]
    of_problem: Callable[[Any, Any], Mapping[str, Array]]
    start: Any
    advance: Any
    obstacle: Callable[[Any], str | None] = lambda field: None


class Clauses(NamedTuple):
    """Kind of :class:`ClauseField`."""

    number: int = 0


class Bonds(NamedTuple):
    """Kind of :class:`BondField`."""

    number: int = 1


def _listed_clauses(machine: ClauseMachine) -> Listed:
    xp, shape = namespace(machine.weight), machine.weight.shape
    both = [xp.broadcast_to(q, shape).reshape(shape[0], -1) for q in (machine.first, machine.second)]
    polarity = xp.stack(both, axis=-1)
    longer = (machine.longer_variables, machine.longer_polarity, machine.longer_weight[..., 0, :])
    return Listed(machine.weight, machine.unit, polarity, longer)


def _clause_obstacle(field: ClauseField) -> str | None:
    decays = field.zeta > 0
    return f"zeta = {field.zeta:g} has no compiled kernel: set it to 0 for speed." if decays else None


FIELDS: dict[type, Compiled] = {
    ClauseField: Compiled(
        Clauses(),
        CONSTANTS,
        _listed_clauses,
        lambda field, machine: {"long_term_max": field.most_long_term(machine.degree)},
        lanes.clause_start,
        lanes.clause_advance,
        _clause_obstacle,
    ),
    BondField: Compiled(
        Bonds(),
        CONSTANTS,
        lambda machine: Listed(machine.bond, machine.field),
        lambda field, machine: {"pull_scale": machine.pull_scale},
        lanes.bond_start,
        lanes.bond_advance,
    ),
}
"""By the class of the field. ``rows`` is faster for two coupled layers, and has these two alone."""
