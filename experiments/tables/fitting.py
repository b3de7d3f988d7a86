"""RBMs of tables in files, trained by the bare loop: the updates of memcomp-train without a Lightning trainer."""

import copy
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from torch.optim import SGD

from memcomp_lightning import defaults, rng
from memcomp_lightning.data import Table, TableDataModule
from memcomp_lightning.data.tables import TableData
from memcomp_lightning.models import RBM, start_at_means
from memcomp_lightning.objective import Centring
from memcomp_lightning.samplers import PCD, NegativePhaseSampler
from memcomp_lightning.trained.run import Run
from memcomp_lightning.training import L1, DivergedError, Greedy, pretrain
from memcomp_lightning.training.schedules import LearningRateDecay


@dataclass(frozen=True, kw_only=True)
class Settings:
    """Of the training of an RBM.

    Attributes:
        n_hidden: Hidden units in {0, 1}.
        rate: Learning rate of the first pass; a falling one ends at a hundredth of it in the last of ``passes``.
        passes: Passes over the training rows.
        falling: Whether the rate falls.
        l1: Strength of the L1 penalty.
        batch: Rows an update.
        sampler: Of the negative phase.
    """

    n_hidden: int
    rate: float
    passes: int
    falling: bool = True
    l1: float = 0.0
    batch: int = 20
    sampler: Callable[[], NegativePhaseSampler] = PCD

    def __str__(self) -> str:
        penalty = f", L1 {self.l1:g}" if self.l1 else ""
        return f"{self.n_hidden} hidden, rate {self.rate:g}{penalty}"


AS_TYPED = Settings(n_hidden=64, rate=defaults.LEARNING_RATE, passes=defaults.PASSES, falling=False)
"""What ``memcomp-train data=table data.path=...`` does without further settings."""


class Chosen(NamedTuple):
    """The best of several trainings.

    Attributes:
        settings: Of the training.
        passes: After which it was best.
        quality: Of the run, the higher the better.
        run: With the weights of that time.
    """

    settings: Settings
    passes: int
    quality: float
    run: Run


def read(folder: Path, **parts: Any) -> TableData:
    """Frames, or arrays with NaN where a cell is missing, written to files and read again, as memcomp-train does.

    Args:
        folder: Where the files are written.
        parts: The rows to ``train`` on, and those of ``validation`` and ``test``.
    """
    files = {}
    for name, part in parts.items():
        if isinstance(part, np.ndarray):
            np.save(folder / f"{name}.npy", part)
            files[name] = str(folder / f"{name}.npy")
        else:
            part.to_csv(folder / f"{name}.csv", index=False)
            files[name] = str(folder / f"{name}.csv")
    return Table(path=files.pop("train"), **files).load()


def trained(table: TableData, settings: Settings, *, seed: int = 0, looks: int = 1) -> Iterator[tuple[int, Run]]:
    """Passes done and the run, which goes on being trained, ``looks`` times in all.

    Raises:
        DivergedError: A parameter left the finite numbers.
    """
    data = TableDataModule(table, batch_size=settings.batch, seed=seed)
    rbm = RBM(visible=data.units, n_hidden=settings.n_hidden, generator=rng.stream(seed, "weights"))
    some = data.some_train()
    start_at_means(rbm, some.v, some.observed)
    run = Run(Path("table"), rbm, schema=table.schema)
    for done in pretrain(
        Greedy(rbm),
        data.train_dataloader(),
        settings.sampler(),
        iterations=settings.passes,
        optimizer=partial(SGD, lr=settings.rate),
        schedules=[LearningRateDecay(settings.passes)] if settings.falling else [],
        centring=Centring(),
        penalties=[L1(settings.l1)] if settings.l1 else [],
        seed=seed,
    ):
        if done.number % (settings.passes // looks) == 0:
            yield done.number, run


def choose(
    table: TableData,
    grid: Sequence[Settings],
    quality: Callable[[Run], float],
    *,
    seed: int = 0,
    looks: int = 1,
) -> Chosen:
    """Train with each of the settings and keep the best run; a training that diverges is none."""
    best: Chosen | None = None
    for settings in grid:
        try:
            for passes, run in trained(table, settings, seed=seed, looks=looks):
                found = quality(run)
                if np.isfinite(found) and (best is None or found > best.quality):
                    kept = replace(run, network=copy.deepcopy(run.network))
                    best = Chosen(settings, passes, found, kept)
        except DivergedError:
            continue
    assert best is not None, "all trainings diverged"
    return best
