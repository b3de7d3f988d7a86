"""What the LightningModules of all stages share: optimiser, random streams, state in checkpoints."""

import time
from collections.abc import Iterable, Sequence
from typing import Any

import lightning.pytorch as pl
import torch
import torch.distributed
from lightning.pytorch.trainer.states import TrainerFn
from torch import Generator, Tensor, nn
from torch.nn import Parameter
from torch.optim import Optimizer

from memcomp_lightning import rng
from memcomp_lightning.modules.trainers import check_trainer, tries
from memcomp_lightning.training import DivergedError, OptimizerFactory, Schedule, diverged_parameter
from memcomp_lightning.training.schedules import begin_pass, check_schedules


class NotTrainedError(ValueError):
    """A stage ended, or a pass did, without the optimiser steps that belong to it."""


class StageModule(pl.LightningModule):
    """Base of all stages: steps the optimiser itself, once all chunks of the images of an update are in.

    Whatever asks to stop (``EarlyStopping``, a ``Timer``, ``max_time``, a callback of yours that sets
    ``trainer.should_stop``) is heard at the end of the pass, so that no update is cut in two. The stage is then
    done, after fewer passes.

    Checkpoints hold the random streams and the extra state of every process, as plain tensors: they load
    with ``weights_only=True``.

    Attributes:
        stage: Name of the stage; prefix of everything that it logs.
        network: What is trained.
        iterations: Passes over the training set.
        streams: Named generators of this process, made by :meth:`setup`.
    """

    stage: str
    network: nn.Module
    stream_names: tuple[str, ...] = ("negative_phase",)

    def __init__(
        self, *, iterations: int, optimizer: OptimizerFactory, schedules: Sequence[Schedule], seed: int
    ) -> None:
        super().__init__()
        self.automatic_optimization = False
        self.iterations = iterations
        self.make_optimizer = optimizer
        self.schedules = schedules
        self.seed = seed
        self.streams: dict[str, Generator] = {}
        self._loaded: list[dict[str, Any]] | None = None
        self._passes_done = 0
        self._stop_asked = False
        self._mid_update = False
        self._seconds_before = 0.0
        self._started_at: float | None = None

    @property
    def n_epochs(self) -> int:
        """Value for the trainer's ``max_epochs``: the passes of all models."""
        return self.iterations * self.n_models

    @property
    def iteration(self) -> int:
        """Passes done over the training set in this stage (of this layer, in pretraining)."""
        return self.current_epoch

    @property
    def passes(self) -> list[int]:
        """Passes done, for each of the models that the stage trains one after the other."""
        return [self.current_epoch]

    @property
    def log_prefix(self) -> str:
        """Prefix of tags."""
        return self.stage

    @property
    def progress(self) -> str:
        """Where the stage is, for people."""
        return f"{self.stage} · iteration {self.iteration + 1}/{self.iterations}"

    @property
    def wall_time_s(self) -> float:
        """Seconds of training so far, those before an interruption included."""
        running = 0.0 if self._started_at is None else time.perf_counter() - self._started_at
        return self._seconds_before + running

    @property
    def n_models(self) -> int:
        """Models that the stage trains one after the other."""
        return 1

    def record(self) -> dict[str, object]:
        """What the stage did, as plain values for the record of its run."""
        return {"iterations": self.iterations, "passes": self.passes, "wall_time_s": self.wall_time_s}

    @property
    def active_optimizer(self) -> Optimizer:
        """The optimiser that steps now."""
        return self.trainer.optimizers[0]

    def configure_callbacks(self) -> list[pl.Callback]:
        """Add none; check the trainer, by :func:`check_trainer`, before its callbacks set anything up."""
        if self.trainer.state.fn == TrainerFn.FITTING:
            check_trainer(self.trainer)
        return []

    def setup(self, stage: str) -> None:
        """Make this process's random streams."""
        if stage == "fit":
            self._passes_done, self._stop_asked, self._mid_update = 0, False, False
        self.streams = rng.streams(self.seed, self.stream_names, index=self.global_rank)

    def on_train_epoch_start(self) -> None:
        """Let the schedules set what the pass needs."""
        begin_pass(self.schedules, self.active_optimizer, self.iteration)

    def update(self, loss: Tensor, *, closes_step: bool, optimizer_index: int = 0) -> None:
        """Add the gradient of ``loss``; step and clear once the step's last chunk is in."""
        if self.trainer.world_size > 1:
            # Distributed training waits for the gradient of every parameter: those at rest give a zero.
            at_rest = list(self.parameters_at_rest())
            self.manual_backward(loss + sum(0.0 * parameter.sum() for parameter in at_rest))
            for parameter in at_rest:
                parameter.grad = None
        else:
            self.manual_backward(loss)
        self._mid_update = not closes_step
        if closes_step:
            optimizers = self.optimizers()
            optimizer = optimizers[optimizer_index] if isinstance(optimizers, list) else optimizers
            optimizer.step()
            optimizer.zero_grad()
            # Before the pass's checkpoint is written, so that the last good one stays.
            if self.trainer.is_last_batch and (diverged := diverged_parameter(self)) is not None:
                raise DivergedError(
                    f"{self.progress}: training diverged, {diverged}. Lower the learning rate "
                    f"({self.stage}.optimizer.lr) and start a new run."
                )

    def __setattr__(self, name: str, value: Any) -> None:
        """As in any module; at once for what Lightning sets before and after each of its hooks."""
        if name == "_current_fx_name":
            object.__setattr__(self, name, value)
        else:
            super().__setattr__(name, value)

    def backward(self, loss: Tensor, *arguments: Any, **settings: Any) -> None:
        """Nothing for a loss without a graph: its gradient has been added already."""
        if loss.requires_grad:
            super().backward(loss, *arguments, **settings)

    def on_train_batch_end(self, *_: object) -> None:
        """Keep a wish to stop until the end of the pass."""
        self._keep_wish()

    def on_validation_end(self) -> None:
        """Keep a wish to stop until the end of the pass."""
        self._keep_wish()

    def _keep_wish(self) -> None:
        if self.trainer.should_stop and not self.trainer.sanity_checking:
            self._stop_asked, self.trainer.should_stop = True, False

    def on_train_epoch_end(self) -> None:
        """Hand on a wish to stop; raise a NotTrainedError if the pass ended in the middle of an update."""
        if self._mid_update and not tries(self.trainer):
            raise NotTrainedError(
                "the pass ended in the middle of an update, whose step was not taken. Something "
                "left the last batches of the pass out: a callback, or a data loader of your own whose last batch "
                "has closes_step = False."
            )
        self._passes_done = self.current_epoch + 1
        if self._stop_asked:
            self._stop_asked, self.trainer.should_stop = False, True

    def parameters_at_rest(self) -> Iterable[Parameter]:
        """Parameters that the present loss does not depend on."""
        return ()

    def extra_state(self) -> dict[str, Any]:
        """State of this process that a checkpoint must hold beside weights and streams: tensors in dicts."""
        return {}

    def take_extra_state(self, state: dict[str, Any]) -> None:
        """Inverse of :meth:`extra_state`."""

    def on_save_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Add streams and extra state of all processes."""
        own = {
            "streams": rng.save(self.streams),
            "extra": self.extra_state(),
            "wall_time_s": self.wall_time_s,
            "passes_done": self._passes_done,
            "stop_asked": self._stop_asked or self.trainer.should_stop,
        }
        states: list[dict[str, Any] | None] = [own]
        if torch.distributed.is_available() and torch.distributed.is_initialized():
            states = [None] * torch.distributed.get_world_size()
            torch.distributed.all_gather_object(states, own)
        checkpoint["process_states"] = states

    def on_load_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Keep streams and extra state until training starts."""
        self._loaded = checkpoint["process_states"]

    def on_train_start(self) -> None:
        """Take back streams and extra state, now that device and number of processes are settled."""
        self._started_at = time.perf_counter()
        check_schedules(self.schedules, self.trainer.optimizers)
        self._take_back()

    @property
    def _nothing_was_left(self) -> bool:
        """Whether a resumed training was at its end already: neither its start nor its end is then announced."""
        return self._loaded is not None

    def _take_back(self) -> None:
        if self._loaded is None:
            return
        states, self._loaded = self._loaded, None
        if len(states) != self.trainer.world_size:
            raise ValueError(
                f"the checkpoint holds the random streams of {len(states)} processes, this run has "
                f"{self.trainer.world_size}: resume with trainer.devices={len(states)}, or start a new run."
            )
        own = states[self.global_rank]
        rng.restore(self.streams, own["streams"])
        self.take_extra_state(own["extra"])
        self._seconds_before = own["wall_time_s"]
        self._passes_done = own.get("passes_done", self.current_epoch)
        asked = own.get("stop_asked", False)
        at_the_end_of_a_pass = self._passes_done == self.current_epoch
        self._stop_asked = asked and not at_the_end_of_a_pass
        self.trainer.should_stop = asked and at_the_end_of_a_pass

    def on_train_end(self) -> None:
        """Stop the clock."""
        self._seconds_before, self._started_at = self.wall_time_s, None

    def on_fit_end(self) -> None:
        """Take back the state of a checkpoint of the last pass; raise a NotTrainedError if no step was taken."""
        self._take_back()
        if self.trainer.global_step == 0 and not tries(self.trainer):
            raise NotTrainedError(
                "the stage ended without an optimiser step: its weights are those it began with. A limit of "
                "the trainer (max_time, max_steps, max_epochs) or a callback stopped it before the first one."
            )
