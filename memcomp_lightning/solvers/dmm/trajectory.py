"""The path of the machine, recorded on the way."""

from typing import NamedTuple

from torch import Tensor


class Trajectory(NamedTuple):
    """What a solver passed through, recorded at intervals.

    Attributes:
        time: Machine time of each record, ``(*problems, n_restarts, n_records)``.
        unsatisfied_weight: Total weight of unsatisfied clauses then, same shape.
        assignments: The digital state then, ``(*problems, n_restarts, n_records, n)``, bool.
        dwell: Machine time since the record before, its weight in a time average, same shape as ``time``.
    """

    time: Tensor
    unsatisfied_weight: Tensor
    assignments: Tensor
    dwell: Tensor

    def weights(self) -> Tensor:
        """Of a time average that leaves out the start: ``dwell``, but 0 until the weight falls to its median."""
        weight = self.unsatisfied_weight
        reached = (weight <= weight.median(-1, keepdim=True).values).cummax(-1).values
        return self.dwell * reached
