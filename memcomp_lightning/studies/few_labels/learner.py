"""What learns from few labels: the protocol of all methods, and what they are given beside the rows."""

import copy
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import NamedTuple, Protocol

import torch
from torch import Tensor, nn

from memcomp_lightning.files import inside
from memcomp_lightning.models import DBN
from memcomp_lightning.modules.weights import load_weights
from memcomp_lightning.studies.few_labels.data import Sets
from memcomp_lightning.studies.search import Setting
from memcomp_lightning.training import evaluate


class Point(NamedTuple):
    """What was measured after some passes.

    Attributes:
        passes: Done; 0 of a method without passes.
        accuracy: Share of the judging rows that are classified correctly, ``(n_sets,)``.
        loss: Mean of their cross-entropy, in nats, ``(n_sets,)``; 0 where a method has none.
    """

    passes: int
    accuracy: Tensor
    loss: Tensor

    @property
    def value(self) -> float:
        """What is maximised: mean accuracy, and between equals less loss; -inf where it diverged."""
        value = float(self.accuracy.mean()) - 1e-6 * min(float(self.loss.mean()), 100.0)
        return value if bool(self.loss.isfinite().all()) else -torch.inf


def point_of(passes: int, network: nn.Module, sets: Sets, *, at_once: int = 2000) -> Point:
    """Measure networks side by side."""
    score = evaluate(network, sets.judged(at_once))
    return Point(passes, score.accuracy, score.mean_loss)


@dataclass(frozen=True, kw_only=True)
class Lengths:
    """How long networks are trained, and in which batches; settings of ``conf/few_labels``."""

    updates: int
    passes: int
    measured: int
    batch_sizes: list[int]

    def batch_size(self, n: int) -> int:
        """Rows an update: a twentieth of ``n`` within the limits."""
        low, high = self.batch_sizes
        return min(max(n // 20, low), high, n)

    def points(self, n: int) -> tuple[int, ...]:
        """Passes after which is measured, each twice the one before; the last one ends the training.

        >>> Lengths(updates=100, passes=20, measured=3, batch_sizes=[20, 100]).points(200)
        (5, 10, 20)
        """
        last = max(self.passes, round(self.updates / -(-n // self.batch_size(n))))
        return tuple(sorted({max(1, round(last / 2**k)) for k in range(self.measured)}))


@dataclass(kw_only=True)
class Context:
    """What a method is given beside the rows.

    Attributes:
        blank: A DBN of the size of all, with weights N(0, 0.01^2).
        pretraining: Name of the method's pretraining; None is none.
        folder: Of the pretrained weights.
        pretrained_by: Seed of the pretraining.
        seed: Of everything else.
        lengths: Of training.
        rows: All training rows, without labels.
        base: Setting of the method that this one goes on from, if there is one.
    """

    blank: DBN
    pretraining: str | None
    folder: Path
    pretrained_by: int
    seed: int
    lengths: Lengths
    rows: Tensor
    base: Mapping[str, float] | None = None
    _kept: dict[str, Tensor] = field(default_factory=dict)

    def dbn(self) -> DBN:
        """A new DBN with the weights that the pretraining has left, or small random ones without it."""
        dbn = copy.deepcopy(self.blank)
        if self.pretraining is not None:
            load_weights(dbn, weight_file(self.folder, self.pretraining, self.pretrained_by))
        return dbn

    def kept(self, name: str, make: Callable[[], Tensor]) -> Tensor:
        """A tensor that is made once."""
        if name not in self._kept:
            self._kept[name] = make()
        return self._kept[name]

    @cached_property
    def principal(self) -> tuple[Tensor, Tensor, Tensor]:
        """Means, principal axes in columns, the largest variance first, and variances of all training rows."""
        mean = self.rows.mean(0)
        centred = self.rows - mean
        variance, axes = torch.linalg.eigh((centred.T @ centred).double() / len(centred))
        return mean, axes.flip(-1).to(mean), variance.flip(-1).clamp_min(1e-6).to(mean)


def weight_file(folder: Path, name: str, seed: int) -> Path:
    """Where a pretraining leaves its weights."""
    return inside(folder / "pretrained", f"{name}_{seed}.pt")


class Learner(Protocol):
    """A method; its settings are frozen, and what is tuned comes as a setting."""

    def learn(self, context: Context, sets: Sets, setting: Setting, passes: Sequence[int] | None) -> list[Point]:
        """Learn from each of the sets alone, and measure by its judging rows.

        Args:
            context: Weights, lengths and seeds.
            sets: Rows.
            setting: What is tuned.
            passes: After which is measured; None is as the method thinks best.
        """
