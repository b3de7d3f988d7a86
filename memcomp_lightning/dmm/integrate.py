"""Integrators: one step of the machine's ODE. One class a scheme."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Protocol, TypeVar

import torch
from torch import Tensor

from memcomp_lightning.dmm.base import HasVoltage, VectorField
from memcomp_lightning.errors import require

MachineT = TypeVar("MachineT")
StateT = TypeVar("StateT", bound=HasVoltage)


Shake = Callable[[Any, Tensor], Any]
"""From a state and the step sizes to the state with noise on its voltages."""


def still(state: Any, dt: Tensor) -> Any:
    """No noise."""
    return state


class Integrator(Protocol):
    """Advances all restarts of all problems by one step, each with a step size of its own."""

    def step(
        self, field: VectorField[MachineT, StateT], machine: MachineT, state: StateT, shake: Shake = still
    ) -> tuple[StateT, Tensor]:
        """Return the next state and the step sizes ``(*problems, n_restarts)``.

        ``shake`` adds the noise of a step to the voltages, once they have moved and before they are bounded.
        """
        ...


@dataclass(frozen=True, kw_only=True, slots=True)
class StepControl:
    """``dt = clip(s max_change / max_i |dv_i/dt|, dt_min, dt_max)``, for each restart on its own.

    The factor s is the field's ``stability`` on the problem.

    Source: Bearden, Pei, Di Ventra, Sci. Rep. 10:19741 (2020), methods. The steps are far too large for an
    accurate trajectory; what matters is that the machine keeps its attractors.

    Attributes:
        max_change: Largest change of a voltage in a step before the bounds apply, > 0.
        dt_min: Smallest step in machine time, > 0.
        dt_max: Largest step in machine time, >= dt_min.
    """

    max_change: float = 2.35
    dt_min: float = 0.0126
    dt_max: float = 2.8

    def __post_init__(self) -> None:
        require(self.max_change > 0, "max_change", self.max_change, "a number > 0")
        require(0 < self.dt_min <= self.dt_max, "dt_min", self.dt_min, f"a number in (0, dt_max = {self.dt_max}]")

    def step_size(self, voltage_rate: Tensor, stability: Tensor) -> Tensor:
        """Step sizes ``(*problems, n_restarts)`` from ``dv/dt``."""
        return (stability * self.max_change / voltage_rate.abs().amax(-1)).clamp(self.dt_min, self.dt_max)


@dataclass(frozen=True, kw_only=True, slots=True)
class AdaptiveEuler(StepControl):
    """Forward Euler: voltages and memories move together. One evaluation a step."""

    def step(
        self, field: VectorField[MachineT, StateT], machine: MachineT, state: StateT, shake: Shake = still
    ) -> tuple[StateT, Tensor]:
        """Return the next state and the step sizes."""
        rate = field.derivative(machine, state)
        dt = self.step_size(rate.voltage, field.stability(machine))
        return field.bound(machine, shake(_move(state, rate, dt), dt)), dt


@dataclass(frozen=True, kw_only=True, slots=True)
class Splitting(StepControl):
    """Lie splitting: the voltages move with frozen memories, then the memories with the new voltages.

    The compiled kernels need a single pass over the memories for it, which makes it the fastest scheme.
    """

    def step(
        self, field: VectorField[MachineT, StateT], machine: MachineT, state: StateT, shake: Shake = still
    ) -> tuple[StateT, Tensor]:
        """Return the next state and the step sizes."""
        rate = field.derivative(machine, state)
        dt = self.step_size(rate.voltage, field.stability(machine))
        state = field.bound(machine, shake(_move_voltage(state, rate, dt), dt))
        return _move_memories(field, machine, state, dt), dt


@dataclass(frozen=True, kw_only=True, slots=True)
class Strang(StepControl):
    """Strang splitting: half a step of the memories, a full one of the voltages, half a step of the memories."""

    def step(
        self, field: VectorField[MachineT, StateT], machine: MachineT, state: StateT, shake: Shake = still
    ) -> tuple[StateT, Tensor]:
        """Return the next state and the step sizes."""
        dt = self.step_size(field.derivative(machine, state).voltage, field.stability(machine))
        state = _move_memories(field, machine, state, dt / 2)
        rate = field.derivative(machine, state)
        state = field.bound(machine, shake(_move_voltage(state, rate, dt), dt))
        return _move_memories(field, machine, state, dt / 2), dt


@dataclass(frozen=True, kw_only=True, slots=True)
class ExactShortTerm(StepControl):
    """Lie splitting in which the short-term memory follows its exact solution for frozen voltages.

    The field must offer ``short_term_after(machine, state, dt)``; removes the stiffness of x_s.
    """

    def step(self, field: Any, machine: MachineT, state: StateT, shake: Shake = still) -> tuple[StateT, Tensor]:
        """Return the next state and the step sizes."""
        require(
            hasattr(field, "short_term_after"),
            "integrator",
            "ExactShortTerm",
            f"a scheme that {type(field).__name__} supports",
            "The field has no method short_term_after(machine, state, dt): use Splitting.",
        )
        rate = field.derivative(machine, state)
        dt = self.step_size(rate.voltage, field.stability(machine))
        state = field.bound(machine, shake(_move_voltage(state, rate, dt), dt))
        exact = field.short_term_after(machine, state, dt)
        moved = _move_memories(field, machine, state, dt)
        return field.bound(machine, moved._replace(**exact)), dt


@dataclass(frozen=True, kw_only=True, slots=True)
class Heun(StepControl):
    """Heun's method: the mean of the rates at both ends of an Euler step. Two evaluations, second order."""

    def step(
        self, field: VectorField[MachineT, StateT], machine: MachineT, state: StateT, shake: Shake = still
    ) -> tuple[StateT, Tensor]:
        """Return the next state and the step sizes."""
        rate = field.derivative(machine, state)
        dt = self.step_size(rate.voltage, field.stability(machine))
        ahead = field.derivative(machine, field.bound(machine, _move(state, rate, dt)))
        mean = type(rate)(*((a + b) / 2 for a, b in zip(_tensors(rate), _tensors(ahead), strict=True)))
        return field.bound(machine, shake(_move(state, mean, dt), dt)), dt


def _move(state: StateT, rate: StateT, dt: Tensor) -> StateT:
    """``state + dt rate``, for all tensors."""
    moved = (
        torch.addcmul(x, dt.reshape(*dt.shape, *(1,) * (x.ndim - dt.ndim)), x_rate)
        for x, x_rate in zip(_tensors(state), _tensors(rate), strict=True)
    )
    return type(state)(*moved)


def _move_voltage(state: Any, rate: Any, dt: Tensor) -> Any:
    """Move the voltages alone."""
    return state._replace(voltage=state.voltage + dt.unsqueeze(-1) * rate.voltage)


def _move_memories(field: Any, machine: Any, state: Any, dt: Tensor) -> Any:
    """Move the memories alone, at the state's voltages."""
    moved = _move(state, field.derivative(machine, state), dt)
    return field.bound(machine, moved._replace(voltage=state.voltage))


def _tensors(state: object) -> tuple[Tensor, ...]:
    """The tensors of a NamedTuple state."""
    if not isinstance(state, tuple):
        raise TypeError(f"the state of a vector field must be a NamedTuple of tensors, got {type(state).__name__}")
    return state
