"""Small runs of the commands, each in a folder and a process group of its own, and what they leave.

Programs are forks of a process that has imported the package (``tests/integration/warm.py``): most of the time of
a short one is that of its imports. What is forked is the command itself, as typed, from its first line to its end.
"""

import csv
import json
import os
import random
import re
import shlex
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch

ROOT = Path(__file__).resolve().parents[2]
sys.path.append(str(ROOT / "tests/integration"))

import running  # noqa: E402

# What is tried is the package of this tree.
os.environ["PYTHONPATH"] = os.pathsep.join(filter(None, [str(ROOT), os.environ.get("PYTHONPATH")]))

running.WARM.extend(f"memcomp_lightning.cli.commands.{name}" for name in ("sample",))

GIVEN_UP_AFTER = 300.0
"""Seconds; far more than any of these commands takes."""

START = """
import importlib, os, sys
from contextlib import suppress
with suppress(PermissionError):
    os.setsid()
last = int(os.environ.pop("KILLED_AT_WRITE", "0"))
told = os.environ.pop("WRITES_TOLD_IN", "")
ready = os.environ.pop("READY_TOLD_IN", "")
writes = 0

def count(event, arguments):
    global writes
    writing = event == "open" and (arguments[2] or 0) & (os.O_WRONLY | os.O_RDWR)
    if (writing or event in ("os.rename", "os.remove", "os.mkdir", "os.rmdir")) and os.getpid() == own:
        if not str(arguments[0]).startswith(("/dev", "/proc", "/sys")):
            writes += 1
            if writes == last:
                os.killpg(0, 9)

def tell():
    at = os.open(told, os.O_CREAT | os.O_WRONLY)
    os.write(at, str(writes).encode())

own = os.getpid()
if last or told:
    sys.addaudithook(count)
if told:
    import atexit
    atexit.register(tell)
for code in filter(None, [os.environ.pop("BEFORE_THE_COMMAND", "")]):
    exec(code)
module = importlib.import_module(f"memcomp_lightning.cli.{sys.argv[1]}")
sys.argv[:2] = [f"memcomp-{sys.argv[1]}"]
if ready:
    os.close(os.open(ready, os.O_CREAT | os.O_WRONLY))
module.main()
"""
"""What stands before a command: a process group of its own, and a count of its writes, at one of which it dies."""


@dataclass(frozen=True)
class Kind:
    """A kind of run.

    Attributes:
        name: Of the summary.
        command: ``train``, ``solve`` or ``sample``.
        arguments: What is typed; files that are written lie in ``run``.
        files: What lies in the folder before.
        before: A command whose results it needs, such as a trained run.
        resumes: Whether ``memcomp-train resume=run`` goes on; else the same command again.
        weight: How many of the cases it gets, beside others.
    """

    name: str
    command: str
    arguments: tuple[str, ...]
    files: tuple[tuple[str, str], ...] = ()
    before: "Kind | None" = None
    resumes: bool = False
    weight: int = 8

    def prepare(self, folder: Path) -> None:
        """Make the folder with all that the command needs."""
        folder.mkdir(parents=True, exist_ok=True)
        for name, text in self.files:
            (folder / name).parent.mkdir(exist_ok=True, parents=True)
            (folder / name).write_text(text)
        if self.before is not None:
            ended = live(self.before.command, self.before.arguments, folder)
            if ended.status != 0:
                raise RuntimeError(f"{self.before.name} did not end: {ended.err}")

    def goes_on(self, folder: Path) -> tuple[str, tuple[str, ...]]:
        """The command that goes on after an end that said nothing."""
        if self.resumes and (folder / "run/overrides.json").exists():
            return "train", ("resume=run",)
        return self.command, self.arguments


_TINY = ("callbacks=minimal", "logger=none", "checkpoint_every=1", "hydra.run.dir=run")
_BARS = (*_TINY, "data=shifting_bars", "data.source.copies=3", "sampler=pcd", "sampler.n_chains=7")
_SWEPT = (
    *("-m", *(o for o in _BARS[:-2] if "hydra" not in o), "sampler=cd,pcd", "hydra.sweep.dir=run"),
    *("model.hidden_sizes=[5,4]", "pretrain.iterations=4", "finetune.iterations=3"),
)
_SOLVE = ("problems", "seed=0,1", "solver.n_restarts=8", "--output", "run/results.csv")
_MACHINE = ("model=boltzmann", "model.n_hidden=3", "pretrain=boltzmann")
_TWO = ("model.hidden_sizes=[5,4]", "pretrain.iterations=8", "finetune.iterations=6")
_PEOPLE = "id,age,sex,colour,species\n" + "".join(
    f"{i},{20 + 7 * (i % 5) + i % 3},{'fm'[i % 2]},{['red', 'green', '', 'blue'][i % 4]},{['cat', 'dog'][i % 2]}\n"
    for i in range(60)
)
_TABLE = (*_TINY, "data=table", "data.path=people.csv", "model.hidden_sizes=[4]", "pretrain.iterations=6")
_RING = "9 9\n" + "".join(f"{i} {i % 9 + 1} {1 + i % 3}\n" for i in range(1, 10))
_PROBLEMS = (
    ("problems/ring.txt", _RING),
    ("problems/b.sparse", "3 3\n1 1 -3\n1 3 2\n2 3 -5\n"),
    ("problems/pairs.wcnf", "p wcnf 3 4 10\n10 1 2 0\n2 -1 0\n3 -2 0\n1 3 0\n"),
)
_FIGURE = (
    *("experiment=figure4", "figure/curves=none", "data=digits", "data.partitions=3", "figure.passes=[1,2]"),
    *("figure.seeds=[0]", "figure.iterations=[1,2]", "solver.max_steps=20", "solver.n_restarts=3"),
    "hydra.run.dir=run",
)
_WORTH = (
    *("experiment=sampler_worth", "worth.only=[shifting_bars]", "worth.data_sets.shifting_bars.passes=8"),
    *("+worth.data_sets.shifting_bars.methods=[cd1,mode_cd_exact]", "worth.claimed=[mode_cd_exact]"),
    *("worth.baselines=[cd1]", "worth.rates=[0.1,0.5]", "worth.methods.cd1.rates=[0.1,0.5]"),
    *("worth.replicas=3", "worth.choosing=2", "worth.points=4", "worth.workers=1", "hydra.run.dir=run"),
)
_DRAWS = random.Random(0)
_DENSITY = (
    *("experiment=density", "density.folder=tables", "density.tables=[small]", "density.only=[cd1,mode_cd]"),
    "density.axes={rate: [0.1, 0.2], l2: [0.001], hidden: [3], updates: [20]}",
    "density.start={rate: 0.1, l2: 0.001, hidden: 3, updates: 20}",
    *("density.replicas=2", "density.points=3", "density.workers=1", "pretrain.batch_size=20"),
    *("density.peers=null", "hydra.run.dir=run"),
)
_BITS = tuple(
    (
        f"tables/small.{part}.csv",
        "".join(",".join(str(_DRAWS.randint(0, 1)) for _ in range(5)) + "\n" for _ in range(n)),
    )
    for part, n in (("train", 60), ("valid", 20), ("test", 30))
)
_GAPS = Kind(
    "table with gaps",
    "train",
    (*_TABLE, "data.columns={species: ignore}", "finetune.iterations=0"),
    (("people.csv", _PEOPLE),),
    resumes=True,
)

KINDS = {
    kind.name: kind
    for kind in (
        Kind("greedy", "train", (*_BARS, *_TWO, "finetune.dropout=0.3"), resumes=True),
        Kind("joint", "train", (*_BARS, *_TWO, "pretrain=joint"), resumes=True),
        Kind(
            "machine",
            "train",
            (*_BARS, *_MACHINE, "finetune.iterations=0", "pretrain.iterations=12"),
            resumes=True,
        ),
        _GAPS,
        Kind(
            "table with gaps, classes",
            "train",
            (*_TABLE, "data.columns={label: species}", "finetune.iterations=6"),
            (("people.csv", _PEOPLE),),
            resumes=True,
        ),
        Kind(
            "early stopping",
            "train",
            (*_BARS, *_TWO, "data.validation_fraction=0.3", "finetune.patience=3", "finetune.iterations=30"),
            resumes=True,
        ),
        Kind(
            "mode-assisted",
            "train",
            (
                *(*_BARS[:6], *_TWO, "sampler=mode_assisted_pcd", "sampler.inner.n_chains=11"),
                *("sampler.schedule.p_max=0.5", "solver.n_restarts=3"),
            ),
            resumes=True,
        ),
        Kind("figure", "train", (*_FIGURE, "figure.workers=1"), resumes=True, weight=3),
        Kind("figure, 2 workers", "train", (*_FIGURE, "figure.workers=2"), resumes=True, weight=1),
        Kind("comparison of samplers", "train", _WORTH, resumes=True, weight=2),
        Kind("comparison of densities", "train", _DENSITY, _BITS, resumes=True, weight=2),
        Kind(
            "sweep",
            "train",
            _SWEPT,
            weight=3,
        ),
        Kind(
            "sweep by joblib",
            "train",
            (*_SWEPT, "hydra/launcher=joblib", "hydra.launcher.n_jobs=2"),
            weight=1,
        ),
        Kind(
            "solving",
            "solve",
            (*_SOLVE, "solver=best,annealing,dmm"),
            _PROBLEMS,
            weight=4,
        ),
        Kind(
            "solving, 2 workers",
            "solve",
            (*_SOLVE, "solver=best,annealing", "--workers", "2"),
            _PROBLEMS,
            weight=1,
        ),
        Kind("sampling", "sample", ("run", "n=200", "output=rows.csv"), _GAPS.files, before=_GAPS),
        Kind(
            "sampling and drawing",
            "sample",
            ("run", "n=200", "output=rows.csv", "data=people.csv", "figures=looks"),
            _GAPS.files,
            before=_GAPS,
        ),
    )
}


@dataclass(frozen=True)
class Ended:
    """How a command ended: its status, below 0 by a signal, what it said, how long it took."""

    status: int
    out: str
    err: str
    seconds: float
    writes: int = 0

    @property
    def said(self) -> str:
        """The last lines of what it said, in one."""
        return " / ".join((self.err or self.out).strip().splitlines()[-3:])[-400:]


def live(
    command: str,
    arguments: Sequence[str],
    folder: Path,
    *,
    signals: Sequence[tuple[float, int]] = (),
    at_write: int = 0,
    count_writes: bool = False,
    cold: bool = False,
    meanwhile: Callable[[Any], object] | None = None,
    **environment: str,
) -> Ended:
    """Run a command to its end, which may be that of a signal to its process group after some seconds.

    ``meanwhile`` is called with the program once its command has begun.
    """
    told, ready = (folder.parent / f".{folder.name}.{what}" for what in ("writes", "ready"))
    ready.unlink(missing_ok=True)
    own = {**environment, **({"KILLED_AT_WRITE": str(at_write)} if at_write else {})}
    own |= {"WRITES_TOLD_IN": str(told)} if count_writes else {}
    own |= {} if meanwhile is None else {"READY_TOLD_IN": str(ready)}
    begin = time.monotonic()
    program: Any
    if cold:
        program = subprocess.Popen(
            [sys.executable, "-c", START, command, *arguments],
            cwd=folder,
            env={**os.environ, "OMP_NUM_THREADS": running.THREADS, **own},
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )
    else:
        program = running.python("-c", START, command, *arguments, folder=folder, **own)
    timers = [threading.Timer(seconds, send, (program.pid, number)) for seconds, number in signals]
    for timer in timers:
        timer.start()
    if meanwhile is not None:
        until = time.monotonic() + GIVEN_UP_AFTER
        while not ready.exists() and time.monotonic() < until:
            time.sleep(0.002)
        meanwhile(program)
    try:
        out, err = program.communicate(timeout=GIVEN_UP_AFTER)
    finally:
        for timer in timers:
            timer.cancel()
        send(program.pid, signal.SIGKILL)  # whoever is left of the group
    writes = int(told.read_text()) if told.exists() else 0
    told.unlink(missing_ok=True)
    return Ended(int(program.returncode), out, err, time.monotonic() - begin, writes)


def send(leader: int, number: int) -> None:
    """Send a signal to a process group, or to its leader while it has none."""
    with suppress(ProcessLookupError, PermissionError):
        try:
            os.killpg(leader, number)
        except ProcessLookupError:
            os.kill(leader, number)


# ----------------------------------------------------------------------------------------------- what a run leaves

_TIMES = re.compile(r"wall_time(_s)?|us an update.*|seconds|curve|time_to_.*|sweeps_per_second|folder|run")
"""Names of what differs between two runs of the same."""

_NOT_COMPARED = re.compile(
    r".*\.(log|png|svg|pdf|html|writes)|events\.out.*|multirun\.yaml|people\.csv|problems|tables"
)

PARTIAL = re.compile(r"\..*\.partial")


def difference(folder: Path, whole: Path) -> str | None:
    """The first thing in which what a run left differs from what an uninterrupted one did; None if no bit does."""
    found, expected = (dict(_left(path)) for path in (folder, whole))
    for name in sorted(found.keys() ^ expected.keys()):
        return f"{name} is {'left over' if name in found else 'missing'}"
    for name in sorted(found):
        if (where := _differs(_content(found[name]), _content(expected[name]), name)) is not None:
            return where
    return None


def leftovers(folder: Path) -> list[str]:
    """Files that were begun and not finished."""
    return sorted(str(path.relative_to(folder)) for path in folder.rglob("*") if PARTIAL.fullmatch(path.name))


def _left(folder: Path) -> Iterator[tuple[str, Path]]:
    for path in folder.rglob("*"):
        parts = path.relative_to(folder).parts
        hidden = any(part.startswith(".") for part in parts)
        if path.is_file() and not hidden and not any(_NOT_COMPARED.fullmatch(part) for part in parts):
            yield "/".join(parts), path


def _content(path: Path) -> Any:
    if path.suffix in (".pt", ".ckpt"):
        return torch.load(path, weights_only=True)
    if path.suffix == ".json":
        return json.loads(path.read_text())
    if path.suffix == ".jsonl":
        records = [json.loads(line) for line in path.read_text().splitlines()]
        return {json.dumps(_named(record)): record for record in records} | {"records": len(records)}
    if path.suffix == ".csv":
        return list(csv.DictReader(path.read_text().splitlines()))
    return path.read_bytes()


def _named(record: dict[str, Any]) -> dict[str, Any]:
    return {name: value for name, value in record.items() if name not in ("seconds", "measures", "at")}


def _differs(found: Any, expected: Any, name: str) -> str | None:
    """Where two values differ, bit for bit, but for times."""
    if isinstance(expected, dict) and isinstance(found, dict):
        for key in sorted(found.keys() | expected.keys(), key=str):
            if _TIMES.fullmatch(str(key)):
                continue
            if key not in found or key not in expected:
                return f"{name}: {key} is {'left over' if key in found else 'missing'}"
            if (where := _differs(found[key], expected[key], f"{name}: {key}")) is not None:
                return where
        return None
    if isinstance(expected, list) and isinstance(found, list):
        if len(found) != len(expected):
            return f"{name} has {len(found)} entries, not {len(expected)}"
        pairs = enumerate(zip(found, expected, strict=True))
        return next((w for k, (a, b) in pairs if (w := _differs(a, b, f"{name}[{k}]")) is not None), None)
    if isinstance(expected, torch.Tensor) and isinstance(found, torch.Tensor):
        same = found.dtype == expected.dtype and found.shape == expected.shape and _bits(found) == _bits(expected)
        return None if same else f"{name}: a tensor of other values"
    same = type(found) is type(expected) and repr(found) == repr(expected)
    return None if same else f"{name} is {_short(found)}, not {_short(expected)}"


def _bits(tensor: torch.Tensor) -> bytes:
    return tensor.contiguous().numpy().tobytes()


def _short(value: object) -> str:
    return repr(value)[:80]


def typed(command: str, arguments: Sequence[str]) -> str:
    """A command as a person types it."""
    return shlex.join([f"memcomp-{command}", *arguments])
