"""The loops of pretraining and fine-tuning on the replica axis.

They do what ``DBNPretraining``, ``DBMPretraining`` and ``Classifier`` do under a Lightning trainer, update for
update and, on the CPU, draw for draw: a replica here ends with the weights of the run that trains it alone. On
another device chains are drawn there, from a stream of that device, and nothing waits for it within a pass. What
they leave out looks at training, which costs more than an update of a small network.
"""

from collections.abc import Callable, Iterable, Iterator
from typing import Any, NamedTuple, cast

import torch
from torch import Generator, Tensor, nn
from torch.optim import Optimizer

from memcomp_lightning import rng
from memcomp_lightning.ambient import with_gradient
from memcomp_lightning.callbacks.learning_rate_decay import set_learning_rate
from memcomp_lightning.data import Batches
from memcomp_lightning.errors import require_count
from memcomp_lightning.models import DBN, RBM, BoltzmannMachine, EnergyModel
from memcomp_lightning.modules import DivergedError, Loss, OptimizerFactory, cross_entropy, joined
from memcomp_lightning.modules.stage import diverged_parameter
from memcomp_lightning.objective import Centring, weighted
from memcomp_lightning.replicas.backprop import gradient_of
from memcomp_lightning.samplers import NegativePhaseSampler, PositivePhaseSampler, positive_phase
from memcomp_lightning.training import EnergyStep, StepState
from memcomp_lightning.types import Batch, Configurations


class Rates(NamedTuple):
    """How a stage follows its gradient.

    Attributes:
        optimizer: Builds an optimiser for some parameters; element-wise, so that replicas stay independent.
        momentum: Momentum of a pass, by its number from 0 (of the layer, in pretraining); None leaves it.
        learning_rate: Share of the optimiser's learning rate in a pass; None leaves it.
    """

    optimizer: OptimizerFactory
    momentum: Callable[[int], float] | None = None
    learning_rate: Callable[[int], float] | None = None

    def begin_pass(self, optimizer: Optimizer, iteration: int) -> None:
        """Set momentum and learning rate of a pass."""
        if self.momentum is not None:
            for group in optimizer.param_groups:
                group["momentum"] = self.momentum(iteration)
        if self.learning_rate is not None:
            set_learning_rate(optimizer, self.learning_rate(iteration))


class Pass(NamedTuple):
    """What a pass of pretraining leaves.

    Attributes:
        number: Passes done, from 1.
        state: Of the sampler.
        positive: Positive phase of the last batch.
    """

    number: int
    state: Any
    positive: Configurations


def pretrain(
    dbn: DBN,
    batches: Batches,
    sampler: NegativePhaseSampler[RBM, Any],
    *,
    iterations: int,
    rates: Rates,
    centring: Centring | None = None,
    seed: int = 0,
) -> None:
    """Train each RBM of a DBN in place on the mean activations of the layers below it.

    Args:
        dbn: The network.
        batches: Its images, with its replica axis.
        sampler: Supplies the negative phase.
        iterations: Passes over the training set for each layer, >= 0.
        rates: Optimiser and momentum of each layer.
        centring: Settings of the centred gradient; None follows the plain one.
        seed: Of the negative phase.

    Raises:
        DivergedError: A parameter left the finite numbers.
    """
    settings: dict[str, Any] = {"iterations": iterations, "rates": rates, "centring": centring}
    # On the parameters' device: a draw from elsewhere would be copied in each update, and the copy would wait.
    generator = rng.stream(seed, "negative_phase", device=dbn[0].b.device)
    for layer in range(len(dbn)):
        for _ in pretrain_layer(dbn, layer, batches, sampler, generator=generator, **settings):
            pass


def pretrain_layer(
    dbn: DBN,
    layer: int,
    batches: Batches,
    sampler: NegativePhaseSampler[RBM, Any],
    *,
    iterations: int,
    rates: Rates,
    centring: Centring | None = None,
    generator: Generator,
) -> Iterator[Pass]:
    """Train one RBM of a DBN in place; yield each pass once it is done.

    Arguments are those of :func:`pretrain`, with the index of the layer and the stream of the negative phase.

    Raises:
        DivergedError: A parameter left the finite numbers.
    """
    require_count("iterations", iterations, minimum=0)
    rbm = dbn[layer]
    training = ContrastTraining(
        rbm,
        lambda v: positive_phase(rbm, dbn.visible_of(layer, v)),
        sampler,
        rates=rates,
        centring=centring,
        generator=generator,
    )
    epochs = range(layer * iterations, (layer + 1) * iterations)
    yield from _passes(training, batches, epochs, f"pretraining, layer {layer + 1}")


def pretrain_jointly(
    dbn: DBN,
    batches: Batches,
    sampler: NegativePhaseSampler[Any, Any],
    positive: PositivePhaseSampler,
    *,
    iterations: int,
    rates: Rates,
    centring: Centring | None = None,
    seed: int = 0,
) -> None:
    """Train all layers of a DBN at once, in place, as ``DBMPretraining`` does.

    Arguments are those of :func:`pretrain`, with what supplies the hidden units given the data.

    Raises:
        DivergedError: A parameter left the finite numbers.
    """
    dbm = joined(dbn)
    for _ in pretrain_machine(
        dbm, batches, sampler, positive, iterations=iterations, rates=rates, centring=centring, seed=seed
    ):
        pass
    dbm.give(dbn)


def pretrain_machine(
    model: BoltzmannMachine,
    batches: Batches,
    sampler: NegativePhaseSampler[Any, Any],
    positive: PositivePhaseSampler,
    *,
    iterations: int,
    rates: Rates,
    centring: Centring | None = None,
    seed: int = 0,
) -> Iterator[Pass]:
    """Train a Boltzmann machine in place, as ``BoltzmannPretraining`` does; yield each pass once it is done.

    Arguments are those of :func:`pretrain`, with what supplies the hidden units given the data.

    Raises:
        DivergedError: A parameter left the finite numbers.
    """
    require_count("iterations", iterations, minimum=0)
    device = model.b.device
    of_data = rng.stream(seed, "positive_phase", device=device)
    training = ContrastTraining(
        model,
        lambda v: positive.sample(model, v, generator=of_data).configurations,
        sampler,
        rates=rates,
        centring=centring,
        generator=rng.stream(seed, "negative_phase", device=device),
    )
    yield from _passes(training, batches, range(iterations), "pretraining")


class ContrastTraining:
    """One model that follows the contrast: its optimiser, its chains and its centres, kept from pass to pass.

    Can be pickled where ``positive_of`` can.

    Args:
        model: The energy model; trained in place.
        positive_of: Maps visible states ``(*replicas, n, n_visible)`` to configurations, without the weights.
        sampler: Supplies the negative phase.
        rates: Optimiser and momentum.
        centring: Settings of the centred gradient; None follows the plain one.
        generator: Random stream of the negative phase.

    Attributes:
        passes_done: How many.
    """

    def __init__(
        self,
        model: EnergyModel,
        positive_of: Callable[[Tensor], Configurations],
        sampler: NegativePhaseSampler[Any, Any],
        *,
        rates: Rates,
        centring: Centring | None,
        generator: Generator,
    ) -> None:
        self.model = model
        self.positive_of = positive_of
        self.step = EnergyStep(sampler=sampler, centring=centring)
        self.rates = rates
        self.generator = generator
        self.optimizer = rates.optimizer(model.parameters())
        self.passes_done = 0
        self._state = StepState()

    @property
    def state(self) -> Any:
        """Of the sampler."""
        return self._state.sampler

    def go_on_with(self, sampler: NegativePhaseSampler[Any, Any], centring: Centring | None) -> None:
        """Take other settings for the passes that follow; another sampler starts anew."""
        if sampler != self.step.sampler:
            self._state = self._state._replace(sampler=None)
        self.step = EnergyStep(sampler=sampler, centring=centring)

    def run_pass(self, batches: Iterable[Batch]) -> Pass:
        """Update the model by each step of the batches, once."""
        with with_gradient():
            return self._run_pass(batches)

    def _run_pass(self, batches: Iterable[Batch]) -> Pass:
        self.rates.begin_pass(self.optimizer, self.passes_done)
        state = self._state
        for batch in batches:
            with torch.no_grad():
                positive = weighted(self.positive_of(batch.v), batch.weight)
            gap, _, state = self.step.contrast(self.model, positive, state, generator=self.generator)
            (batch.share * gap.sum()).backward()
            if batch.closes_step:
                self.optimizer.step()
                self.optimizer.zero_grad()
                state = state.after_update()
        self.passes_done += 1
        self._state = state
        return Pass(self.passes_done, self.state, positive)


def _passes(training: ContrastTraining, batches: Batches, epochs: range, where: str) -> Iterator[Pass]:
    """One pass an epoch; yield each once it is done."""
    for epoch in epochs:
        batches.set_epoch(epoch)
        yield training.run_pass(batches)
    require_finite(cast(nn.Module, training.model), where)


class Backpropagation:
    """A network that follows the gradient of its loss: its optimiser, kept from pass to pass.

    Args:
        network: Maps inputs ``(*replicas, n, n_visible)`` to logits; trained in place.
        rates: Optimiser and momentum.
        loss: Of each image.

    Attributes:
        passes_done: How many.
    """

    def __init__(self, network: nn.Module, *, rates: Rates, loss: Loss = cross_entropy) -> None:
        self.network = network
        self.rates = rates
        self.loss = loss
        self.optimizer = rates.optimizer(network.parameters())
        self.passes_done = 0

    def run_pass(self, batches: Iterable[Batch]) -> None:
        """Update the network by each step of the batches, once; it is in evaluation mode afterwards."""
        self.network.train()
        self.rates.begin_pass(self.optimizer, self.passes_done)
        with with_gradient():
            add_gradient = gradient_of(self.network, self.loss)
            for batch in batches:
                add_gradient(batch)
                if batch.closes_step:
                    self.optimizer.step()
                    self.optimizer.zero_grad()
        self.network.eval()
        self.passes_done += 1


def finetune(
    network: nn.Module, batches: Batches, *, iterations: int, rates: Rates, loss: Loss = cross_entropy
) -> Iterator[int]:
    """Minimise the loss of a network in place; yield the number of each pass once it is done.

    The network is in evaluation mode while the caller has it, and nothing waits for the device in between.

    Args:
        network: Maps inputs ``(*replicas, n, n_visible)`` to logits.
        batches: Its images, with its replica axis.
        iterations: Passes over the training set, >= 1.
        rates: Optimiser and momentum.
        loss: Of each image.

    Raises:
        DivergedError: A parameter left the finite numbers.
    """
    require_count("iterations", iterations)
    training = Backpropagation(network, rates=rates, loss=loss)
    for iteration in range(iterations):
        batches.set_epoch(iteration)
        training.run_pass(batches)
        yield iteration + 1
    require_finite(network, "fine-tuning")


def require_finite(module: nn.Module, where: str) -> None:
    """Raise if a parameter left the finite numbers.

    Raises:
        DivergedError: Naming the parameter.
    """
    if (diverged := diverged_parameter(module)) is not None:
        raise DivergedError(f"{where}: {diverged}. Lower the learning rate.")
