"""The rows of one experiment, dealt into replicas and held-out parts, as Lightning wants them."""

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, ClassVar, Literal

import torch
from lightning.pytorch import LightningDataModule
from torch import Tensor

from memcomp_lightning import defaults, rng
from memcomp_lightning.data.images import ImageData, PixelLayout
from memcomp_lightning.data.labels import with_label, with_labels
from memcomp_lightning.data.loading import Batches
from memcomp_lightning.data.rows import UNLABELLED, Origin, Part, Rows, Share
from memcomp_lightning.data.schema import ImageSchema, Schema
from memcomp_lightning.errors import require, require_count
from memcomp_lightning.models.units import Bernoulli, Units
from memcomp_lightning.types import Batch

if TYPE_CHECKING:
    from memcomp_lightning.data.sequences import SequenceData
    from memcomp_lightning.data.tables import TableData


class RowsDataModule(LightningDataModule):
    """Training, validation and test batches of one data set.

    With ``partitions > 1`` the training set is dealt into that many disjoint parts of
    ``floor(n / partitions)`` rows, and the parts become the replica axis: each replica of the model learns
    from its own part, and all of them are tested on the same rows. Up to ``partitions - 1`` rows are
    left over. How the set is dealt depends on ``partition_seed`` alone, so the parts stay the same when the
    seed of the training varies.

    Held-out and test rows come unshuffled, all of them in each process, as one step in chunks: the sum of
    ``share * mean over the chunk`` is the mean over the set.

    Batches hold values of the visible units, which are made of the numbers that are kept.

    Attributes:
        replicas: Leading axes of the batches: ``()``, or the number of parts in use, ``(n,)``.
        n_train: Training rows of one replica, without those held out.
        n_labels: Labels in use, of one replica, those of held-out rows included; None where every row's is.
        units: The kind of the visible units: ``RBM(visible=data.units, ...)``.
        n_classes: Number of classes, 0 without labels.
        data_name: Of the data, for reports.
        pixel_layout: Where the visible units lie in a picture; None where they lie in none.

    Args:
        train: Training rows, without replica axes.
        test: Test rows.
        units: Kind of the visible units, with a site for each number of a row.
        n_classes: Number of classes, 0 without labels.
        name: Of the data, for reports.
        pixel_layout: Where the visible units lie in a picture.
        validation: Rows that are held out; None holds out some of the training rows, as the next argument says.
        batch_size: Rows of a replica in an optimiser step, over all processes; None means all of them.
        partitions: Number of parts, >= 1; 1 means the whole set and no replica axis.
        first_partitions: Use at most so many of the parts, >= 1; None means all.
        validation_fraction: Share of each part's training rows that is held out for validation, in
            [0, 1), rounded to whole rows. With 0 the *test* rows are shown as validation set: look at
            them while training, but never choose a setting or a checkpoint by them.
        chunk_size: Rows of a replica in one Batch at most, >= 1: bounds the memory of large steps.
        seed: Seed of the order in which training rows come, and of the draw of the labels.
        partition_seed: Seed of the partition and of the held-out rows.
        labels: Take the rows that have a label alone, ``"all"`` or so many of them for each replica, of each class
            its share; the held-out share of these is held out. None takes all rows.
        share: Of all rows that this process holds: ``train`` and ``test`` are its own alone, and which rows are
            held out does not depend on the number of processes. None where it holds all.
        origin: Several files that the rows are from, by which they are told from others; None goes by all numbers.
    """

    most_numbers: ClassVar[int | None] = None
    """Values of visible units that are held at once to read means from; None is all of them."""

    def __init__(
        self,
        train: Rows,
        test: Rows,
        *,
        units: Units,
        n_classes: int,
        name: str,
        pixel_layout: PixelLayout | None = None,
        validation: Rows | None = None,
        batch_size: int | None = defaults.BATCH_SIZE,
        partitions: int = 1,
        first_partitions: int | None = None,
        validation_fraction: float = 0.0,
        chunk_size: int = 10_000,
        seed: int = 0,
        partition_seed: int = 0,
        labels: int | Literal["all"] | None = None,
        share: Share | None = None,
        origin: Origin | None = None,
    ) -> None:
        super().__init__()
        self.units, self.n_classes, self.data_name, self.pixel_layout = units, n_classes, name, pixel_layout
        remedy = "Rows to look at are given: leave validation_fraction at 0."
        twice = validation is not None and validation_fraction != 0
        require(not twice, "validation_fraction", validation_fraction, "0", remedy)
        remedy = "Rows with weights are not dealt into parts: type data.similarity=null where they are sequences, "
        remedy += "or data.columns={NAME: ignore} where a column of a table holds them."
        require(partitions == 1 or train.weight is None, "partitions", partitions, "1", remedy)
        remedy = "Join the files into one, which each process holds whole."
        require(share is None or partitions == 1, "partitions", partitions, "1 where processes share rows", remedy)
        require(share is None or labels is None, "labels", labels, "none where processes share rows", remedy)
        n_all = train.n if share is None else len(share.train)
        n_part, n_held_out = _split(n_all, partitions, validation_fraction, partition_seed)
        n_parts = partitions
        if first_partitions is not None:
            require_count("first_partitions", first_partitions)
            n_parts = min(partitions, first_partitions)
        self.replicas: tuple[int, ...] = (n_parts,) if partitions > 1 else ()
        self._batch_size, self._chunk_size, self._seed = batch_size, chunk_size, seed
        # Without parts and without a held-out set there is nothing to deal.
        at = heldout_at = None
        if partitions > 1 or n_held_out:
            generator = rng.stream(partition_seed, "partition")
            order = torch.randperm(n_all, generator=generator, device=generator.device)
            order = order[: n_parts * n_part].view(*self.replicas, n_part)
            at = order[..., : n_part - n_held_out]
            heldout_at = order[..., n_part - n_held_out :] if n_held_out else None
        self._share, self._origin = share, origin
        self._held: list[int] | None = None
        if share is not None:
            self.n_train = n_all if at is None else at.shape[-1]
            self._some_at = [_which(share.some_at, places, n_all) for places in (at, heldout_at)]
            self._held = share.held(share.train if at is None else share.train[at])
            self._held_out = None if heldout_at is None else share.held(share.train[heldout_at])
            at, heldout_at = (None if places is None else share.own(places) for places in (at, heldout_at))
            sets = {"validation_fraction": self._held_out}
            sets |= {"test_fraction": None if share.test is None else share.held(share.test)}
            for setting, each in sets.items():
                allowed = f"a share of which each process holds a row; theirs are {each}"
                require(each is None or min(each) > 0, f"data.{setting}", "too small", allowed)
        self.n_labels: int | None = None
        if labels is not None:
            n = None if labels == "all" else labels
            at, heldout_at = with_labels(train.label, at, heldout_at, n, validation_fraction, seed=seed)
            found = sum(places.shape[-1] for places in (at, heldout_at) if places is not None)
            self.n_labels = found if 0 < found < n_part else None
        self._train = Part(train, at)
        self._test = Part(test) if labels is None else with_label(test, "test rows")
        self._heldout = self._test if heldout_at is None else Part(train, heldout_at)
        if validation is not None:
            what = "rows of data.validation"
            self._heldout = Part(validation) if labels is None else with_label(validation, what)
        if share is None:
            self.n_train = self._train.n
            self.train_batches(rank=0, world_size=1)
        else:
            self.train_batches(share.rank, share.n_processes)
            self.val_dataloader()

    @property
    def schema(self) -> Schema | None:
        """What the units stand for; None where nothing is known of it."""
        return None

    @property
    def described(self) -> str:
        """What the data are taken for, for people; nothing where there is no question."""
        return ""

    @property
    def train(self) -> tuple[Tensor, Tensor]:
        """Training rows ``(*replicas, n, n_visible)`` and labels ``(*replicas, n)``, without those held out."""
        return self._values(self._train.taken())

    @property
    def train_observed(self) -> Tensor | None:
        """Where the training rows are known, a mask of their shape; None is everywhere."""
        return self._mask(self._train.taken())

    @property
    def test(self) -> tuple[Tensor, Tensor]:
        """Test rows ``(n, n_visible)`` and labels ``(n,)``."""
        return self._values(self._test.taken())

    @property
    def heldout(self) -> tuple[Tensor, Tensor]:
        """The rows of the validation: those held out, or the test rows, which all replicas share."""
        return self._values(self._heldout.taken())

    @property
    def heldout_observed(self) -> Tensor | None:
        """Where they are known."""
        return self._mask(self._heldout.taken())

    @property
    def validation(self) -> tuple[Tensor, Tensor] | None:
        """Held-out training rows ``(*replicas, n, n_visible)`` and labels; None if none are held out."""
        return self.heldout if self.holds_out else None

    @property
    def has_gaps(self) -> bool:
        """Whether values of any rows are missing."""
        parts = (self._train, self._heldout, self._test)
        return any(part.has_gaps for part in parts)

    @property
    def holds_out(self) -> bool:
        """Whether there are rows to judge by beside the test rows."""
        return self._heldout is not self._test

    @property
    def fingerprints(self) -> dict[str, str]:
        """Of all training rows, of the test rows, and of the rows that those held out are taken from."""
        parts = {"train": self._train, "test": self._test}
        if self.holds_out:
            parts["held-out"] = self._heldout
        return {name: self._fingerprint(part) for name, part in parts.items()}

    @property
    def class_names(self) -> list[str]:
        """The classes in words."""
        return [str(k) for k in range(self.n_classes)] if self.schema is None else self.schema.class_names

    @property
    def class_totals(self) -> Tensor:
        """Training rows of each class, over all replicas, each by its weight, ``(n_classes,)``."""
        label, weight = self._train.label, self._train.weight
        known = label != UNLABELLED
        weights = None if weight is None else weight[known]
        return torch.bincount(label[known], weights, minlength=self.n_classes)

    @property
    def n_at_once(self) -> int:
        """Training rows of a replica that are computed together: of an update, or of a chunk of it."""
        return min(self.n_train, self._batch_size or self.n_train, self._chunk_size)

    @property
    def n_visible(self) -> int:
        """Number of visible units; of categories a site has one for each state."""
        return self.units.n

    def some_train(self) -> Rows:
        """Training rows as values of the visible units: of large tables evenly spaced ones."""
        if self._share is not None:
            some = self._share.some_train.at(self._some_at[0])
            return some._replace(v=self._values(some)[0], observed=self._mask(some))
        step = 1 if self.most_numbers is None else -(-self.n_train * self.n_visible // self.most_numbers)
        some = self._train.taken(step)
        return some._replace(v=self._values(some)[0], observed=self._mask(some))

    def some_heldout(self) -> tuple[Tensor, Tensor | None]:
        """The rows of the validation and where they are known; evenly spaced ones where processes share them."""
        some, share = None, self._share
        if share is not None and self._heldout.rows is self._train.rows:
            some = share.some_train.at(self._some_at[1])
        elif share is not None and self._heldout is self._test:
            some = share.some_test
        return (
            (self.heldout[0], self.heldout_observed) if some is None else (self._values(some)[0], self._mask(some))
        )

    def train_dataloader(self) -> Batches:
        """Return the shuffled training batches of this process."""
        if self.trainer is None:
            return self.train_batches(rank=0, world_size=1)  # refused where processes share the rows
        return self.train_batches(self.trainer.global_rank, self.trainer.world_size)

    def val_dataloader(self) -> Batches:
        """Return the held-out rows, or the test rows if none are held out."""
        if self._heldout is self._test:
            return self.test_dataloader()
        shared = self._share is not None and self._heldout.rows is self._train.rows
        return self._evaluation_batches(self._heldout, self._held_out if shared else None)

    def test_dataloader(self) -> Batches:
        """Return the test rows, the same for every replica."""
        holder = None if self._share is None else self._share.test
        held = None if self._share is None or holder is None else self._share.held(holder)
        return self._evaluation_batches(self._test, held)

    def transfer_batch_to_device(self, batch: Any, device: torch.device, dataloader_idx: int) -> Any:
        """Nothing for batches that are there already; Lightning would look for tensors in each field."""
        if isinstance(batch, Batch) and batch.v.device == device:
            return batch
        return super().transfer_batch_to_device(batch, device, dataloader_idx)

    def train_batches(self, rank: int, world_size: int) -> Batches:
        """Return the shuffled training batches of one of ``world_size`` processes."""
        if self._share is not None:
            own = (self._share.rank, self._share.n_processes)
            allowed = f"{own}: this is process {own[0]} of {own[1]}, which holds a share of the rows"
            require((rank, world_size) == own, "rank and world_size", (rank, world_size), allowed)
        return Batches(
            self._train.rows.v,
            self._train.label,
            batch_size=self._batch_size,
            chunk_size=self._chunk_size,
            shuffle=True,
            seed=self._seed,
            rank=rank,
            world_size=world_size,
            held=self._held,
            observed=self._train.rows.observed,
            weight=self._train.weight,
            units=self.units,
            at=self._train.at,
            check=False,
        )

    def _evaluation_batches(self, part: Part, held: list[int] | None) -> Batches:
        v, observed, label, at = part.rows.v, part.rows.observed, part.label, part.at
        if label.ndim == 1:
            label = label.expand(*self.replicas, -1)
            if at is None:
                v = v.expand(*self.replicas, -1, -1)
                observed = None if observed is None else observed.expand(*self.replicas, -1, -1)
            else:
                at = at.expand(*self.replicas, -1)
        settings: dict[str, Any] = {"chunk_size": self._chunk_size, "shuffle": False, "seed": self._seed}
        settings |= {"observed": observed, "weight": part.weight, "units": self.units, "at": at, "check": False}
        if held is not None and self._share is not None:
            settings |= {"rank": self._share.rank, "world_size": self._share.n_processes, "held": held}
        return Batches(v, label, None, **settings)

    def _fingerprint(self, part: Part) -> str:
        origin = self._origin
        if origin is not None and (part.rows is self._train.rows or (part is self._test and origin.splits)):
            return origin.fingerprint
        return part.rows.fingerprint

    def _values(self, kept: Rows) -> tuple[Tensor, Tensor]:
        return self.units.encode(kept.v, check=False), kept.label

    def _mask(self, kept: Rows) -> Tensor | None:
        return None if kept.observed is None else self.units.over_sites(kept.observed)


class ImageDataModule(RowsDataModule):
    """Training, validation and test batches of one :class:`ImageData`.

    The kind of the visible units says which of their values stand for the grey values. All else is as in
    :class:`RowsDataModule`.

    Attributes:
        images: The data.

    Args:
        images: The data.
        units: Kind of the visible units, with a site for each pixel; None is units in {0, 1}.
        settings: Of :class:`RowsDataModule`: ``batch_size``, ``partitions``, ``validation_fraction`` and so on.
    """

    def __init__(self, images: ImageData, *, units: Units | None = None, **settings: Any) -> None:
        units = Bernoulli(images.n_visible) if units is None else units
        n_sites, allowed = units.n_sites, f"{images.n_visible}, one for each pixel"
        require(n_sites == images.n_visible, "number of sites of the units", n_sites, allowed)
        train, test = (image_rows(images, subset, units) for subset in ("train", "test"))
        own: dict[str, Any] = {"n_classes": images.n_classes, "name": images.name, "pixel_layout": images.layout}
        super().__init__(train, test, units=units, **own, **settings)
        self.images = images

    @property
    def schema(self) -> Schema:
        """Where the pixels lie."""
        return ImageSchema.of(self.images)

    def values_of(self, intensity: Tensor) -> Tensor:
        """Values of the visible units that stand for grey values, ``(..., n_pixels)`` to ``(..., n_visible)``."""
        return self.units.encode(self.units.from_intensity(intensity), check=False)


class TableDataModule(RowsDataModule):
    """Training, validation and test batches of a table, or of aligned sequences.

    Attributes:
        table: The data, with the schema of its columns.

    Args:
        table: From :class:`memcomp_lightning.data.Table`, :meth:`from_frame` or :meth:`from_array`; or from
            :class:`memcomp_lightning.data.Sequences`.
        settings: Of :class:`RowsDataModule`: ``batch_size``, ``partitions``, ``validation_fraction`` and so on.
    """

    most_numbers: ClassVar[int | None] = 2**24

    def __init__(self, table: "TableData | SequenceData", **settings: Any) -> None:
        own: dict[str, Any] = {"n_classes": table.n_classes, "name": table.name, "pixel_layout": table.layout}
        own |= {"validation": table.validation, "units": table.units()}
        own |= {name: getattr(table, name, None) for name in ("share", "origin")}
        super().__init__(table.train, table.test, **own, **settings)
        self.table = table

    @property
    def schema(self) -> Schema:
        """What the units are in the user's columns."""
        return self.table.schema

    @property
    def described(self) -> str:
        """The columns with their kinds."""
        return self.table.described()

    @classmethod
    def from_frame(
        cls, frame: Any, *, columns: Mapping[str, str] | None = None, test_fraction: float = 0.1, **settings: Any
    ) -> "TableDataModule":
        """Batches of a DataFrame of pandas, or a table of Arrow.

        Args:
            frame: The rows.
            columns: Kinds by column, see :class:`memcomp_lightning.data.Table`; the others are found.
            test_fraction: Share of the rows that is split off as test rows.
            settings: Of the class.
        """
        return cls(_data_of(frame, columns=columns, test_fraction=test_fraction), **settings)

    @classmethod
    def from_array(
        cls,
        array: Any,
        label: Any = None,
        *,
        columns: Mapping[str, str] | str | None = None,
        test_fraction: float = 0.1,
        **settings: Any,
    ) -> "TableDataModule":
        """Batches of a matrix of NumPy, SciPy or torch, NaN being a missing value.

        Args:
            array: The rows.
            label: A class for each row, -1 where it has none; None without labels.
            columns: The kind of all columns, or kinds by their numbers as texts; None finds them.
            test_fraction: Share of the rows that is split off as test rows.
            settings: Of the class.
        """
        return cls(_data_of(array, label, columns=columns, test_fraction=test_fraction), **settings)


def _which(some_at: Tensor, at: Tensor | None, n: int) -> Tensor:
    """Which of some of n rows have places among these; None is all places."""
    if at is None:
        return torch.ones_like(some_at, dtype=torch.bool)
    known = torch.zeros(n, dtype=torch.bool, device="cpu")
    known[at] = True
    return known[some_at]


def _data_of(*arguments: Any, **settings: Any) -> "TableData":
    from memcomp_lightning.data.tables import data_of  # Arrow is read where a table is

    return data_of(*arguments, **settings)


def image_rows(images: ImageData, subset: str, units: Units) -> Rows:
    """The ``train`` or ``test`` images as the units keep them."""
    v, label, observed = (getattr(images, f"{subset}_{name}") for name in ("v", "label", "observed"))
    return Rows(units.from_intensity(v), label, observed)


def _split(n: int, partitions: int, validation_fraction: float, partition_seed: int) -> tuple[int, int]:
    """Rows of a part, and how many of them are held out."""
    require_count("partitions", partitions)
    require(partitions <= n, "partitions", partitions, f"at most the {n} training rows")
    require_count("partition_seed", partition_seed, minimum=0)
    in_range = isinstance(validation_fraction, int | float) and 0 <= validation_fraction < 1
    require(in_range, "validation_fraction", validation_fraction, "a number in [0, 1)")
    n_part = n // partitions
    n_held_out = round(validation_fraction * n_part)
    require(
        validation_fraction == 0 or 1 <= n_held_out < n_part,
        "validation_fraction",
        validation_fraction,
        f"0, or a share that holds out at least 1 and leaves at least 1 of {n_part} rows; "
        f"this one holds out {n_held_out}",
        "Change validation_fraction or use fewer partitions.",
    )
    return n_part, n_held_out
