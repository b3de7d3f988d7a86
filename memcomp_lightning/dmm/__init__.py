"""Digital memcomputing machines: vector fields, integrators, kernels and the solver."""

from memcomp_lightning.dmm.base import Recording, VectorField
from memcomp_lightning.dmm.clause import ClauseField
from memcomp_lightning.dmm.integrate import AdaptiveEuler, Integrator
from memcomp_lightning.dmm.solver import DmmSolver

__all__ = ["AdaptiveEuler", "ClauseField", "DmmSolver", "Integrator", "Recording", "VectorField"]
