"""MNIST in the size of the paper."""

from dataclasses import dataclass
from typing import ClassVar

from jaxtyping import Float
from torch import Tensor

from memcomp_lightning.data.images import PixelLayout
from memcomp_lightning.data.reduce import SIX_BY_SIX_WITHOUT_CORNERS, reduce_images
from memcomp_lightning.data.sources.mnist import Mnist


@dataclass(frozen=True, kw_only=True, slots=True)
class ReducedMnist(Mnist):
    """MNIST reduced to the paper's 32 inputs in [0, 1], see :func:`reduce_images`.

    Args:
        data_dir, download: As for :class:`Mnist`.
        pixels, threshold, seed: As for :class:`GreySource`, of the reduced images.
    """

    name: ClassVar[str] = "reduced_mnist"
    layout: ClassVar[PixelLayout] = SIX_BY_SIX_WITHOUT_CORNERS

    @staticmethod
    def inputs(images: Float[Tensor, "n 28 28"]) -> Float[Tensor, "n 32"]:
        """The paper's 32 inputs."""
        return reduce_images(images)
