"""Greedy pretraining of a deep belief network, one RBM after the other."""

import re
from collections.abc import Iterable, Sequence
from typing import Any

from torch import Tensor
from torch.nn import Parameter
from torch.optim import Optimizer

from memcomp_lightning import defaults, rng
from memcomp_lightning.models import DBN, RBM
from memcomp_lightning.modules.energy import EnergyPretraining
from memcomp_lightning.modules.stage import PRETRAINING_SGD, OptimizerFactory
from memcomp_lightning.objective import Centring
from memcomp_lightning.samplers import NegativePhaseSampler, PositivePhase, positive_phase
from memcomp_lightning.samplers.base import require_state
from memcomp_lightning.types import Batch

CENTRED = Centring(rate=defaults.CENTRING_RATE)


class DBNPretraining(EnergyPretraining):
    """Train each RBM of a DBN on the mean activations of the layers below it.

    One epoch is one *iteration*, a pass over the training set; each layer has ``iterations`` of them, or fewer
    where something stops its training. Activations below the trained layer are computed chunk by chunk and never
    held for the whole data set. Each layer has an optimiser of its own.

    Args:
        dbn: The network; trained in place.
        sampler: Supplies the negative phase.
        iterations: Passes over the training set for each layer, >= 1.
        optimizer: Builds the optimiser of one layer from its parameters.
        centring: Settings of the centred gradient; None follows the plain one.
        seed: Seed of the random streams.

    Raises:
        SettingError: ``iterations`` out of range, or a layer that the sampler cannot handle.
    """

    def __init__(
        self,
        dbn: DBN,
        sampler: NegativePhaseSampler[RBM, Any],
        *,
        iterations: int = defaults.PASSES,
        optimizer: OptimizerFactory = PRETRAINING_SGD,
        centring: Centring | None = CENTRED,
        seed: int = 0,
    ) -> None:
        super().__init__(sampler, iterations=iterations, optimizer=optimizer, centring=centring, seed=seed)
        for rbm in dbn:
            require_state(sampler.init(rbm, 1, generator=rng.stream(seed, "check")))
        self.dbn = dbn

    @property
    def models(self) -> Sequence[RBM]:
        """The RBMs from the lowest up."""
        return list(self.dbn)

    @property
    def model_names(self) -> list[str]:
        """Layers, counted from 1."""
        return [f"layer {layer}" for layer in range(1, len(self.dbn) + 1)]

    @property
    def log_prefix(self) -> str:
        """Prefix of tags: stage and layer, counted from 1."""
        return f"{self.stage}/layer{self.layer + 1}"

    @property
    def progress(self) -> str:
        """Where the stage is, for people."""
        layer = f"layer {self.layer + 1}/{len(self.dbn)}"
        return f"{self.stage} · {layer} · iteration {self.iteration + 1}/{self.iterations}"

    @property
    def active_optimizer(self) -> Optimizer:
        """The optimiser of the layer in training."""
        return self.trainer.optimizers[self.layer]

    def monitored(self, name: str) -> str:
        """The same value of the layer in training."""
        return re.sub(rf"^{self.stage}/layer\d+/", f"{self.log_prefix}/", name)

    def images_of(self, v: Tensor) -> Tensor:
        """Inputs that the visible states of the layer in training stand for, for pictures."""
        return self.dbn.images_of(self.layer, v)

    def configure_optimizers(self) -> list[Optimizer]:
        """One optimiser a layer, so that momentum and adaptive rates start afresh."""
        return [self.make_optimizer(rbm.parameters()) for rbm in self.dbn]

    def visible_of(self, batch: Batch) -> Tensor:
        """Mean activations of the layers below."""
        return self.dbn.visible_of(self.layer, batch.v)

    def infer(self, v: Tensor) -> PositivePhase:
        """The hidden means."""
        return PositivePhase(positive_phase(self.model, v), {})

    def parameters_at_rest(self) -> Iterable[Parameter]:
        """Those of the other layers."""
        return (p for layer, rbm in enumerate(self.dbn) if layer != self.layer for p in rbm.parameters())
