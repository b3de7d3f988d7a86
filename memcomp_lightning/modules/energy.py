"""Pretraining under a trainer: the energy models of a stage, one after the other."""

import logging
import math
import re
import sys
from collections.abc import Callable, Iterable, Mapping, Sequence
from itertools import pairwise
from typing import Any, cast

import lightning.pytorch as pl
import torch
import torch.distributed
from lightning.fabric.utilities import move_data_to_device
from torch import Tensor, nn
from torch.nn import Parameter
from torch.optim import Optimizer

from memcomp_lightning import defaults, rng
from memcomp_lightning.ambient import with_gradient
from memcomp_lightning.errors import require_count
from memcomp_lightning.models import EnergyModel
from memcomp_lightning.models.units import Units
from memcomp_lightning.modules.stage import StageModule
from memcomp_lightning.objective import Centring, Offsets, weighted
from memcomp_lightning.products import quick_products
from memcomp_lightning.samplers import tensors_of, with_tensors
from memcomp_lightning.samplers.base import require_sampler
from memcomp_lightning.training import (
    PRETRAINING_SGD,
    EnergyStep,
    OptimizerFactory,
    Penalty,
    Phase,
    PretrainingStage,
    Processes,
    Sampler,
    Schedule,
    StepState,
    kept_of,
    state_of,
)
from memcomp_lightning.training.given import Given, as_batch
from memcomp_lightning.training.stages.base import check_stage
from memcomp_lightning.types import Batch, NegativePhase

CENTRED = Centring(rate=defaults.CENTRING_RATE)

log = logging.getLogger(__name__)


class EnergyPretraining(StageModule):
    """Pretrains energy models one after the other, by the gradient of mean E(data) - mean E(negative phase).

    If a callback or a limit asks to stop, only the training of the present model ends, and the next one begins.
    An ``EarlyStopping`` starts afresh with each model; if it monitors a value of one layer, it follows the same
    value of each layer in turn.

    Args:
        pretraining: Way of pretraining, with its network: ``Greedy(dbn)``, ``Joint(dbn)``, ``Boltzmann(machine)``.
        sampler: Supplies the negative phase.
        iterations: Passes over the training set for each model, >= 1.
        optimizer: Builds the optimiser of one model from its parameters.
        schedules: Change the optimiser from pass to pass, for each model anew.
        centring: Settings of the centred gradient; None follows the plain one.
        penalties: What the couplings cost, beside the contrast: ``[L1(1e-3)]``.
        seed: Seed of the random streams.
        earlier: What an earlier training of these models left, :meth:`left`: its chains and centres are kept where
            they fit, and its random streams go on if the seed is the same. None begins anew.

    Attributes:
        chains: What became of the earlier training's chains, in words, by phase.
        energy_gaps: For each model begun, mean energy of the data less that of the negative phase, in its newest
            update, ``(*replicas,)``: the contrast.
    """

    stage = "pretrain"
    stream_names = ("negative_phase", "positive_phase")

    def __init__(
        self,
        pretraining: PretrainingStage,
        sampler: Sampler,
        *,
        iterations: int = defaults.PASSES,
        optimizer: OptimizerFactory = PRETRAINING_SGD,
        schedules: Sequence[Schedule] = (),
        centring: Centring | None = CENTRED,
        penalties: Sequence[Penalty] = (),
        seed: int = 0,
        earlier: Mapping[str, Any] | None = None,
    ) -> None:
        require_count("pretrain.iterations", iterations)
        require_sampler("sampler", sampler)
        super().__init__(iterations=iterations, optimizer=optimizer, schedules=schedules, seed=seed)
        check_stage(pretraining, sampler, seed)
        self.pretraining = pretraining
        self.network = pretraining.network
        known = set(self.network.modules())
        self.models_beside_network = nn.ModuleList(m for m in cast(list[nn.Module], self.models) if m not in known)
        self.sampler = sampler
        self.centring = centring
        self.penalties = penalties
        self.earlier = earlier
        self.chains: dict[str, str] = {}
        self._left: dict[str, Any] = {}
        self.energy_gaps: list[Tensor] = []
        self._state = StepState()
        self._gap: Tensor | float = 0.0
        self._begun_at = [0]
        self._fewest_passes = 0

    @property
    def _units(self) -> Units:
        """Those that the data are values of."""
        return self.phases[0].model.visible

    @property
    def phases(self) -> Sequence[Phase]:
        """The trainings of one model each, in order."""
        return self.pretraining.phases

    @property
    def n_models(self) -> int:
        """Models that are trained, one for each phase."""
        return len(self.phases)

    def record(self) -> dict[str, object]:
        """What the stage did, as plain values, with the energy gaps and the names of the models."""
        gaps = [gap.reshape(-1).tolist() for gap in self.energy_gaps]
        found = {"energy_gap": gaps, "trained": [phase.name for phase in self.phases]}
        return {**super().record(), **found, **({"chains": self.chains} if self.chains else {})}

    def left(self) -> dict[str, Any] | None:
        """What a training that goes on from this one needs beside the weights: tensors in dicts; None without.

        Of several processes each has chains of its own: they are not kept.
        """
        if not self._left or self.trainer.world_size > 1:
            return None
        left = {"seed": self.seed, "streams": rng.save(self.streams), "models": self._left}
        return cast(dict[str, Any], move_data_to_device(left, "cpu"))

    @property
    def models(self) -> list[EnergyModel]:
        """All energy models that are trained, in order."""
        return [phase.model for phase in self.phases]

    @property
    def phase(self) -> Phase:
        """The phase in training."""
        return self.phases[self.layer]

    @property
    def model(self) -> EnergyModel:
        """The energy model in training."""
        return self.phase.model

    @property
    def log_prefix(self) -> str:
        """Prefix of tags: stage and phase."""
        return f"{self.stage}/{self.phase.tag}".rstrip("/")

    @property
    def progress(self) -> str:
        """Where the stage is, for people."""
        which = f"{self.phase.name}/{len(self.phases)} · " if len(self.phases) > 1 else ""
        return f"{self.stage} · {which}iteration {self.iteration + 1}/{self.iterations}"

    @property
    def active_optimizer(self) -> Optimizer:
        """The optimiser of the model in training."""
        return self.trainer.optimizers[self.layer]

    def images_of(self, v: Tensor) -> Tensor:
        """Images that the visible states of the model in training stand for, for pictures."""
        return self.phase.images_of(v)

    def configure_optimizers(self) -> list[Optimizer]:
        """One optimiser a model, so that momentum and adaptive rates start afresh."""
        return [self.make_optimizer(phase.model.parameters()) for phase in self.phases]

    def parameters_at_rest(self) -> Iterable[Parameter]:
        """All but those of the model in training."""
        in_training = set(self.model.parameters())
        return (parameter for parameter in self.parameters() if parameter not in in_training)

    @property
    def layer(self) -> int:
        """Index of the model in training, 0 being the first."""
        return len(self._begun_at) - 1 + self._next_is_due

    @property
    def iteration(self) -> int:
        """Passes done over the training set for this model."""
        return 0 if self._next_is_due else self.current_epoch - self._begun_at[-1]

    @property
    def passes(self) -> list[int]:
        """Passes done for each model begun."""
        return [stop - start for start, stop in pairwise([*self._begun_at, self.current_epoch])]

    @property
    def _next_is_due(self) -> bool:
        """Whether the model begun last has had its passes, and there is another one."""
        n_passes = self.current_epoch - self._begun_at[-1]
        if len(self._begun_at) == len(self.phases) or n_passes <= 0:
            return False
        stopped = self.current_epoch == self._passes_done and self.trainer.should_stop
        return n_passes >= self.iterations or (stopped and n_passes >= self._fewest_passes)

    def setup(self, stage: str) -> None:
        """Begin with the first model."""
        super().setup(stage)
        if stage == "fit":
            self._begun_at, self.energy_gaps, self.chains, self._left = [0], [], {}, {}

    def on_train_start(self) -> None:
        """Take back the state of a checkpoint, or the random streams of an earlier training."""
        if self._loaded is None and self.earlier is not None and self.earlier["seed"] == self.seed:
            rng.restore(self.streams, self.earlier["streams"])
        fewest = self.trainer.min_epochs or 0
        self._fewest_passes = 0 if fewest == sys.maxsize else fewest
        super().on_train_start()
        self._let_stop()

    def on_train_epoch_start(self) -> None:
        """A new model starts without chains, and nothing has asked to stop its training."""
        if self._next_is_due:
            self._keep(self.phases[self.layer - 1])
            # The trainer would end the stage otherwise.
            self.trainer.should_stop = False
            self._begun_at.append(self.current_epoch)
        if self.iteration == 0:
            self._state = StepState()
            self.energy_gaps.append(torch.zeros(self.model.replicas, dtype=torch.float32, device="cpu"))
            for callback in self.trainer.early_stopping_callbacks:
                callback.wait_count, callback.stopped_epoch = 0, 0
                callback.best_score = torch.tensor(math.inf if callback.mode == "min" else -math.inf, device="cpu")
                callback.monitor = self.monitored(callback.monitor)
        super().on_train_epoch_start()

    def on_train_epoch_end(self) -> None:
        """Give the network its weights; the stage may end with the last model alone."""
        super().on_train_epoch_end()
        self.pretraining.hand_over()
        self._let_stop()
        planned = (len(self.phases) - 1) * self.iterations
        is_last = len(self._begun_at) == len(self.phases)
        if is_last and self._begun_at[-1] < planned and self.iteration + 1 == self.iterations:
            self.trainer.should_stop = True  # the trainer does not know that earlier models had fewer passes

    def on_train_end(self) -> None:
        """Give the trainer its own setting back, and the network the weights that a callback chose."""
        super().on_train_end()
        self._keep(self.phase)
        self.pretraining.hand_over()
        self.trainer.fit_loop.min_epochs = self._fewest_passes

    def on_fit_end(self) -> None:
        """Keep and hand over, as at the end of training, where a resumed run had nothing left to train."""
        at_its_end = self._nothing_was_left
        super().on_fit_end()
        if at_its_end:
            self._keep(self.phase)
        self.pretraining.hand_over()

    def _let_stop(self) -> None:
        """Tell the trainer from which pass on it may stop."""
        is_last = len(self._begun_at) == len(self.phases)
        self.trainer.fit_loop.min_epochs = self._begun_at[-1] + self._fewest_passes if is_last else sys.maxsize

    def _keep(self, phase: Phase) -> None:
        if self._state.sampler is not None:
            self._left[phase.name] = kept_of(self._state, self._step())

    def _step(self) -> EnergyStep:
        processes = _OfTrainer(self.trainer, self.device) if self.trainer.world_size > 1 else Processes()
        return EnergyStep(
            sampler=self.sampler, centring=self.centring, penalties=self.penalties, processes=processes
        )

    def _go_on(self, step: EnergyStep, n: int) -> None:
        """Begin with what an earlier training left."""
        assert self.earlier is not None
        kept, said = self.earlier["models"].get(self.phase.name), "begin anew, because none were kept"
        if self.trainer.world_size > 1:
            said = "begin anew, because each process has its own"
        elif kept is not None:
            generator = rng.stream(self.seed, "check")
            self._state, said = state_of(kept, step, self.model, n, generator=generator)
        self.chains[self.phase.name] = said
        log.info("The chains of %s %s.", self.phase.name, said)

    def monitored(self, name: str) -> str:
        """The tag to monitor now: ``pretrain/layer1/x`` becomes ``pretrain/layer2/x`` while layer 2 trains."""
        tags = "|".join(re.escape(phase.tag) for phase in self.phases)
        return re.sub(rf"^{self.stage}/({tags})/", f"{self.log_prefix}/", name) if tags else name

    @with_gradient()
    def training_step(self, batch: Given, batch_idx: int) -> dict[str, object]:
        """Follow the gradient of the contrast of both phases; return it, and what the callbacks look at."""
        batch, phase = as_batch(batch, self._units), self.phases[self.layer]
        with quick_products(batch.v.shape[-2] * phase.model.n_visible * phase.model.n_hidden):
            return self._train_on(batch, phase)

    def _train_on(self, batch: Batch, phase: Phase) -> dict[str, object]:
        model, layer = phase.model, self.layer
        with torch.no_grad():
            v, (positive, inferred) = phase.positive_of(batch, self.streams["positive_phase"])
            positive = weighted(positive, batch.weight)
        step, generator = self._step(), self.streams["negative_phase"]
        if self._state.sampler is None and self.earlier is not None:
            self._go_on(step, positive.v.shape[-2])
        if self.trainer.world_size > 1:  # the processes add their gradients up in the backward pass
            gap, negative, state = step.contrast(
                model, positive, self._state, share=batch.share, generator=generator
            )
            loss = step.loss(model, gap, batch.share)
        else:
            followed = step.add_gradient(model, positive, self._state, share=batch.share, generator=generator)
            gap, negative, state = cast(tuple[Tensor, NegativePhase[object], StepState], followed)
            with torch.no_grad():
                loss = step.loss(model, gap, batch.share)
        self.update(loss, closes_step=batch.closes_step, optimizer_index=layer)
        gap_so_far = self._gap + batch.share * gap.detach()
        if batch.closes_step:
            model.project()
            (self.energy_gaps[layer],) = step.processes.means([gap_so_far])
            self._state, self._gap = state.after_update(), 0.0
        else:
            self._state, self._gap = state, gap_so_far
        return {
            "loss": loss.detach(),
            "contrast": gap.detach(),
            "v": v,
            "observed": batch.observed if phase.complete is None else None,
            "weight": batch.weight,
            "positive": positive,
            "negative": negative.configurations,
            "info": {**inferred, **negative.info},
        }

    def validation_step(self, batch: Given, batch_idx: int) -> dict[str, Tensor | None]:
        """Return the model's visible states ``v`` of held-out images, where they are known, and their weights."""
        batch = as_batch(batch, self._units)
        v, observed = self.phase.seen_of(batch, rng.stream(self.seed, "validation", batch_idx))
        return {"v": v, "observed": observed, "weight": batch.weight}

    def extra_state(self) -> dict[str, Any]:
        """The sampler's chains, the offsets and the energy gaps."""
        chains = None if self._state.sampler is None else tensors_of(self._state.sampler)
        offsets = None if self._state.offsets is None else self._state.offsets._asdict()
        state = {
            "sampler": chains,
            "offsets": offsets,
            "energy_gaps": list(self.energy_gaps),
            "begun_at": list(self._begun_at),
            "left": dict(self._left),
            "chains": dict(self.chains),
        }
        return cast(dict[str, Any], move_data_to_device(state, "cpu"))

    def on_load_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Let callbacks find their state under the names of the model that was in training."""
        super().on_load_checkpoint(checkpoint)
        self._take_begun_at(checkpoint["process_states"][0]["extra"])
        for callback in self.trainer.early_stopping_callbacks:
            callback.monitor = self.monitored(callback.monitor)

    def _take_begun_at(self, state: dict[str, Any]) -> None:
        first_passes = [self.iterations * number for number in range(len(state["energy_gaps"]))]
        self._begun_at = list(state.get("begun_at", first_passes or [0]))

    def take_extra_state(self, state: dict[str, Any]) -> None:
        """Take back the sampler's chains, the offsets and the energy gaps."""
        self._take_begun_at(state)
        self._left, self.chains = dict(state.get("left", {})), dict(state.get("chains", {}))
        self.energy_gaps = [gap.to(self.device) for gap in state["energy_gaps"]]
        if state.get("offsets") is not None:
            offsets = Offsets(**{name: offset.to(self.device) for name, offset in state["offsets"].items()})
            self._state = self._state._replace(offsets=offsets)
        if state["sampler"] is not None:
            template = self.sampler.init(self.model, 1, generator=rng.stream(self.seed, "check"))
            chains = {name: tensor.to(self.device) for name, tensor in state["sampler"].items()}
            self._state = self._state._replace(sampler=with_tensors(template, chains))


class _OfTrainer(Processes):
    """The processes of a trainer that has several."""

    def __init__(self, trainer: pl.Trainer, device: torch.device) -> None:
        self._trainer, self._device = trainer, device

    def means(self, values: Sequence[Tensor], share: float | None = None) -> Sequence[Tensor]:
        """All of them in one message; Lightning would send each by itself, with a barrier before it."""
        together = torch.cat([value.reshape(-1) for value in values])
        if share is not None:
            together = torch.cat([share * together, together.new_full((1,), share)])
        torch.distributed.all_reduce(together)
        n = self._trainer.world_size if share is None else together[-1]
        parts = (together / n)[: sum(value.numel() for value in values)].split([value.numel() for value in values])
        return [part.view_as(value) for part, value in zip(parts, values, strict=True)]

    def from_first(self, make: Callable[[], NegativePhase[object]]) -> NegativePhase[object]:
        """Call ``make`` in the process of rank 0 alone, and return its result in all of them."""
        made = make() if self._trainer.is_global_zero else None
        made = self._trainer.strategy.broadcast(move_data_to_device(made, "cpu"))
        if made is None:
            raise RuntimeError("the process of rank 0 sent no negative phase")
        return cast(NegativePhase[object], move_data_to_device(made, self._device))
