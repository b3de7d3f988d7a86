"""Greedy pretraining of a deep belief network: one RBM after the other."""

from functools import partial

from torch import Generator, Tensor

from memcomp_lightning.errors import require
from memcomp_lightning.models import DBN, RBM
from memcomp_lightning.samplers import ClampedGibbs, PositivePhase, positive_phase
from memcomp_lightning.samplers.positive import posterior_of
from memcomp_lightning.training.stages.base import Phase


class Greedy:
    """Train each RBM of a DBN on the mean activations of the layers below it.

    Activations are computed batch by batch and never held for the whole data set.

    Args:
        network: The DBN, or a single RBM; trained in place.
    """

    def __init__(self, network: DBN | RBM) -> None:
        self.network = network
        if isinstance(network, RBM):
            positive = partial(_hidden_means, network)
            self.phases = [Phase(name="layer 1", tag="layer1", model=network, positive=positive)]
            return
        require_dbn(network)
        self.phases = [_phase(network, layer) for layer in range(len(network))]

    def hand_over(self) -> None:
        """Nothing to do: the RBMs are the DBN's own."""


def require_dbn(network: object) -> None:
    """Raise a SettingError for everything else."""
    remedy = "For a Boltzmann machine use pretrain=boltzmann."
    require(isinstance(network, DBN), "pretrained network", type(network).__name__, "a DBN", remedy)


def _phase(dbn: DBN, layer: int) -> Phase:
    return Phase(
        name=f"layer {layer + 1}",
        tag=f"layer{layer + 1}",
        model=dbn[layer],
        positive=partial(_hidden_means, dbn[layer]),
        visible_of=partial(dbn.visible_of, layer),
        images_of=partial(dbn.images_of, layer),
        complete=partial(_drawn, dbn[0]) if layer else None,
    )


def _hidden_means(rbm: RBM, v: Tensor, observed: Tensor | None, generator: Generator) -> PositivePhase:
    if observed is None:
        return PositivePhase(positive_phase(rbm, v), {})
    return posterior_of(rbm).sample(rbm, v, observed=observed, generator=generator)


def _drawn(rbm: RBM, v: Tensor, observed: Tensor, generator: Generator) -> Tensor:
    """Data with draws given the observed values where some are missing: what the layers above see."""
    return ClampedGibbs().sample(rbm, v, observed=observed, generator=generator).configurations.v
