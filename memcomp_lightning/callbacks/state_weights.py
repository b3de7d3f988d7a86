"""What the strongest hidden units prefer at each site of categories."""

from typing import cast

import lightning.pytorch as pl
import torch

from memcomp_lightning.callbacks.against_samples import by_site, has_categories, letters_in, schema_of_model
from memcomp_lightning.callbacks.base import EveryIterations, model_of, tensorboards, write_picture
from memcomp_lightning.errors import require_count
from memcomp_lightning.models import RBM
from memcomp_lightning.plotting.rendering import rendered
from memcomp_lightning.plotting.state_weights import plot_state_weights


class StateWeights(EveryIterations):
    """Draws weights of hidden units as heat maps of site and state: picture ``state_weights``.

    Those of the first replica with the largest norm, each site in the gauge in which its weights add up to zero.
    Of visible units that are no categories, and without hidden units, there is no picture.

    Args:
        every: Passes between two pictures, >= 1.
        n_units: Most hidden units to draw, >= 1.
        alphabet: Letters of the states; None takes those of sequences, and else digits and then capitals.
    """

    def __init__(self, every: int = 10, n_units: int = 6, alphabet: str | None = None) -> None:
        super().__init__(every)
        require_count("n_units", n_units)
        self.n_units = n_units
        self.alphabet = alphabet

    def look(self, trainer: pl.Trainer, pl_module: pl.LightningModule, outputs: object) -> None:
        """The strongest units."""
        model = model_of(pl_module)
        if not tensorboards(trainer) or not has_categories(model.visible) or not model.n_hidden:
            return
        weight = cast(RBM, model).weight.detach()
        weight = by_site(model.visible, weight.reshape(-1, *weight.shape[-2:])[0].cpu())
        weight = weight - weight.nanmean(-1, keepdim=True)
        norm = weight.square().nansum((-1, -2)).sqrt()
        strongest = torch.topk(norm, min(self.n_units, len(norm))).indices
        names = [f"h {unit}" for unit in strongest.tolist()]
        alphabet = self.alphabet or letters_in(schema_of_model(trainer, pl_module))
        figure = plot_state_weights(weight[strongest].numpy(), names, alphabet=alphabet)
        write_picture(trainer, pl_module, "state_weights", rendered(figure))
