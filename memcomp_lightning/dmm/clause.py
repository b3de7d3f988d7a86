"""Clause dynamics: every clause of a weighted MAX-SAT has a short- and a long-term memory.

Sources: [B] Bearden, Pei, Di Ventra, Sci. Rep. 10:19741 (2020), the 3-SAT form, eqs. 2 to 6. Its weighted
two-literal form as in public research code of the same group. Constants: a random search on 32x32 and
64x64 RBMs, see docs/dmm.md.
"""

import math
from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Generator, Tensor

from memcomp_lightning import rng
from memcomp_lightning.errors import require
from memcomp_lightning.qubo.graph import Graph
from memcomp_lightning.qubo.maxsat import WeightedMaxSat


class ClauseMachine(NamedTuple):
    """A problem in the machine's units; per-clause tensors have an axis of size 1 for the restarts."""

    graph: Graph
    weight: Tensor
    first: Tensor
    second: Tensor
    unit: Tensor
    unit_sign: Tensor


class ClauseState(NamedTuple):
    """Voltages ``(*problems, n_restarts, n)``, memories of clauses and of unit clauses."""

    voltage: Tensor
    short_term: Tensor
    long_term: Tensor
    unit_long_term: Tensor


@dataclass(frozen=True, kw_only=True, slots=True)
class ClauseField:
    r"""The vector field of the clause dynamics.

    With literal polarity q, voltage v in [-1, 1], clause weight w and the clause's unsatisfaction
    ``C = 1/2 min(1 - q_i v_i, 1 - q_j v_j)``:

    .. math::
        \dot v_i &= \sum_m w_m [x_l x_s G_i + (1 + \zeta x_l)(1 - x_s) R_i] + \rho u_i y_i \\
        \dot x_s &= \beta (x_s + \epsilon)(C - \gamma), \quad x_s \in [0, 1] \\
        \dot x_l &= \alpha (C - \delta) \cdot (x_l - 1 \text{ if } C < \delta \text{ else } 1),
                    \quad x_l \in [1, x_{max}]

    Deviation: no noise on the voltages; it hardly mattered in the search for the constants.

    Weights are divided by ``rms(w) sqrt(longest layer or largest degree)``, so that the drive of a voltage
    does not depend on the problem's scale and size.

    Attributes:
        alpha: Rate of the long-term memory, > 0.
        beta: Rate of the short-term memory, > 0.
        gamma: Threshold of the short-term memory, in (0, 1/2).
        delta: Threshold of the long-term memory, in (0, gamma).
        epsilon: Keeps the short-term memory from sticking at 0, > 0.
        zeta: Share of the long-term memory in the rigidity, >= 0.
        long_term_max: Upper bound of the long-term memories, > 1.
        unit_pull: rho, strength of the unit clauses, > 0.
    """

    alpha: float = 7.6
    beta: float = 0.39
    gamma: float = 0.033
    delta: float = 0.0073
    epsilon: float = 0.041
    zeta: float = 0.040
    long_term_max: float = 3.3
    unit_pull: float = 0.99

    def __post_init__(self) -> None:
        for name in ("alpha", "beta", "epsilon", "unit_pull"):
            require(getattr(self, name) > 0, name, getattr(self, name), "a number > 0")
        require(0 < self.gamma < 0.5, "gamma", self.gamma, "a number in (0, 1/2)")
        require(0 < self.delta < self.gamma, "delta", self.delta, f"a number in (0, gamma = {self.gamma})")
        require(self.zeta >= 0, "zeta", self.zeta, "a number >= 0")
        require(self.long_term_max > 1, "long_term_max", self.long_term_max, "a number > 1")

    def build(self, maxsat: WeightedMaxSat) -> ClauseMachine:
        """Divide the weights by their scale; a problem without couplings is scaled by its unit clauses."""
        axes = tuple(range(-len(maxsat.graph.edge_shape), 0))
        n_clauses = math.prod(maxsat.graph.edge_shape)
        # Scaled by the maximum first: squares of 1e-30 or 1e30 leave the range of float32.
        largest = torch.maximum(_amax(maxsat.weight, axes), maxsat.unit.abs().amax(-1))
        largest = torch.where(largest > 0, largest, torch.ones_like(largest))
        weight = maxsat.weight / _expand(largest, len(axes))
        unit = maxsat.unit / largest.unsqueeze(-1)
        degree = maxsat.graph.scatter(torch.ones_like(weight), torch.ones_like(weight)).amax(-1)
        rms = (weight.square().sum(axes) / max(n_clauses, 1)).sqrt() * degree.clamp(min=1).sqrt()
        scale = torch.where(rms > _SMALLEST_RATIO, rms, torch.ones_like(rms))
        return ClauseMachine(
            graph=maxsat.graph,
            weight=(weight / _expand(scale, len(axes))).unsqueeze(-1 - len(axes)),
            first=maxsat.first.unsqueeze(-1 - len(axes)),
            second=maxsat.second.unsqueeze(-1 - len(axes)),
            unit=(unit / scale.unsqueeze(-1)).unsqueeze(-2),
            unit_sign=unit.sign().unsqueeze(-2),
        )

    def init(self, machine: ClauseMachine, n_restarts: int, *, generator: Generator) -> ClauseState:
        """Voltages uniform in [-1, 1], x_s(0) = C(0), long-term memories at 1 ([B], methods)."""
        problems, n = machine.unit.shape[:-2], machine.unit.shape[-1]
        draw = rng.uniform((*problems, n_restarts, n), generator=generator, like=machine.unit)
        voltage = 2 * draw - 1
        unsatisfied, _, _ = _unsatisfaction(machine, voltage)
        return ClauseState(
            voltage=voltage,
            short_term=unsatisfied,
            long_term=torch.ones_like(unsatisfied),
            unit_long_term=torch.ones_like(voltage),
        )

    def derivative(self, machine: ClauseMachine, state: ClauseState) -> ClauseState:
        """Right-hand side; each line names its equation."""
        voltage, short_term, long_term, unit_long_term = state
        # [B] eq. 3: C = 1/2 min_i (1 - q_i v_i).
        unsatisfied, false_first, false_second = _unsatisfaction(machine, voltage)
        # [B] eq. 4: G_i = 1/2 q_i (1 - q_j v_j): each literal is pushed by how false the other one is.
        gradient = machine.weight * long_term * short_term
        # [B] eq. 5: R_i = 1/2 (q_i - v_i) = q_i C where i attains the minimum, else 0.
        # Deviation: a tie goes to the first literal alone.
        rigidity = machine.weight * (1 + self.zeta * long_term) * (1 - short_term) * unsatisfied
        rigidity_first = rigidity * (false_first <= false_second)
        # [B] eq. 2, one sum for each end of the clauses.
        drive = machine.graph.scatter(
            machine.first * torch.addcmul(rigidity_first, gradient, false_second),
            machine.second * torch.addcmul(rigidity - rigidity_first, gradient, false_first),
        )
        # Deviation: unit clauses pull with a long-term memory of their own, not as two equal literals.
        unit_unsatisfied = 0.5 * (1 - machine.unit_sign * voltage)
        drive = drive + self.unit_pull * machine.unit * unit_long_term
        return ClauseState(
            voltage=drive,
            # [B] eq. 6.
            short_term=self.beta * (short_term + self.epsilon) * (unsatisfied - self.gamma),
            long_term=self._long_term_rate(unsatisfied, long_term),
            unit_long_term=self._long_term_rate(unit_unsatisfied, unit_long_term),
        )

    def _long_term_rate(self, unsatisfied: Tensor, long_term: Tensor) -> Tensor:
        """[B] eq. 7. Deviations: no factor (1 + w), and below delta the decay towards 1 is exponential."""
        excess = unsatisfied - self.delta
        return self.alpha * torch.addcmul(excess.clamp(min=0), excess.clamp(max=0), long_term - 1)

    def bound(self, machine: ClauseMachine, state: ClauseState) -> ClauseState:
        """V in [-1, 1], x_s in [0, 1], long-term memories in [1, long_term_max]."""
        return ClauseState(
            voltage=state.voltage.clamp(-1, 1),
            short_term=state.short_term.clamp(0, 1),
            long_term=state.long_term.clamp(1, self.long_term_max),
            unit_long_term=state.unit_long_term.clamp(1, self.long_term_max),
        )


_SMALLEST_RATIO = 1e-12
"""Couplings this much smaller than the largest unit clause do not set the scale."""


def _unsatisfaction(machine: ClauseMachine, voltage: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """C of each clause, and how false each of its two literals is: 1/2 (1 - q v)."""
    first, second = machine.graph.gather(voltage)
    false_first = 0.5 - 0.5 * machine.first * first
    false_second = 0.5 - 0.5 * machine.second * second
    return torch.minimum(false_first, false_second), false_first, false_second


def _expand(x: Tensor, n_axes: int) -> Tensor:
    """Append axes of size 1."""
    return x.reshape(*x.shape, *(1,) * n_axes)


def _amax(x: Tensor, axes: tuple[int, ...]) -> Tensor:
    """Maximum over the last axes, 0 where they are empty."""
    return x.amax(axes) if math.prod(x.shape[axes[0] :]) else x.sum(axes)
