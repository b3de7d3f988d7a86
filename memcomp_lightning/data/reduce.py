"""MNIST at the size of the paper: 32 inputs."""

from jaxtyping import Float
from torch import Tensor

from memcomp_lightning.data.images import PixelLayout
from memcomp_lightning.errors import require

SIX_BY_SIX_WITHOUT_CORNERS = PixelLayout(
    height=6, width=6, pixels=tuple(pixel for pixel in range(36) if pixel not in (0, 5, 30, 35))
)
"""The 32 inputs of the paper: a 6x6 picture less its four corners. Reduced MNIST and digits share it."""


def reduce_images(images: Tensor) -> Float[Tensor, "n 32"]:
    """Strip 2 pixels on each side, take the mean of 4x4 blocks, drop the four corners of the 6x6 picture.

    Source: Adachi and Henderson 2015 (arXiv 1510.06356), followed by Manukian et al. 2019.

    Args:
        images: Intensities in [0, 1], ``(n, 28, 28)``.

    Returns:
        ``(n, 32)``, in the order of :data:`SIX_BY_SIX_WITHOUT_CORNERS`.

    >>> import torch
    >>> reduce_images(torch.ones(2, 28, 28)).shape
    torch.Size([2, 32])
    """
    matches = images.ndim == 3 and images.shape[1:] == (28, 28)
    require(matches, "images.shape", tuple(images.shape), "(n, 28, 28)")
    blocks = images[:, 2:-2, 2:-2].reshape(len(images), 6, 4, 6, 4)
    return without_corners(blocks.mean(dim=(2, 4)))


def without_corners(images: Float[Tensor, "n 6 6"]) -> Float[Tensor, "n 32"]:
    """Return the units of :data:`SIX_BY_SIX_WITHOUT_CORNERS` of 6x6 pictures."""
    return images.flatten(1)[:, list(SIX_BY_SIX_WITHOUT_CORNERS.pixels or ())]
