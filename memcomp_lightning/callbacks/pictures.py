"""Receptive fields, samples and chains as pictures in TensorBoard."""

from abc import abstractmethod
from collections.abc import Mapping
from typing import Any, Protocol

import lightning.pytorch as pl
from torch import Tensor

from memcomp_lightning import rng
from memcomp_lightning.callbacks.base import EveryIterations, model_of, prefix_of, required, tensorboards
from memcomp_lightning.errors import require_count
from memcomp_lightning.plotting.grid import picture_grid


class Layout(Protocol):
    """Where visible units lie in a picture; the data module's ``pixel_layout``."""

    def to_picture(self, v: Tensor) -> Tensor:
        """Picture ``(*leading, height, width)`` of visible states ``(*leading, n_visible)``."""
        ...


class Pictures(EveryIterations):
    """Writes one picture grid of the first replica every so many passes.

    The data module's ``pixel_layout`` says where each input lies; without one nothing is drawn.

    Args:
        tag: Name of the picture, after stage and layer.
        every: Passes between two pictures, >= 1.
        n_pictures: Most tiles in the grid, >= 1.
    """

    def __init__(self, tag: str, every: int, n_pictures: int) -> None:
        super().__init__(every)
        require_count("n_pictures", n_pictures)
        self.tag = tag
        self.n_pictures = n_pictures

    @abstractmethod
    def tiles(self, pl_module: pl.LightningModule, outputs: Mapping[str, Any]) -> Tensor:
        """Inputs to draw, ``(*replicas, n, n_visible)``, given the outputs of the pass's last step."""

    def look(self, trainer: pl.Trainer, pl_module: pl.LightningModule, outputs: Mapping[str, Any]) -> None:
        """Draw the grid."""
        boards = tensorboards(trainer)
        layout: Layout | None = getattr(getattr(trainer, "datamodule", None), "pixel_layout", None)
        if not boards or layout is None:
            return
        tiles = self.tiles(pl_module, outputs)
        if not tiles.numel():  # receptive fields of no hidden units
            return
        first_replica = tiles.reshape(-1, *tiles.shape[-2:])[0, : self.n_pictures]
        grid = picture_grid(layout.to_picture(first_replica).float().cpu().numpy())
        for board in boards:
            tag = f"{prefix_of(pl_module)}/{self.tag}"
            board.add_image(tag, grid, trainer.global_step, dataformats="HW")


class ReceptiveFields(Pictures):
    """Draws each hidden unit's weights, projected through the layers below it onto the inputs.

    In the lowest layer these are the rows of W; above it, products of the weight matrices.

    Args:
        every: Passes between two pictures, >= 1.
        n_units: Most units to draw, >= 1.
    """

    def __init__(self, every: int = 10, n_units: int = 64) -> None:
        super().__init__("receptive_fields", every, n_units)

    def tiles(self, pl_module: pl.LightningModule, outputs: Mapping[str, Any]) -> Tensor:
        """Weights of the layer in training times those below."""
        fields: Tensor = model_of(pl_module).weight
        models: Any = getattr(pl_module, "models", ())
        layer: Any = getattr(pl_module, "layer", 0)
        for below in reversed(models[:layer]):
            fields = fields @ below.weight
        return fields


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

    def tiles(self, pl_module: pl.LightningModule, outputs: Mapping[str, Any]) -> Tensor:
        """Run the chains and project them down to the inputs."""
        model = model_of(pl_module)
        generator = rng.stream(self.seed, "evaluation")
        chains = model.chains()
        x = chains.random(self.n_pictures, generator=generator)
        for _ in range(self.n_sweeps):
            x = chains.sweep(x, generator=generator)
        states = chains.read(x)
        return _images(pl_module, model.visible_mean(states.h) if model.n_hidden else states.v)


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

    def tiles(self, pl_module: pl.LightningModule, outputs: Mapping[str, Any]) -> Tensor:
        """The last update's configurations."""
        negative = required(outputs, "negative", self)
        v: Tensor = negative.v
        if negative.weight is not None:
            n_drawn = min(self.n_pictures, v.shape[-2])
            v = v.take_along_dim(negative.weight.topk(n_drawn, dim=-1).indices.unsqueeze(-1), dim=-2)
        return _images(pl_module, v)


def _images(module: pl.LightningModule, v: Tensor) -> Tensor:
    """Inputs that visible states stand for."""
    images_of = getattr(module, "images_of", None)
    images: Tensor = v if images_of is None else images_of(v)
    return images
