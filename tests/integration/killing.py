"""A callback that kills its own process, for tests of what is left behind."""

import os
import signal
import time
from pathlib import Path
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


class KillOnceCopied(pl.Callback):
    """At the start of an epoch, once the file is there that ``MEMCOMP_COPY`` names."""

    def __init__(self, epoch: int) -> None:
        self.epoch = epoch

    def on_train_epoch_start(self, trainer: pl.Trainer, pl_module: Any) -> None:
        if trainer.current_epoch == self.epoch and not trainer.ckpt_path:
            while not Path(os.environ["MEMCOMP_COPY"]).exists():
                time.sleep(0.01)
            os.kill(os.getpid(), signal.SIGKILL)
