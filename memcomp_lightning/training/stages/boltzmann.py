"""Training of a Boltzmann machine of any connectivity: all units at once."""

from functools import partial

from torch import Generator, Tensor

from memcomp_lightning.errors import require
from memcomp_lightning.models import BoltzmannMachine
from memcomp_lightning.samplers import MeanField, PositivePhase, PositivePhaseSampler
from memcomp_lightning.training.stages.base import Phase


class Boltzmann:
    """Train a Boltzmann machine.

    Args:
        network: The machine; trained in place.
        positive: Supplies the hidden units given the data, and is logged with the sampler; None is the mean field.
    """

    def __init__(self, network: BoltzmannMachine, *, positive: PositivePhaseSampler | None = None) -> None:
        kind, remedy = type(network).__name__, "For a DBN use pretrain=greedy, centred or joint."
        fits = isinstance(network, BoltzmannMachine)
        require(fits, "pretrained network", kind, "a Boltzmann machine", remedy)
        self.network = network
        positive_of = partial(sampled, positive or MeanField(), network)
        self.phases = [Phase(name="jointly", tag="", model=network, positive=positive_of)]

    def hand_over(self) -> None:
        """Nothing to do: the machine is what is trained."""


def sampled(
    positive: PositivePhaseSampler,
    model: BoltzmannMachine,
    v: Tensor,
    observed: Tensor | None,
    generator: Generator,
) -> PositivePhase:
    """The positive phase by a sampler."""
    return positive.sample(model, v, observed=observed, generator=generator)
