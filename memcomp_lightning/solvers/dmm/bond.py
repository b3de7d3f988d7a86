r"""Bond dynamics: every coupling of the spin form has a short- and a long-term memory.

Source: [P] Pei, Di Ventra, arXiv:2102.04557, eqs. for v, X and Y. Constants: docs/dmm.md.
"""

from dataclasses import dataclass, field
from typing import ClassVar, NamedTuple

from memcomp_lightning.arrays import Array, namespace, sign
from memcomp_lightning.errors import require
from memcomp_lightning.problems.graph import Graph
from memcomp_lightning.problems.maxsat import WeightedMaxSat, as_qubo, over_states
from memcomp_lightning.problems.qubo import Qubo
from memcomp_lightning.solvers.dmm.integrate import Integrator, Splitting
from memcomp_lightning.solvers.dmm.scaling import (
    by_largest,
    collective_mode,
    coupling_norm,
    decisive,
    expand,
    mean_strength,
)


class BondMachine(NamedTuple):
    r"""Ferromagnetic bonds and fields in the machine's units, with an axis of size 1 for the restarts.

    ``pull_scale`` is the mean over the spins of ``\sum_j |J_ij|`` in the same units.
    """

    graph: Graph
    bond: Array
    field: Array
    pull_scale: Array


class BondState(NamedTuple):
    """Voltages ``(*problems, n_restarts, n)``, memories of the bonds and of the fields."""

    voltage: Array
    short_term: Array
    long_term: Array
    field_short_term: Array
    field_long_term: Array


@dataclass(frozen=True, kw_only=True, slots=True)
class BondField:
    r"""Equations of the DMM for spins, an alternative to ``ClauseField``: every coupling has two memories.

    Spins relaxed to voltages v in [-1, 1]; a coupling J of the energy ``-\sum J v_i v_j - \sum h_i v_i`` is a
    bond, a field h_i is a bond to a spin clamped at +1. With C = 1 + kappa sign(J) v_i v_j:

    .. math::
        \dot v_i &= \alpha (\sum_j J_ij v_j + h_i) - 2 \beta v_i (\sum_j |J_ij| X_ij + |h_i| X_i) / s \\
        \dot X &= \gamma C - Y, \quad X \in [X_{min}, 1] \\
        \dot Y &= \delta X - \zeta, \quad Y \in [1, Y_{max}]

    where s is the mean over the spins of ``\sum_j |J_ij|``. Bonds are divided by
    :func:`~memcomp_lightning.solvers.dmm.scaling.coupling_norm`, or by half their largest eigenvalue if that
    is more.

    Deviations from [P]: a bond pulls its spins to 0 in proportion to its strength, where in [P] all bonds pull
    alike, so that bonds of strength 0 change nothing; C depends on the sign of J, not on its size.

    Attributes:
        alpha: Strength of the drive, > 0.
        beta: Strength of the pull to 0, > 0.
        gamma: Drive of the short-term memory, > 0.
        kappa: Weight of a bond's satisfaction in that drive, >= 0.
        delta: Growth of the long-term memory, > 0.
        zeta: Decay of the long-term memory, > 0.
        short_term_start: X(0), in [short_term_min, 1].
        short_term_min: Lower bound of X, in (0, 1).
        long_term_max: Upper bound of Y, >= 1; 1 freezes it.
        noise: Width of the uniform noise on the voltages per square root of machine time, >= 0.
        spread: Initial voltages are uniform in [-spread, spread], in (0, 1].
        integrator: The scheme that the constants were chosen with.
    """

    alpha: float = 2.07
    beta: float = 7.74
    gamma: float = 0.606
    kappa: float = 1.32
    delta: float = 0.476
    zeta: float = 2.98
    short_term_start: float = 0.28
    short_term_min: float = 0.0164
    long_term_max: float = 4.15
    noise: float = 0.79
    spread: float = 1.0
    takes_long_clauses: ClassVar[bool] = False
    integrator: Integrator = field(default_factory=lambda: Splitting(change=1.0, dt_min=0.183, dt_max=0.183))

    def __post_init__(self) -> None:
        for name in ("alpha", "beta", "gamma", "delta", "zeta"):
            require(getattr(self, name) > 0, name, getattr(self, name), "a number > 0")
        for name in ("kappa", "noise"):
            require(getattr(self, name) >= 0, name, getattr(self, name), "a number >= 0")
        require(0 < self.short_term_min < 1, "short_term_min", self.short_term_min, "a number in (0, 1)")
        start, allowed = self.short_term_start, f"a number in [short_term_min = {self.short_term_min}, 1]"
        require(self.short_term_min <= start <= 1, "short_term_start", start, allowed)
        require(self.long_term_max >= 1, "long_term_max", self.long_term_max, "a number >= 1")
        require(0 < self.spread <= 1, "spread", self.spread, "a number in (0, 1]")

    def build(self, problem: Qubo | WeightedMaxSat) -> BondMachine:
        """Write the problem in spins, x = (1 + v) / 2, and divide bonds and fields by their scale.

        Raises:
            SettingError: The problem has clauses of three literals or more.
        """
        if isinstance(problem, WeightedMaxSat):
            longest = max((block.variables.shape[-1] for block in problem.longer), default=2)
            remedy = "Solve as_qubo(problem), or the clauses with DmmSolver(field=ClauseField())."
            require(longest == 2, "longest clause", longest, "at most 2 literals", remedy)
        qubo = as_qubo(problem)
        n_axes = len(qubo.graph.edge_shape)
        coupling, linear = by_largest(qubo.coupling, qubo.linear, n_axes)
        # The energy is coupling / 4 a bond and linear / 2 + sum of couplings / 4 a field: here times -4.
        field = -2 * linear - qubo.graph.scatter(coupling, coupling)
        norm = coupling_norm(qubo.graph, coupling)
        scale = norm / collective_mode(qubo.graph, coupling / expand(norm, n_axes))
        bond = -coupling / expand(scale, n_axes)
        field = decisive(qubo.graph, bond, field / scale[..., None])
        return BondMachine(
            graph=qubo.graph,
            bond=over_states(bond, n_axes),
            field=field[..., None, :],
            pull_scale=expand(mean_strength(qubo.graph, bond), 2),
        )

    def stability(self, machine: BondMachine) -> Array:
        """1: the scale of the bonds takes care of it."""
        return namespace(machine.bond).ones_like(machine.pull_scale[..., 0])

    def init(self, machine: BondMachine, voltage: Array) -> BondState:
        """Short-term memories at ``short_term_start``, long-term ones at 1."""
        first, second = machine.graph.gather(voltage)
        xp = namespace(voltage)
        bond = xp.ones_like(first * second)
        return BondState(
            voltage=voltage,
            short_term=self.short_term_start * bond,
            long_term=bond,
            field_short_term=xp.full_like(voltage, self.short_term_start),
            field_long_term=xp.ones_like(voltage),
        )

    def derivative(self, machine: BondMachine, state: BondState) -> BondState:
        """Right-hand side; each line names its equation."""
        voltage = state.voltage
        first, second = machine.graph.gather(voltage)
        # [P]: dv_i = alpha sum_j J_ij v_j - 2 beta (sum_j X_ij) v_i.
        drive = machine.graph.scatter(machine.bond * second, machine.bond * first) + machine.field
        strength = abs(machine.bond) * state.short_term
        pull = machine.graph.scatter(strength, strength) + abs(machine.field) * state.field_short_term
        return BondState(
            voltage=self.alpha * drive - 2 * self.beta / machine.pull_scale * pull * voltage,
            # [P]: dX = gamma C - Y with C = 1 + kappa sign(J) v_i v_j.
            short_term=self.gamma * (1 + self.kappa * sign(machine.bond) * first * second) - state.long_term,
            # [P]: dY = delta X - zeta.
            long_term=self.delta * state.short_term - self.zeta,
            field_short_term=self.gamma * (1 + self.kappa * sign(machine.field) * voltage) - state.field_long_term,
            field_long_term=self.delta * state.field_short_term - self.zeta,
        )

    def bound(self, machine: BondMachine, state: BondState) -> BondState:
        """V in [-1, 1], X in [short_term_min, 1], Y in [1, long_term_max]."""
        return BondState(
            voltage=state.voltage.clip(-1, 1),
            short_term=state.short_term.clip(self.short_term_min, 1),
            long_term=state.long_term.clip(1, self.long_term_max),
            field_short_term=state.field_short_term.clip(self.short_term_min, 1),
            field_long_term=state.field_long_term.clip(1, self.long_term_max),
        )
