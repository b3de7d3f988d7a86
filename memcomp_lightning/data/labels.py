"""Labels for some of the rows: which rows a classifier learns from and is judged by."""

import torch
from torch import Tensor

from memcomp_lightning import rng
from memcomp_lightning.data.rows import UNLABELLED, Part, Rows
from memcomp_lightning.errors import require, require_count


def with_label(rows: Rows, what: str) -> Part:
    """The rows that have a label; those of a replica axis are not for it.

    Raises:
        SettingError: There is none; ``what`` names the rows.
    """
    n = n_labels(rows.label)
    _require_some(n, what, "Or leave out fine-tuning: finetune.iterations=0.")
    return Part(rows, None if n == rows.n else labelled_at(rows.label, n))


def with_labels(
    label: Tensor, at: Tensor | None, heldout_at: Tensor | None, n: int | None, share: float, *, seed: int
) -> tuple[Tensor | None, Tensor | None]:
    """Of training and held-out rows, by their places, those that have a label, or ``n`` of them in all.

    Held-out rows stay held out: pretraining has not seen them either.

    Args:
        label: Class indices of all rows, -1 where there is none, ``(n_rows,)``.
        at: Places of the training rows, ``(*replicas, n_train)``; None is all rows.
        heldout_at: Places of the held-out rows; None where there are none.
        n: Labels of each replica; None is all.
        share: Of the labels that is held out.
        seed: Of the draw.

    Raises:
        SettingError: There are fewer, or too few for each class.
    """
    own = label if at is None else label[at]
    judging = None if heldout_at is None else label[heldout_at]
    n_own, n_judging = n_labels(own), 0 if judging is None else n_labels(judging)
    _require_some(n_own, "training rows", "Or leave out fine-tuning: finetune.iterations=0.")
    if judging is not None:
        _require_some(n_judging, "held-out rows", "Raise data.validation_fraction.")
    if n is not None:
        require_count("finetune.labels", n)
        n_classes, most = len(label[label != UNLABELLED].unique()), n_own + n_judging
        # The share, but for chance: more or fewer of the rows that are held out may have a label.
        held_out = min(max(round(share * n), n - n_own, min(1, n_judging)), n_judging)
        beside = f" beside the {held_out} that are held out" if held_out else ""
        allowed = f"an integer up to the {most} rows with a label, with one to train on for each of the "
        allowed += f"{n_classes} classes{beside}; or null for all"
        require(n_classes <= n - held_out and n <= most, "finetune.labels", n, allowed)
        n_own, n_judging = n - held_out, held_out
    if n_own < own.shape[-1]:
        places = labelled_at(own, n_own, seed=seed)
        at = places if at is None else at.gather(-1, places)
    if judging is not None and heldout_at is not None and n_judging < judging.shape[-1]:
        heldout_at = heldout_at.gather(-1, labelled_at(judging, n_judging, seed=seed))
    return at, heldout_at


def n_labels(label: Tensor) -> int:
    """Rows that have a label, of the replica with the fewest; labels are ``(*replicas, n_rows)``."""
    return int((label != UNLABELLED).sum(-1).min())


def labelled_at(label: Tensor, n: int, *, seed: int = 0) -> Tensor:
    """Places of ``n`` rows that have a label, of each class its share, and at least one if ``n`` is enough.

    Args:
        label: Class indices, -1 where there is none, ``(*replicas, n_rows)``.
        n: How many of each replica, all at most.
        seed: Of the draw; each replica has its own.

    Returns:
        In rising order, ``(*replicas, n)``.
    """
    chosen = []
    for number, row in enumerate(label.reshape(-1, label.shape[-1])):
        places = (row != UNLABELLED).nonzero().flatten()
        if n < len(places):
            generator = rng.stream(seed, "labels", number)
            shuffled = places[torch.randperm(len(places), generator=generator, device="cpu")]
            places = shuffled[_first_of_each(row[shuffled], n)].sort().values
        chosen.append(places)
    return torch.stack(chosen).view(*label.shape[:-1], n)


def _require_some(n: int, what: str, remedy: str) -> None:
    require(n > 0, f"labels of the {what}", 0, "one or more, for a classifier", remedy)


def _first_of_each(classes: Tensor, n: int) -> Tensor:
    """A mask of n rows: the first ones of each class."""
    counts = classes.bincount()
    order = classes.argsort(stable=True)
    rank = torch.empty_like(order)
    rank[order] = torch.arange(len(order), device="cpu") - (counts.cumsum(0) - counts)[classes[order]]
    return rank < _shares(counts, n)[classes]


def _shares(counts: Tensor, n: int) -> Tensor:
    """Whole numbers that add up to n, as the counts are to each other; one of each class, if n is enough."""
    exact, least = counts.double() * n / counts.sum(), (counts > 0).long()
    if int(least.sum()) > n:
        least = torch.zeros_like(least)
    found = torch.maximum(exact.floor().long(), least)
    while (short := n - int(found.sum())) != 0:
        room = counts > found if short > 0 else found > least
        gain = torch.where(room, (exact - found) * (1 if short > 0 else -1), -torch.inf)
        found[int(gain.argmax())] += 1 if short > 0 else -1
    return found
