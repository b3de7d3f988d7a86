"""A stacked denoising autoencoder with the layers of a DBN, to compare pretraining with."""

from collections.abc import Callable
from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import Tensor

from memcomp_lightning import rng
from memcomp_lightning.ambient import with_gradient
from memcomp_lightning.models import DBN, RBM, Normal


@dataclass(frozen=True, kw_only=True)
class DenoisingAutoencoder:
    r"""Trains each layer to restore what lies below it from a part of it.

    A share of the inputs is set to 0; :math:`h = \sigma(W \tilde v + c)`, :math:`\hat v = \sigma(W^T h + b)`, and
    the cross-entropy of :math:`\hat v` with v is minimised by Adam. A layer is then fixed, and its h given v are
    what the next one sees. Vincent et al. 2010, Stacked Denoising Autoencoders.

    Attributes:
        noise: Share of the inputs that is set to 0, in [0, 1).
        passes: For each layer.
        rate: Of Adam.
        batch_size: Rows an update.
        std: Of the first weights.
    """

    noise: float
    passes: int
    rate: float
    batch_size: int = 100
    std: float = 0.05

    @with_gradient()
    def train(self, dbn: DBN, rows: Tensor, seed: int, done: Callable[[int], None]) -> None:
        """Train the layers of a DBN in place: weights, hidden biases, and visible biases as those of the outputs.

        Args:
            dbn: Without replica axes.
            rows: ``(n, n_visible)`` in [0, 1].
            seed: Of weights, order and noise.
            done: Is told each pass, by its number over all layers.
        """
        generator, v = rng.stream(seed, "denoising autoencoder"), rows
        first = Normal(std=self.std)
        for number, rbm in enumerate(dbn):
            with torch.no_grad():
                rbm.weight.copy_(first(tuple(rbm.weight.shape), generator=generator))
                rbm.b.zero_()
                rbm.c.zero_()
            optimizer = torch.optim.Adam((rbm.weight, rbm.b, rbm.c), lr=self.rate)
            for number_of_pass in range(self.passes):
                order = torch.randperm(len(v), generator=generator, device="cpu")
                for some in order.split(self.batch_size):
                    optimizer.zero_grad()
                    self.loss(rbm, v[some], generator).backward()
                    optimizer.step()
                done(number * self.passes + number_of_pass + 1)
            with torch.no_grad():
                v = torch.cat([rbm(part) for part in v.split(10_000)])
        dbn.zero_grad()

    def loss(self, rbm: RBM, v: Tensor, generator: torch.Generator) -> Tensor:
        """Mean over rows of the cross-entropy of what is restored, in nats."""
        kept = rng.uniform(v.shape, generator=generator, like=v) >= self.noise
        restored = rbm.visible_field(rbm(v * kept))
        return F.binary_cross_entropy_with_logits(restored, v, reduction="sum") / len(v)
