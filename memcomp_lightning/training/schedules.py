"""How the optimiser of a stage changes from pass to pass."""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Protocol

from torch.nn import Parameter
from torch.optim import SGD, Optimizer

from memcomp_lightning import defaults
from memcomp_lightning.errors import require, require_count

OptimizerFactory = Callable[[Iterable[Parameter]], Optimizer]
"""Builds an optimiser for some parameters: ``functools.partial(torch.optim.SGD, lr=0.1)``."""

PRETRAINING_SGD: OptimizerFactory = partial(SGD, lr=defaults.LEARNING_RATE)
"""What trains energy models unless an optimiser is given."""

FINETUNING_SGD: OptimizerFactory = partial(
    SGD, lr=defaults.FINETUNING_LEARNING_RATE, momentum=defaults.FINETUNING_MOMENTUM
)
"""What trains classifiers unless an optimiser is given."""


class Schedule(Protocol):
    """Changes an optimiser at the start of each pass."""

    def check(self, optimizer: Optimizer) -> None:
        """Raise a SettingError for an optimiser without the settings that this schedule changes."""

    def begin_pass(self, optimizer: Optimizer, iteration: int) -> None:
        """Change the optimiser for a pass, numbered from 0 in the stage or, in greedy pretraining, the layer."""


@dataclass(frozen=True)
class MomentumSchedule:
    """A small momentum in the first passes, a larger one after.

    Defaults are those of Manukian et al. 2019, section 4, and of Adachi & Henderson.

    Attributes:
        initial: Momentum of the first passes, in [0, 1).
        final: Momentum after, in [0, 1).
        switch_at: Number of passes with ``initial``, >= 0.
    """

    initial: float = 0.1
    final: float = 0.5
    switch_at: int = 5

    def __post_init__(self) -> None:
        for name, value in (("initial", self.initial), ("final", self.final)):
            require(0 <= value < 1, f"momentum {name}", value, "a number in [0, 1)")
        require_count("switch_at", self.switch_at, minimum=0)

    def check(self, optimizer: Optimizer) -> None:
        """Refuse an optimiser without momentum."""
        require(
            "momentum" in optimizer.param_groups[0],
            "optimizer",
            type(optimizer).__name__,
            "one with a 'momentum' setting (torch.optim.SGD, RMSprop) for MomentumSchedule",
            "Leave the schedule out: pretrain.schedules.momentum=null, finetune.schedules.momentum=null.",
        )

    def begin_pass(self, optimizer: Optimizer, iteration: int) -> None:
        """Set the momentum of the pass."""
        for group in optimizer.param_groups:
            group["momentum"] = self.initial if iteration < self.switch_at else self.final


@dataclass(frozen=True)
class LearningRateDecay:
    """A learning rate that falls linearly, pass by pass, from the optimiser's own to a share of it.

    Attributes:
        n_passes: Passes until the last one, >= 1; later ones keep the lowest rate.
        final: Share of the initial rate in the last pass, in (0, 1].
    """

    n_passes: int
    final: float = 0.01

    def __post_init__(self) -> None:
        require_count("n_passes", self.n_passes)
        require(0 < self.final <= 1, "final", self.final, "a number in (0, 1]")

    def check(self, optimizer: Optimizer) -> None:
        """Every optimiser has a learning rate."""

    def factor(self, iteration: int) -> float:
        """Share of the initial rate in a pass.

        >>> [LearningRateDecay(3, final=0.5).factor(iteration) for iteration in range(4)]
        [1.0, 0.75, 0.5, 0.5]
        """
        done = min(iteration / max(self.n_passes - 1, 1), 1.0)
        return 1.0 - (1.0 - self.final) * done

    def begin_pass(self, optimizer: Optimizer, iteration: int) -> None:
        """Give every group its share of its first learning rate, which checkpoints of the optimiser keep."""
        for group in optimizer.param_groups:
            group["lr"] = group.setdefault("initial_lr", group["lr"]) * self.factor(iteration)


def check_schedules(schedules: Sequence[Schedule], optimizers: Sequence[Optimizer]) -> None:
    """Raise a SettingError unless all schedules can change all optimisers."""
    for schedule in schedules:
        for optimizer in optimizers:
            schedule.check(optimizer)


def begin_pass(schedules: Sequence[Schedule], optimizer: Optimizer, iteration: int) -> None:
    """Let all schedules set what a pass needs."""
    for schedule in schedules:
        schedule.begin_pass(optimizer, iteration)
