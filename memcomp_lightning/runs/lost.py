"""A process of another machine that is lost while several train: which one it was, for people."""

import os
import re
import socket
import time
from contextlib import suppress
from datetime import timedelta
from typing import Any

import lightning.pytorch as pl
import torch.distributed as dist

_ADDRESS = re.compile(r"\[([^\[\]\s]+)\]:\d+")
_WAIT_S = 5.0
"""Seconds in which the processes that are left say so: they notice within a moment of each other."""


class Others(pl.Callback):
    """The processes that train together, as far as this one knows them."""

    changes_training = False

    def __init__(self) -> None:
        self._n, self._rank = 1, 0
        self._store: Any = None

    def setup(self, trainer: pl.Trainer, pl_module: pl.LightningModule, stage: str) -> None:
        """Tell the others on which machine this process is."""
        if trainer.world_size > 1 and self._store is None:
            self._n, self._rank, self._store = trainer.world_size, trainer.global_rank, _store()
            self._set("host", socket.gethostname())

    def lost(self, error: RuntimeError) -> str | None:
        """Say which process an error of a collective operation is about; None if it is another error."""
        text = str(error)
        if not (dist.is_available() and (isinstance(error, dist.DistError) or "gloo/" in text)):
            return None
        address = _ADDRESS.search(text)
        if address is not None:
            return f"the process at {address[1]} has ended or can no longer be reached"
        return self._silent()

    def _silent(self) -> str:
        """Who does not say within a few seconds that it has given up as well."""
        if self._store is None:
            return "another process has ended or can no longer be reached"
        self._set("gave up", "yes")
        time.sleep(_WAIT_S)
        silent = [rank for rank in range(self._n) if rank != self._rank and not self._has(f"gave up/{rank}")]
        if not silent:
            return "the processes wait for each other, though all of them can be reached"
        names = " and ".join(f"process {rank} on {self._host(rank)}" for rank in silent)
        return f"{names} {'does' if len(silent) == 1 else 'do'} not answer"

    def _set(self, key: str, value: str) -> None:
        with suppress(RuntimeError):
            assert self._store is not None
            self._store.set(f"memcomp_lightning/{key}/{self._rank}", value)

    def _has(self, key: str) -> bool:
        with suppress(RuntimeError):
            assert self._store is not None
            return bool(self._store.check([f"memcomp_lightning/{key}"]))
        return False

    def _host(self, rank: int) -> str:
        with suppress(RuntimeError):
            if self._has(f"host/{rank}"):
                assert self._store is not None
                return str(self._store.get(f"memcomp_lightning/host/{rank}").decode())
        return "an unknown machine"


def _store() -> Any:
    """A connection of our own to where the processes met; None where they met elsewhere."""
    with suppress(RuntimeError, KeyError, ValueError):
        port = int(os.environ["MASTER_PORT"])
        timeout = timedelta(seconds=10)
        return dist.TCPStore(os.environ["MASTER_ADDR"], port, is_master=False, timeout=timeout)  # type: ignore[attr-defined]
    return None
