"""Fine-tuning: a DBN becomes a classifier."""

from collections.abc import Iterable

from torch import Generator, nn
from torch.nn import Parameter

from memcomp_lightning.errors import require_count
from memcomp_lightning.models import DBN, Initialiser, Linear
from memcomp_lightning.modules.classifier import Classifier
from memcomp_lightning.modules.stage import PAPER_SGD, OptimizerFactory


class DBNClassifier(Classifier):
    """The DBN with sigmoid units and a linear output layer on top, all trained by back-propagation.

    Args:
        dbn: The network, pretrained or not; trained in place.
        n_classes: Size of the output layer, >= 2.
        iterations: Passes over the training set, >= 1.
        optimizer: Builds the optimiser.
        output_init: Draws the weights of the output layer; None is N(0, 0.01^2).
        generator: Random stream of these weights; None is a fresh stream of seed 0.
        seed: Seed of the random streams.
    """

    def __init__(
        self,
        dbn: DBN,
        *,
        n_classes: int = 10,
        iterations: int = 100,
        optimizer: OptimizerFactory = PAPER_SGD,
        output_init: Initialiser | None = None,
        generator: Generator | None = None,
        seed: int = 0,
    ) -> None:
        require_count("n_classes", n_classes, minimum=2)
        output = Linear(
            dbn.n_hidden, n_classes, replicas=dbn.replicas, weight_init=output_init, generator=generator
        )
        network = nn.Sequential(dbn, output.to(dbn[0].weight))
        super().__init__(network, iterations=iterations, optimizer=optimizer, seed=seed)
        self.dbn = dbn

    def parameters_at_rest(self) -> Iterable[Parameter]:
        """The visible biases: a feed-forward pass does not use them."""
        return (rbm.b for rbm in self.dbn)
