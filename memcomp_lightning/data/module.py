"""The images of one experiment, dealt into replicas and held-out parts, as Lightning wants them."""

from typing import Any, NamedTuple

import torch
from lightning.pytorch import LightningDataModule
from torch import Tensor

from memcomp_lightning import defaults, rng
from memcomp_lightning.data.images import ImageData, PixelLayout
from memcomp_lightning.data.loading import Batches
from memcomp_lightning.errors import require, require_count
from memcomp_lightning.models.units import Bernoulli, Units


class _Kept(NamedTuple):
    """Some of the images, as the units keep them: ``(*replicas, n, n_sites)``."""

    v: Tensor
    label: Tensor
    observed: Tensor | None

    def at(self, index: Tensor) -> "_Kept":
        return _Kept(self.v[index], self.label[index], None if self.observed is None else self.observed[index])


class ImageDataModule(LightningDataModule):
    """Training, validation and test batches of one :class:`ImageData`.

    With ``partitions > 1`` the training set is dealt into that many disjoint parts of
    ``floor(n / partitions)`` images, and the parts become the replica axis: each replica of the model learns
    from its own part, and all of them are tested on the same images. Up to ``partitions - 1`` images are
    left over. How the set is dealt depends on ``partition_seed`` alone, so the parts stay the same when the
    seed of the training varies.

    Held-out and test images come unshuffled, all of them in each process, as one step in chunks: the sum of
    ``share * mean over the chunk`` is the mean over the set.

    Batches hold values of the visible units: the kind of these says which ones stand for the grey values.

    Attributes:
        replicas: Leading axes of the batches: ``()``, or the number of parts in use, ``(n,)``.
        n_train: Training images of one replica, without those held out.
        units: The kind of the visible units: ``RBM(visible=data.units, ...)``.

    Args:
        images: The data.
        batch_size: Images of a replica in an optimiser step, over all processes; None means all of them.
        partitions: Number of parts, >= 1; 1 means the whole set and no replica axis.
        first_partitions: Use at most so many of the parts, >= 1; None means all.
        validation_fraction: Share of each part's training images that is held out for validation, in
            [0, 1), rounded to whole images. With 0 the *test* images are shown as validation set: look at
            them while training, but never choose a setting or a checkpoint by them.
        chunk_size: Images of a replica in one Batch at most, >= 1: bounds the memory of large steps.
        seed: Seed of the order in which training images come.
        partition_seed: Seed of the partition and of the held-out images.
        units: Kind of the visible units, with a site for each pixel; None is units in {0, 1}.
    """

    def __init__(
        self,
        images: ImageData,
        *,
        batch_size: int | None = defaults.BATCH_SIZE,
        partitions: int = 1,
        first_partitions: int | None = None,
        validation_fraction: float = 0.0,
        chunk_size: int = 10_000,
        seed: int = 0,
        partition_seed: int = 0,
        units: Units | None = None,
    ) -> None:
        super().__init__()
        self.units = Bernoulli(images.n_visible) if units is None else units
        n_sites, allowed = self.units.n_sites, f"{images.n_visible}, one for each pixel"
        require(n_sites == images.n_visible, "number of sites of the units", n_sites, allowed)
        n_part, n_held_out = _split(images, partitions, validation_fraction, partition_seed)
        n_parts = partitions
        if first_partitions is not None:
            require_count("first_partitions", first_partitions)
            n_parts = min(partitions, first_partitions)
        self.images = images
        self.replicas: tuple[int, ...] = (n_parts,) if partitions > 1 else ()
        self._batch_size, self._chunk_size, self._seed = batch_size, chunk_size, seed
        self.n_train = n_part - n_held_out
        self._train, self._test = self._kept("train"), self._kept("test")
        self._heldout = self._test
        # Without parts and without a held-out set there is nothing to deal, and no copy of the images.
        if partitions > 1 or n_held_out:
            generator = rng.stream(partition_seed, "partition")
            order = torch.randperm(len(images.train_label), generator=generator, device=generator.device)
            order = order[: n_parts * n_part].view(*self.replicas, n_part)
            everything = self._train
            self._train = everything.at(order[..., : self.n_train])
            if n_held_out:
                self._heldout = everything.at(order[..., self.n_train :])
        self.train_batches(rank=0, world_size=1)

    @property
    def train(self) -> tuple[Tensor, Tensor]:
        """Training images ``(*replicas, n, n_visible)`` and labels ``(*replicas, n)``, without those held out."""
        return self._values(self._train)

    @property
    def train_observed(self) -> Tensor | None:
        """Where the training images are known, a mask of their shape; None is everywhere."""
        return self._mask(self._train)

    @property
    def test(self) -> tuple[Tensor, Tensor]:
        """Test images ``(n, n_visible)`` and labels ``(n,)``."""
        return self._values(self._test)

    @property
    def heldout(self) -> tuple[Tensor, Tensor]:
        """The images of the validation: those held out, or the test images, which all replicas share."""
        return self._values(self._heldout)

    @property
    def heldout_observed(self) -> Tensor | None:
        """Where they are known."""
        return self._mask(self._heldout)

    @property
    def validation(self) -> tuple[Tensor, Tensor] | None:
        """Held-out training images ``(*replicas, n, n_visible)`` and labels; None if none are held out."""
        return None if self._heldout is self._test else self.heldout

    def values_of(self, intensity: Tensor) -> Tensor:
        """Values of the visible units that stand for grey values, ``(..., n_pixels)`` to ``(..., n_visible)``."""
        return self.units.encode(self.units.from_intensity(intensity), check=False)

    @property
    def n_at_once(self) -> int:
        """Training images of a replica that are computed together: of an update, or of a chunk of it."""
        return min(self.n_train, self._batch_size or self.n_train, self._chunk_size)

    @property
    def n_visible(self) -> int:
        """Number of visible units; of categories a site has one for each state."""
        return self.units.n

    @property
    def n_classes(self) -> int:
        """Number of classes."""
        return self.images.n_classes

    @property
    def pixel_layout(self) -> PixelLayout:
        """Where the visible units lie in the picture."""
        return self.images.layout

    def train_dataloader(self) -> Batches:
        """Return the shuffled training batches of this process."""
        if self.trainer is None:
            return self.train_batches(rank=0, world_size=1)
        return self.train_batches(self.trainer.global_rank, self.trainer.world_size)

    def val_dataloader(self) -> Batches:
        """Return the held-out images, or the test images if none are held out."""
        return self._evaluation_batches(self._heldout)

    def test_dataloader(self) -> Batches:
        """Return the test images, the same for every replica."""
        return self._evaluation_batches(self._test)

    def train_batches(self, rank: int, world_size: int) -> Batches:
        """Return the shuffled training batches of one of ``world_size`` processes."""
        return Batches(
            self._train.v,
            self._train.label,
            batch_size=self._batch_size,
            chunk_size=self._chunk_size,
            shuffle=True,
            seed=self._seed,
            rank=rank,
            world_size=world_size,
            observed=self._train.observed,
            units=self.units,
        )

    def _evaluation_batches(self, kept: _Kept) -> Batches:
        v, label, observed = kept
        if label.ndim == 1:
            v, label = v.expand(*self.replicas, -1, -1), label.expand(*self.replicas, -1)
            observed = None if observed is None else observed.expand(*self.replicas, -1, -1)
        settings: dict[str, Any] = {"chunk_size": self._chunk_size, "shuffle": False, "seed": self._seed}
        return Batches(v, label, None, **settings, observed=observed, units=self.units)

    def _kept(self, subset: str) -> _Kept:
        v, label, observed = (getattr(self.images, f"{subset}_{name}") for name in ("v", "label", "observed"))
        return _Kept(self.units.from_intensity(v), label, observed)

    def _values(self, kept: _Kept) -> tuple[Tensor, Tensor]:
        return self.units.encode(kept.v, check=False), kept.label

    def _mask(self, kept: _Kept) -> Tensor | None:
        return None if kept.observed is None else self.units.over_sites(kept.observed)


def _split(images: ImageData, partitions: int, validation_fraction: float, partition_seed: int) -> tuple[int, int]:
    """Images of a part, and how many of them are held out."""
    n = len(images.train_label)
    require_count("partitions", partitions)
    require(partitions <= n, "partitions", partitions, f"at most the {n} training images")
    require_count("partition_seed", partition_seed, minimum=0)
    in_range = isinstance(validation_fraction, int | float) and 0 <= validation_fraction < 1
    require(in_range, "validation_fraction", validation_fraction, "a number in [0, 1)")
    n_part = n // partitions
    n_held_out = round(validation_fraction * n_part)
    require(
        validation_fraction == 0 or 1 <= n_held_out < n_part,
        "validation_fraction",
        validation_fraction,
        f"0, or a share that holds out at least 1 and leaves at least 1 of {n_part} images; "
        f"this one holds out {n_held_out}",
        "Change validation_fraction or use fewer partitions.",
    )
    return n_part, n_held_out
