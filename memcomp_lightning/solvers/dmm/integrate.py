"""Integrators: one step of the machine's ODE. One class a scheme."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple, Protocol, TypeVar

from memcomp_lightning.arrays import Array, multiply_add
from memcomp_lightning.errors import require
from memcomp_lightning.solvers.dmm.base import HasVoltage, VectorField

MachineT = TypeVar("MachineT")
StateT = TypeVar("StateT", bound=HasVoltage)


Shake = Callable[[Any, Array], Any]
"""From a state and the step sizes to the state with noise on its voltages."""


def still(state: Any, dt: Array) -> Any:
    """No noise."""
    return state


class Step(NamedTuple):
    """What a step leads to.

    Attributes:
        state: The next state.
        dt: Step sizes in machine time, ``(*problems, n_restarts)``.
        rate: ``dv/dt`` where the step began, for the next one.
    """

    state: Any
    dt: Array
    rate: Array


class Integrator(Protocol):
    """Advances all restarts of all problems by one step, each with a step size of its own."""

    def step(
        self,
        field: VectorField[MachineT, StateT],
        machine: MachineT,
        state: StateT,
        *,
        before: Array | None = None,
        shake: Shake = still,
    ) -> Step:
        """Return the next state.

        Args:
            field: The vector field.
            machine: The problem in its units.
            state: The state.
            before: ``Step.rate`` of the step that led here; None at the start.
            shake: Adds the noise of a step to the voltages, once they have moved and before they are bounded.
        """


@dataclass(frozen=True, kw_only=True, slots=True)
class StepControl:
    r"""Choose the step size of each restart: shorter steps where its voltages change faster.

    ``dt = clip(s change / \sqrt{mean_i (dv_i/dt)^2}, dt_min, dt_max)``, s being the field's ``stability`` on the
    problem. The steps are far too large for an accurate trajectory; what matters is that the machine keeps its
    attractors.

    Deviation from Bearden, Pei, Di Ventra, Sci. Rep. 10:19741 (2020), methods, who bound the largest
    \|dv_i/dt\|: the largest of n numbers grows with n and with a few strong fields, their mean square does not.

    Attributes:
        change: Root mean square change of the voltages in a step before the bounds apply, > 0.
        dt_min: Smallest step in machine time, > 0.
        dt_max: Largest step in machine time, >= dt_min.
    """

    change: float = 1.0
    dt_min: float = 0.0126
    dt_max: float = 6.0

    def __post_init__(self) -> None:
        require(self.change > 0, "change", self.change, "a number > 0")
        require(0 < self.dt_min <= self.dt_max, "dt_min", self.dt_min, f"a number in (0, dt_max = {self.dt_max}]")

    def step_size(self, voltage_rate: Array, stability: Array) -> Array:
        """Step sizes ``(*problems, n_restarts)`` from ``dv/dt``."""
        size = (voltage_rate * voltage_rate).mean(-1) ** 0.5
        return (stability * self.change / size).clip(self.dt_min, self.dt_max)


@dataclass(frozen=True, kw_only=True, slots=True)
class AdaptiveEuler(StepControl):
    """Forward Euler: voltages and memories move together. One evaluation a step."""

    def step(
        self,
        field: VectorField[MachineT, StateT],
        machine: MachineT,
        state: StateT,
        *,
        before: Array | None = None,
        shake: Shake = still,
    ) -> Step:
        """Return the next state."""
        rate = field.derivative(machine, state)
        dt = self.step_size(rate.voltage, field.stability(machine))
        return Step(field.bound(machine, shake(_move(state, rate, dt), dt)), dt, rate.voltage)


@dataclass(frozen=True, kw_only=True, slots=True)
class Splitting(StepControl):
    r"""Lie splitting: the voltages move with frozen memories, then the memories with the new voltages.

    The voltages move by ``dt [(1 - lag) f_k + lag f_{k-1}]``, where f_k is dv/dt at step k: a linear two-step
    method. Where a coupling is too strong for the step, voltages jump back and forth and f changes its sign from
    step to step. The lag multiplies such motion by 1 - 2 lag and leaves slow motion as it is; lag = 0 is Euler's
    rule.

    It is the only scheme with compiled kernels, which need a single pass over the memories for a step.

    Attributes:
        lag: Share of the last step's rate, in [0, 1/2].
    """

    lag: float = 0.0

    def __post_init__(self) -> None:
        StepControl.__post_init__(self)
        require(0 <= self.lag <= 0.5, "lag", self.lag, "a number in [0, 1/2]")

    def step(
        self,
        field: VectorField[MachineT, StateT],
        machine: MachineT,
        state: StateT,
        *,
        before: Array | None = None,
        shake: Shake = still,
    ) -> Step:
        """Return the next state."""
        rate = field.derivative(machine, state).voltage
        mixed = rate if before is None else (1 - self.lag) * rate + self.lag * before
        dt = self.step_size(mixed, field.stability(machine))
        state = field.bound(machine, shake(_move_voltage(state, mixed, dt), dt))
        return Step(_move_memories(field, machine, state, dt), dt, rate)


@dataclass(frozen=True, kw_only=True, slots=True)
class Strang(StepControl):
    """Strang splitting: half a step of the memories, a full one of the voltages, half a step of the memories."""

    def step(
        self,
        field: VectorField[MachineT, StateT],
        machine: MachineT,
        state: StateT,
        *,
        before: Array | None = None,
        shake: Shake = still,
    ) -> Step:
        """Return the next state."""
        dt = self.step_size(field.derivative(machine, state).voltage, field.stability(machine))
        state = _move_memories(field, machine, state, dt / 2)
        rate = field.derivative(machine, state).voltage
        state = field.bound(machine, shake(_move_voltage(state, rate, dt), dt))
        return Step(_move_memories(field, machine, state, dt / 2), dt, rate)


@dataclass(frozen=True, kw_only=True, slots=True)
class Heun(StepControl):
    """Heun's method: the mean of the rates at both ends of an Euler step. Two evaluations, second order."""

    def step(
        self,
        field: VectorField[MachineT, StateT],
        machine: MachineT,
        state: StateT,
        *,
        before: Array | None = None,
        shake: Shake = still,
    ) -> Step:
        """Return the next state."""
        rate = field.derivative(machine, state)
        dt = self.step_size(rate.voltage, field.stability(machine))
        ahead = field.derivative(machine, field.bound(machine, _move(state, rate, dt)))
        mean = type(rate)(*((a + b) / 2 for a, b in zip(_arrays(rate), _arrays(ahead), strict=True)))
        return Step(field.bound(machine, shake(_move(state, mean, dt), dt)), dt, rate.voltage)


def _move(state: StateT, rate: StateT, dt: Array) -> StateT:
    """``state + dt rate``, for all arrays."""
    moved = (
        multiply_add(x, dt.reshape(*dt.shape, *(1,) * (x.ndim - dt.ndim)), x_rate)
        for x, x_rate in zip(_arrays(state), _arrays(rate), strict=True)
    )
    return type(state)(*moved)


def _move_voltage(state: Any, rate: Array, dt: Array) -> Any:
    """Move the voltages alone."""
    return state._replace(voltage=state.voltage + dt[..., None] * rate)


def _move_memories(field: Any, machine: Any, state: Any, dt: Array) -> Any:
    """Move the memories alone, at the state's voltages."""
    moved = _move(state, field.derivative(machine, state), dt)
    return field.bound(machine, moved._replace(voltage=state.voltage))


def _arrays(state: object) -> tuple[Array, ...]:
    """The arrays of a NamedTuple state."""
    if not isinstance(state, tuple):
        raise TypeError(f"the state of a vector field must be a NamedTuple of arrays, got {type(state).__name__}")
    return state
