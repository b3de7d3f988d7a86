"""Grey values as inputs, or bits made of them."""

from abc import ABC, abstractmethod
from dataclasses import dataclass, replace
from typing import Literal

from torch import Tensor

from memcomp_lightning import rng
from memcomp_lightning.data.images import ImageData
from memcomp_lightning.errors import require, require_choice, require_count

Pixels = Literal["grey", "threshold", "stochastic"]


@dataclass(frozen=True, kw_only=True, slots=True)
class GreySource(ABC):
    """Base of the sources of grey images: settles whether the inputs are grey values or bits.

    Args:
        pixels: ``grey``: intensities in [0, 1]. ``threshold``: 1 where the intensity is above ``threshold``,
            else 0. ``stochastic``: 1 with the intensity as probability, drawn once.
        threshold: Used by ``threshold`` alone, in [0, 1).
        seed: Of the draw, used by ``stochastic`` alone. It belongs to the data: keep it when the seed of the
            training varies.
    """

    pixels: Pixels = "grey"
    threshold: float = 0.5
    seed: int = 0

    def __post_init__(self) -> None:
        require_choice("pixels", self.pixels, ("grey", "threshold", "stochastic"))
        require(0 <= self.threshold < 1, "threshold", self.threshold, "a number in [0, 1)")
        require_count("seed", self.seed, minimum=0)

    @abstractmethod
    def load_grey(self) -> ImageData:
        """Return the images in grey."""

    def load(self) -> ImageData:
        """Return the images, in grey or as bits."""
        images = self.load_grey()
        if self.pixels == "grey":
            return images
        generator = rng.stream(self.seed, "binarisation")

        def bits(v: Tensor) -> Tensor:
            if self.pixels == "threshold":
                return (v > self.threshold).float()
            return rng.bernoulli(v, generator=generator)

        train_v, test_v = bits(images.train_v), bits(images.test_v)
        return replace(images, train_v=train_v, test_v=test_v, name=f"{images.name}_{self.pixels}")
