"""Up-down training under a trainer."""

from collections.abc import Sequence
from typing import Any, cast

import torch
from lightning.fabric.utilities import move_data_to_device
from torch import Tensor
from torch.optim import Optimizer

from memcomp_lightning import rng
from memcomp_lightning.ambient import with_gradient
from memcomp_lightning.errors import require, require_count
from memcomp_lightning.models import GenerativeDBN
from memcomp_lightning.modules.stage import StageModule
from memcomp_lightning.objective import Offsets
from memcomp_lightning.products import n_weights, quick_products
from memcomp_lightning.samplers import tensors_of, with_tensors
from memcomp_lightning.training import PRETRAINING_SGD, OptimizerFactory, Schedule, StepState, UpDownStep
from memcomp_lightning.training.given import Given, as_batch
from memcomp_lightning.training.updown import STREAMS


class UpDown(StageModule):
    """Trains a deep belief network as a generative model, see :class:`memcomp_lightning.training.UpDownStep`.

    Args:
        network: The model; its weights are where training starts.
        step: Settings of an update; None are those of the paper.
        iterations: Passes over the training set, >= 1.
        optimizer: Builds the optimiser.
        schedules: Change the optimiser from pass to pass.
        seed: Seed of the random streams.
    """

    stage = "updown"
    stream_names = STREAMS

    def __init__(
        self,
        network: GenerativeDBN,
        *,
        step: UpDownStep | None = None,
        iterations: int = 1,
        optimizer: OptimizerFactory = PRETRAINING_SGD,
        schedules: Sequence[Schedule] = (),
        seed: int = 0,
    ) -> None:
        require_count("updown.iterations", iterations)
        super().__init__(iterations=iterations, optimizer=optimizer, schedules=schedules, seed=seed)
        self.network: GenerativeDBN = network
        self.step = UpDownStep() if step is None else step
        self._state = StepState()

    def configure_optimizers(self) -> Optimizer:
        """One optimiser for all three parts."""
        return self.make_optimizer(self.network.parameters())

    def setup(self, stage: str) -> None:
        """Begin without chains; refuse several processes, whose gradients nothing would add up."""
        n, remedy = self.trainer.world_size, "Leave up-down training out, or use one device."
        require(n == 1, "number of processes", n, "1 in up-down training", remedy)
        super().setup(stage)
        if stage == "fit":
            self._state = StepState()

    @with_gradient()
    def training_step(self, batch: Given, batch_idx: int) -> dict[str, object]:
        """Follow the three gradients; return the losses."""
        batch = as_batch(batch)
        with quick_products(batch.v.shape[-2] * n_weights(self.network)):
            losses, self._state = self.step.add_gradient(self.network, batch, self._state, streams=self.streams)
        loss = torch.stack(losses).sum().detach()
        self.update(loss, closes_step=batch.closes_step)
        if batch.closes_step:
            self.network.top.project()
            self._state = self._state.after_update()
        for name, value in losses._asdict().items():
            self.log(f"{self.log_prefix}/{name}", value.mean(), on_step=False, on_epoch=True, batch_size=1)
        return {"loss": loss, **losses._asdict()}

    def validation_step(self, batch: Given, batch_idx: int) -> dict[str, Tensor]:
        """Log how many held-out labels the model finds, if it has labels."""
        batch = as_batch(batch)
        if not self.network.n_classes:
            return {}
        right = (self.network.logits(batch.v).argmax(-1) == batch.label).to(batch.v)
        n = right.shape[-1]
        self.log(f"{self.log_prefix}/heldout_accuracy", right.mean(), on_epoch=True, batch_size=n)
        return {"right": right}

    def extra_state(self) -> dict[str, Any]:
        """The sampler's chains and the offsets."""
        state = self._state
        kept = {
            "sampler": None if state.sampler is None else tensors_of(state.sampler),
            "offsets": None if state.offsets is None else state.offsets._asdict(),
        }
        return cast(dict[str, Any], move_data_to_device(kept, "cpu"))

    def take_extra_state(self, state: dict[str, Any]) -> None:
        """Take back the sampler's chains and the offsets."""
        if state["offsets"] is not None:
            offsets = Offsets(**{name: x.to(self.device) for name, x in state["offsets"].items()})
            self._state = self._state._replace(offsets=offsets)
        if state["sampler"] is not None:
            sampler = self.step.top.sampler
            template = sampler.init(self.network.top, 1, generator=rng.stream(self.seed, "check"))
            chains = {name: x.to(self.device) for name, x in state["sampler"].items()}
            self._state = self._state._replace(sampler=with_tensors(template, chains))
