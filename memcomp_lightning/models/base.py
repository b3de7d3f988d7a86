"""What samplers, likelihoods, solvers and callbacks ask of an energy model."""

from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING, Literal, NamedTuple, Protocol, Self

from jaxtyping import Float
from torch import Generator, Tensor, nn

from memcomp_lightning.errors import require
from memcomp_lightning.models.affine import affine, scaled
from memcomp_lightning.models.units.base import Units
from memcomp_lightning.types import Configurations

if TYPE_CHECKING:
    from memcomp_lightning.models.bit_form import BitForm
    from memcomp_lightning.models.rbm import RBM

Readout = Literal["mean", "sample"]

Visible = Float[Tensor, "*replicas n n_visible"]
"""Values of the visible units in n configurations."""
Hidden = Float[Tensor, "*replicas n n_hidden"]
"""Values of the hidden units."""
PerState = Float[Tensor, "*replicas n"]
"""One number a configuration."""
PerReplica = Float[Tensor, "*replicas"]
"""One number a replica."""
Images = Float[Tensor, "*axes n n_visible"]
"""Data with the replica axes of a model, or without any."""


class Block(NamedTuple):
    """What it takes to draw one class of units given all others: its couplings and biases, as they are now.

    Attributes:
        units: Their indices, ``(n_class,)``.
        neighbours: Indices of the units coupled to any of them, ``(n_neighbours,)``.
        couplings: To the neighbours, ``(*replicas, n_class, n_neighbours)``; where these are most units, to all of
            them, ``(*replicas, n_class, n_units)``. Zero where a pair is not coupled.
        bias: ``(*replicas, n_class)``.
        kind: What the units are.
    """

    units: Tensor
    neighbours: Tensor
    couplings: Tensor
    bias: Tensor
    kind: Units

    @property
    def to_all(self) -> bool:
        """Whether ``couplings`` has a column for each unit of the model."""
        return self.couplings.shape[-1] > self.neighbours.shape[0]

    @property
    def weight(self) -> Tensor:
        """The couplings to the neighbours, ``(*replicas, n_class, n_neighbours)``."""
        return self.couplings[..., self.neighbours] if self.to_all else self.couplings

    def field(self, x: Float[Tensor, "*replicas n n_units"]) -> Float[Tensor, "*replicas n n_class"]:
        """Field of each unit given all others: the log odds of units in {0, 1}."""
        # To gather values of most units would take longer than to multiply them.
        return affine(x if self.to_all else x.index_select(-1, self.neighbours), self.couplings, self.bias)

    def draw(self, x: Tensor, beta: float | Tensor, base: Tensor | None, *, generator: Generator) -> None:
        """Draw the units in ``x``, given all others, with the fields of :func:`annealed`."""
        own = None if base is None else base[..., self.units]
        x[..., self.units] = self.kind.sample(annealed(self.field(x), beta, own), generator=generator)


def annealed(
    field: Float[Tensor, "*replicas n n_some"],
    beta: float | Tensor,
    base: Float[Tensor, "*replicas n_some"] | None,
) -> Float[Tensor, "*replicas n n_some"]:
    """Return ``beta * field + (1 - beta) * base``, the fields between those of independent units and of a model.

    The inverse temperature ``beta`` is a number or ``(..., n, 1)``; no base is one of zeros.
    """
    field = scaled(field, beta)
    return field if base is None else field + (1 - beta) * base.unsqueeze(-2)


class QuadraticForm(NamedTuple):
    """The energy as ``E(x) = -sum over pairs of coupling x_i x_j - bias . x`` with x = (v, h).

    Attributes:
        pairs: Coupled units, ``(n_pairs, 2)``; None if each hidden unit is coupled to each visible one.
        coupling: ``(*replicas, n_pairs)``; ``(*replicas, n_hidden, n_visible)`` where ``pairs`` is None.
        bias: ``(*replicas, n_visible + n_hidden)``.
    """

    pairs: Tensor | None
    coupling: Tensor
    bias: Tensor


class TwoLayers(NamedTuple):
    """A model of two classes of units seen as an RBM, so that what is made for RBMs works for it.

    Attributes:
        rbm: It has the model's energies, with the first class as its visible units.
        units: For each unit of the RBM its number in the model; None if the order is the same.
    """

    rbm: "RBM"
    units: Tensor | None

    def first(self, x: Tensor) -> Tensor:
        """Take from ``x``, ``(..., n_units)``, the entries of the units of the first class."""
        units = slice(self.rbm.n_visible) if self.units is None else self.units[: self.rbm.n_visible]
        return x[..., units]


class Chains(Protocol):
    """Gibbs chains of one model at its present parameters.

    A chain's state is ``x``, ``(*replicas, n, n_units)``. In an RBM it holds the visible units alone, because a
    sweep draws the hidden ones anew from them; in other models it holds all units.
    """

    free_readout: bool
    """Whether either layer can be read as means or as samples."""

    def random(self, n: int, *, generator: Generator) -> Tensor:
        """Draw n states a replica as at infinite temperature: bits and states of a site with equal probability."""

    def sweep(self, x: Tensor, *, beta: float | Tensor = 1.0, generator: Generator) -> Tensor:
        """Draw every unit once given the others, at inverse temperature ``beta``, a number or ``(..., n, 1)``.

        It multiplies the fields; real units keep their measure.
        """

    def swept_with_energy(self, x: Tensor, *, beta: float | Tensor, generator: Generator) -> tuple[Tensor, Tensor]:
        """Sweep, and return the ``tempered_energy`` of the new joint state as well, ``(*replicas, n)``."""

    def read(self, x: Tensor) -> Configurations:
        """Return the states, one class (in an RBM the hidden units) replaced by its means given the others."""

    def from_data(
        self, positive: Configurations, k: int, *, visible: Readout, hidden: Readout, generator: Generator
    ) -> Configurations:
        """Sweep k times from the positive phase, and read the layers as means or samples, with its weights.

        Other readouts than ``visible="sample"``, ``hidden="mean"`` need ``free_readout``.
        """


class EnergyModel(Protocol):
    """What a model must offer to be trained and measured: units of some kind, their energies, means and chains.

    The energy is linear in each unit but for the measures of real ones. Where these are constant, it is the
    expected one at means of independent units.
    """

    b: nn.Parameter
    """Visible bias, ``(*replicas, n_visible)``; gives dtype and device."""

    @property
    def replicas(self) -> tuple[int, ...]:
        """Leading axes of independent models."""

    @property
    def n_visible(self) -> int:
        """Number of visible units, which are numbered first."""

    @property
    def n_hidden(self) -> int:
        """Number of hidden units."""

    @property
    def n_units(self) -> int:
        """Number of all units."""

    @property
    def visible(self) -> Units:
        """The kind of the visible units."""

    @property
    def hidden(self) -> Units:
        """The kind of the hidden units."""

    @property
    def n_enumerated(self) -> float:
        """Number of bits that exact computations enumerate: those of all units outside the largest class."""

    def double(self) -> Self:
        """The model itself, with its numbers in float64 from now on."""

    def parameters(self) -> Iterator[nn.Parameter]:
        """Couplings, biases, and what the units have of their own."""

    def named_parameters(self) -> Iterator[tuple[str, nn.Parameter]]:
        """The same with their names."""

    def energy(self, v: Tensor, h: Tensor) -> Tensor:
        """E(v, h) of each configuration, ``(*replicas, n)``."""

    def tempered_energy(self, v: Tensor, h: Tensor) -> Tensor:
        """E(v, h) without the measures of the units: what an inverse temperature multiplies."""

    def project(self) -> None:
        """Bring the units' own parameters back to where they are allowed, after a step of an optimiser."""

    def total_energy(self, v: Tensor, h: Tensor, weight: Tensor) -> Tensor:
        """Sum of ``weight * E(v, h)`` over configurations, ``(*replicas,)``; weights of any sign."""

    def centred_total_energy(
        self, v: Tensor, h: Tensor, weight: Tensor, visible_offset: Tensor, hidden_offset: Tensor
    ) -> Tensor:
        """The same sum; its gradient is that of the centred parametrisation, in the model's own parameters."""

    def free_energy(self, v: Tensor) -> Tensor:
        """F(v), ``(*replicas, n)``; an upper bound where hidden units are coupled to each other."""

    def hidden_mean(self, v: Tensor) -> Tensor:
        """E[h | v], in the mean field where hidden units are coupled to each other."""

    @property
    def classes(self) -> Sequence[Tensor]:
        """Indices of the units of each class."""

    def blocks(self) -> Sequence[Block]:
        """The classes of units, each with its couplings."""

    def outside_largest_class(self) -> tuple[Block, Tensor, Units]:
        """The class that exact computations sum in closed form, all other units, and what these are."""

    def chains(self) -> Chains:
        """Gibbs chains at the present parameters."""

    def all_configurations(self) -> Configurations:
        """All states outside the largest class with their probabilities as weights; that class by its means."""

    def quadratic_form(self) -> QuadraticForm:
        """Couplings and biases as they stand in the energy."""

    def in_bits(self) -> "BitForm":
        """The energy in bits, for solvers of QUBOs."""

    def two_layers(self) -> TwoLayers | None:
        """The RBM with the same energies; None where the units do not fall into two classes."""


def as_two_layers(model: EnergyModel) -> TwoLayers:
    """The RBM with the energies of a model.

    Raises:
        SettingError: The units do not fall into two classes.
    """
    layers = model.two_layers()
    allowed = "2, with couplings only between them, as in an RBM, a DBM or a grid"
    remedy = "For other machines use Ais or log_partition_function."
    require(layers is not None, "number of classes of units", len(model.classes), allowed, remedy)
    assert layers is not None
    return layers
