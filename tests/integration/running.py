"""What the integration tests share: quick settings, the outcome of a run, real processes."""

import json
import os
import signal
import socket
import subprocess
import sys
import threading
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import TextIO

THREADS = os.environ.get("MEMCOMP_THREADS", "1")
"""Of every process, as in this one: the last bits depend on their number."""

HANGS_AFTER = 900
"""Seconds after which a process is given up; far more than it takes on a busy machine."""

QUIET = ["callbacks=minimal", "logger=none"]
"""Half of the time of a small run is that of its pictures."""

FAST = [
    *(*QUIET, "preset=paper", "pretrain.iterations=2", "finetune.iterations=2"),
    *("solver.max_steps=20", "solver.n_restarts=5"),
]
"""Few updates: those of the paper are of all images."""

LOGGED = [*FAST, "callbacks=default", "logger=tensorboard"]

# D-Wave's own mock of a Pegasus annealer, with a few qubits missing, in place of the service.
MOCK_QPU = (
    "sampler.sampler.qpu={_target_:dwave.system.testing.MockDWaveSampler,topology_type:pegasus,topology_shape:[6],"
    "broken_nodes:[33,108,402],parameter_warnings:false,exact_solver_cutoff:0}"
)


WARM = [f"memcomp_lightning.cli.{name}" for name in ("train", "commands.train", "commands.solve")]
"""What a program need not import again, with all that these import: most of the time of a short one."""


@dataclass(frozen=True)
class Outcome:
    status: int
    out: str
    err: str


class Program:
    """A running program, to be used like ``subprocess.Popen``."""

    def __init__(
        self,
        arguments: Sequence[str],
        folder: Path,
        environment: Mapping[str, str],
        interpreter: str = sys.executable,
    ) -> None:
        (self.stdout, out), (self.stderr, err), (self._told, tell) = _pipe(), _pipe(), _pipe()
        message = json.dumps((list(arguments), str(folder), dict(environment))).encode()
        with Path(os.devnull).open() as nothing:
            socket.send_fds(_warm_python(interpreter), [message], [nothing.fileno(), out, err, tell])
        for descriptor in (out, err, tell):
            os.close(descriptor)
        self.pid = int(self._told.readline())
        self.returncode: int | None = None

    def send_signal(self, number: int) -> None:
        os.kill(self.pid, number)

    def communicate(self, timeout: float = HANGS_AFTER) -> tuple[str, str]:
        """Wait for its end; return what it wrote."""
        give_up = threading.Timer(timeout, self.send_signal, [signal.SIGKILL])
        give_up.start()
        try:
            with ThreadPoolExecutor() as pool:
                out, err = pool.map(lambda stream: stream.read(), (self.stdout, self.stderr))
            self.returncode = int(self._told.readline())
        finally:
            give_up.cancel()
            for stream in (self.stdout, self.stderr, self._told):
                stream.close()
        return out, err


def _pipe() -> tuple[TextIO, int]:
    read, write = os.pipe()
    return os.fdopen(read), write


_warm: "dict[str, tuple[socket.socket, subprocess.Popen[bytes]]]" = {}
"""Of each interpreter, where programs are asked for, and the process that starts them."""


def _warm_python(interpreter: str) -> socket.socket:
    if interpreter not in _warm:
        ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        script = Path(__file__).with_name("warm.py")
        environment = {**os.environ, "OMP_NUM_THREADS": THREADS}
        if interpreter != sys.executable:  # what is installed there
            environment.pop("PYTHONPATH", None)
        process = subprocess.Popen(
            [interpreter, script, str(theirs.fileno()), *WARM],
            env=environment,
            pass_fds=[theirs.fileno()],
        )
        theirs.close()
        _warm[interpreter] = ours, process
    return _warm[interpreter][0]


def end_warm_pythons() -> None:
    while _warm:
        ours, process = _warm.popitem()[1]
        ours.close()
        process.wait()


def python(*arguments: str, folder: Path, **environment: str) -> Program:
    """Start ``python ARGUMENTS``; torch, Lightning and this package are imported already."""
    return Program(arguments, folder, {**os.environ, "OMP_NUM_THREADS": THREADS, **environment})


def launch(*arguments: str, folder: Path, command: str = "train") -> Program:
    """Start a command as a process of its own."""
    return python("-m", f"memcomp_lightning.cli.{command}", *arguments, folder=folder)
