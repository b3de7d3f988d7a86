"""Batches of images that lie in memory: gathered by index, split over processes and into chunks."""

import copy
import math
import re
from collections.abc import Iterator, Sequence
from typing import NamedTuple

import torch
from jaxtyping import Int
from torch import Tensor

from memcomp_lightning import rng
from memcomp_lightning.arrays import moved
from memcomp_lightning.data.missing import split_missing
from memcomp_lightning.errors import SettingError, require, require_count
from memcomp_lightning.models.units import Units
from memcomp_lightning.types import Batch

_ENTRIES_CHECKED = 2**22
"""Entries that are held at once while values are looked at."""


class SparseRows(NamedTuple):
    """Images most of whose intensities are 0, as the rows of a matrix in CSR form; batches of them are dense.

    Attributes:
        start: Where each row begins in the two others, and where the last one ends (int64), ``(n + 1,)``.
        unit: Visible unit of each value, ``(n_values,)`` int64.
        value: Intensities in [0, 1], ``(n_values,)``.
        n_visible: Visible units.

    >>> rows = SparseRows(torch.tensor([0, 1, 3]), torch.tensor([2, 0, 1]), torch.tensor([0.5, 1.0, 1.0]), 3)
    >>> rows.dense(torch.tensor([1, 0])).tolist()
    [[1.0, 1.0, 0.0], [0.0, 0.0, 0.5]]
    """

    start: Tensor
    unit: Tensor
    value: Tensor
    n_visible: int

    @property
    def shape(self) -> torch.Size:
        """``(n, n_visible)``."""
        return torch.Size((len(self.start) - 1, self.n_visible))

    def to(self, device: torch.device | str) -> "SparseRows":
        """Return the same rows on a device."""
        return SparseRows(self.start.to(device), self.unit.to(device), self.value.to(device), self.n_visible)

    def dense(self, index: Int[Tensor, " n_chunk"]) -> Tensor:
        """Return some of the rows as a dense matrix, ``(n_chunk, n_visible)``."""
        first = self.start[index]
        counts = self.start[index + 1] - first
        row = torch.arange(len(index), device=index.device).repeat_interleave(counts)
        within = torch.arange(len(row), device=index.device) - (counts.cumsum(0) - counts)[row]
        at = first[row] + within
        dense = self.value.new_zeros(len(index), self.n_visible)
        dense[row, self.unit[at]] = self.value[at]
        return dense


class Batches:
    """Deals images in memory out to updates, a pass at a time, as :class:`~memcomp_lightning.types.Batch` objects.

    The order of a pass depends on the seed and the number of the pass alone, so a resumed run goes on like an
    uninterrupted one without a saved order; only a checkpoint from within a pass has to say how far it was
    (:meth:`state_dict`). Each replica has its own order.

    A step's images are dealt to the processes (process r takes every ``world_size``-th, from the r-th on),
    then split evenly into the fewest chunks that hold at most ``chunk_size``. All processes have the same
    number of chunks in a step. No image is repeated or left out.

    Where each process holds images of its own, a pass has as many steps as if one held all, and each process gives
    each step an equal share of its own: a share of a step's mean is as large as the images in it are many.

    Args:
        v: Intensities, or data as ``units`` keep them, ``(*replicas, n, n_sites)``; :class:`SparseRows` without
            replica axes. NaN is a missing value.
        label: Class indices, ``(*replicas, n)``.
        batch_size: Images of a replica in an optimiser step, over all processes, >= 1; the last step of a
            pass takes what is left. None, or n and more, means all n.
        chunk_size: Images of a replica that one Batch holds at most, >= 1.
        shuffle, seed: Whether each epoch has another order, and its seed.
        rank, world_size: Index of this process, and how many there are.
        weight: How often each image counts in the mean over a step, > 0, ``(n,)``, without replica axes; None
            means once each.
        observed: Where ``v`` is known, a mask of its shape; None is wherever it is not NaN.
        units: Kind of the visible units, which makes entries of the data when a batch is taken, so that a category
            takes a number in memory and no row of zeros; None takes the data as they are.
        at: Places of the images among those of ``v`` and ``observed``, which then have no replica axes,
            ``(*replicas, n)``; ``label`` and ``weight`` are those of the places. None takes all images.
        check: Whether values that the units do not take are looked for, once; data modules have done it.
        held: Images that each of the processes holds, where ``v`` and all else are those of this one; None where
            each holds all images.

    Raises:
        SettingError: Sizes that do not fit, or a value that the units do not take, by its column and row.

    >>> batches = Batches(torch.zeros(7, 2), torch.zeros(7).long(), 3, chunk_size=2, shuffle=True, seed=0)
    >>> [(len(batch.label), batch.closes_step) for batch in batches]
    [(1, False), (2, True), (1, False), (2, True), (1, True)]
    """

    def __init__(
        self,
        v: Tensor | SparseRows,
        label: Tensor,
        batch_size: int | None,
        chunk_size: int,
        shuffle: bool,
        seed: int,
        rank: int = 0,
        world_size: int = 1,
        weight: Tensor | None = None,
        observed: Tensor | None = None,
        units: Units | None = None,
        at: Tensor | None = None,
        check: bool = True,
        held: Sequence[int] | None = None,
    ) -> None:
        filled = len(v.shape) >= 2 and v.shape.numel() > 0
        require(filled, "v.shape", tuple(v.shape), "(*replicas, n, n_visible), not empty")
        shape = v.shape[:-1] if at is None else at.shape
        require(label.shape == shape, "label.shape", tuple(label.shape), f"{tuple(shape)}, as v")
        n = label.shape[-1]
        if batch_size is not None:
            require_count("batch_size", batch_size)
        require_count("chunk_size", chunk_size)
        require_count("seed", seed, minimum=0)
        require_count("world_size", world_size)
        require_count("rank", rank, minimum=0)
        require(rank < world_size, "rank", rank, f"an integer from 0 to {world_size - 1} (world_size - 1)")
        if held is not None:
            fits = len(held) == world_size and held[rank] == n
            require(fits, "held", list(held), f"a number for each of {world_size} processes, of this one {n}")
        self._chunks = _plan(n, batch_size, chunk_size, rank, world_size, held)
        if weight is not None:
            fits = weight.shape == label.shape == (n,)
            require(fits, "weight.shape", tuple(weight.shape), f"{(n,)}: a weight an image, without replica axes")
            smallest = float(weight.min())
            require(smallest > 0, "weight", smallest, "numbers > 0", "Leave out images that do not count.")
        # One chunk that is the whole pass: the order cannot matter, and the tensors go out uncopied.
        self._shuffle = shuffle and (len(self._chunks) > 1 or (world_size > 1 and held is None))
        sparse = isinstance(v, SparseRows)
        fits = not sparse or (observed is None and units is None and at is None)
        require(fits, "observed, units and at", "given", "None where images are in sparse rows")
        if not isinstance(v, SparseRows):
            if at is not None and not self._shuffle and len(self._chunks) == 1:  # gathered once, not in each pass
                v, observed, at = v[at], None if observed is None else observed[at], None
            v, observed = split_missing(v, observed, "v")
            if units is not None and check:
                _check_values(units, v, observed)
        # Contiguous, the images of all replicas are the rows of one matrix.
        self._v, self._label, self._weight, self._observed, self._units = v, label, weight, observed, units
        self._at = at
        if self._shuffle:
            self._v, self._label = v if isinstance(v, SparseRows) else v.contiguous(), label.contiguous()
            self._observed = None if observed is None else observed.contiguous()
        self._world_size, self._held, self._rank = world_size, held, rank
        self._of_steps: list[float] | None = None
        self._seeds: tuple[int, ...] = (seed,)
        self._replicas = tuple(label.shape[:-1])
        self._epoch = 0
        self._progress = {"epoch": 0, "position": 0}
        self._resume: dict[str, int] | None = None

    def repeated(self, seeds: Sequence[int]) -> "Batches":
        """Return the same images once for each seed, in the order of that seed, on one replica axis.

        Raises:
            SettingError: Images with weights come in chunks, whose shares of a step would hang on the seed.
        """
        require(len(seeds) > 0, "seeds", list(seeds), "at least one seed")
        if isinstance(self._v, SparseRows):
            raise ValueError("images in sparse rows have no replica axis: they are not repeated.")
        whole = self._world_size == 1 and all(chunk.closes_step for chunk in self._chunks)
        fits = self._weight is None or len(seeds) == 1 or whole
        allowed = "one seed for images with weights, or chunks that are whole steps"
        require(fits, "seeds", list(seeds), allowed, "Raise chunk_size.")
        repeated = copy.copy(self)
        repeated._seeds = tuple(seeds)
        repeated._replicas = (len(seeds) * math.prod(self._replicas),)
        if not self._shuffle:
            n, units = self._label.shape[-1], self._v.shape[-1]
            repeated._label = self._label.reshape(-1, n).repeat(len(seeds), 1)
            repeated._weight = None if self._weight is None else self._weight.repeat(len(seeds), 1)
            if self._at is not None:
                repeated._at = self._at.reshape(-1, n).repeat(len(seeds), 1)
                return repeated
            repeated._v = self._v.reshape(-1, n, units).repeat(len(seeds), 1, 1)
            if self._observed is not None:
                repeated._observed = self._observed.reshape(-1, n, units).repeat(len(seeds), 1, 1)
        return repeated

    def to(self, device: torch.device | str) -> "Batches":
        """Return the same batches with all images on a device."""
        moved = copy.copy(self)
        moved._v, moved._label = self._v.to(device), self._label.to(device)
        moved._weight = None if self._weight is None else self._weight.to(device)
        moved._at = None if self._at is None else self._at.to(device)
        moved._observed = None if self._observed is None else self._observed.to(device)
        moved._units = None if self._units is None else copy.deepcopy(self._units).to(device)
        return moved

    @property
    def sampler(self) -> "Batches":
        """Itself: at each epoch Lightning calls ``dataloader.sampler.set_epoch(epoch)``."""
        return self

    @property
    def batch_sampler(self) -> None:
        """None: Lightning reads it from everything that has a ``sampler``."""
        return None

    def set_epoch(self, epoch: int) -> None:
        """Choose the order of the passes that start from now on, by the index of the first, >= 0."""
        require_count("epoch", epoch, minimum=0)
        self._epoch = epoch

    def __len__(self) -> int:
        return len(self._chunks)

    def __iter__(self) -> Iterator[Batch]:
        # A generator runs nothing until its first batch is asked for. That matters: Lightning calls iter()
        # before set_epoch() in the first epoch of a run.
        resume, self._resume = self._resume, None
        start = resume["position"] % len(self) if resume and resume["epoch"] == self._epoch else 0
        order = self._order() if self._shuffle else None
        self._of_steps = self._weights_of_steps(order)
        for position, chunk in enumerate(self._chunks[start:], start + 1):
            self._progress = {"epoch": self._epoch, "position": position}
            yield self._batch(chunk, order)

    def state_dict(self) -> dict[str, int]:
        """Return how far the current pass is; Lightning saves it with a checkpoint."""
        return dict(self._progress)

    def load_state_dict(self, state: dict[str, int]) -> None:
        """Let the next pass start where the saved one was, if it is of the same epoch."""
        self._resume = self._progress = dict(state)

    def _batch(self, chunk: "_Chunk", order: Tensor | None) -> Batch:
        positions, observed = chunk.positions, None
        if isinstance(self._v, SparseRows):
            n = len(self._label)
            rows = torch.arange(n, device=self._label.device)[positions] if order is None else order[positions]
            v, label = self._v.dense(rows), self._label[rows]
        else:
            index = None if order is None else order[..., positions]
            label, places = self._labels(positions, index), index
            if self._at is not None:
                places = self._at[..., positions] if index is None else self._at.flatten()[index]
            v = _taken(self._v, positions, places)
            if self._observed is not None:
                observed = _taken(self._observed, positions, places)
            if self._units is not None:
                v = self._units.encode(v, check=False)
                observed = None if observed is None else self._units.over_sites(observed)
        if self._weight is None:
            return Batch(v, label, chunk.share, chunk.closes_step, None, observed)
        weight, share = self._weights(positions, order), 1.0
        if positions != chunk.step or self._of_steps:  # a device would be waited for; alike for all seeds
            if self._of_steps:
                of_step = self._of_steps[chunk.number]
            else:
                of_step = float(self._weights(chunk.step, order).sum())
            share = self._world_size * float(weight.sum()) / of_step
        return Batch(v, label, share, chunk.closes_step, weight, observed)

    def _weights(self, positions: slice, order: Tensor | None) -> Tensor:
        assert self._weight is not None
        return self._weight[..., positions] if order is None else self._weight[order[..., positions]]

    def _weights_of_steps(self, order: Tensor | None) -> list[float]:
        """Sum of the weights of each step over all processes, where each knows its own alone."""
        if self._weight is None or self._held is None:
            return []
        closing = [chunk for chunk in self._chunks if chunk.closes_step]
        own = [float(self._weights(chunk.step, order).double().sum()) for chunk in closing]
        of_all: list[list[float]] = [own] * self._world_size
        torch.distributed.all_gather_object(of_all, own)
        return [sum(of_step) for of_step in zip(*of_all, strict=True)]

    def _labels(self, positions: slice, index: Tensor | None) -> Tensor:
        if index is None:
            return self._label[..., positions]
        return self._label.flatten().index_select(0, index.flatten()).view(index.shape)

    def _order(self) -> Int[Tensor, "*replicas n"]:
        """Return this epoch's order, as rows of all replicas' images laid end to end."""
        *replicas, n = self._label.shape
        first_rows = range(0, math.prod(replicas) * n, n)
        orders = {}
        for seed in dict.fromkeys(self._seeds):
            # Of images of its own each process has an order of its own.
            name = "data_order" if self._held is None else f"data_order of process {self._rank}"
            generator = rng.stream(seed, name, self._epoch)
            # On the generator's device, whatever torch's default device is.
            orders[seed] = torch.stack(
                [torch.randperm(n, generator=generator, device="cpu") + first for first in first_rows]
            )
        order = torch.cat([orders[seed] for seed in self._seeds])
        found: Tensor = moved(order.view(*self._replicas, n), self._label.device)
        return found


class _Chunk(NamedTuple):
    """Positions in the order, of the chunk and of its whole step, which has a number in the pass."""

    positions: slice
    step: slice
    share: float
    closes_step: bool
    number: int


def _check_values(units: Units, v: Tensor, observed: Tensor | None) -> None:
    """Raise a SettingError for data that the units do not take; a part of the rows has its entries at once."""
    rows = max(1, _ENTRIES_CHECKED // (units.n * math.prod(v.shape[:-2])))
    for first in range(0, v.shape[-2], rows):
        at = (..., slice(first, first + rows), slice(None))
        mask = None if observed is None else units.over_sites(observed[at])
        try:
            units.check(units.encode(v[at]), mask)
        except SettingError as error:
            raise SettingError(_with_row(str(error), first)) from None


def _with_row(message: str, first: int) -> str:
    """A message about a part of the rows, with the row counted from the first of all."""
    return re.sub(r", row (\d+)", lambda found: f", row {first + int(found[1])}", message, count=1)


def _taken(v: Tensor, positions: slice, index: Tensor | None) -> Tensor:
    """Rows by their positions, or by their places among those of all replicas."""
    if index is None:
        return v[..., positions, :]
    # Whole rows are copied out of (all images, n_visible): for replicas that takes a sixth of the time
    # of torch.take_along_dim, which looks up each single value.
    return v.flatten(0, -2).index_select(0, index.flatten()).view(*index.shape, -1)


def _plan(
    n: int, batch_size: int | None, chunk_size: int, rank: int, world_size: int, held: Sequence[int] | None
) -> list[_Chunk]:
    """Return which positions of the order form each chunk of this process."""
    plan = []
    dealt = _of_all(n, batch_size, rank, world_size) if held is None else _of_own(held, batch_size, rank)
    for number, (shard, step, n_images, fewest, most) in enumerate(dealt):
        n_chunks = math.ceil(most / chunk_size)
        # An empty chunk is refused: the mean over it is NaN.
        allowed = f"at least one image for each process in every step, but a step has {n_images} images for "
        allowed += f"{world_size} processes"
        remedy = "Choose a batch_size that leaves more in the last step, or use fewer processes."
        require(fewest > 0, "batch_size", batch_size, allowed, remedy)
        allowed = f"an integer >= 2, because {world_size} processes share a step of {n_images} images unevenly"
        require(fewest >= n_chunks, "chunk_size", chunk_size, allowed)
        bounds = [k * len(shard) // n_chunks for k in range(n_chunks + 1)]
        for k in range(n_chunks):
            part = shard[bounds[k] : bounds[k + 1]]
            positions = slice(part.start, part.stop, part.step)
            share = world_size * len(part) / n_images
            plan.append(_Chunk(positions, slice(step.start, step.stop, 1), share, k == n_chunks - 1, number))
    return plan


class _Dealt(NamedTuple):
    """A step: positions of this process, those that its weights add up over; images of all processes, of each."""

    shard: range
    step: range
    n_images: int
    fewest: int
    most: int


def _of_all(n: int, batch_size: int | None, rank: int, world_size: int) -> Iterator[_Dealt]:
    """Steps of images that each process holds all of: it takes every n-th."""
    for start in range(0, n, batch_size or n):
        step = range(start, min(start + (batch_size or n), n))
        fewest, most = len(step) // world_size, math.ceil(len(step) / world_size)
        yield _Dealt(step[rank::world_size], step, len(step), fewest, most)


def _of_own(held: Sequence[int], batch_size: int | None, rank: int) -> Iterator[_Dealt]:
    """Steps of images that each process has its own of: an equal part of them, to one image."""
    n_steps = math.ceil(sum(held) / (batch_size or sum(held)))
    for k in range(n_steps):
        shards = [range(k * n // n_steps, (k + 1) * n // n_steps) for n in held]
        sizes = [len(shard) for shard in shards]
        yield _Dealt(shards[rank], shards[rank], sum(sizes), min(sizes), max(sizes))
