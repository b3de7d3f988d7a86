"""Digital memcomputing machines (DMMs), which solve QUBO and MAX-SAT by integrating an ODE with memories."""

from memcomp_lightning.solvers.dmm.base import Recording, VectorField
from memcomp_lightning.solvers.dmm.bond import BondField
from memcomp_lightning.solvers.dmm.clause import ClauseField
from memcomp_lightning.solvers.dmm.integrate import (
    AdaptiveEuler,
    Heun,
    Integrator,
    Splitting,
    Strang,
)
from memcomp_lightning.solvers.dmm.solver import DmmSolver, WarmRestart, default_quench, default_steps
from memcomp_lightning.solvers.dmm.trajectory import Trajectory

__all__ = [
    "AdaptiveEuler",
    "BondField",
    "ClauseField",
    "DmmSolver",
    "Heun",
    "Integrator",
    "Recording",
    "Splitting",
    "Strang",
    "Trajectory",
    "VectorField",
    "WarmRestart",
    "default_quench",
    "default_steps",
]
