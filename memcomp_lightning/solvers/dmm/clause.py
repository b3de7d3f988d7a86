"""Clause dynamics: every clause of a weighted MAX-SAT has a short- and a long-term memory.

Sources: [B] Bearden, Pei, Di Ventra, Sci. Rep. 10:19741 (2020), the 3-SAT form, eqs. 2 to 6. The weighted
two-literal form follows public research code of the same group. Constants: docs/dmm.md.
"""

import math
from dataclasses import dataclass, field
from typing import NamedTuple

from memcomp_lightning.arrays import Array, add_up, cast, multiply_add, namespace, sign
from memcomp_lightning.errors import require
from memcomp_lightning.problems.graph import Graph
from memcomp_lightning.problems.maxsat import Clauses, WeightedMaxSat, from_qubo, over_states
from memcomp_lightning.problems.qubo import Qubo
from memcomp_lightning.solvers.dmm.integrate import Integrator, Splitting
from memcomp_lightning.solvers.dmm.scaling import (
    DEGREE_EXPONENT,
    by_largest,
    coupling_norm,
    decisive,
    effective_degree,
    expand,
    mean_of_used,
    step_scale,
)


class ClauseMachine(NamedTuple):
    """A problem in the machine's units; per-clause arrays have an axis of size 1 for the restarts.

    Clauses of three literals and more are padded to the longest one with polarity 0. ``degree`` is the
    effective one, ``(*problems,)``.
    """

    graph: Graph
    weight: Array
    first: Array
    second: Array
    unit: Array
    unit_sign: Array
    longer_variables: Array
    longer_polarity: Array
    longer_weight: Array
    stability: Array
    degree: Array


class ClauseState(NamedTuple):
    """Voltages ``(*problems, n_restarts, n)``, memories of pairs, of unit clauses and of longer clauses."""

    voltage: Array
    short_term: Array
    long_term: Array
    unit_long_term: Array
    longer_short_term: Array
    longer_long_term: Array


@dataclass(frozen=True, kw_only=True, slots=True)
class ClauseField:
    r"""Equations of the default DMM: clauses with memories push the voltages until they are satisfied.

    With literal polarity q, voltage v in [-1, 1], clause weight w, the falsehood f_i = 1/2 (1 - q_i v_i) of a
    literal and the clause's unsatisfaction ``C = min_i f_i``:

    .. math::
        \dot v_i &= \sum_m w_m [x_l x_s G_i + (1 + \zeta x_l)(1 - x_s) R_i] + \rho u_i y_i \\
        G_i &= q_i \min_{j \ne i} f_j, \qquad R_i = q_i C \text{ where } f_i = C \text{, else } 0 \\
        \dot x_s &= \beta (x_s + \epsilon)(C - \gamma), \quad x_s \in [0, 1] \\
        \dot x_l &= \alpha (C - \delta) \cdot (x_l - 1 \text{ if } C < \delta \text{ else } 1),
                    \quad x_l \in [1, 1 + (x_{max} - 1) d^{-0.17}]

    and y, the long-term memory of a unit clause of signed weight u, like x_l. Weights are divided by
    :func:`~memcomp_lightning.solvers.dmm.scaling.coupling_norm`, so that the drive of a voltage does not depend
    on the problem's units, size and degrees; d is its
    :func:`~memcomp_lightning.solvers.dmm.scaling.effective_degree`.

    Attributes:
        alpha: Rate of the long-term memory, > 0.
        beta: Rate of the short-term memory, > 0.
        gamma: Threshold of the short-term memory, in (0, 1/2).
        delta: Threshold of the long-term memory, in (0, gamma].
        epsilon: Keeps the short-term memory from sticking at 0, > 0.
        zeta: Share of the long-term memory in the rigidity, >= 0.
        long_term_max: x_max, upper bound of the long-term memories at degree 1, >= 1; 1 freezes them.
        unit_pull: rho, strength of the unit clauses, > 0.
        noise: Width of the uniform noise on the voltages per square root of machine time, >= 0.
        spread: Initial voltages are uniform in [-spread, spread], in (0, 1].
        integrator: The scheme that the constants were chosen with.
    """

    alpha: float = 13.5
    beta: float = 0.14
    gamma: float = 0.031
    delta: float = 0.028
    epsilon: float = 0.65
    zeta: float = 0.0
    long_term_max: float = 10.2
    unit_pull: float = 0.94
    noise: float = 0.0
    spread: float = 0.5
    integrator: Integrator = field(
        default_factory=lambda: Splitting(change=0.9, dt_min=0.0126, dt_max=6.0, lag=0.3)
    )

    def __post_init__(self) -> None:
        for name in ("alpha", "beta", "epsilon", "unit_pull"):
            require(getattr(self, name) > 0, name, getattr(self, name), "a number > 0")
        require(0 < self.gamma < 0.5, "gamma", self.gamma, "a number in (0, 1/2)")
        require(0 < self.delta <= self.gamma, "delta", self.delta, f"a number in (0, gamma = {self.gamma}]")
        for name in ("zeta", "noise"):
            require(getattr(self, name) >= 0, name, getattr(self, name), "a number >= 0")
        require(self.long_term_max >= 1, "long_term_max", self.long_term_max, "a number >= 1")
        require(0 < self.spread <= 1, "spread", self.spread, "a number in (0, 1]")

    def most_long_term(self, degree: Array) -> Array:
        """Upper bound of the long-term memories at an effective degree."""
        return 1 + (self.long_term_max - 1) * degree**-DEGREE_EXPONENT

    def build(self, problem: Qubo | WeightedMaxSat) -> ClauseMachine:
        """Write a QUBO as MAX-SAT and divide the weights by their scale."""
        maxsat = problem if isinstance(problem, WeightedMaxSat) else from_qubo(problem)
        n_axes = len(maxsat.graph.edge_shape)
        longer = _padded(maxsat)
        # Longer clauses stand behind the pairs while the scale is found.
        n_pairs = math.prod(maxsat.graph.edge_shape)
        xp, flat = namespace(maxsat.unit), maxsat.weight.reshape(*maxsat.problems, n_pairs)
        flat = xp.concat((flat, longer.weight), axis=-1)
        flat, unit = by_largest(flat, maxsat.unit, 1)
        weight = flat[..., :n_pairs].reshape(maxsat.weight.shape)
        longer_weight = flat[..., n_pairs:]
        scale = coupling_norm(maxsat.graph, weight)
        if maxsat.longer:
            norm = mean_of_used(_per_variable(longer, longer_weight * longer_weight, maxsat.n)) ** 0.5
            alone = (flat[..., :n_pairs] == 0).all(-1) & (norm > 0)
            scale = xp.where(alone, norm, scale)
        weight, unit = weight / expand(scale, n_axes), unit / scale[..., None]
        if not maxsat.longer:
            unit = decisive(maxsat.graph, weight, unit)
        longer_weight = longer_weight / scale[..., None]
        size, power = (
            maxsat.graph.scatter(of_pairs, of_pairs) + _per_variable(longer, of_longer, maxsat.n)
            for of_pairs, of_longer in ((weight, longer_weight), (weight * weight, longer_weight * longer_weight))
        )
        return ClauseMachine(
            graph=maxsat.graph,
            weight=over_states(weight, n_axes),
            first=over_states(maxsat.first, n_axes),
            second=over_states(maxsat.second, n_axes),
            unit=unit[..., None, :],
            unit_sign=sign(unit)[..., None, :],
            longer_variables=longer.variables,
            longer_polarity=longer.polarity,
            longer_weight=longer_weight[..., None, :],
            stability=cast(step_scale(maxsat.n, (size > 0).sum(-1)), weight.dtype)[..., None],
            degree=effective_degree(size, power),
        )

    def stability(self, machine: ClauseMachine) -> Array:
        """Smaller steps for larger problems."""
        return machine.stability

    def init(self, machine: ClauseMachine, voltage: Array) -> ClauseState:
        """x_s(0) = C(0), long-term memories at 1 ([B], methods)."""
        xp, unsatisfied = namespace(voltage), _unsatisfaction(machine, voltage)[0]
        longer = xp.min(_falsehood(machine, voltage), axis=-1)
        return ClauseState(
            voltage=voltage,
            short_term=unsatisfied,
            long_term=xp.ones_like(unsatisfied),
            unit_long_term=xp.ones_like(voltage),
            longer_short_term=longer,
            longer_long_term=xp.ones_like(longer),
        )

    def derivative(self, machine: ClauseMachine, state: ClauseState) -> ClauseState:
        """Right-hand side; each line names its equation."""
        voltage = state.voltage
        # [B] eq. 3: C = 1/2 min_i (1 - q_i v_i).
        unsatisfied, false_first, false_second = _unsatisfaction(machine, voltage)
        # [B] eq. 4: each literal is pushed by how false the other one is.
        gradient = machine.weight * state.long_term * state.short_term
        # [B] eq. 5. Deviation: a tie goes to the first literal alone.
        rigidity = machine.weight * (1 + self.zeta * state.long_term) * (1 - state.short_term) * unsatisfied
        rigidity_first = rigidity * (false_first <= false_second)
        # [B] eq. 2, one sum for each end of the clauses.
        drive = machine.graph.scatter(
            machine.first * multiply_add(rigidity_first, gradient, false_second),
            machine.second * multiply_add(rigidity - rigidity_first, gradient, false_first),
        )
        # Deviation: unit clauses pull with a long-term memory of their own, not as two equal literals.
        drive = drive + self.unit_pull * machine.unit * state.unit_long_term
        longer_unsatisfied = state.longer_short_term
        if machine.longer_weight.shape[-1]:
            longer_drive, longer_unsatisfied = self._longer(machine, state)
            drive = drive + longer_drive
        return ClauseState(
            voltage=drive,
            short_term=self._short_term_rate(unsatisfied, state.short_term),
            long_term=self._long_term_rate(unsatisfied, state.long_term),
            unit_long_term=self._long_term_rate(0.5 * (1 - machine.unit_sign * voltage), state.unit_long_term),
            longer_short_term=self._short_term_rate(longer_unsatisfied, state.longer_short_term),
            longer_long_term=self._long_term_rate(longer_unsatisfied, state.longer_long_term),
        )

    def _longer(self, machine: ClauseMachine, state: ClauseState) -> tuple[Array, Array]:
        """Drive and C of the clauses of three literals and more: the same equations, [B] eqs. 2 to 5."""
        false = _falsehood(machine, state.voltage)
        xp, smallest = namespace(false), namespace(false).min(false, axis=-1)
        is_smallest = false.argmin(-1)[..., None] == xp.arange(false.shape[-1], device=false.device)
        next_smallest = xp.min(xp.where(is_smallest, xp.inf, false), axis=-1)
        others = xp.where(is_smallest, next_smallest[..., None], smallest[..., None])
        gradient = machine.longer_weight * state.longer_long_term * state.longer_short_term
        stiffness = (1 + self.zeta * state.longer_long_term) * (1 - state.longer_short_term)
        rigidity = machine.longer_weight * stiffness * smallest
        push = machine.longer_polarity * (gradient[..., None] * others + rigidity[..., None] * is_smallest)
        of_literals = push.reshape(*push.shape[:-2], -1)
        return add_up(of_literals, machine.longer_variables.reshape(-1), state.voltage.shape[-1]), smallest

    def _short_term_rate(self, unsatisfied: Array, short_term: Array) -> Array:
        """[B] eq. 6."""
        return self.beta * (short_term + self.epsilon) * (unsatisfied - self.gamma)

    def _long_term_rate(self, unsatisfied: Array, long_term: Array) -> Array:
        """[B] eq. 7. Deviations: no factor (1 + w), and below delta the decay towards 1 is exponential."""
        excess = unsatisfied - self.delta
        return self.alpha * multiply_add(excess.clip(min=0), excess.clip(max=0), long_term - 1)

    def bound(self, machine: ClauseMachine, state: ClauseState) -> ClauseState:
        """V in [-1, 1], x_s in [0, 1], long-term memories in [1, :meth:`most_long_term`]."""

        def bounded(memory: Array) -> Array:
            most = self.most_long_term(machine.degree)
            return namespace(memory).minimum(memory.clip(min=1), expand(most, memory.ndim - most.ndim))

        return ClauseState(
            voltage=state.voltage.clip(-1, 1),
            short_term=state.short_term.clip(0, 1),
            long_term=bounded(state.long_term),
            unit_long_term=bounded(state.unit_long_term),
            longer_short_term=state.longer_short_term.clip(0, 1),
            longer_long_term=bounded(state.longer_long_term),
        )


def _unsatisfaction(machine: ClauseMachine, voltage: Array) -> tuple[Array, Array, Array]:
    """C of each pair, and how false each of its two literals is: 1/2 (1 - q v)."""
    first, second = machine.graph.gather(voltage)
    false_first = 0.5 - 0.5 * machine.first * first
    false_second = 0.5 - 0.5 * machine.second * second
    return namespace(voltage).minimum(false_first, false_second), false_first, false_second


def _falsehood(machine: ClauseMachine, voltage: Array) -> Array:
    """How false each literal of the longer clauses is; 1 for a padded one, which is never the smallest."""
    false = 0.5 - 0.5 * machine.longer_polarity * voltage[..., machine.longer_variables]
    return namespace(false).where(machine.longer_polarity == 0, 1.0, false)


def _padded(maxsat: WeightedMaxSat) -> Clauses:
    """All longer clauses as one block, padded with variable 0 at polarity 0."""
    unit, xp = maxsat.unit, namespace(maxsat.unit)
    length = max((block.variables.shape[-1] for block in maxsat.longer), default=3)
    none = Clauses(
        variables=xp.zeros((0, length), dtype=xp.int64, device=unit.device),
        polarity=xp.zeros((0, length), dtype=unit.dtype, device=unit.device),
        weight=xp.zeros((*maxsat.problems, 0), dtype=unit.dtype, device=unit.device),
    )

    def padded(x: Array) -> Array:
        missing = xp.zeros((len(x), length - x.shape[-1]), dtype=x.dtype, device=x.device)
        return xp.concat((x, missing), axis=-1)

    blocks = (none, *maxsat.longer)
    return Clauses(
        variables=xp.concat([padded(block.variables) for block in blocks]),
        polarity=xp.concat([padded(block.polarity) for block in blocks]),
        weight=xp.concat([block.weight for block in blocks], axis=-1),
    )


def _per_variable(clauses: Clauses, values: Array, n: int) -> Array:
    """Sum of a number a clause over the clauses of each variable, ``(*problems, n)``."""
    per_literal = values[..., None] * (clauses.polarity != 0)
    return add_up(per_literal.reshape(*values.shape[:-1], -1), clauses.variables.reshape(-1), n)
