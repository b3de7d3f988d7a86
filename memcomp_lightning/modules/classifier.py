"""Supervised training of any network on the replica axis."""

from collections.abc import Sequence

from torch import Tensor, nn
from torch.optim import Optimizer

from memcomp_lightning import defaults
from memcomp_lightning.ambient import plain, with_gradient
from memcomp_lightning.errors import require_choice, require_count
from memcomp_lightning.modules.stage import StageModule
from memcomp_lightning.products import n_weights, quick_products
from memcomp_lightning.training import (
    FINETUNING_SGD,
    LOSSES,
    ClassifierStep,
    ClassWeighted,
    Dropout,
    Loss,
    OptimizerFactory,
    Schedule,
)
from memcomp_lightning.training.dropout import require_share
from memcomp_lightning.training.filling import Filling
from memcomp_lightning.training.given import Given, as_batch
from memcomp_lightning.training.score import judged, score_of


class Classifier(StageModule):
    """Minimise the loss of a network by back-propagation.

    Args:
        network: Maps inputs ``(*replicas, n, n_visible)`` to logits ``(*replicas, n, n_classes)``.
        iterations: Passes over the training set, >= 1.
        optimizer: Builds the optimiser from the network's parameters.
        schedules: Change the optimiser from pass to pass.
        loss: "cross_entropy", or "squared_error" of sigmoid outputs.
        class_weights: How much each class counts in the loss, > 0, ``(n_classes,)``; None is all alike.
        dropout: Share of the activations of hidden layers that is left out while training, in [0, 1).
        seed: Seed of the random streams.
    """

    stage = "finetune"

    def __init__(
        self,
        network: nn.Module,
        *,
        iterations: int = defaults.FINETUNING_PASSES,
        optimizer: OptimizerFactory = FINETUNING_SGD,
        schedules: Sequence[Schedule] = (),
        loss: str = "cross_entropy",
        class_weights: Tensor | None = None,
        dropout: float = 0.0,
        seed: int = 0,
    ) -> None:
        require_count("finetune.iterations", iterations)
        require_choice("finetune.loss", loss, tuple(LOSSES))
        require_share(dropout)
        super().__init__(iterations=iterations, optimizer=optimizer, schedules=schedules, seed=seed)
        self.network = network
        self.dropout = dropout
        self.filling: Filling | None = None
        if dropout:
            self.stream_names = (*self.stream_names, "dropout")
        plain_loss = LOSSES[loss]
        self.loss: Loss = plain_loss if class_weights is None else ClassWeighted(plain_loss, class_weights)

    def fill_by(self, filling: Filling) -> None:
        """Draw what is missing of the inputs, before training begins."""
        self.filling = filling
        self.stream_names = (*self.stream_names, "missing")

    def forward(self, v: Tensor) -> Tensor:
        """Class logits."""
        logits: Tensor = self.network(v)
        return logits

    def configure_optimizers(self) -> Optimizer:
        """One optimiser for all parameters."""
        return self.make_optimizer(self.network.parameters())

    @with_gradient()
    def training_step(self, batch: Given, batch_idx: int) -> dict[str, object]:
        """Follow the gradient of the mean loss; replicas add up and stay independent. Return the ``score``."""
        network = self.network if type(self).forward is Classifier.forward else self
        batch = as_batch(batch)
        batch = batch._replace(v=plain(batch.v), label=plain(batch.label))
        if self.filling is not None:
            batch = self.filling.complete(batch, self.streams["missing"])
        dropout = Dropout(self.dropout, [self.streams["dropout"]]) if self.dropout else None
        with quick_products(batch.v.shape[-2] * n_weights(network)):
            loss, losses, logits = ClassifierStep(network, self.loss, dropout).loss(batch)
            self.update(loss, closes_step=batch.closes_step)
        return {"loss": loss.detach(), "score": score_of(losses, logits, batch.label)}

    def validation_step(self, batch: Given, batch_idx: int) -> dict[str, object]:
        """Return the ``score`` of held-out images."""
        return {"score": judged(self, as_batch(batch), self.loss, self.filling, batch_idx)}

    def test_step(self, batch: Given, batch_idx: int) -> dict[str, object]:
        """Return the ``score`` of test images."""
        return self.validation_step(batch, batch_idx)
