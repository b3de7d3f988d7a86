"""What a memory dynamics is: parameters of a problem, a state, its time derivative, its bounds."""

from typing import NamedTuple, Protocol, TypeVar

from torch import Generator, Tensor

from memcomp_lightning.qubo.maxsat import WeightedMaxSat

MachineT = TypeVar("MachineT")
StateT = TypeVar("StateT", bound="HasVoltage")


class HasVoltage(Protocol):
    """A state of the machine; voltages are always part of it."""

    @property
    def voltage(self) -> Tensor:
        """``(*problems, n_restarts, n)`` in [-1, 1]; > 0 reads as TRUE."""
        ...


class VectorField(Protocol[MachineT, StateT]):
    """One family of memory dynamics. Pure: settings are frozen, the state goes in and comes out.

    ``MachineT`` holds the problem's tensors as the equations use them; ``StateT`` is a NamedTuple.
    """

    def build(self, maxsat: WeightedMaxSat) -> MachineT:
        """Scale a problem into the machine's units."""
        ...

    def init(self, machine: MachineT, n_restarts: int, *, generator: Generator) -> StateT:
        """Draw independent initial conditions."""
        ...

    def derivative(self, machine: MachineT, state: StateT) -> StateT:
        """Right-hand side of the ODE, one tensor for each of the state's."""
        ...

    def bound(self, machine: MachineT, state: StateT) -> StateT:
        """Project voltages and memories onto their intervals."""
        ...


class Recording(NamedTuple):
    """What to keep of a trajectory.

    Attributes:
        every: Record each so many steps, >= 1.
    """

    every: int = 8
