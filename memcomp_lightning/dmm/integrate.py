"""Integrators: one step of the machine's ODE. One file, one class a scheme."""

from dataclasses import dataclass
from typing import Protocol, TypeVar

import torch
from torch import Tensor

from memcomp_lightning.dmm.base import HasVoltage, VectorField
from memcomp_lightning.errors import require

MachineT = TypeVar("MachineT")
StateT = TypeVar("StateT", bound=HasVoltage)


class Integrator(Protocol):
    """Advances all restarts of all problems by one step, each with a step size of its own."""

    def step(
        self, field: VectorField[MachineT, StateT], machine: MachineT, state: StateT
    ) -> tuple[StateT, Tensor]:
        """Return the next state and the step sizes ``(*problems, n_restarts)``."""
        ...


@dataclass(frozen=True, kw_only=True, slots=True)
class AdaptiveEuler:
    """Forward Euler with ``dt = clip(max_change / max_i |dv_i/dt|, dt_min, dt_max)``.

    Source: Bearden, Pei, Di Ventra, Sci. Rep. 10:19741 (2020), methods. The steps are far too large for an
    accurate trajectory; what matters is that the machine keeps its attractors, see docs/dmm.md.

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

    def step(
        self, field: VectorField[MachineT, StateT], machine: MachineT, state: StateT
    ) -> tuple[StateT, Tensor]:
        """Return the next state and the step sizes ``(*problems, n_restarts)``."""
        rate = field.derivative(machine, state)
        fastest = rate.voltage.abs().amax(-1)
        dt = (self.max_change / fastest).clamp(self.dt_min, self.dt_max)
        moved = (
            torch.addcmul(x, dt.reshape(*dt.shape, *(1,) * (x.ndim - dt.ndim)), x_rate)
            for x, x_rate in zip(_tensors(state), _tensors(rate), strict=True)
        )
        return field.bound(machine, type(state)(*moved)), dt


def _tensors(state: object) -> tuple[Tensor, ...]:
    """The tensors of a NamedTuple state."""
    if not isinstance(state, tuple):
        raise TypeError(f"the state of a vector field must be a NamedTuple of tensors, got {type(state).__name__}")
    return state
