"""What the programs of this folder share: two clocks, and images whose content does not matter."""

import time
from typing import NamedTuple

import torch

from memcomp_lightning import rng
from memcomp_lightning.data import ImageData, PixelLayout

N_VISIBLE = 784


class Seconds(NamedTuple):
    """Of a piece of work; the second ones are the processor's, which other work on the machine changes less."""

    wall: float
    cpu: float

    @staticmethod
    def now() -> "Seconds":
        return Seconds(time.perf_counter(), time.process_time())

    def since(self, begin: "Seconds") -> "Seconds":
        return Seconds(self.wall - begin.wall, self.cpu - begin.cpu)


def random_images(n: int, n_held_out: int = 1) -> ImageData:
    """Random binary images, the first ones as test images, too."""
    v = rng.bernoulli(torch.full((n, N_VISIBLE), 0.5), generator=rng.stream(0, "images"))
    label = torch.zeros(n, dtype=torch.int64)
    held_out = v[:n_held_out], label[:n_held_out]
    return ImageData(v, label, *held_out, n_classes=1, layout=PixelLayout(28, 28), name="random")
