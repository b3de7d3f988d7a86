"""Samples of the model in training."""

import lightning.pytorch as pl
from torch import Tensor

from memcomp_lightning.callbacks.against_samples import fresh_chains
from memcomp_lightning.callbacks.base import model_of
from memcomp_lightning.callbacks.pictures import Pictures, inputs_of
from memcomp_lightning.errors import require_count


class ModelSamples(Pictures):
    """Draws samples that show what the model has learnt: Gibbs chains from random states, as conditional means.

    The chains have a random stream of their own, so they do not touch training.

    Args:
        every: Passes between two pictures, >= 1.
        n_samples: Chains, >= 1.
        n_sweeps: Gibbs sweeps of each chain, >= 1.
        seed: Seed of the chains; the same starts each time, so that pictures compare.
    """

    def __init__(self, every: int = 20, n_samples: int = 64, n_sweeps: int = 100, seed: int = 0) -> None:
        super().__init__("samples", every, n_samples)
        require_count("n_sweeps", n_sweeps)
        self.n_sweeps = n_sweeps
        self.seed = seed

    def tiles(self, pl_module: pl.LightningModule, outputs: object) -> Tensor:
        """Run the chains and project them down to the inputs."""
        model = model_of(pl_module)
        states = model.chains().read(fresh_chains(model, self.n_pictures, self.n_sweeps, self.seed))
        return inputs_of(pl_module, model.visible_mean(states.h) if model.n_hidden else states.v)
