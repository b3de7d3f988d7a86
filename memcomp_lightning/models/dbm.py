"""The deep Boltzmann machine: layers of hidden units, all in one energy."""

from collections.abc import Sequence
from itertools import pairwise
from typing import Any

import torch
from jaxtyping import Float
from torch import Generator, Tensor

from memcomp_lightning.errors import require, require_count
from memcomp_lightning.models.affine import plus_product
from memcomp_lightning.models.boltzmann import BoltzmannMachine
from memcomp_lightning.models.connectivity import layered
from memcomp_lightning.models.dbn import DBN
from memcomp_lightning.models.init import Initialiser
from memcomp_lightning.models.machine import units_of
from memcomp_lightning.models.units import Units
from memcomp_lightning.types import Weighted


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
        """The couplings of each layer to the one below, as views."""
        return [upwards.mT for upwards in self._by_layers(self.coupling)]

    def _by_layers(self, of_pairs: Tensor) -> list[Float[Tensor, "*replicas n_in n_out"]]:
        """A number for each pair as a matrix for each two layers."""
        parts = of_pairs.split([n_in * n_out for n_in, n_out in pairwise(self.sizes)], dim=-1)
        return [
            part.unflatten(-1, (n_in, n_out))
            for part, (n_in, n_out) in zip(parts, pairwise(self.sizes), strict=True)
        ]

    def _weights_of(self, layouts: Sequence[Any]) -> list[Tensor]:
        """The even layers have the odd ones for neighbours, and the other way round."""
        even, odd = (sum(self.sizes[begin::2]) for begin in (0, 1))
        matrix, row, column = self.coupling.new_zeros(*self.replicas, even, odd), 0, 0
        for lower, weight in enumerate(self._by_layers(self.coupling)):
            across = weight.mT if lower % 2 else weight
            n_rows, n_columns = across.shape[-2:]
            matrix[..., row : row + n_rows, column : column + n_columns] = across
            row, column = (row, column + n_columns) if lower % 2 else (row + n_rows, column)
        return [matrix, matrix.mT]

    def _moments(self, parts: Sequence[Weighted]) -> tuple[Tensor, Tensor]:
        of_pairs: list[Tensor | None] = [None] * len(self.sizes[1:])
        of_v = of_h = None
        for v, h, weight in parts:
            each = weight.unsqueeze(-2)
            of_v, of_h = plus_product(of_v, each, v), plus_product(of_h, each, h)
            below, above = (v, *self.hidden_layers(h)), self.hidden_layers(h * weight.unsqueeze(-1))
            of_pairs = [plus_product(total, x.mT, y) for total, x, y in zip(of_pairs, below, above, strict=False)]
        of_units = [total.squeeze(-2) for total in (of_v, of_h) if total is not None]
        return _joined([product for product in of_pairs if product is not None]), torch.cat(of_units, dim=-1)

    def _own_moments(
        self, centred: Sequence[Tensor], visible_offset: Tensor, hidden_offset: Tensor
    ) -> tuple[Tensor, Tensor]:
        of_pairs, of_units = centred
        return of_pairs, of_units - self._fields(of_pairs, visible_offset, hidden_offset)

    def _plain_moments(
        self, centred: Sequence[Tensor], visible_offset: Tensor, hidden_offset: Tensor
    ) -> tuple[Tensor, Tensor]:
        of_pairs, of_units = centred
        of_units = of_units + self._fields(of_pairs, visible_offset, hidden_offset)
        offsets, units = (visible_offset, *self.hidden_layers(hidden_offset)), of_units.split(self.sizes, dim=-1)
        plain = [
            product
            + offsets[k].unsqueeze(-1) * units[k + 1].unsqueeze(-2)
            + units[k].unsqueeze(-1) * offsets[k + 1].unsqueeze(-2)
            for k, product in enumerate(self._by_layers(of_pairs))
        ]
        return _joined(plain), of_units

    def _fields(self, of_pairs: Tensor, v: Tensor, h: Tensor) -> Tensor:
        """Of each unit the sum over its neighbours, of their values times a number of the pair."""
        x = (v, *self.hidden_layers(h))
        fields = [torch.zeros_like(layer) for layer in x]
        for k, numbers in enumerate(self._by_layers(of_pairs)):
            fields[k] += (numbers @ x[k + 1].unsqueeze(-1)).squeeze(-1)
            fields[k + 1] += (x[k].unsqueeze(-2) @ numbers).squeeze(-2)
        return torch.cat(fields, dim=-1)

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
    return _joined([weight.mT for weight in weights])


def _joined(upwards: Sequence[Tensor]) -> Tensor:
    """Matrices of each two layers as a number for each pair."""
    return torch.cat([matrix.flatten(-2) for matrix in upwards], dim=-1)
