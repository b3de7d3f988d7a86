"""Some rows of a data set, as the visible units keep them."""

from typing import NamedTuple

import torch
from torch import Tensor

from memcomp_lightning import rng
from memcomp_lightning.errors import require, require_count

UNLABELLED = -1
"""The class of a row that has none."""


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


def labelled(rows: Rows, n: int | None, n_classes: int, *, seed: int) -> Rows:
    """The rows that have a label, or some of them: as many of each class as its share, at least one.

    Args:
        rows: Without replica axes.
        n: How many; None is all of them.
        n_classes: Number of classes.
        seed: Of the draw.

    Raises:
        SettingError: There are fewer.
    """
    known = (rows.label != UNLABELLED).nonzero().flatten()
    require(
        len(known) > 0, "rows with a label", 0, "one or more to train or test a classifier", "Leave out the label."
    )
    if n is not None:
        require_count("finetune.labels", n)
    if n is None or n == len(known):
        return rows if len(known) == rows.n else rows.at(known)
    allowed = f"an integer from {n_classes} (a row of each class) to the {len(known)} rows with a label, or null"
    require(n_classes <= n < len(known), "finetune.labels", n, allowed)
    generator = rng.stream(seed, "labels")
    shuffled = known[torch.randperm(len(known), generator=generator, device="cpu")]
    classes = rows.label[shuffled]
    counts = torch.bincount(classes, minlength=n_classes)
    wanted = _shares(counts, n)
    within = torch.stack([(classes == c).long().cumsum(0) for c in range(n_classes)])
    rank = within.gather(0, classes.unsqueeze(0)).squeeze(0)
    return rows.at(shuffled[rank <= wanted[classes]].sort().values)


def _shares(counts: Tensor, n: int) -> Tensor:
    """Whole numbers that add up to n, as the counts are to each other: at least one of each class there is."""
    exact = counts.double() * n / counts.sum()
    found = torch.maximum(exact.floor().long(), (counts > 0).long())
    while (short := n - int(found.sum())) != 0:
        room = counts > found if short > 0 else found > 1
        gain = torch.where(room, (exact - found) * (1 if short > 0 else -1), -torch.inf)
        found[int(gain.argmax())] += 1 if short > 0 else -1
    return found
