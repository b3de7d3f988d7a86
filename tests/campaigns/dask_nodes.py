"""A figure on a Dask cluster of two workers of this machine, one of which dies in the middle.

``python tests/campaigns/dask_nodes.py --out FOLDER`` needs ``pip install distributed``. It starts a scheduler and
two workers (``dask scheduler``, ``dask worker``), spreads a figure of some trials over them by
``figure.workers=dask``, kills a worker while both train, and shows that the figure ends complete, and is that of
one process to the last bit.
"""

import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Mapping
from pathlib import Path

import ledger
from ray_nodes import ROOT, kill

PORT = 28786
FIGURE = [
    *("experiment=figure4", "figure/curves=none", "data=digits", "data.partitions=3", "figure.passes=[1,2]"),
    *(
        "figure.seeds=[0,1]",
        "figure.iterations=[100,150,200,250,300,350]",
        "solver.max_steps=20",
        "solver.n_restarts=3",
    ),
]
CASES = ("whole", "a worker dies")


def program(environment: Mapping[str, str], place: Path, name: str, *command: str) -> "subprocess.Popen[bytes]":
    with (place / f"{name}.log").open("wb") as log:
        return subprocess.Popen(
            [sys.executable, *command], env=environment, cwd=place, stdout=log, stderr=log, start_new_session=True
        )


def records(folder: Path) -> list[str]:
    """What was measured to the last bit, without the seconds that it took, in an order of its own."""
    file = folder / "records.jsonl"
    lines = file.read_text().splitlines(keepends=True) if file.exists() else []
    whole = [json.loads(line) for line in lines if line.endswith("\n")]  # another process may be writing
    return sorted(json.dumps({**record, "seconds": None}, sort_keys=True) for record in whole)


def spread(case: str, place: Path) -> ledger.Outcome:
    import distributed

    kind, findings = f"Dask {distributed.__version__}: {case}, the figure is that of one process", []
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"}
    train = ("-m", "memcomp_lightning.cli.train", *FIGURE)
    alone = program(environment, place, "alone", *train, "figure.workers=1", "hydra.run.dir=alone")
    alone.wait(ledger.HANGS_AFTER)
    expected = records(place / "alone")
    address = f"tcp://127.0.0.1:{PORT}"
    scheduler = program(
        environment, place, "scheduler", "-m", "dask", "scheduler", f"--port={PORT}", "--no-dashboard"
    )
    worker = ("-m", "dask", "worker", address, "--nworkers=1", "--nthreads=1", "--no-dashboard")
    workers = [program(environment, place, f"worker{k}", *worker) for k in (0, 1)]
    started = [scheduler, *workers]
    try:
        own = {**environment, "DASK_SCHEDULER_ADDRESS": address}
        figure = program(own, place, "figure", *train, "figure.workers=dask", "hydra.run.dir=figure")
        started.append(figure)

        def begun() -> bool:
            return figure.poll() is not None or 0 < len(records(place / "figure")) < len(expected)

        n_before = 0
        if case != "whole":
            ledger.wait_until(begun, "some trials are done and some are not")
            n_before = len(records(place / "figure"))
            kill(workers[1].pid)
        status = figure.wait(ledger.HANGS_AFTER)
        found = records(place / "figure")
        if alone.returncode != 0 or status != 0:
            said = (place / "figure.log").read_text()[-1000:] + (place / "alone.log").read_text()[-500:]
            findings.append(f"one process ended with {alone.returncode}, Dask with {status}: {said}")
        if not expected or found != expected:
            same = len({*found} & {*expected})
            findings.append(
                f"{same} of {len(expected)} records are those of one process, {len(found)} were written"
            )
        if case != "whole" and not 0 < n_before < len(expected):
            findings.append(
                f"the worker died when {n_before} of {len(expected)} trials were done: nothing is shown"
            )
        logs = [(place / f"worker{k}.log").read_text() for k in (0, 1)]
        facts: dict[str, float | str] = {"records": len(found), "when it died": n_before, "log": logs[1][-300:]}
        return ledger.Outcome(kind=kind, tried=len(expected), findings=findings, facts=facts)
    finally:
        for process in started:
            kill(process.pid)
            process.wait()


def attempt(case: str) -> ledger.Outcome:
    with tempfile.TemporaryDirectory() as place:
        return spread(case, Path(place))


def main() -> int:
    given = ledger.parser(__doc__, count=len(CASES), what="cases").parse_args()
    return ledger.run(given.out, CASES[: given.count], attempt, workers=1)


if __name__ == "__main__":
    sys.exit(main())
