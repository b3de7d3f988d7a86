"""Fine-tuning: a DBN becomes a classifier."""

from collections.abc import Iterable, Sequence
from typing import Literal

from torch import Generator, Tensor, nn
from torch.nn import Parameter

from memcomp_lightning import defaults
from memcomp_lightning.errors import require_choice, require_count
from memcomp_lightning.models import DBN, Initialiser, Linear, with_batch_norm_relu
from memcomp_lightning.modules.classifier import Classifier
from memcomp_lightning.training import FINETUNING_SGD, OptimizerFactory, Schedule


class DBNClassifier(Classifier):
    """The DBN with a linear output layer on top, all trained by back-propagation.

    Args:
        dbn: The network, pretrained or not; trained in place.
        n_classes: Size of the output layer, >= 2.
        iterations, optimizer, schedules, loss, class_weights, dropout, seed: As for :class:`Classifier`.
        units: Hidden units: "sigmoid", or "batch_norm_relu" for batch normalisation and ReLU on the same weights.
        output_init: Draws the weights of the output layer; None is N(0, 0.01^2).
        generator: Random stream of these weights; None is a fresh stream of seed 0.
    """

    def __init__(
        self,
        dbn: DBN,
        *,
        n_classes: int = 10,
        iterations: int = defaults.FINETUNING_PASSES,
        optimizer: OptimizerFactory = FINETUNING_SGD,
        schedules: Sequence[Schedule] = (),
        loss: str = "cross_entropy",
        class_weights: Tensor | None = None,
        dropout: float = 0.0,
        units: Literal["sigmoid", "batch_norm_relu"] = "sigmoid",
        output_init: Initialiser | None = None,
        generator: Generator | None = None,
        seed: int = 0,
    ) -> None:
        require_count("n_classes", n_classes, minimum=2)
        require_choice("finetune.units", units, ("sigmoid", "batch_norm_relu"))
        output = Linear(
            dbn.n_hidden, n_classes, replicas=dbn.replicas, weight_init=output_init, generator=generator
        )
        hidden = dbn if units == "sigmoid" else with_batch_norm_relu(dbn).to(dbn[0].weight)
        network = nn.Sequential(hidden, output.to(dbn[0].weight))
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
        self.dbn = dbn

    def parameters_at_rest(self) -> Iterable[Parameter]:
        """The visible biases, and what the visible units have of their own: a feed-forward pass uses neither."""
        return (parameter for rbm in self.dbn for parameter in (rbm.b, *rbm.visible.parameters()))
