"""The path of the machine, recorded on the way."""

from typing import NamedTuple

from memcomp_lightning.arrays import Array, as_array, namespace


class Trajectory(NamedTuple):
    """What a solver passed through, recorded at intervals.

    Attributes:
        time: Machine time of each record, ``(*problems, n_restarts, n_records)``.
        unsatisfied_weight: Total weight of unsatisfied clauses then, same shape.
        assignments: The digital state then, ``(*problems, n_restarts, n_records, n)``, bool.
        dwell: Machine time since the record before, its weight in a time average, same shape as ``time``.
        found_weight: Total weight of unsatisfied clauses of the restart's best assignment, which a descent from a
            copy may have found; infinite until it was found. Same shape as ``time``.
    """

    time: Array
    unsatisfied_weight: Array
    assignments: Array
    dwell: Array
    found_weight: Array

    def weights(self) -> Array:
        """Of a time average that leaves out the start: ``dwell``, but 0 until the weight falls to its median."""
        weight = self.unsatisfied_weight
        xp = namespace(weight)
        median = xp.sort(weight, axis=-1)[..., (weight.shape[-1] - 1) // 2]
        reached = xp.cumulative_sum(xp.astype(weight <= median[..., None], xp.int64), axis=-1) > 0
        return self.dwell * as_array(reached)
