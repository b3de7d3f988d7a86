"""The deep belief network: RBMs on top of each other."""

from collections.abc import Iterator, Sequence
from itertools import pairwise
from typing import Any, cast

import torch
from jaxtyping import Float
from torch import Generator, Tensor, nn

from memcomp_lightning.errors import require_count
from memcomp_lightning.models.base import Hidden, Visible
from memcomp_lightning.models.init import Initialiser
from memcomp_lightning.models.rbm import RBM
from memcomp_lightning.models.units import Units
from memcomp_lightning.rng import stream


class DBN(nn.Module):
    """A stack of RBMs; the hidden units of one are the visible units of the next.

    Args:
        n_visible: Number of inputs in [0, 1]; None where ``visible`` says it.
        hidden_sizes: Units of each hidden layer, in {0, 1}; at least one layer.
        visible: Kind of the inputs, see :mod:`memcomp_lightning.models.units`.
        replicas: Leading axes of independent networks.
        weight_init: Draws the weights of every layer; biases start at zero.
        generator: Random stream of the weights; None is a fresh stream of seed 0.

    >>> dbn = DBN(5, [3, 2])
    >>> dbn(torch.zeros(7, 5)).shape
    torch.Size([7, 2])
    """

    def __init__(
        self,
        n_visible: int | None = None,
        hidden_sizes: Sequence[int] = (),
        *,
        visible: Units | None = None,
        replicas: tuple[int, ...] = (),
        weight_init: Initialiser | None = None,
        generator: Generator | None = None,
    ) -> None:
        super().__init__()
        require_count("number of hidden layers", len(hidden_sizes))
        generator = stream(0, "weights") if generator is None else generator
        settings: dict[str, Any] = {
            "replicas": replicas,
            "weight_init": weight_init,
            "generator": generator,
        }
        self.rbms = nn.ModuleList([RBM(n_visible, hidden_sizes[0], visible=visible, **settings)])
        self.rbms += [RBM(n_in, n_out, **settings) for n_in, n_out in pairwise(hidden_sizes)]

    def __len__(self) -> int:
        return len(self.rbms)

    def __getitem__(self, layer: int) -> RBM:
        """The RBM of one layer, 0 being the lowest."""
        return cast(RBM, self.rbms[layer])

    def __iter__(self) -> Iterator[RBM]:
        return (self[layer] for layer in range(len(self)))

    @property
    def n_visible(self) -> int:
        """Number of inputs."""
        return self[0].n_visible

    @property
    def n_hidden(self) -> int:
        """Number of units of the top layer."""
        return self[-1].n_hidden

    @property
    def replicas(self) -> tuple[int, ...]:
        """Leading axes of independent networks."""
        return self[0].replicas

    def visible_of(self, layer: int, v: Visible) -> Float[Tensor, "*replicas n n_layer_visible"]:
        """What the RBM of ``layer`` sees when the network sees ``v``: the mean activations below it."""
        for rbm in self.rbms[:layer]:
            v = rbm(v)
        return v

    def forward(self, v: Visible) -> Hidden:
        """Mean activations of the top layer."""
        return self.visible_of(len(self), v)

    def images_of(self, layer: int, x: Float[Tensor, "*replicas n n_layer_visible"]) -> Visible:
        """Project visible states of ``layer`` down to the inputs by the conditional means."""
        with torch.no_grad():
            for below in reversed(range(layer)):
                x = self[below].visible_mean(x)
        return x
