"""What the callbacks share that hold samples of the model against the data."""

from abc import abstractmethod

import lightning.pytorch as pl
import torch
from matplotlib.figure import Figure
from torch import Tensor

from memcomp_lightning import rng
from memcomp_lightning.callbacks.base import (
    EveryIterations,
    LastImages,
    images_of_step,
    mask_of_step,
    model_of,
    tensorboards,
    write_picture,
)
from memcomp_lightning.data.schema import Schema
from memcomp_lightning.data.sequences import SequenceSchema
from memcomp_lightning.errors import require_count
from memcomp_lightning.models import EnergyModel
from memcomp_lightning.models.units import Categorical, Mixed, Units
from memcomp_lightning.plotting.rendering import rendered


def fresh_chains(model: EnergyModel, n: int, n_sweeps: int, seed: int) -> Tensor:
    """Gibbs chains from random states, with a random stream of their own: the same starts each time."""
    generator = rng.stream(seed, "evaluation")
    chains = model.chains()
    x = chains.random(n, generator=generator)
    for _ in range(n_sweeps):
        x = chains.sweep(x, generator=generator)
    return x


class AgainstSamples(EveryIterations):
    """A figure of data and samples of the first replica, in TensorBoard; none where the units are of other kinds.

    Data are the images of the pass's last batches, samples are visible states of Gibbs chains that start afresh.

    Args:
        tag: Name of the picture, after stage and layer.
        every: Passes between two pictures, >= 1.
        n_images: Images to take, >= 1; whole batches are taken.
        n_samples: Chains, >= 1.
        n_sweeps: Gibbs sweeps of each chain, >= 1.
        seed: Seed of the chains.
    """

    def __init__(self, tag: str, every: int, n_images: int, n_samples: int, n_sweeps: int, seed: int) -> None:
        super().__init__(every)
        require_count("n_samples", n_samples)
        require_count("n_sweeps", n_sweeps)
        self.tag = tag
        self.n_samples = n_samples
        self.n_sweeps = n_sweeps
        self.seed = seed
        self._train = LastImages(n_images)

    @abstractmethod
    def has_units(self, units: Units) -> bool:
        """Whether there is anything to draw of these visible units."""

    @abstractmethod
    def figure(
        self, units: Units, data: Tensor, observed: Tensor | None, samples: Tensor, schema: Schema | None
    ) -> Figure:
        """Draw data ``(n, n_visible)``, their mask, and samples ``(n_samples, n_visible)``.

        ``schema`` says what the units stand for; None where that is not known.
        """

    def on_train_epoch_start(self, *_: object) -> None:
        """Forget the last pass."""
        self._train = LastImages(self._train.n)

    def on_train_batch_end(
        self, trainer: pl.Trainer, pl_module: pl.LightningModule, outputs: object, *_: object
    ) -> None:
        """Keep the visible states of the last batches."""
        super().on_train_batch_end(trainer, pl_module, outputs)
        if self.is_due(trainer, pl_module) and self.has_units(model_of(pl_module).visible):
            self._train.add(images_of_step(outputs, self), mask_of_step(outputs))

    def look(self, trainer: pl.Trainer, pl_module: pl.LightningModule, outputs: object) -> None:
        """Run the chains, and draw."""
        model, data, observed = model_of(pl_module), self._train.images(), self._train.observed()
        if data is None or not tensorboards(trainer) or not self.has_units(model.visible):
            return
        samples = fresh_chains(model, self.n_samples, self.n_sweeps, self.seed)[..., : model.n_visible]
        mask = None if observed is None else _first(observed)
        schema = schema_of_model(trainer, pl_module)
        figure = self.figure(model.visible, _first(data), mask, _first(samples), schema)
        write_picture(trainer, pl_module, self.tag, rendered(figure))


def schema_of_model(trainer: pl.Trainer, module: pl.LightningModule) -> Schema | None:
    """What the visible units of the model in training stand for; None for those of an upper layer."""
    schema: Schema | None = getattr(getattr(trainer, "datamodule", None), "schema", None)
    return None if getattr(module, "layer", 0) else schema


def letters_in(schema: Schema | None) -> str | None:
    """The letters of the states, where the data have letters."""
    return schema.letters if isinstance(schema, SequenceSchema) else None


def kinds_in(units: Units) -> list[tuple[Units, slice]]:
    """The kinds that stand side by side in a layer, each with its entries."""
    found, begin = [], 0
    for kind in units.kinds if isinstance(units, Mixed) else [units]:
        found.append((kind, slice(begin, begin + kind.n)))
        begin += kind.n
    return found


def has_categories(units: Units) -> bool:
    """Whether some of the units are categories."""
    return any(isinstance(kind, Categorical) for kind, _ in kinds_in(units))


def by_site(units: Units, x: Tensor) -> Tensor:
    """What categories have, ``(..., n)``, as ``(..., n_sites, q)``; NaN where a site has fewer states."""
    parts = []
    for kind, at in kinds_in(units):
        if isinstance(kind, Categorical):
            parts += x[..., at].split(list(kind.sizes), dim=-1)
    widest = max(part.shape[-1] for part in parts)
    pad = torch.nn.functional.pad
    wide = [pad(part.float(), (0, widest - part.shape[-1]), value=torch.nan) for part in parts]
    return torch.stack(wide, dim=-2)


def frequencies(units: Units, v: Tensor, observed: Tensor | None = None) -> Tensor:
    """Shares of the states at each site of the categories, ``(n_sites, q)``, of the observed values."""
    if observed is None:
        return by_site(units, v.float().mean(-2))
    known = torch.where(observed, v, 0.0).sum(-2) / observed.sum(-2).clamp(min=1)
    return by_site(units, known)


def _first(x: Tensor) -> Tensor:
    """That of the first replica, on the CPU."""
    return x.reshape(-1, *x.shape[-2:])[0].detach().cpu()
