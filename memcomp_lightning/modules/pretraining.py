"""Greedy pretraining of a deep belief network, one RBM after the other."""

from collections.abc import Iterable
from typing import Any, cast

import torch
from lightning.fabric.utilities import move_data_to_device
from torch import Tensor
from torch.nn import Parameter
from torch.optim import Optimizer

from memcomp_lightning import rng
from memcomp_lightning.errors import require_count
from memcomp_lightning.models import DBN, RBM
from memcomp_lightning.modules.stage import PAPER_SGD, OptimizerFactory, StageModule
from memcomp_lightning.objective import Centring, Offsets, contrast
from memcomp_lightning.samplers import NegativePhaseSampler, positive_phase, tensors_of, with_tensors
from memcomp_lightning.types import Batch, Configurations, NegativePhase


class DBNPretraining(StageModule):
    """Train each RBM of a DBN on the mean activations of the layers below it.

    One epoch is one *iteration*, a pass over the training set; the layer is
    ``current_epoch // iterations``. Activations below the trained layer are computed chunk by chunk and
    never held for the whole data set. Each layer has an optimiser of its own.

    Args:
        dbn: The network; trained in place.
        sampler: Supplies the negative phase.
        iterations: Passes over the training set for each layer, >= 1.
        optimizer: Builds the optimiser of one layer from its parameters.
        centring: Settings of the centred gradient; None follows the plain one.
        seed: Seed of the random streams.

    Attributes:
        energy_gaps: For each layer begun, mean energy of the data less that of the negative phase, in its
            newest update, ``(*replicas,)``: the contrast.

    Raises:
        SettingError: ``iterations`` out of range, or a layer that the sampler cannot handle.
    """

    stage = "pretrain"

    def __init__(
        self,
        dbn: DBN,
        sampler: NegativePhaseSampler[RBM, Any],
        *,
        iterations: int = 50,
        optimizer: OptimizerFactory = PAPER_SGD,
        centring: Centring | None = None,
        seed: int = 0,
    ) -> None:
        require_count("pretrain.iterations", iterations)
        super().__init__(iterations=iterations, optimizer=optimizer, seed=seed)
        for rbm in dbn:
            sampler.init(rbm, 1, generator=rng.stream(seed, "check"))
        self.dbn = dbn
        self.sampler = sampler
        self.centring = centring
        self.energy_gaps: list[Tensor] = []
        self._sampler_state: Any = None
        self._offsets: Offsets | None = None
        self._negative: NegativePhase[Any] | None = None
        self._gap: Tensor | float = 0.0

    @property
    def n_epochs(self) -> int:
        """Value for the trainer's ``max_epochs``: all layers."""
        return self.iterations * len(self.dbn)

    @property
    def layer(self) -> int:
        """Index of the RBM in training, 0 being the lowest."""
        return min(self.current_epoch // self.iterations, len(self.dbn) - 1)

    @property
    def iteration(self) -> int:
        """Passes done over the training set for this layer."""
        return self.current_epoch - self.layer * self.iterations

    @property
    def rbm(self) -> RBM:
        """The RBM in training."""
        return self.dbn[self.layer]

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

    def images_of(self, v: Tensor) -> Tensor:
        """Inputs that the visible states of the layer in training stand for, for pictures."""
        return self.dbn.images_of(self.layer, v)

    def configure_optimizers(self) -> list[Optimizer]:
        """One optimiser a layer, so that momentum and adaptive rates start afresh."""
        return [self.make_optimizer(rbm.parameters()) for rbm in self.dbn]

    def on_train_epoch_start(self) -> None:
        """A new layer starts without chains."""
        if self.iteration == 0:
            self._sampler_state, self._offsets = None, None
            self.energy_gaps = [*self.energy_gaps, torch.zeros(self.dbn.replicas)]

    def training_step(self, batch: Batch, batch_idx: int) -> dict[str, Any]:
        """Follow the gradient of the contrast of both phases.

        Returns:
            ``loss`` (scalar), ``contrast`` ``(*replicas,)``, ``positive`` and ``negative``
            (:class:`Configurations`) and the sampler's ``info``: what the callbacks look at.
        """
        rbm = self.rbm
        with torch.no_grad():
            positive = positive_phase(rbm, self.dbn.visible_of(self.layer, batch.v))
        if self._negative is None and self.centring is not None:
            offsets = self.centring.follow(self._offsets, positive)
            self._offsets = Offsets(*(self._mean_over_processes(offset) for offset in offsets))
        if self._negative is None or self.sampler.uses_data:
            self._negative = self._negative_phase(rbm, positive)
        negative = self._negative
        gap = contrast(rbm, positive, negative.configurations, self._offsets)
        loss = batch.share * gap.sum()
        self.update(loss, closes_step=batch.closes_step, optimizer_index=self.layer)
        self._gap = self._gap + batch.share * gap.detach()
        if batch.closes_step:
            self.energy_gaps[self.layer] = self._mean_over_processes(self._gap)
            self._negative, self._gap = None, 0.0
        return {
            "loss": loss.detach(),
            "contrast": gap.detach(),
            "positive": positive,
            "negative": negative.configurations,
            "info": negative.info,
        }

    def validation_step(self, batch: Batch, batch_idx: int) -> dict[str, Tensor]:
        """Return the layer's visible states ``v`` of held-out images, for the callbacks."""
        return {"v": self.dbn.visible_of(self.layer, batch.v)}

    def _negative_phase(self, rbm: RBM, positive: Configurations) -> NegativePhase[Any]:
        """Ask the sampler; an answer that depends on the model alone is computed once for all processes."""
        generator = self.streams["negative_phase"]
        if self._sampler_state is None:
            self._sampler_state = self.sampler.init(rbm, positive.v.shape[-2], generator=generator)
        negative: NegativePhase[Any] | None = None
        one_for_all = self.sampler.shared and self.trainer.world_size > 1
        if self.trainer.is_global_zero or not one_for_all:
            negative = self.sampler.sample(rbm, self._sampler_state, positive, generator=generator)
        if one_for_all:
            negative = self.trainer.strategy.broadcast(move_data_to_device(negative, "cpu"))
            negative = move_data_to_device(negative, self.device)
        if negative is None:
            raise RuntimeError("the process of rank 0 sent no negative phase")
        self._sampler_state = negative.state
        return negative

    def _mean_over_processes(self, value: Tensor | float) -> Tensor:
        value = torch.as_tensor(value)
        if self.trainer.world_size == 1:
            return value
        return cast(Tensor, self.trainer.strategy.reduce(value, reduce_op="mean"))

    def parameters_at_rest(self) -> Iterable[Parameter]:
        """Those of the other layers."""
        return (p for layer, rbm in enumerate(self.dbn) if layer != self.layer for p in rbm.parameters())

    def extra_state(self) -> dict[str, Any]:
        """The sampler's chains, the offsets and the energy gaps."""
        chains = None if self._sampler_state is None else tensors_of(self._sampler_state)
        offsets = None if self._offsets is None else self._offsets._asdict()
        state = {"sampler": chains, "offsets": offsets, "energy_gaps": list(self.energy_gaps)}
        return cast(dict[str, Any], move_data_to_device(state, "cpu"))

    def take_extra_state(self, state: dict[str, Any]) -> None:
        """Take back the sampler's chains, the offsets and the energy gaps."""
        self.energy_gaps = [gap.to(self.device) for gap in state["energy_gaps"]]
        if state.get("offsets") is not None:
            self._offsets = Offsets(**{name: offset.to(self.device) for name, offset in state["offsets"].items()})
        if state["sampler"] is not None:
            template = self.sampler.init(self.rbm, 1, generator=rng.stream(self.seed, "check"))
            chains = {name: tensor.to(self.device) for name, tensor in state["sampler"].items()}
            self._sampler_state = with_tensors(template, chains)
