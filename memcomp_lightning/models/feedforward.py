"""Feed-forward layers and the baseline network, on the replica axis."""

import itertools
from collections.abc import Sequence
from functools import partial

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Generator, Tensor, nn

from memcomp_lightning.errors import require_count
from memcomp_lightning.models.affine import affine
from memcomp_lightning.models.base import Visible
from memcomp_lightning.models.dbn import DBN
from memcomp_lightning.models.init import Initialiser, initial
from memcomp_lightning.rng import stream


class Linear(nn.Module):
    """``x W^T + bias`` with one weight matrix a replica.

    Args:
        n_in: Number of inputs, >= 1.
        n_out: Number of outputs, >= 1.
        replicas: Leading axes of independent layers.
        weight_init: Draws the weights; the bias starts at zero.
        generator: Random stream of the weights; None is a fresh stream of seed 0.
    """

    @torch.inference_mode(False)
    def __init__(
        self,
        n_in: int,
        n_out: int,
        *,
        replicas: tuple[int, ...] = (),
        weight_init: Initialiser | None = None,
        generator: Generator | None = None,
    ) -> None:
        super().__init__()
        require_count("n_in", n_in)
        require_count("n_out", n_out)
        weight = initial((*replicas, n_out, n_in), weight_init, generator)
        self.weight = nn.Parameter(weight)
        self.bias = nn.Parameter(weight.new_zeros(*replicas, n_out))

    def forward(self, x: Float[Tensor, "*replicas n n_in"]) -> Float[Tensor, "*replicas n n_out"]:
        """Return ``x W^T + bias``."""
        return affine(x, self.weight, self.bias)


class BatchNorm(nn.Module):
    """Batch normalisation (Ioffe & Szegedy 2015) with statistics of its own for each replica.

    Args:
        n_features: Number of units, >= 1.
        replicas: Leading axes of independent layers.
        momentum: Weight of the newest batch in the running statistics, in (0, 1].
        eps: Added to the variance, > 0.
    """

    running_mean: Tensor
    running_var: Tensor

    @torch.inference_mode(False)
    def __init__(
        self, n_features: int, *, replicas: tuple[int, ...] = (), momentum: float = 0.1, eps: float = 1e-5
    ) -> None:
        super().__init__()
        require_count("n_features", n_features)
        self.momentum = momentum
        self.eps = eps
        ones = torch.ones(*replicas, n_features, dtype=torch.float32, device="cpu")
        self.weight = nn.Parameter(ones)
        self.bias = nn.Parameter(torch.zeros_like(ones))
        self.register_buffer("running_mean", torch.zeros_like(ones))
        self.register_buffer("running_var", ones.clone())

    def forward(self, x: Float[Tensor, "*replicas n n_features"]) -> Float[Tensor, "*replicas n n_features"]:
        """Normalise over the images of each replica.

        In evaluation mode, and for a batch of a single image, by the running statistics.
        """
        # Replicas become channels: torch's own kernel then keeps their statistics apart.
        channels = x.movedim(-2, 0)
        normalised = F.batch_norm(
            channels.flatten(1),
            self.running_mean.view(-1),
            self.running_var.view(-1),
            self.weight.flatten(),
            self.bias.flatten(),
            training=self.training and x.shape[-2] > 1,
            momentum=self.momentum,
            eps=self.eps,
        )
        return normalised.view(channels.shape).movedim(0, -2)


class BatchNormReluNetwork(nn.Module):
    """The network without pretraining that DBNs are compared with (Manukian et al. 2019, Fig. 6).

    Each hidden layer is linear, batch normalisation, ReLU; the output is linear.

    Args:
        n_visible: Number of inputs.
        hidden_sizes: Units of each hidden layer, at least one layer.
        n_classes: Number of outputs, >= 2.
        replicas: Leading axes of independent networks.
        weight_init: Draws all weights.
        generator: As that of :class:`Linear`.
    """

    def __init__(
        self,
        n_visible: int,
        hidden_sizes: Sequence[int],
        n_classes: int,
        *,
        replicas: tuple[int, ...] = (),
        weight_init: Initialiser | None = None,
        generator: Generator | None = None,
    ) -> None:
        super().__init__()
        require_count("number of hidden layers", len(hidden_sizes))
        require_count("n_classes", n_classes, minimum=2)
        generator = stream(0, "weights") if generator is None else generator
        linear = partial(Linear, replicas=replicas, weight_init=weight_init, generator=generator)
        sizes = [n_visible, *hidden_sizes]
        layers: list[nn.Module] = []
        for n_in, n_out in itertools.pairwise(sizes):
            layers += [linear(n_in, n_out), BatchNorm(n_out, replicas=replicas), nn.ReLU()]
        layers.append(linear(sizes[-1], n_classes))
        self.layers = nn.Sequential(*layers)

    def forward(self, v: Visible) -> Float[Tensor, "*replicas n n_classes"]:
        """Class logits."""
        logits: Tensor = self.layers(v)
        return logits


def with_batch_norm_relu(dbn: DBN) -> nn.Sequential:
    """Return the layers of a DBN with batch normalisation and ReLU in place of the sigmoid.

    Weights and hidden biases are the DBN's own parameters: what trains one trains the other.
    """
    layers: list[nn.Module] = []
    for rbm in dbn:
        linear = Linear(rbm.n_visible, rbm.n_hidden, replicas=rbm.replicas)
        linear.weight, linear.bias = rbm.weight, rbm.c
        layers += [linear, BatchNorm(rbm.n_hidden, replicas=rbm.replicas), nn.ReLU()]
    return nn.Sequential(*layers)
