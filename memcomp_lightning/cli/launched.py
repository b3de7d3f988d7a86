"""Processes that torchrun or srun starts: each of them reads the command line, and all must make one run of it."""

import os
from collections.abc import Sequence
from dataclasses import replace
from typing import Any, NamedTuple

from omegaconf import DictConfig

from memcomp_lightning.cli.arguments import CommandLine
from memcomp_lightning.errors import UserError


class Launched(NamedTuple):
    """The processes that a command was started in, each with the same command line.

    Attributes:
        by: What started them, for people.
        n: How many there are.
        n_nodes: On how many machines.
        rank: Number of this one, from 0.
    """

    by: str
    n: int
    n_nodes: int
    rank: int


def launched() -> Launched | None:
    """Read from the environment who started this process together with others; None if nobody did."""
    environ = os.environ
    if "TORCHELASTIC_RUN_ID" in environ:
        n, of_node = int(environ["WORLD_SIZE"]), int(environ["LOCAL_WORLD_SIZE"])
        found = Launched("torchrun", n, n // of_node, int(environ["RANK"]))
    elif "SLURM_PROCID" in environ and environ.get("SLURM_JOB_NAME") not in ("bash", "interactive"):
        n, n_nodes = int(environ.get("SLURM_NTASKS", "1")), int(environ.get("SLURM_NNODES", "1"))
        found = Launched("srun", n, n_nodes, int(environ["SLURM_PROCID"]))
    else:
        return None
    return found if found.n > 1 else None


def check_line(line: CommandLine) -> CommandLine:
    """Return the line as this process carries it out; only the first one writes Hydra's own files.

    Raises:
        UserError: Several processes would not find each other's folder, or would all start a sweep.
    """
    found = launched()
    if found is None or line.shows:
        return line
    if line.multirun:
        raise UserError(
            f"-m with {found.by}: each of its {found.n} processes would start the whole sweep. Start it once, "
            "with a launcher: hydra/launcher=submitit_slurm or hydra/launcher=joblib."
        )
    if line.value("hydra.run.dir") is None:
        raise UserError(
            f"{found.by} started {found.n} processes, which need one run folder that all of them see: add "
            "hydra.run.dir=FOLDER, on a disk that all nodes share."
        )
    if found.rank == 0:
        return line
    return replace(line, overrides=(*line.overrides, "hydra.output_subdir=null"))


def check_config(config: DictConfig) -> None:
    """Raise a UserError where the settings of a run are not for as many processes as were started."""
    found = launched()
    if found is None:
        return
    each = found.n // found.n_nodes
    given = {name: config.trainer.get(name) for name in ("devices", "num_nodes")}
    counts = tuple(map(_count, given.values()))
    if counts not in ((each, found.n_nodes), (None, found.n_nodes)):
        have = " ".join(f"trainer.{name}={value}" for name, value in given.items())
        raise UserError(
            f"{have} is not allowed: {found.by} started {found.n} processes on {found.n_nodes} nodes. Add "
            f"trainer.devices={each} trainer.num_nodes={found.n_nodes} trainer.strategy=ddp"
        )


def check_alone(what: str, remedy: str) -> None:
    """Raise a UserError where several processes were started for what one process does."""
    found = launched()
    if found is not None:
        raise UserError(f"{what} with {found.by}: each of its {found.n} processes would train all of it. {remedy}")


def _count(value: Any) -> int | None:
    """A number of devices; None where Lightning finds it."""
    if isinstance(value, int):
        return value
    if isinstance(value, str) and value.isdigit():
        return int(value)
    return len(value) if isinstance(value, Sequence) and not isinstance(value, str) else None
