"""Some rows of a data set, as the visible units keep them."""

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import NamedTuple

import torch
from torch import Tensor

from memcomp_lightning.types import UNLABELLED as UNLABELLED  # for all that reads rows


class Rows(NamedTuple):
    """Rows of data.

    Attributes:
        v: A number a site, float32, ``(*replicas, n, n_sites)``; 0 where it is missing.
        label: Class indices, int64, ``(*replicas, n)``; -1 where there is none.
        observed: Where ``v`` is known, a mask of its shape; None is everywhere.
        weight: How often each row counts, > 0, ``(*replicas, n)``; None is once.
    """

    v: Tensor
    label: Tensor
    observed: Tensor | None = None
    weight: Tensor | None = None

    def at(self, index: Tensor) -> "Rows":
        """Some of them, by their numbers."""
        return Rows(*(None if part is None else part[index] for part in self))  # type: ignore[arg-type]

    @property
    def n(self) -> int:
        """Number of rows of a replica."""
        return self.label.shape[-1]

    @property
    def fingerprint(self) -> str:
        """Sixteen digits that stand for all numbers of all rows, in their order."""
        digest = hashlib.blake2b(digest_size=8)
        for part in self:
            for some in () if part is None else part.split(_ROWS):
                digest.update(some.contiguous().cpu().numpy())
        return digest.hexdigest()


_ROWS = 2**14
"""That are looked at together."""


@dataclass(frozen=True, eq=False)
class Share:
    """What a process knows of the rows that others hold, where each of several holds some of a data set.

    Attributes:
        rank: Number of the process.
        n_processes: How many there are.
        train, test: Which process holds each row, int16, ``(n,)``; those of a process are in this order in its
            :class:`Rows`. ``test`` is None where each process holds all test rows.
        some_train, some_test: Evenly spaced rows of all.
        some_at: Which training rows the first of them are, ``(n_some,)``.
    """

    rank: int
    n_processes: int
    train: Tensor
    test: Tensor | None
    some_train: Rows
    some_test: Rows | None
    some_at: Tensor

    def held(self, holder: Tensor) -> list[int]:
        """How many of the rows with these holders each process has."""
        return torch.bincount(holder.long(), minlength=self.n_processes).tolist()

    def own(self, at: Tensor) -> Tensor:
        """Places among the training rows of this process of those that it has of ``at``, places among all."""
        mine = self.train == self.rank
        place = mine.cumsum(0) - 1
        return place[at[mine[at]]]


@dataclass(frozen=True, eq=False)
class Origin:
    """Files that rows were read from, which stand for the rows where nobody may hold all of these.

    Attributes:
        files: In their order.
        split: What split the rows into training and test rows.
        splits: Whether test rows are among them.
    """

    files: Sequence[Path]
    split: str
    splits: bool

    @cached_property
    def fingerprint(self) -> str:
        """Sixteen digits that stand for all bytes of the files, and how their rows were split."""
        digest = hashlib.blake2b(self.split.encode(), digest_size=8)
        for path in self.files:
            with path.open("rb") as file:
                while some := file.read(2**20):
                    digest.update(some)
        return digest.hexdigest()


class Part(NamedTuple):
    """Some rows of a data set by their places, so that none is held twice.

    Attributes:
        rows: Of the data set, without replica axes.
        at: Places, ``(*replicas, n)``; None is all rows.
    """

    rows: Rows
    at: Tensor | None = None

    @property
    def n(self) -> int:
        """Number of rows of a replica."""
        return self.label.shape[-1]

    @property
    def label(self) -> Tensor:
        """Class indices, ``(*replicas, n)``."""
        return self.rows.label if self.at is None else self.rows.label[self.at]

    @property
    def weight(self) -> Tensor | None:
        """How often each row counts, ``(*replicas, n)``; None is once."""
        weight = self.rows.weight
        return weight if weight is None or self.at is None else weight[self.at]

    @property
    def has_gaps(self) -> bool:
        """Whether a value is missing."""
        if self.rows.observed is None:
            return False
        whole = self.rows.observed.all(-1)
        return not bool((whole if self.at is None else whole[self.at]).all())

    def taken(self, step: int = 1) -> Rows:
        """Every ``step``-th of them; copied, unless it is all rows."""
        if self.at is None:
            return self.rows if step == 1 else Rows(*(None if x is None else x[::step] for x in self.rows))  # type: ignore[arg-type]
        return self.rows.at(self.at[..., ::step])
