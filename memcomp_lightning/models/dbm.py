"""The deep Boltzmann machine: layers of hidden units, all in one energy."""

from collections.abc import Sequence
from itertools import pairwise

import torch
from jaxtyping import Float
from torch import Generator, Tensor

from memcomp_lightning.errors import require, require_count
from memcomp_lightning.models.boltzmann import BoltzmannMachine
from memcomp_lightning.models.connectivity import layered
from memcomp_lightning.models.dbn import DBN
from memcomp_lightning.models.init import Initialiser
from memcomp_lightning.models.machine import units_of
from memcomp_lightning.models.units import Units


class DBM(BoltzmannMachine):
    r"""Several hidden layers that are trained together: a Boltzmann machine, each layer coupled to the next.

    .. math:: E(v, h_1, h_2, \ldots) = -h_1^T W_1 v - h_2^T W_2 h_1 - \ldots - b^T v - \sum_l c_l^T h_l

    (Salakhutdinov & Hinton 2009.) The odd and the even layers are the two classes of units.

    Args:
        n_visible: Number of visible units in {0, 1}; None where ``visible`` says it.
        hidden_sizes: Units of each hidden layer, at least one layer.
        visible: Kind of the visible units, see :mod:`memcomp_lightning.models.units`.
        replicas: Leading axes of independent machines.
        weight_init: Draws the weights of each layer, as in :class:`DBN`: the same stream gives the same weights.
        generator: Random stream of the weights; None is a fresh stream of seed 0.

    >>> [tuple(weight.shape) for weight in DBM(5, [3, 2]).weights()]
    [(3, 5), (2, 3)]
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
        require_count("number of hidden layers", len(hidden_sizes))
        visible = units_of("visible", n_visible, visible)
        self.sizes = (visible.n, *hidden_sizes)
        super().__init__(
            None,
            sum(hidden_sizes),
            layered((visible.n_sites, *hidden_sizes)),
            visible=visible,
            replicas=replicas,
            weight_init=weight_init,
            generator=generator,
        )

    @classmethod
    @torch.no_grad()
    def from_dbn(cls, dbn: DBN) -> "DBM":
        """The machine with the weights of a DBN, on its device."""
        machine = cls(hidden_sizes=[rbm.n_hidden for rbm in dbn], visible=dbn[0].visible, replicas=dbn.replicas)
        machine.to(dbn[0].b)
        machine.take(dbn)
        return machine

    def _initial(
        self, n_units: int, replicas: tuple[int, ...], weight_init: Initialiser, generator: Generator
    ) -> Tensor:
        """Initial couplings, layer by layer."""
        shapes = [(*replicas, n_out, n_in) for n_in, n_out in pairwise(self.sizes)]
        return _flat([weight_init(shape, generator=generator) for shape in shapes])

    def other_pairs(self, pairs: Tensor | None) -> str:
        """As in any machine; files without pairs are taken to be of the same layers."""
        return "" if pairs is None else super().other_pairs(pairs)

    def weights(self) -> list[Float[Tensor, "*replicas n_out n_in"]]:
        """The couplings of each layer to the one below, as copies."""
        parts = self.coupling.split([n_in * n_out for n_in, n_out in pairwise(self.sizes)], dim=-1)
        return [
            part.unflatten(-1, (n_in, n_out)).mT
            for part, (n_in, n_out) in zip(parts, pairwise(self.sizes), strict=True)
        ]

    def hidden_layers(self, h: Float[Tensor, "*axes n_hidden"]) -> tuple[Float[Tensor, "*axes n_layer"], ...]:
        """Split ``h``, which has an entry for each hidden unit, into its layers, the lowest first."""
        return tuple(h.split(self.sizes[1:], dim=-1))

    @torch.no_grad()
    def take(self, dbn: DBN) -> None:
        """Take weights and biases of a DBN of the same sizes.

        The bias of a hidden layer is the hidden bias of its RBM plus the visible bias of the RBM above, because
        both are biases of these units.

        Raises:
            SettingError: The DBN has other sizes.
        """
        self._check(dbn)
        self.coupling.copy_(_flat([rbm.weight for rbm in dbn]))
        self.b.copy_(dbn[0].b)
        self.visible.load_state_dict(dbn[0].visible.state_dict())
        above = [*(rbm.b for rbm in list(dbn)[1:]), torch.zeros_like(dbn[-1].c)]
        self.c.copy_(torch.cat([rbm.c + b for rbm, b in zip(dbn, above, strict=True)], dim=-1))

    @torch.no_grad()
    def give(self, dbn: DBN) -> None:
        """Copy weights and biases to a DBN of these sizes; its visible biases above the first layer become zero.

        ``take`` of that DBN gives the same machine again.

        Raises:
            SettingError: The DBN has other sizes.
        """
        self._check(dbn)
        for rbm, weight, c in zip(dbn, self.weights(), self.hidden_layers(self.c), strict=True):
            rbm.weight.copy_(weight)
            rbm.b.zero_()
            rbm.c.copy_(c)
        dbn[0].b.copy_(self.b)
        dbn[0].visible.load_state_dict(self.visible.state_dict())

    def _check(self, dbn: DBN) -> None:
        sizes = (dbn.n_visible, *(rbm.n_hidden for rbm in dbn))
        require(sizes == self.sizes, "sizes of the DBN", sizes, f"{self.sizes}, those of the DBM")


def _flat(weights: Sequence[Tensor]) -> Tensor:
    """Couplings in the order of :func:`layered`."""
    return torch.cat([weight.mT.flatten(-2) for weight in weights], dim=-1)
