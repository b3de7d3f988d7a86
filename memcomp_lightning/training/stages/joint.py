"""Joint pretraining of a deep belief network: all layers at once."""

from functools import partial

from memcomp_lightning.models import DBM, DBN
from memcomp_lightning.samplers import MeanField, PositivePhaseSampler
from memcomp_lightning.training.stages.base import Phase
from memcomp_lightning.training.stages.boltzmann import sampled
from memcomp_lightning.training.stages.greedy import require_dbn


class Joint:
    """Train all layers of a DBN at once, as the deep Boltzmann machine that has its weights.

    After every pass the DBN has the weights of the machine, ready to be fine-tuned as after greedy pretraining.
    See Salakhutdinov & Hinton (2009).

    Args:
        network: The DBN; its weights are where training starts, random ones or those of greedy pretraining.
        positive: Supplies the hidden units given the data; None is the mean field.
    """

    def __init__(self, network: DBN, *, positive: PositivePhaseSampler | None = None) -> None:
        require_dbn(network)
        self.network = network
        self.machine = DBM.from_dbn(network)
        positive_of = partial(sampled, positive or MeanField(), self.machine)
        self.phases = [Phase(name="jointly", tag="joint", model=self.machine, positive=positive_of)]

    def hand_over(self) -> None:
        """Give the DBN the weights of the machine."""
        self.machine.give(self.network)
