"""What a method sees of the data: all training rows, labels of some of them, and rows to be judged by."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from memcomp_lightning import rng
from memcomp_lightning.data import Batches
from memcomp_lightning.data.labels import labelled_at
from memcomp_lightning.errors import require
from memcomp_lightning.types import Batch


class Draw(NamedTuple):
    """Rows whose labels are known.

    Attributes:
        at: Their places among the training rows, ``(n,)``.
        label: Their classes, ``(n,)``.
    """

    at: Tensor
    label: Tensor


def drawn(label: Tensor, n: int | None, draw: int) -> Draw:
    """Draw ``n`` rows with a label, of each class its share; the same for every method.

    Args:
        label: Classes of all training rows, -1 where there is none, ``(n_rows,)``.
        n: How many; None is all.
        draw: Number of the draw.

    Raises:
        SettingError: There are fewer.
    """
    known = int((label >= 0).sum())
    require(n is None or n <= known, "few_labels.labels", n, f"at most the {known} training rows with a label")
    at = labelled_at(label, known if n is None else n, seed=draw)
    return Draw(at, label[at])


@dataclass(frozen=True, kw_only=True)
class Sets:
    """Training sets side by side, each with rows that judge what was learned from it.

    Labels of other rows are not in here: nothing can be learned from them.

    Attributes:
        rows: All training rows, ``(n_rows, n_visible)``, to learn from without labels.
        at: Places of the rows with a label, ``(n_sets, n)``.
        label: Their classes, ``(n_sets, n)``.
        judging: Rows to judge by, ``(n_judging_rows, n_visible)``.
        judging_at: Places among these, ``(n_sets, m)``.
        judging_label: Their classes, ``(n_sets, m)``.
        n_classes: Of the data.
        seed: Of the order of the rows.
    """

    rows: Tensor
    at: Tensor
    label: Tensor
    judging: Tensor
    judging_at: Tensor
    judging_label: Tensor
    n_classes: int
    seed: int

    @property
    def n_sets(self) -> int:
        """How many."""
        return len(self.at)

    def batches(self, size: int) -> Batches:
        """The labelled rows of all sets in random order, each pass another one."""
        return batches(self.rows, self.at, self.label, size, self.seed)

    def judged(self, at_once: int = 2000) -> Iterator[Batch]:
        """The rows to judge by, all sets side by side."""
        for some in torch.arange(self.judging_at.shape[-1], device="cpu").split(at_once):
            yield Batch(self.judging[self.judging_at[:, some]], self.judging_label[:, some], 1.0, True)


def batches(rows: Tensor, at: Tensor, label: Tensor, size: int, seed: int) -> Batches:
    """Rows at some places with these classes in random order, ``(n_sets, n)``."""
    size = min(size, at.shape[-1])
    return Batches(rows, label, size, max(size, 1), shuffle=True, seed=seed, at=at, check=False)


def folded(rows: Tensor, own: Draw, n_folds: int, n_classes: int, seed: int) -> Sets:
    """Sets for cross-validation: each leaves one fold of the labelled rows out, which judges it.

    Folds have ``n // n_folds`` rows, of each class its share; the few rows that are left are in all training sets.

    Raises:
        SettingError: There are more folds than rows.
    """
    n = len(own.at)
    require(n >= n_folds, "few_labels.labels", n, f"at least {n_folds}, the folds of the cross-validation")
    shuffled = torch.randperm(n, generator=rng.stream(seed, "folds"), device="cpu")
    by_class = shuffled[own.label[shuffled].argsort(stable=True)]
    size = n // n_folds
    out = by_class[: size * n_folds].view(size, n_folds).T.sort(-1).values
    kept = torch.ones(n_folds, n, dtype=torch.bool, device="cpu").scatter_(1, out, False)
    inside = kept.nonzero()[:, 1].view(n_folds, n - size)
    return Sets(
        rows=rows,
        at=own.at[inside],
        label=own.label[inside],
        judging=rows,
        judging_at=own.at[out],
        judging_label=own.label[out],
        n_classes=n_classes,
        seed=seed,
    )


def whole(rows: Tensor, own: Draw, test: tuple[Tensor, Tensor], n_classes: int, seed: int) -> Sets:
    """One set with all labelled rows, judged by the test rows."""
    v, label = test
    at = torch.arange(len(v), device="cpu")
    return Sets(
        rows=rows,
        at=own.at.unsqueeze(0),
        label=own.label.unsqueeze(0),
        judging=v,
        judging_at=at.unsqueeze(0),
        judging_label=label.unsqueeze(0),
        n_classes=n_classes,
        seed=seed,
    )
