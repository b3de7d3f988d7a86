"""The chains that training follows."""

import lightning.pytorch as pl
from torch import Tensor

from memcomp_lightning.callbacks.base import required
from memcomp_lightning.callbacks.pictures import Pictures, inputs_of


class ChainPictures(Pictures):
    """Draws the negative phase that training followed: its configurations' visible units, projected to the inputs.

    Beside :class:`ModelSamples`, whose chains start afresh, it shows where the sampler is: near the data (CD), in
    one mode, or all over the model. Weighted configurations come in the order of their weights.

    Args:
        every: Passes between two pictures, >= 1.
        n_chains: Most configurations to draw, >= 1.
    """

    def __init__(self, every: int = 10, n_chains: int = 64) -> None:
        super().__init__("chains", every, n_chains)

    def tiles(self, pl_module: pl.LightningModule, outputs: object) -> Tensor:
        """The last update's configurations."""
        negative = required(outputs, self, "negative")["negative"]
        v = negative.v
        if negative.weight is not None:
            n_drawn = min(self.n_pictures, v.shape[-2])
            v = v.take_along_dim(negative.weight.topk(n_drawn, dim=-1).indices.unsqueeze(-1), dim=-2)
        return inputs_of(pl_module, v)
