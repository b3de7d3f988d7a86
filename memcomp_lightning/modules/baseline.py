"""The paper's baseline: no pretraining, batch normalisation and ReLU."""

from collections.abc import Sequence

from torch import Generator, Tensor

from memcomp_lightning import defaults
from memcomp_lightning.models import BatchNormReluNetwork, Initialiser
from memcomp_lightning.modules.classifier import Classifier
from memcomp_lightning.training import FINETUNING_SGD, OptimizerFactory, Schedule


class BaselineClassifier(Classifier):
    """A network of the DBN's size with batch normalisation and ReLU, from random weights (Fig. 6).

    With several processes each one normalises by the statistics of its own images.

    Args:
        n_visible: Number of inputs.
        hidden_sizes: Units of each hidden layer.
        n_classes: Size of the output layer, >= 2.
        replicas: Leading axes of independent networks.
        iterations, optimizer, schedules, loss, class_weights, dropout, seed: As for :class:`Classifier`.
        weight_init: Draws all weights.
        generator: Random stream of the weights; None is a fresh stream of seed 0.
    """

    def __init__(
        self,
        n_visible: int,
        hidden_sizes: Sequence[int] = (32, 32),
        *,
        n_classes: int = 10,
        replicas: tuple[int, ...] = (),
        iterations: int = defaults.FINETUNING_PASSES,
        optimizer: OptimizerFactory = FINETUNING_SGD,
        schedules: Sequence[Schedule] = (),
        loss: str = "cross_entropy",
        class_weights: Tensor | None = None,
        dropout: float = 0.0,
        weight_init: Initialiser | None = None,
        generator: Generator | None = None,
        seed: int = 0,
    ) -> None:
        network = BatchNormReluNetwork(
            n_visible, hidden_sizes, n_classes, replicas=replicas, weight_init=weight_init, generator=generator
        )
        super().__init__(
            network,
            iterations=iterations,
            optimizer=optimizer,
            schedules=schedules,
            loss=loss,
            class_weights=class_weights,
            dropout=dropout,
            seed=seed,
        )
