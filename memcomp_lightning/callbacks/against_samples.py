"""What the callbacks share that hold samples of the model against the data."""

import copy
from abc import abstractmethod
from typing import NamedTuple

import lightning.pytorch as pl
import torch
from matplotlib.figure import Figure
from torch import Tensor

from memcomp_lightning import rng
from memcomp_lightning.callbacks.base import (
    EveryIterations,
    LastImages,
    ShownModel,
    images_of_step,
    mask_of_step,
    model_of,
    tensorboards,
    weight_of_step,
    write_picture,
)
from memcomp_lightning.data.schema import Schema
from memcomp_lightning.data.sequences import SequenceSchema
from memcomp_lightning.data.shown import Shown
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


class Seen(NamedTuple):
    """What a picture is drawn of; the rows are those of the first replica, on the CPU.

    Attributes:
        model: In training.
        data: Training images.
        samples: Of the model.
        heldout: Images of the validation; None without one.
    """

    model: ShownModel
    data: Shown
    samples: Shown
    heldout: Shown | None


class AgainstSamples(EveryIterations):
    """Figures of data and samples of the first replica, in TensorBoard; none where the units are of other kinds.

    Data are the images of the pass's last batches, samples are visible states of Gibbs chains that start afresh.

    Args:
        every: Passes between two pictures, >= 1.
        n_images: Images to take, >= 1; whole batches are taken.
        n_samples: Chains, >= 1.
        n_sweeps: Gibbs sweeps of each chain, >= 1.
        seed: Seed of the chains.
    """

    def __init__(self, every: int, n_images: int, n_samples: int, n_sweeps: int, seed: int) -> None:
        super().__init__(every)
        require_count("n_samples", n_samples)
        require_count("n_sweeps", n_sweeps)
        self.n_samples = n_samples
        self.n_sweeps = n_sweeps
        self.seed = seed
        self._train, self._heldout = LastImages(n_images), LastImages(n_images)

    def has_units(self, units: Units) -> bool:
        """Whether there is anything to draw of these visible units: of all, unless a subclass says otherwise."""
        return True

    @abstractmethod
    def figures(self, seen: Seen) -> dict[str, Figure]:
        """Draw data and samples: figures by their tags."""

    def on_train_epoch_start(self, *_: object) -> None:
        """Forget the last pass."""
        self._train = LastImages(self._train.n)

    def on_train_batch_end(
        self, trainer: pl.Trainer, pl_module: pl.LightningModule, outputs: object, *_: object
    ) -> None:
        """Keep the visible states of the last batches."""
        super().on_train_batch_end(trainer, pl_module, outputs)
        if self._looks(trainer, pl_module):
            self._train.add(images_of_step(outputs, self), mask_of_step(outputs), weight_of_step(outputs))

    def on_validation_epoch_start(self, *_: object) -> None:
        """Forget the last validation."""
        self._heldout = LastImages(self._heldout.n)

    def on_validation_batch_end(
        self, trainer: pl.Trainer, pl_module: pl.LightningModule, outputs: object, *_: object
    ) -> None:
        """Keep the visible states of the last held-out images, the same in each pass."""
        if isinstance(outputs, dict) and "v" in outputs and self._looks(trainer, pl_module):
            self._heldout.add(outputs["v"], mask_of_step(outputs), weight_of_step(outputs))

    def look(self, trainer: pl.Trainer, pl_module: pl.LightningModule, outputs: object) -> None:
        """Run the chains, and draw."""
        model, schema = model_of(pl_module), schema_of_model(trainer, pl_module)
        if not tensorboards(trainer) or not self.has_units(model.visible):
            return
        units = copy.deepcopy(model.visible).cpu()
        if schema is not None and schema.n_sites != units.n_sites:
            schema = None  # somebody else's module sees something else of the data
        data, heldout = (_shown(images, units, schema) for images in (self._train, self._heldout))
        if data is None:
            return
        v = _first(fresh_chains(model, self.n_samples, self.n_sweeps, self.seed)[..., : model.n_visible])
        if not bool(v.isfinite().all()):
            self.leave_out("the chains ran away to infinity")
            return
        seen = Seen(model, data, Shown(units, v, schema=schema), heldout)
        for tag, figure in self.figures(seen).items():
            write_picture(trainer, pl_module, tag, rendered(figure))

    def _looks(self, trainer: pl.Trainer, module: pl.LightningModule) -> bool:
        """Whether the present pass ends with a picture."""
        return self.is_due(trainer, module) and self.has_units(model_of(module).visible)


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


def frequencies(units: Units, v: Tensor, observed: Tensor | None = None, weight: Tensor | None = None) -> Tensor:
    """Shares of the states at each site of the categories, ``(n_sites, q)``, of the observed values."""
    w = torch.ones_like(v[:, :1]) if weight is None else weight.to(v.dtype).unsqueeze(-1)
    known = torch.ones_like(v) if observed is None else observed.to(v.dtype)
    total = (w * known).sum(-2)
    smallest = torch.finfo(v.dtype).tiny
    return by_site(units, (w * known * v).sum(-2) / total.clamp(min=smallest))


def _shown(images: LastImages, units: Units, schema: Schema | None) -> Shown | None:
    """The rows of the first replica; None without any."""
    v, observed, weight = images.images(), images.observed(), images.weight()
    if v is None:
        return None
    mask = None if observed is None else _first(observed)
    counts = None if weight is None else weight.reshape(-1, weight.shape[-1])[0].detach().cpu()
    return Shown(units, _first(v), mask, counts, schema)


def _first(x: Tensor) -> Tensor:
    """That of the first replica, on the CPU."""
    return x.reshape(-1, *x.shape[-2:])[0].detach().cpu()
