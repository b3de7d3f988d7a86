"""What other projects test their own parts with: conformance of samplers and solvers, statistical checks."""

from memcomp_lightning.testing.conformance import (
    check_sampler,
    check_solver,
    hidden_kinds,
    small_dbm,
    small_machine,
    small_rbm,
    visible_kinds,
)
from memcomp_lightning.testing.statistics import chi_square_p_value, state_counts, visible_probabilities

__all__ = [
    "check_sampler",
    "check_solver",
    "chi_square_p_value",
    "hidden_kinds",
    "small_dbm",
    "small_machine",
    "small_rbm",
    "state_counts",
    "visible_kinds",
    "visible_probabilities",
]
