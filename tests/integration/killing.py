"""A callback that kills its own process, for tests of what is left behind."""

import os
import signal
from typing import Any

import lightning.pytorch as pl


class Kill(pl.Callback):
    """At the start of an epoch, once ``MEMCOMP_KILL=stage/epoch/signal`` says so."""

    def __init__(self, stage: str) -> None:
        self.stage = stage

    def on_train_epoch_start(self, trainer: pl.Trainer, pl_module: Any) -> None:
        stage, _, rest = os.environ.get("MEMCOMP_KILL", "").partition("/")
        epoch, _, name = rest.partition("/")
        if stage == self.stage and int(epoch) == trainer.current_epoch:
            os.kill(os.getpid(), getattr(signal, name))
