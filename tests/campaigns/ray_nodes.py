"""A sweep on a Ray cluster of two nodes of this machine, one of which dies in the middle.

``python tests/campaigns/ray_nodes.py --out FOLDER`` needs ``pip install ray hydra-ray-launcher``. It starts Ray
twice (``ray start``), runs ``hydra/launcher=ray`` over four jobs, kills the second node and its jobs while both
train, and shows that the sweep ends with all four results, the lost job from its checkpoint.
"""

import csv
import os
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path

import ledger

ROOT = Path(__file__).parents[2]
PORT = 26379
SEEDS = (0, 1, 2, 3)
JOB = [
    *("sampler=pcd", "callbacks=minimal", "logger=none", "preset=paper", "pretrain.iterations=1500"),
    *("finetune.iterations=2", "checkpoint_every=5", "trainer.accelerator=cpu"),
]


def node(environment: Mapping[str, str], place: Path, *where: str) -> "subprocess.Popen[bytes]":
    """Start a node of one core, whose processes are of one session."""
    command = [sys.executable, "-m", "ray.scripts.scripts", "start", "--block", "--num-cpus=1", *where]
    with (place / f"node{len(list(place.glob('node*')))}.log").open("wb") as log:
        return subprocess.Popen(command, env=environment, stdout=log, stderr=log, start_new_session=True)


def below(pid: int) -> list[int]:
    """A process and all that came of it."""
    lines = subprocess.run(
        ["ps", "-eo", "pid=,ppid="], capture_output=True, text=True, check=True
    ).stdout.splitlines()
    pairs = [tuple(map(int, line.split())) for line in lines]
    found = [pid]
    for parent in found:
        found += [child for child, its in pairs if its == parent]
    return found


def kill(pid: int) -> None:
    for process in below(pid):
        with suppress(ProcessLookupError):
            os.kill(process, signal.SIGKILL)


def node_dies(place: Path) -> ledger.Outcome:
    import ray

    kind, findings = f"Ray {ray.__version__}: a node dies, the sweep ends complete", []
    own = {"PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1", "RAY_AUTH_MODE": "disabled"}
    environment = {**os.environ, **own, "RAY_TMPDIR": str(place / "ray")}
    (place / "ray").mkdir()
    head = node(environment, place, "--head", f"--port={PORT}", "--include-dashboard=false")
    time.sleep(10)
    second = node(environment, place, f"--address=127.0.0.1:{PORT}")
    try:
        time.sleep(8)
        launcher = ["hydra/launcher=ray", f"hydra.launcher.ray.init.address=127.0.0.1:{PORT}"]
        # The launcher gives the store a size, which Ray does not take from who joins a cluster.
        launcher += ["+hydra.launcher.ray.init.object_store_memory=null", f"hydra.sweep.dir={place}/sweep"]
        seeds = f"seed={','.join(map(str, SEEDS))}"
        command = [sys.executable, "-m", "memcomp_lightning.cli.train", "-m", *JOB, seeds, *launcher]
        pipe = subprocess.PIPE
        sweep = subprocess.Popen(
            command, cwd=place, env=environment, stdout=pipe, stderr=subprocess.STDOUT, text=True
        )

        def training() -> list[Path]:
            return list((place / "sweep").glob("*/checkpoints/pretrain/last.ckpt"))

        ledger.wait_until(lambda: len(training()) == 2 or sweep.poll() is not None, "both nodes train")
        time.sleep(1)
        kill(second.pid)
        out, _ = sweep.communicate(timeout=ledger.HANGS_AFTER)
        table = place / "sweep/table.csv"
        lines = table.read_text().splitlines() if table.exists() else []
        rows = [row["n_runs"] for row in csv.DictReader(lines)]
        logs = [path.read_text() for path in (place / "sweep").glob("*/train.log")]
        went_on = sum("Going on from" in text for text in logs)
        if sweep.returncode != 0 or rows != [str(len(SEEDS))]:
            findings.append(f"the sweep ended with {sweep.returncode}, its table holds {rows} runs: {out[-1500:]}")
        if went_on != 1:
            findings.append(f"{went_on} jobs went on from a checkpoint, not the one that was lost")
        if list((place / "sweep").rglob(".lock*")):
            findings.append("a lock is left")
        return ledger.Outcome(kind=kind, tried=len(SEEDS), findings=findings, facts={"said": out[-600:]})
    finally:
        for process in (head, second):
            kill(process.pid)
            process.wait()


def attempt(_: str) -> ledger.Outcome:
    with tempfile.TemporaryDirectory(prefix="r") as place:  # Ray's sockets need short names
        return node_dies(Path(place))


def main() -> int:
    given = ledger.parser(__doc__, count=1, what="cases").parse_args()
    return ledger.run(given.out, ["a node dies"][: given.count], attempt, workers=1)


if __name__ == "__main__":
    sys.exit(main())
