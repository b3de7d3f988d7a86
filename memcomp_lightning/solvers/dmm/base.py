"""The contract of the DMM's equations: what a class must offer so that ``DmmSolver`` can integrate it."""

from typing import TYPE_CHECKING, NamedTuple, Protocol, TypeVar

from memcomp_lightning.arrays import Array
from memcomp_lightning.problems.maxsat import WeightedMaxSat
from memcomp_lightning.problems.qubo import Qubo

if TYPE_CHECKING:
    from memcomp_lightning.solvers.dmm.integrate import Integrator

MachineT = TypeVar("MachineT")
StateT = TypeVar("StateT", bound="HasVoltage")


class HasVoltage(Protocol):
    """A state of the machine; voltages are always part of it."""

    @property
    def voltage(self) -> Array:
        """``(*problems, n_restarts, n)`` in [-1, 1]; > 0 reads as TRUE."""


class VectorField(Protocol[MachineT, StateT]):
    """One set of equations of the DMM, as pure functions: settings are frozen, states are taken and returned.

    ``MachineT`` holds the problem's arrays as the equations use them; ``StateT`` is a NamedTuple of arrays.
    Those whose names end in ``long_term`` are kept over a warm restart and are 1 at rest.
    """

    @property
    def integrator(self) -> "Integrator":
        """The scheme that the constants were chosen with."""

    @property
    def noise(self) -> float:
        """Width of the uniform noise on the voltages per square root of machine time, >= 0."""

    @property
    def spread(self) -> float:
        """Initial voltages are uniform in [-spread, spread], in (0, 1]."""

    def build(self, problem: Qubo | WeightedMaxSat) -> MachineT:
        """Scale a problem into the machine's units."""

    def stability(self, machine: MachineT) -> Array:
        """Factor > 0 on ``StepControl.change``, so that steps suit the problem's size, ``(*problems, 1)``."""

    def init(self, machine: MachineT, voltage: Array) -> StateT:
        """The state at the start: voltages ``(*problems, n_restarts, n)`` as given, and their memories."""

    def derivative(self, machine: MachineT, state: StateT) -> StateT:
        """Right-hand side of the ODE, one array for each of the state's."""

    def bound(self, machine: MachineT, state: StateT) -> StateT:
        """Project voltages and memories onto their intervals."""


class Recording(NamedTuple):
    """What to keep of a trajectory.

    Attributes:
        every: Steps from one record to the next, >= 1.
    """

    every: int = 8
