"""Pretraining of all layers at once, as one deep Boltzmann machine."""

from collections.abc import Iterable, Sequence
from typing import Any

import torch
from torch import Tensor
from torch.nn import Parameter
from torch.optim import Optimizer

from memcomp_lightning import defaults, rng
from memcomp_lightning.models import DBM, DBN, BoltzmannMachine
from memcomp_lightning.modules.energy import EnergyPretraining
from memcomp_lightning.modules.stage import PRETRAINING_SGD, OptimizerFactory
from memcomp_lightning.objective import Centring
from memcomp_lightning.samplers import MeanField, NegativePhaseSampler, PositivePhase, PositivePhaseSampler
from memcomp_lightning.samplers.base import require_state
from memcomp_lightning.types import Batch


class BoltzmannPretraining(EnergyPretraining):
    """Train a Boltzmann machine of any connectivity.

    One epoch is one *iteration*, a pass over the training set.

    Args:
        model: The machine; trained in place.
        sampler: Supplies the negative phase.
        positive: Supplies the hidden units given the data; what it reports is logged with the sampler's report.
        iterations: Passes over the training set, >= 1.
        optimizer: Builds the optimiser from the parameters.
        centring: Settings of the centred gradient; None follows the plain one.
        seed: Seed of the random streams.

    Raises:
        SettingError: ``iterations`` out of range, or a machine that the sampler cannot handle.
    """

    stream_names = ("negative_phase", "positive_phase")

    def __init__(
        self,
        model: BoltzmannMachine,
        sampler: NegativePhaseSampler[Any, Any],
        *,
        positive: PositivePhaseSampler | None = None,
        iterations: int = defaults.PASSES,
        optimizer: OptimizerFactory = PRETRAINING_SGD,
        centring: Centring | None = None,
        seed: int = 0,
    ) -> None:
        super().__init__(sampler, iterations=iterations, optimizer=optimizer, centring=centring, seed=seed)
        require_state(sampler.init(model, 1, generator=rng.stream(seed, "check")))
        self.machine = model
        self.positive = MeanField() if positive is None else positive

    @property
    def models(self) -> Sequence[BoltzmannMachine]:
        """The machine."""
        return [self.machine]

    def configure_optimizers(self) -> Optimizer:
        """One optimiser for all parameters of the machine."""
        return self.make_optimizer(self.machine.parameters())

    def visible_of(self, batch: Batch) -> Tensor:
        """The images."""
        return batch.v

    def infer(self, v: Tensor) -> PositivePhase:
        """The images, each perhaps several times, with hidden units."""
        return self.positive.sample(self.machine, v, generator=self.streams["positive_phase"])


class DBMPretraining(BoltzmannPretraining):
    """Train all layers of a DBN at once, as the DBM that has its weights.

    After every pass the DBN has the weights of the DBM, ready to be fine-tuned as after greedy pretraining.

    Args:
        dbn: The network; its weights are where training starts, random ones or those of greedy pretraining.
        sampler: Supplies the negative phase.
        positive: Supplies the hidden units given the data; None is the mean field.
        iterations: Passes over the training set, >= 1, for all layers together.
        optimizer: Builds the optimiser from the parameters.
        centring: Settings of the centred gradient; None follows the plain one.
        seed: Seed of the random streams.

    Raises:
        SettingError: ``iterations`` out of range, or a DBM that the sampler cannot handle.
    """

    def __init__(self, dbn: DBN, sampler: NegativePhaseSampler[Any, Any], **settings: Any) -> None:
        super().__init__(joined(dbn), sampler, **settings)
        self.dbn = dbn

    @property
    def log_prefix(self) -> str:
        """Prefix of tags."""
        return f"{self.stage}/joint"

    def on_train_epoch_end(self) -> None:
        """Hand the weights to the DBN."""
        super().on_train_epoch_end()
        self._give()

    def on_train_end(self) -> None:
        """The same for weights that a callback put in their place."""
        super().on_train_end()
        self._give()

    def _give(self) -> None:
        assert isinstance(self.machine, DBM)
        self.machine.give(self.dbn)

    def parameters_at_rest(self) -> Iterable[Parameter]:
        """Those of the DBN, which only receives."""
        return self.dbn.parameters()


def joined(dbn: DBN) -> DBM:
    """The DBM with the weights of a DBN, on its device."""
    sizes = [rbm.n_hidden for rbm in dbn]
    dbm = DBM(dbn.n_visible, sizes, replicas=dbn.replicas)
    dbm.to(dbn[0].b)
    with torch.no_grad():
        dbm.take(dbn)
    return dbm
