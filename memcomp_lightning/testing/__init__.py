"""What other projects test their own parts with: conformance of samplers, solvers and units, statistics."""

from memcomp_lightning.testing.conformance import (
    check_sampler,
    check_solver,
    hidden_kinds,
    small_dbm,
    small_machine,
    small_rbm,
    visible_kinds,
)
from memcomp_lightning.testing.enumerated import Enumerated, enumerated, most_errors_off, sample_moments
from memcomp_lightning.testing.small_models import small_dbn, small_layers, small_machines, small_rbms
from memcomp_lightning.testing.statistics import chi_square_p_value, state_counts, visible_probabilities
from memcomp_lightning.testing.units import check_units

__all__ = [
    "Enumerated",
    "check_sampler",
    "check_solver",
    "check_units",
    "chi_square_p_value",
    "enumerated",
    "hidden_kinds",
    "most_errors_off",
    "sample_moments",
    "small_dbm",
    "small_dbn",
    "small_layers",
    "small_machine",
    "small_machines",
    "small_rbm",
    "small_rbms",
    "state_counts",
    "visible_kinds",
    "visible_probabilities",
]
