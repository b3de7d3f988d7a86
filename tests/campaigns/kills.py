"""Kills: SIGKILL at any moment of any kind of run, which goes on to the same bits.

``python tests/campaigns/kills.py --out FOLDER --count 1000``. A case is ``KIND/SEED``. The run is begun in a
folder of its own and killed, with all its processes, at a moment that the seed draws: after a share of the time
that an uninterrupted run takes, or just before one of its writes (a file opened for writing, renamed, removed; a
folder made). It is resumed, killed again perhaps, and resumed until it is done; then all that it left is compared
with what an uninterrupted run left, bit for bit but for times. One case in forty starts an interpreter anew.
"""

import json
import random
import shutil
import sys
import tempfile
from collections.abc import Sequence
from dataclasses import asdict
from functools import partial
from pathlib import Path

import ledger
from kinds_of_run import KINDS, Ended, Kind, difference, leftovers, live, typed
from ledger import Outcome

MOST_KILLS = 4
COLD_ONE_IN = 40


def whole(kind: Kind, folder: Path) -> tuple[Path, Ended]:
    """The folder and the course of an uninterrupted run, made once; two of them leave the same.

    Raises:
        RuntimeError: It does not end, or another one leaves something else.
    """
    place = folder / "whole" / kind.name
    told = place / "ended.json"
    if not told.exists():
        shutil.rmtree(place, ignore_errors=True)
        kind.prepare(place / "before")
        for name in ("first", "second"):  # the first one may compile kernels
            shutil.copytree(place / "before", place / name)
            ended = live(kind.command, kind.arguments, place / name, count_writes=True)
            if ended.status != 0:
                raise RuntimeError(f"{kind.name} ends with {ended.status}: {ended.err}")
        if (other := difference(place / "first", place / "second")) is not None:
            raise RuntimeError(f"{kind.name}: two uninterrupted runs differ: {other}")
        told.write_text(json.dumps(asdict(ended)))
    return place, Ended(**json.loads(told.read_text()))


def attempt(case: str, *, folder: Path) -> Outcome:
    """Kill a run, resume it until it is done, and compare."""
    name, _, seed = case.rpartition("/")
    kind, draws = KINDS[name], random.Random(case)
    place, ended = whole(kind, folder)
    own = Path(tempfile.mkdtemp(prefix="case_", dir=folder))
    try:
        shutil.copytree(place / "before", own / "here")
        kills, moments = 0, list[str]()
        cold = int(seed) % COLD_ONE_IN == 0
        command, arguments = kind.command, kind.arguments
        found: str | None = None
        for _ in range(1 + min(MOST_KILLS - 1, int(draws.expovariate(1.0)))):
            by_write = ended.writes > 0 and draws.random() < 0.5
            at, share = draws.randint(1, max(1, ended.writes)), draws.random()
            if by_write:
                moment = f"before write {at} of {ended.writes}"
                last = live(command, arguments, own / "here", at_write=at)
            else:
                moment = f"after {share:.3f} of {ended.seconds:.2f} s"
                seconds = share * (ended.seconds + (COLD_START if cold else 0.0))
                last = live(command, arguments, own / "here", signals=[(seconds, 9)], cold=cold)
            if last.status >= 0 and "overwrite=true" not in last.err:
                found = _refused(kind, last, own / "here")
                break
            if last.status >= 0:  # the rows are there: as the message says
                arguments = (*kind.arguments, "overwrite=true")
                continue
            kills += 1
            moments.append(moment)
            command, arguments = kind.goes_on(own / "here")
        else:
            last = live(command, arguments, own / "here")
            if last.status > 0 and "overwrite=true" in last.err:
                last = live(command, (*kind.arguments, "overwrite=true"), own / "here")
            found = _refused(kind, last, own / "here")
        what = "refused to go on" if found else "differed"
        found = found or difference(own / "here", place / "second")
        if found is None and (left := leftovers(own / "here")):
            what, found = "left", f"{len(left)} files that were not finished, such as {left[0]}"
        where = f"{name}, seed {seed}, killed {' and '.join(moments) or 'at no moment'}"
        said = [] if found is None else [f"{where}: {what}: {found}"]
        return Outcome(kind=name, tried=kills, findings=said, facts={"moments": "; ".join(moments)})
    finally:
        shutil.rmtree(own, ignore_errors=True)


COLD_START = 3.0
"""Seconds of the imports of an interpreter, about."""


def _refused(kind: Kind, last: Ended, folder: Path) -> str | None:
    """What a command said that did not go on to its end; None if it did."""
    if last.status == 0:
        return None
    return f"{typed(*kind.goes_on(folder))} ended with {last.status}: {last.said}"


def cases(count: int, kinds: Sequence[str] = tuple(KINDS)) -> list[str]:
    """So many cases, kinds in the shares of their weights, mixed, so that each beginning has some of all."""
    names = [name for name in kinds for _ in range(KINDS[name].weight)]
    random.Random(0).shuffle(names)
    return [f"{names[k % len(names)]}/{k}" for k in range(count)]


def main() -> int:
    arguments = ledger.parser(__doc__, count=1000, what="runs that are killed").parse_args()
    folder = arguments.out.resolve()
    folder.mkdir(parents=True, exist_ok=True)
    return ledger.run(folder, cases(arguments.count), partial(attempt, folder=folder), workers=arguments.workers)


if __name__ == "__main__":
    sys.exit(main())
