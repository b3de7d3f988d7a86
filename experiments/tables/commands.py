"""Commands as people type them, each a process of its own whose time and memory are measured."""

import os
import subprocess
import sys
import time
from pathlib import Path
from typing import NamedTuple


class Used(NamedTuple):
    """What a process took.

    Attributes:
        seconds: On the wall.
        core_seconds: Of the processor, threads added.
        gibibytes: Most memory that it held.
        out: What it printed.
    """

    seconds: float
    core_seconds: float
    gibibytes: float
    out: str


def command(name: str, *arguments: str, folder: Path) -> Used:
    """Run ``memcomp-NAME`` in a folder.

    Raises:
        RuntimeError: It failed; with the last line of what it said.
    """
    line = [sys.executable, "-m", f"memcomp_lightning.cli.{name}", *arguments]
    begin = time.perf_counter()
    with (folder / f"{name}.log").open("w+") as said:
        process = subprocess.Popen(line, cwd=folder, stdout=said, stderr=subprocess.STDOUT)
        # Of this process alone: getrusage knows the largest of all children.
        _, status, used = os.wait4(process.pid, 0)
        process.returncode = os.waitstatus_to_exitcode(status)
        said.seek(0)
        out = said.read()
    seconds = time.perf_counter() - begin
    if process.returncode:
        raise RuntimeError(f"memcomp-{name} failed: {(out.strip().splitlines() or ['it said nothing'])[-1]}")
    return Used(seconds, used.ru_utime + used.ru_stime, used.ru_maxrss / 2**20, out)
