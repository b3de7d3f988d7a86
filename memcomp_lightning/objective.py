"""The loss that trains an energy model; it is the same for every sampler of the negative phase."""

from dataclasses import dataclass
from typing import NamedTuple, Protocol, cast

import torch
from jaxtyping import Float
from torch import Tensor

from memcomp_lightning.errors import require
from memcomp_lightning.types import Configurations, Weighted


class Offsets(NamedTuple):
    """What the centred gradient subtracts from the units: their running means.

    Attributes:
        visible: ``(*replicas, n_visible)``.
        hidden: ``(*replicas, n_hidden)``.
    """

    visible: Tensor
    hidden: Tensor


@dataclass(frozen=True, kw_only=True, slots=True)
class Centring:
    """Settings of the centred gradient, which subtracts the means of the units and is better conditioned.

    The means are those of the positive phase, as a sliding average over the updates. If the images of an update
    come in chunks, the average takes the first chunk alone. Montavon & Mueller 2012; Melchior, Fischer & Wiskott
    2016 ("dd", with the sliding average that they recommend).

    Attributes:
        rate: Weight of the newest update in the offsets, in (0, 1].
    """

    rate: float = 0.01

    def __post_init__(self) -> None:
        require(0 < self.rate <= 1, "centring rate", self.rate, "a number in (0, 1]")

    def follow(self, offsets: Offsets | None, positive: Configurations) -> Offsets:
        """Return the offsets for an update; the first ones are the means of its positive phase."""
        weight = shares(positive).unsqueeze(-1)
        now = Offsets((positive.v * weight).sum(-2), (positive.h * weight).sum(-2))
        if offsets is None:
            return now
        return Offsets(*(old.lerp(new, self.rate) for old, new in zip(offsets, now, strict=True)))


class HasTotalEnergy(Protocol):
    """An energy model, as far as the objective needs it."""

    def total_energy(self, v: Tensor, h: Tensor, weight: Tensor) -> Tensor:
        """Sum of ``weight * E(v, h)`` over configurations, ``(*replicas,)``; weights of any sign."""


class HasCentredEnergy(HasTotalEnergy, Protocol):
    """An energy model that knows its centred parametrisation."""

    def centred_total_energy(
        self, v: Tensor, h: Tensor, weight: Tensor, visible_offset: Tensor, hidden_offset: Tensor
    ) -> Tensor:
        """The same sum; its gradient is that of the centred parametrisation, in the model's own parameters."""


def contrast(
    model: HasTotalEnergy,
    positive: Configurations,
    negative: Configurations,
    offsets: Offsets | None = None,
) -> Float[Tensor, "*replicas"]:
    r"""Return the loss of each replica, ``mean E(positive) - mean E(negative)``, with weighted means.

    With the hidden means given the data as the positive phase and the exact expectation as the negative
    one, its gradient is the gradient of the mean negative log-likelihood (eqs. 4 to 6 of Manukian et al.
    2019, with the sign of a loss). Both phases are constants to autograd. Sum it over the replicas before
    the backward pass: they stay independent.

    With ``offsets`` the value is the same and the gradient is that of a model whose units are centred,
    :math:`E = -(h - \lambda)^T W (v - \mu) - b'^T v - c'^T h`: it does not change when units swap 0 and 1, and is
    better conditioned. In the parameters of the plain energy, for offsets :math:`\mu, \lambda` that
    stand still, its step is that of :math:`\nabla W`, :math:`\nabla b' - \nabla W^T \lambda` and
    :math:`\nabla c' - \nabla W \mu`, where :math:`\nabla W` is made of :math:`(h - \lambda)(v - \mu)^T`.

    Args:
        model: The energy model; with ``offsets`` it offers ``centred_total_energy`` as well.
        positive: Configurations with the data clamped.
        negative: Configurations that stand for the model's own distribution.
        offsets: From :meth:`Centring.follow`; None leaves the units as they are.
    """
    weight = torch.cat((shares(positive), -shares(negative)), dim=-1)
    v = torch.cat((positive.v, negative.v), dim=-2)
    h = torch.cat((positive.h, negative.h), dim=-2)
    if offsets is None:
        return model.total_energy(v, h, weight)
    return cast(HasCentredEnergy, model).centred_total_energy(v, h, weight, *offsets)


def add_gradient(
    model: HasTotalEnergy,
    positive: Configurations,
    negative: Configurations,
    offsets: Offsets | None = None,
    *,
    share: float = 1.0,
    valued: bool = True,
) -> Float[Tensor, "*replicas"] | None:
    """Add to the gradients of the parameters those of ``share`` times :func:`contrast`; return the contrast.

    A model that has its gradient in closed form, by a method of this name as the package's own, makes no graph.
    With ``valued=False`` nobody looks at the contrast, and None may be returned.
    """
    own = getattr(model, "add_gradient", None)
    if own is None:
        gap = contrast(model, positive, negative, offsets)
        (share * gap.sum()).backward()
        return gap.detach()
    parts = [
        Weighted(positive.v, positive.h, share * shares(positive)),
        Weighted(negative.v, negative.h, -share * shares(negative)),
    ]
    gap = own(parts, offsets, valued=valued)
    return None if gap is None else gap / share


def shares(configurations: Configurations) -> Tensor:
    """Weights that add up to one, ``(*replicas, n)``."""
    v, _, weight = configurations
    if weight is None:
        return torch.full(v.shape[:-1], 1.0 / v.shape[-2], dtype=v.dtype, device=v.device)
    return weight / weight.sum(-1, keepdim=True)


def weighted(positive: Configurations, weight: Tensor | None) -> Configurations:
    """Let each image of a positive phase count so often.

    Args:
        positive: One or more configurations an image, those of one image side by side and of the same total
            weight.
        weight: Of the images, ``(*replicas, n_images)``; None changes nothing.
    """
    if weight is None:
        return positive
    of_rows = weight.repeat_interleave(positive.v.shape[-2] // weight.shape[-1], dim=-1)
    return positive._replace(weight=of_rows if positive.weight is None else positive.weight * of_rows)
