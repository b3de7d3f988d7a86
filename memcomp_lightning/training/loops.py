"""Pretrain and fine-tune any number of replicas without a Lightning trainer, which slows small networks down.

They do what ``EnergyPretraining`` and ``Classifier`` do under a Lightning trainer, update for update and, on the
CPU, draw for draw: a replica here ends with the weights of the run that trains it alone. On another device chains
are drawn there, from a stream of that device, and nothing waits for it within a pass. Callbacks and
logs are left out, because they cost more than an update of a small network.
"""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import NamedTuple, Protocol, cast

import torch
from torch import Generator, Tensor, nn

from memcomp_lightning import rng
from memcomp_lightning.ambient import with_gradient
from memcomp_lightning.errors import require_count
from memcomp_lightning.objective import Centring, weighted
from memcomp_lightning.products import n_weights, quick_products
from memcomp_lightning.samplers.base import holds_chains, positive_phase
from memcomp_lightning.training.backprop import ClassifierStep
from memcomp_lightning.training.best import JUDGED_BY, BestPass
from memcomp_lightning.training.diverged import require_finite
from memcomp_lightning.training.dropout import Dropout
from memcomp_lightning.training.given import Given, begin_epoch, updates_of
from memcomp_lightning.training.losses import Loss, cross_entropy
from memcomp_lightning.training.penalties import Penalty
from memcomp_lightning.training.schedules import OptimizerFactory, Schedule, begin_pass
from memcomp_lightning.training.score import evaluate
from memcomp_lightning.training.stages import Phase, PretrainingStage
from memcomp_lightning.training.stages.base import unchanged
from memcomp_lightning.training.step import EnergyStep, Sampler, StepState
from memcomp_lightning.types import Batch, Configurations


class Batches(Protocol):
    """The images of a training set in the order of a pass, as updates: :class:`memcomp_lightning.data.Batches`."""

    def __iter__(self) -> Iterator[Batch]:
        """The batches of the present pass."""

    def set_epoch(self, epoch: int) -> None:
        """Take the order of a pass, by its number from 0 in the stage."""


class Pass(NamedTuple):
    """What a pass of pretraining leaves.

    Attributes:
        number: Passes done, from 1, over all phases.
        state: Of the sampler.
        positive: Positive phase of the last batch.
    """

    number: int
    state: object
    positive: Configurations


def pretrain(
    stage: PretrainingStage,
    batches: "Batches | Iterable[Given] | Tensor",
    sampler: Sampler,
    *,
    iterations: int,
    optimizer: OptimizerFactory,
    schedules: Sequence[Schedule] = (),
    centring: Centring | None = None,
    penalties: Sequence[Penalty] = (),
    seed: int = 0,
) -> Iterator[Pass]:
    """Train the models of a stage one after the other, in place; yield each pass once it is done.

    Args:
        stage: A way of pretraining, with its network.
        batches: Rows with the network's replica axis: of a data module, a data loader of tensors, or a tensor,
            which is one update a pass.
        sampler: Supplies the negative phase.
        iterations: Passes over the training set for each model, >= 0.
        optimizer: Builds the optimiser of one model, element-wise, so that replicas stay independent.
        schedules: Change the optimiser from pass to pass, for each model anew.
        centring: Settings of the centred gradient; None follows the plain one.
        penalties: What the couplings cost, beside the contrast.
        seed: Of the random streams.

    Raises:
        DivergedError: A parameter left the finite numbers.
    """
    require_count("iterations", iterations, minimum=0)
    # On the parameters' device: a draw from elsewhere would be copied in each update, and the copy would wait.
    device = next(stage.network.parameters()).device
    streams = rng.streams(seed, ("negative_phase", "positive_phase"), device=device)
    for number, phase in enumerate(stage.phases):
        model = cast(nn.Module, phase.model).to(device)  # it need not be a part of the network
        training = PhaseTraining(
            phase,
            sampler,
            optimizer=optimizer,
            schedules=schedules,
            centring=centring,
            penalties=penalties,
            streams=streams,
        )
        for epoch in range(number * iterations, (number + 1) * iterations):
            begin_epoch(batches, epoch)
            done = training.run_pass(batches)
            stage.hand_over()
            yield done._replace(number=epoch + 1)
        require_finite(model, f"pretraining, {phase.name}")


class PhaseTraining:
    """Trains one energy model pass by pass, and keeps its optimiser, its chains and its centres in between.

    Can be pickled where the phase can.

    Args:
        phase: The energy model, trained in place, and what it sees.
        sampler, optimizer, schedules, centring, penalties: As for :func:`pretrain`.
        streams: Generators by the names "negative_phase" and "positive_phase".
    """

    def __init__(
        self,
        phase: Phase,
        sampler: Sampler,
        *,
        optimizer: OptimizerFactory,
        schedules: Sequence[Schedule] = (),
        centring: Centring | None,
        penalties: Sequence[Penalty] = (),
        streams: Mapping[str, Generator],
    ) -> None:
        self.phase = phase
        self._units = phase.model.visible if phase.visible_of is unchanged else None
        self.step = EnergyStep(sampler=sampler, centring=centring, penalties=penalties)
        self.schedules: Sequence[Schedule] = schedules
        self.streams = streams
        self.optimizer = optimizer(phase.model.parameters())
        self.passes_done = 0
        self._state = StepState()

    def chains(self, generator: Generator) -> Tensor | None:
        """Visible states of chains that go on from update to update, one sweep further; None without.

        Two or more of them; the training itself does not see the sweep.
        """
        state, model, sampler = self._state.sampler, self.phase.model, self.step.sampler
        if state is None or not holds_chains(state, (model.n_visible, model.n_visible + model.n_hidden)):
            return None
        nothing = model.b.new_zeros(*model.replicas, 1, model.n_visible)
        found = sampler.sample(model, state, positive_phase(model, nothing), generator=generator).configurations
        return found.v if found.weight is None and found.v.shape[-2] > 1 else None

    def go_on_with(self, sampler: Sampler, centring: Centring | None) -> None:
        """Take other settings for the passes that follow, without schedules; another sampler starts anew."""
        self.schedules = ()
        if sampler != self.step.sampler:
            self._state = self._state._replace(sampler=None)
        self.step = EnergyStep(sampler=sampler, centring=centring, penalties=self.step.penalties)

    @with_gradient()
    def run_pass(self, batches: Iterable[Given] | Tensor) -> Pass:
        """Update the model by each step of the batches, once."""
        begin_pass(self.schedules, self.optimizer, self.passes_done)
        state, phase = self._state, self.phase
        for batch in updates_of(batches, self._units):
            with quick_products(batch.v.shape[-2] * phase.model.n_visible * phase.model.n_hidden):
                with torch.no_grad():
                    _, found = phase.positive_of(batch, self.streams["positive_phase"])
                    positive = weighted(found.configurations, batch.weight)
                _, _, state = self.step.add_gradient(
                    phase.model,
                    positive,
                    state,
                    share=batch.share,
                    generator=self.streams["negative_phase"],
                    valued=False,
                )
            if batch.closes_step:
                self.optimizer.step()
                phase.model.project()
                self.optimizer.zero_grad()
                state = state.after_update()
        self.passes_done += 1
        self._state = state
        return Pass(self.passes_done, state.sampler, positive)


class ClassifierTraining:
    """Trains one network pass by pass, and keeps its optimiser in between.

    Args:
        network, optimizer, schedules, loss: As for :func:`finetune`.
        dropout: Leaves out activations of the hidden layers; None leaves out none.
    """

    def __init__(
        self,
        network: nn.Module,
        *,
        optimizer: OptimizerFactory,
        schedules: Sequence[Schedule] = (),
        loss: Loss = cross_entropy,
        dropout: Dropout | None = None,
    ) -> None:
        self.network = network
        self.schedules: Sequence[Schedule] = schedules
        self.loss = loss
        self.dropout = dropout
        self.optimizer = optimizer(network.parameters())
        self.passes_done = 0

    @with_gradient()
    def run_pass(self, batches: Iterable[Given] | Tensor) -> None:
        """Update the network by each step of the batches, once; it is in evaluation mode afterwards."""
        self.network.train()
        begin_pass(self.schedules, self.optimizer, self.passes_done)
        step = ClassifierStep(self.network, self.loss, self.dropout)
        for batch in updates_of(batches):
            with quick_products(batch.v.shape[-2] * n_weights(self.network)):
                step.add_gradient(batch)
            if batch.closes_step:
                self.optimizer.step()
                self.optimizer.zero_grad()
        self.network.eval()
        self.passes_done += 1


def finetune(
    network: nn.Module,
    batches: "Batches | Iterable[Given] | Tensor",
    *,
    iterations: int,
    optimizer: OptimizerFactory,
    schedules: Sequence[Schedule] = (),
    loss: Loss = cross_entropy,
    dropout: float = 0.0,
    seeds: Sequence[int] = (0,),
    keep_best_by: Batch | None = None,
    best_by: str = "accuracy",
    patience: int | None = None,
) -> Iterator[int]:
    """Minimise the loss of a network in place; yield the number of each pass once it is done.

    The network is in evaluation mode while the caller has it, and nothing waits for the device in between. Once no
    replica has patience left, the passes that follow leave it as it is.

    Args:
        network: Maps inputs ``(*replicas, n, n_visible)`` to logits.
        batches: Its images, with its replica axis.
        iterations: Passes over the training set, >= 1.
        optimizer: Builds the optimiser, element-wise, so that replicas stay independent.
        schedules: Change the optimiser from pass to pass.
        loss: Of each image.
        dropout: Share of the hidden activations that is left out, in [0, 1).
        seeds: Of the streams of dropout, one for each of the trainings that the replica axis holds.
        keep_best_by: Held-out images: at each yield the network has, replica by replica, the weights of the pass
            that classified them best so far. None keeps the newest ones.
        best_by: What is better: a higher "accuracy", or a lower "loss".
        patience: Passes without a better one after which a replica is done, >= 1; None is never.

    Raises:
        DivergedError: A parameter left the finite numbers.
    """
    require_count("iterations", iterations)
    device = next(network.parameters()).device
    generators = [rng.stream(seed, "dropout", device=device) for seed in seeds]
    left_out = Dropout(dropout, generators) if dropout else None
    training = ClassifierTraining(network, optimizer=optimizer, schedules=schedules, loss=loss, dropout=left_out)
    best = BestPass(patience=patience)
    for iteration in range(iterations):
        if best.over:
            yield iteration + 1
            continue
        begin_epoch(batches, iteration)
        training.run_pass(batches)
        if keep_best_by is None:
            yield iteration + 1
            continue
        judged = JUDGED_BY[best_by](evaluate(network, [keep_best_by], loss))
        best.offer(judged, network.state_dict())
        newest = {name: tensor.clone() for name, tensor in network.state_dict().items()}
        network.load_state_dict(best.weights)
        yield iteration + 1
        if not best.over:
            network.load_state_dict(newest)
    require_finite(network, "fine-tuning")
    if best.weights:
        network.load_state_dict(best.weights)
