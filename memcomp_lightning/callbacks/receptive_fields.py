"""What each hidden unit sees."""

from collections.abc import Sequence
from typing import cast

import lightning.pytorch as pl
from torch import Tensor

from memcomp_lightning.callbacks.base import model_of
from memcomp_lightning.callbacks.pictures import Pictures
from memcomp_lightning.models import RBM


class ReceptiveFields(Pictures):
    """Draws each hidden unit's weights, projected through the layers below it onto the inputs.

    In the lowest layer these are the rows of W; above it, products of the weight matrices.

    Args:
        every: Passes between two pictures, >= 1.
        n_units: Most units to draw, >= 1.
    """

    def __init__(self, every: int = 10, n_units: int = 64) -> None:
        super().__init__("receptive_fields", every, n_units)

    def tiles(self, pl_module: pl.LightningModule, outputs: object) -> Tensor:
        """Weights of the layer in training times those below."""
        fields: Tensor = cast(RBM, model_of(pl_module)).weight
        models: Sequence[RBM] = getattr(pl_module, "models", ())
        for below in reversed(models[: getattr(pl_module, "layer", 0)]):
            fields = fields @ below.weight
        return fields
