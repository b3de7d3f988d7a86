"""Machines that are lost with their disks: runs go on from their copies in an object store, to the same bits.

``pip install s3fs 'moto[server]'``, then ``python tests/campaigns/object_store.py --out FOLDER --count 60``. A
case is ``KIND/SEED``, and has a server that speaks S3 (moto), with an empty bucket. The run is begun with
``copy_to=s3://runs/mine`` and killed, with all its processes, after a share of the time that an uninterrupted run
takes; its folder is removed. It goes on by ``resume=ADDRESS`` or by the same command, is killed again perhaps,
and goes on until it is done. Then the folder and the copy are compared with what an uninterrupted run left, bit
for bit but for times.
"""

import os
import random
import shutil
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from urllib.request import Request, urlopen

import fsspec
import ledger
from kinds_of_run import KINDS, Ended, Kind, difference, live, typed
from ledger import Outcome
from moto.server import ThreadedMotoServer

ADDRESS = "s3://runs/mine"
COPIED = ("copy_every=0.1", f"copy_to={ADDRESS}")
MOST_KILLS = 3

TRIED = ("greedy", "joint", "machine", "table with gaps, classes", "early stopping", "mode-assisted", "figure")


@contextmanager
def store() -> Iterator[dict[str, str]]:
    """A server with an empty bucket; the environment that leads to it."""
    server = ThreadedMotoServer(port=0, verbose=False)
    server.start()
    try:
        endpoint = f"http://127.0.0.1:{server.get_host_and_port()[1]}"
        found = {"AWS_ENDPOINT_URL": endpoint, "AWS_DEFAULT_REGION": "us-east-1"}
        found |= {"AWS_ACCESS_KEY_ID": "nobody", "AWS_SECRET_ACCESS_KEY": "nothing"}
        os.environ.update(found)
        urlopen(Request(f"{endpoint}/moto-api/reset", method="POST"))  # all servers of a process have one memory
        _files().mkdir("runs")
        yield found
    finally:
        server.stop()


def _files() -> fsspec.AbstractFileSystem:
    return fsspec.filesystem("s3", skip_instance_cache=True)


def begun(
    kind: Kind, folder: Path, environment: dict[str, str], seconds: float | None = None, *, resumes: bool = False
) -> Ended:
    """Begin a run, or go on with its copy; end it after some seconds, if it has not ended by then."""
    arguments = (*kind.arguments, *COPIED)
    if resumes and _files().exists(f"{ADDRESS}/overrides.json"):
        arguments = (f"resume={ADDRESS}", "hydra.run.dir=run", "copy_every=0.1")
    signals = [] if seconds is None else [(seconds, 9)]
    return live("train", arguments, folder, signals=signals, **environment)


def whole(kind: Kind, folder: Path) -> tuple[Path, float]:
    """What an uninterrupted run leaves, and its seconds; made once."""
    place = folder / "whole" / kind.name
    if not (place / "seconds").exists():
        shutil.rmtree(place, ignore_errors=True)
        kind.prepare(place / "before")
        for name in ("first", "second"):  # the first one may compile kernels
            shutil.copytree(place / "before", place / name)
            with store() as environment:
                ended = begun(kind, place / name, environment)
            if ended.status != 0:
                raise RuntimeError(f"{kind.name} ends with {ended.status}: {ended.err}")
        if (other := difference(place / "first", place / "second")) is not None:
            raise RuntimeError(f"{kind.name}: two uninterrupted runs differ: {other}")
        (place / "seconds").write_text(str(ended.seconds))
    return place, float((place / "seconds").read_text())


def attempt(case: str, *, folder: Path) -> Outcome:
    """Lose the machine, go on elsewhere until the run is done, and compare."""
    name, _, seed = case.rpartition("/")
    kind, draws = KINDS[name], random.Random(case)
    place, seconds = whole(kind, folder)
    own = Path(tempfile.mkdtemp(prefix="case_", dir=folder))
    lost, last, moments = 0, Ended(-9, "", "", 0.0), list[str]()
    try:
        with store() as environment:
            for number in range(1 + MOST_KILLS):
                here = own / f"machine{number}"
                shutil.copytree(place / "before", here)
                share, resumes = draws.random(), draws.random() < 0.5
                limit = None if number == MOST_KILLS else share * seconds
                last = begun(kind, here, environment, limit, resumes=resumes)
                if last.status >= 0:
                    break
                lost += 1
                moments.append(f"{share:.3f}")
                shutil.rmtree(here)
            said = f"{name}, seed {seed}, lost after {' and '.join(moments) or 'nothing'} of {seconds:.1f} s"
            found = None if last.status == 0 else f"{typed('train', kind.arguments)}: {last.said}"
            found = found or difference(here, place / "second")
            if found is None:
                _files().get(ADDRESS, str(own / "copy/run"), recursive=True)
                for beside in place.joinpath("before").iterdir():
                    shutil.copy(beside, own / "copy")
                found = difference(own / "copy", place / "second")
        return Outcome(kind=name, tried=lost, findings=[f"{said}: {found}"] if found else [])
    finally:
        shutil.rmtree(own, ignore_errors=True)


def main() -> int:
    arguments = ledger.parser(__doc__, count=60, what="runs whose machine is lost").parse_args()
    folder = arguments.out.resolve()
    folder.mkdir(parents=True, exist_ok=True)
    cases = [f"{TRIED[k % len(TRIED)]}/{k}" for k in range(arguments.count)]
    return ledger.run(folder, cases, partial(attempt, folder=folder), workers=1)


if __name__ == "__main__":
    sys.exit(main())
