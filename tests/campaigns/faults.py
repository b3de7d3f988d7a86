"""Faults of the machine: signals, memory, disks, clocks and folders. A run says what it lacked, and how to go on.

``python tests/campaigns/faults.py --out FOLDER --count 300``. A case is ``FAULT/KIND/SEED``. Nothing but the work
since the last checkpoint may be lost: the command that the message names is taken from it and run, and what it
leaves is compared with what an uninterrupted run left, bit for bit but for times. No message is a traceback.

Disks are small file systems in memory, which takes the rights to mount them; in ``disk at every page`` one grows
by 4 KiB with each attempt, so that it is full at one write after another. Memory is a limit of the address space.
The clock is that of Python's ``time.time``, which jumps back by a day; a fifth of the runs go on under
libfaketime, where that is installed.
"""

import random
import re
import shlex
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from functools import partial
from pathlib import Path
from typing import Any

import ledger
from kills import whole
from kinds_of_run import KINDS, Ended, Kind, difference, leftovers, live, send, typed
from ledger import Outcome

PAGE = 4096
A_DAY = 86400
MOST_ATTEMPTS = 200

LIMITED = """
import resource
pages = int(open("/proc/self/statm").read().split()[0])
resource.setrlimit(resource.RLIMIT_AS, (pages * 4096 + {0}, pages * 4096 + {0}))
"""

SET_BACK = """
import time
clock, began = time.time, time.monotonic()
time.time = lambda: clock() - {0} * (time.monotonic() - began > {1})
"""

FAKETIME = Path("/usr/lib/x86_64-linux-gnu/faketime/libfaketime.so.1")
"""Where Debian's libfaketime is, if it is installed."""

COMMAND = re.compile(r"Go on with: memcomp-(train|solve|sample) (.*)")


class Case:
    """A run in a folder of its own, with what was found of it."""

    def __init__(self, fault: str, kind: Kind, draws: random.Random, place: Path, ended: Ended, own: Path) -> None:
        self.kind, self.draws, self.place, self.ended = kind, draws, place, ended
        self.fault, self.here = fault, own / "here"
        self.command, self.arguments = kind.command, kind.arguments
        self.moment = "at no moment"
        self.findings: list[str] = []
        self.tried = 0

    def live(self, **settings: Any) -> Ended:
        """Run what is to be run now."""
        return live(self.command, self.arguments, self.here, **settings)

    def found(self, what: str) -> None:
        """Note what did not hold, with what it takes to see it again."""
        self.findings.append(f"{self.fault}, {self.kind.name}, {self.moment}: {what}")

    def heard(self, ended: Ended, *, statuses: Sequence[int] = (1, 2)) -> bool:
        """Read how a command ended, and what is to be run to go on; whether there is anything left to do."""
        if ended.status == 0:
            return False
        self.tried += 1
        said = f"it ended with {ended.status}: {ended.said}"
        if "Traceback" in ended.err + ended.out:
            self.found(f"a traceback: {said}")
        elif ended.status not in statuses:
            self.found(said)
        named = COMMAND.findall(ended.err + "\n" + ended.out)
        if named:
            self.command, self.arguments = named[-1][0], tuple(shlex.split(named[-1][1]))
        elif "Choose another" not in ended.err and "nothing was written" not in ended.err:
            self.found(f"no command that goes on is named: {said}")
            self.command, self.arguments = self.kind.goes_on(self.here)
        return True

    def goes_on(self) -> None:
        """Run what is named until it is done, and compare."""
        ended = self.live()
        if ended.status != 0 and self.kind.command == "sample" and "overwrite=true" in ended.err:
            self.arguments = (*self.arguments, "overwrite=true")
            ended = self.live()
        if ended.status != 0:
            self.found(f"{typed(self.command, self.arguments)} ended with {ended.status}: {ended.said}")
        elif (other := difference(self.here, self.place / "second")) is not None:
            self.found(f"after {typed(self.command, self.arguments)}: {other}")
        elif left := leftovers(self.here):
            self.found(f"{left[0]} was left")


def _after(case: Case, act: Callable[[Any], object]) -> Callable[[Any], None]:
    """Act after a share of the time that the run takes."""
    share = case.draws.random()
    case.moment = f"after {share:.3f} of {case.ended.seconds:.2f} s"

    def wait(program: Any) -> None:
        time.sleep(0.02 + share * case.ended.seconds)
        act(program)

    return wait


def _signal(numbers: Sequence[int], statuses: Sequence[int], case: Case) -> None:
    pause = case.draws.uniform(0.0, 0.5)

    def act(program: Any) -> None:
        for number in numbers:
            with suppress(ProcessLookupError, PermissionError):
                send(program.pid, number)
            time.sleep(pause if len(numbers) > 1 else 0.0)

    if case.heard(case.live(meanwhile=_after(case, act)), statuses=(*statuses, 2)):
        case.goes_on()


def _memory(case: Case) -> None:
    room = int(case.draws.uniform(0, 40)) * 2**20
    case.moment = f"with {room >> 20} MiB more than at its start"
    if case.heard(case.live(BEFORE_THE_COMMAND=LIMITED.format(room))):
        case.goes_on()


@contextmanager
def _disk(folder: Path, size: int) -> Iterator[Callable[[int], None]]:
    """A file system of some bytes in place of a folder, with its files; yield what changes its size."""
    before = folder.with_name("before_the_disk")
    folder.rename(before)
    folder.mkdir()
    options = f"size={size},huge=never"
    subprocess.run(["mount", "-t", "tmpfs", "-o", options, "tmpfs", str(folder)], check=True)

    def resize(n: int) -> None:
        subprocess.run(["mount", "-o", f"remount,size={n}", str(folder)], check=True)

    try:
        shutil.copytree(before, folder, dirs_exist_ok=True)
        yield resize
    finally:
        subprocess.run(["umount", "-l", str(folder)], check=True)


def _pages(folder: Path) -> int:
    """Of its files, about."""
    return sum(-(-path.stat().st_size // PAGE) for path in folder.rglob("*") if path.is_file())


def _disk_full(case: Case) -> None:
    begun, most = _pages(case.here), _pages(case.place / "second")
    pages = case.draws.randint(begun + 1, most + 2)
    case.moment = f"with {pages - begun} free pages of the {most - begun} it needs"
    with _disk(case.here, pages * PAGE) as resize:
        goes = case.heard(case.live())
        resize(2**26)
        if goes:
            case.goes_on()


def _disk_at_every_page(case: Case) -> None:
    pages = _pages(case.here) + 1
    with _disk(case.here, pages * PAGE) as resize:
        for number in range(MOST_ATTEMPTS):
            case.moment = f"attempt {number}, with {pages + number} pages"
            if not case.heard(case.live()) or case.findings:
                break
            resize((pages + number + 1) * PAGE)
        else:
            case.found("it did not end")
        if not case.findings and (other := difference(case.here, case.place / "second")) is not None:
            case.found(other)


def _vanishes(case: Case) -> None:
    """What it writes into is moved away, as when a disk is taken out, and comes back later."""
    names = [path.name for path in (case.place / "second").iterdir() if path.name == "run"]
    away = case.here.with_name("away")

    away.mkdir()

    def act(program: Any) -> None:
        until = time.monotonic() + 10 * case.ended.seconds
        while not any((case.here / "run").rglob("*.*")) and time.monotonic() < until:
            time.sleep(0.002)
        time.sleep(case.draws.random() * case.ended.seconds / 2)
        for name in names:
            with suppress(FileNotFoundError):
                (case.here / name).rename(away / name)

    case.moment = "after its folder was made"
    goes = case.heard(ended := case.live(meanwhile=act))
    for path in away.iterdir():
        if (case.here / path.name).exists():  # what was begun there by one that did not end well is thrown away
            if ended.status == 0 and (other := difference(case.here, case.place / "second")) is not None:
                case.found(f"it did not miss its folder, made it anew, and ended well: {other}")
            shutil.rmtree(case.here / path.name)
        path.rename(case.here / path.name)
    if goes:
        case.goes_on()


def _two_days_ago(case: Case) -> dict[str, Any]:
    """Settings of a program whose clock is that of two days ago: Python's, or in a few cases all of it."""
    if FAKETIME.exists() and case.draws.random() < 0.2:
        faked = {"LD_PRELOAD": str(FAKETIME), "FAKETIME": "-2d", "FAKETIME_DONT_FAKE_MONOTONIC": "1"}
        return {"cold": True, **faked}
    return {"BEFORE_THE_COMMAND": SET_BACK.format(2 * A_DAY, -1)}


def _clock(case: Case) -> None:
    """The clock jumps back while it runs; it is killed, and goes on a day before it began."""
    at = case.draws.random() * case.ended.seconds
    case.moment = f"set back after {at:.2f} s"
    if case.live(BEFORE_THE_COMMAND=SET_BACK.format(A_DAY, at), signals=[(2 * at, 9)]).status != 0:
        case.command, case.arguments = case.kind.goes_on(case.here)
        before = case.live(**_two_days_ago(case))
        if before.status != 0 and "overwrite=true" not in before.err:
            case.found(f"it ended with {before.status}: {before.said}")
    case.tried = 1
    if (other := difference(case.here, case.place / "second")) is not None:
        case.found(other)


FAULTS: dict[str, Callable[[Case], None]] = {
    "SIGTERM": partial(_signal, (15,), (143,)),
    "SIGINT": partial(_signal, (2,), (130,)),
    "SIGINT twice": partial(_signal, (2, 2), (130,)),
    "SIGTERM, then SIGINT": partial(_signal, (15, 2), (143, 130)),
    "memory": _memory,
    "disk full": _disk_full,
    "disk at every page": _disk_at_every_page,
    "folder vanishes": _vanishes,
    "clock set back": _clock,
}

AT_EVERY_PAGE = ("greedy", "table with gaps, classes", "solving", "sampling")
WITHOUT_FOLDER = ("sampling", "sampling and drawing")
"""Kinds that write no folder that could vanish."""


def attempt(case: str, *, folder: Path) -> Outcome:
    """Let a fault come over a run, go on as its message says, and compare."""
    fault, name, seed = case.split("/")
    kind, draws = KINDS[name], random.Random(case)
    place, ended = whole(kind, folder)
    own = Path(tempfile.mkdtemp(prefix="case_", dir=folder))
    try:
        shutil.copytree(place / "before", own / "here")
        tried = Case(f"{fault}, seed {seed}", kind, draws, place, ended, own)
        FAULTS[fault](tried)
        return Outcome(kind=fault, tried=tried.tried, findings=tried.findings, facts={"moment": tried.moment})
    finally:
        shutil.rmtree(own, ignore_errors=True)


def cases(count: int) -> list[str]:
    """So many cases, faults in turn and kinds by their weights, but few of those that take many attempts."""
    names = [kind.name for kind in KINDS.values() for _ in range(kind.weight)]
    draws, found = random.Random(0), list[str]()
    every = [f"disk at every page/{kind}/0" for kind in AT_EVERY_PAGE]
    faults = [fault for fault in FAULTS if fault != "disk at every page"]
    while len(found) < count - len(every):
        fault, kind = faults[len(found) % len(faults)], draws.choice(names)
        if fault != "folder vanishes" or kind not in WITHOUT_FOLDER:
            found.append(f"{fault}/{kind}/{len(found)}")
    return [*found, *every][:count]


def main() -> int:
    arguments = ledger.parser(__doc__, count=300, what="faults").parse_args()
    folder = arguments.out.resolve()
    folder.mkdir(parents=True, exist_ok=True)
    return ledger.run(folder, cases(arguments.count), partial(attempt, folder=folder), workers=arguments.workers)


if __name__ == "__main__":
    sys.exit(main())
