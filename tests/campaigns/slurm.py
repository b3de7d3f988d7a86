"""A sweep on a real Slurm cluster of one node with two slots, which this script sets up and takes down again.

``python tests/campaigns/slurm.py --out FOLDER`` (as root, with Debian's slurm-wlm and munge) shows that

* ``hydra/launcher=submitit_slurm`` runs the jobs of a sweep there, two at a time,
* a job that is requeued while it trains goes on from its checkpoint, to the bits of an uninterrupted run,
* after a job was cancelled the same command goes on with it, and repeats nothing else,
* all results stand in one table,
* two tasks of one job make one run.

Nothing of the system's own Slurm is touched: keys, sockets, ports and states are in a folder of their own.
"""

import csv
import json
import os
import secrets
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path

import ledger

ROOT = Path(__file__).parents[2]
"""Seconds after which something is given up."""

CONF = """\
ClusterName=memcomp
SlurmctldHost={host}(127.0.0.1)
SlurmctldPort=26817
SlurmdPort=26818
SlurmUser=root
AuthType=auth/munge
AuthInfo=socket={place}/munge/socket,cred_expire=5
CredType=cred/munge
StateSaveLocation={place}/state
SlurmdSpoolDir={place}/spool
SlurmctldPidFile={place}/slurmctld.pid
SlurmdPidFile={place}/slurmd.pid
ProctrackType=proctrack/linuxproc
TaskPlugin=task/none
MpiDefault=none
SelectType=select/cons_tres
SelectTypeParameters=CR_CPU
SchedulerParameters=sched_interval=1,batch_sched_delay=0
JobRequeue=1
KillWait=3
ReturnToService=2
AccountingStorageType=accounting_storage/none
JobAcctGatherType=jobacct_gather/none
NodeName={host} NodeAddr=127.0.0.1 CPUs=2 State=UNKNOWN
PartitionName=all Nodes={host} Default=YES MaxTime=INFINITE State=UP OverSubscribe=NO
"""

JOB = [
    "sampler=pcd",
    "callbacks=minimal",
    "logger=none",
    "preset=paper",
    "finetune.iterations=2",
    "checkpoint_every=5",
]
LONG = [*JOB, "pretrain.iterations=1500", "trainer.accelerator=cpu"]


MUNGE = {"key-file": "key", "socket": "socket", "pid-file": "pid", "log-file": "log", "seed-file": "seed"}
"""Files that munge would look for in the system's folders."""


@contextmanager
def cluster(place: Path) -> Iterator[Mapping[str, str]]:
    """Start munge, the controller and the node; yield the environment in which Slurm's commands find them."""
    missing = [name for name in ("munged", "slurmctld", "slurmd", "sbatch") if shutil.which(name) is None]
    if missing or os.geteuid() != 0:
        sys.exit(
            f"slurm.py needs root and {', '.join(missing) or 'nothing else'}: apt-get install slurm-wlm munge"
        )
    munge = place / "munge"
    for folder in (munge, place / "state", place / "spool"):
        folder.mkdir(parents=True)
        folder.chmod(0o755)
    place.chmod(0o755)
    key = munge / "key"
    key.write_bytes(secrets.token_bytes(128))
    key.chmod(0o400)
    host = os.uname().nodename.partition(".")[0]
    conf = place / "slurm.conf"
    conf.write_text(CONF.format(host=host, place=place))
    own = {"SLURM_CONF": str(conf), "OMP_NUM_THREADS": "1", "PYTHONPATH": str(ROOT)}
    environment = {**os.environ, **own}
    keys = [f"--{name}={munge}/{place}" for name, place in MUNGE.items()]
    daemons = [
        ("munged", "--foreground", "--force", "--num-threads=2", *keys),
        ("slurmctld", "-D", "-f", str(conf)),
        ("slurmd", "-D", "-f", str(conf), "-N", host),
    ]
    running: list[subprocess.Popen[bytes]] = []
    try:
        for daemon in daemons:
            with (place / f"{daemon[0]}.log").open("wb") as log:
                running.append(subprocess.Popen(daemon, stdout=log, stderr=log, env=environment))
            time.sleep(1)
        ledger.wait_until(lambda: "idle" in said(environment, "sinfo", "-h", "-o", "%t"), "the node is idle")
        yield environment
    finally:
        said(environment, "scancel", "--user=root", "--signal=KILL", "--full")
        said(environment, "scancel", "--user=root")
        time.sleep(1)
        for process in reversed(running):
            process.send_signal(signal.SIGTERM)
            process.wait(30)


def said(environment: Mapping[str, str], *command: str) -> str:
    """What a command of Slurm prints."""
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    return done.stdout + done.stderr


class Sweep:
    """A sweep of seeds, started as a user starts it."""

    def __init__(self, folder: Path, environment: Mapping[str, str], seeds: str, *more: str) -> None:
        self.folder, self.environment = folder, environment
        launcher = ["hydra/launcher=submitit_slurm", "hydra.launcher.cpus_per_task=1", "hydra.sweep.dir=sweep"]
        self.arguments = ["-m", *LONG, f"seed={seeds}", *launcher, *more]

    def start(self) -> "subprocess.Popen[str]":
        command = [sys.executable, "-m", "memcomp_lightning.cli.train", *self.arguments]
        pipe = subprocess.PIPE
        return subprocess.Popen(
            command,
            cwd=self.folder,
            env=self.environment,
            stdout=pipe,
            stderr=pipe,
            text=True,
            start_new_session=True,
            preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
        )

    def job(self, seed: int) -> Path:
        """The folder of a job."""
        found = list((self.folder / "sweep").glob(f"*,seed={seed},*"))
        return found[0] if found else self.folder / "none"

    def training(self, seed: int) -> bool:
        """Whether a job has a checkpoint to go on from."""
        return (self.job(seed) / "checkpoints/pretrain/last.ckpt").exists()

    def slurm_id(self, seed: int) -> str:
        """The number that Slurm has given to a job: which of the array it is says the order of the seeds."""
        lines = said(self.environment, "squeue", "-h", "-r", "-t", "R", "-o", "%i").split()
        return sorted(lines)[seed]

    def log(self, seed: int) -> str:
        return (self.job(seed) / "train.log").read_text()

    def finished(self) -> list[Path]:
        return sorted((self.folder / "sweep").glob("*/result.json"))


def table(folder: Path) -> list[dict[str, str]]:
    with (folder / "sweep/table.csv").open() as file:
        return list(csv.DictReader(file))


def requeued(folder: Path, environment: Mapping[str, str]) -> ledger.Outcome:
    """A job is sent back to the queue in the middle of its training."""
    import torch

    kind, findings = "a requeued job goes on from its checkpoint; one table", []
    sweep = Sweep(folder, environment, "0,1,2")
    process = sweep.start()
    ledger.wait_until(lambda: sweep.training(0) and sweep.training(1), "two jobs train side by side")
    time.sleep(1)
    job = sweep.slurm_id(1)
    said(environment, "scontrol", "requeue", job)
    out, err = process.communicate(timeout=ledger.HANGS_AFTER)
    if process.returncode != 0:
        findings.append(f"the sweep ended with {process.returncode}: {err[-1500:]}")
    if "Going on from" not in sweep.log(1) or "Going on from" in sweep.log(0):
        findings.append(f"job {job} began anew: {sweep.log(1)[-500:]}")
    if len(sweep.finished()) != 3 or [row["n_runs"] for row in table(folder)] != ["3"]:
        findings.append(f"the table does not hold three runs: {out[-800:]}")
    alone = [sys.executable, "-m", "memcomp_lightning.cli.train", *LONG, "seed=1", "hydra.run.dir=alone"]
    subprocess.run(alone, cwd=folder, env=environment, check=True, capture_output=True)
    for stage in ("pretrain", "finetune"):
        one, other = (
            torch.load(f / f"weights/{stage}.pt", weights_only=True) for f in (folder / "alone", sweep.job(1))
        )
        if not all(one[name].equal(other[name]) for name in one):
            findings.append(f"the weights of {stage} are not those of the run that was not interrupted")
    return ledger.Outcome(kind=kind, tried=3, findings=findings, facts={"said": out[-600:]})


def cancelled(folder: Path, environment: Mapping[str, str]) -> ledger.Outcome:
    """A job is cancelled; the command that waits for it is interrupted, and given once more as it says."""
    kind, findings = "after a job was cancelled the same command goes on with it alone", []
    sweep = Sweep(folder, environment, "0,1,2")
    process = sweep.start()
    ledger.wait_until(lambda: sweep.training(0) and sweep.training(1), "two jobs train side by side")
    said(environment, "scancel", sweep.slurm_id(0))
    ledger.wait_until(lambda: len(sweep.finished()) == 2, "the other jobs have finished")
    ledger.wait_until(lambda: not said(environment, "squeue", "-h").strip(), "no job is left")
    # This cluster keeps no accounts (sacct), from which submitit would know that a job was cancelled.
    os.killpg(process.pid, signal.SIGINT)
    out, err = process.communicate(timeout=ledger.HANGS_AFTER)
    said_first = err.strip().splitlines()[-1] if err.strip() else ""
    if process.returncode != 130 or "Go on with: memcomp-train --multirun" not in said_first:
        findings.append(f"the interrupted command ended with {process.returncode}: {err[-1500:]}")
    written = {path: path.stat().st_mtime_ns for path in sweep.finished()}
    process = sweep.start()
    out, err = process.communicate(timeout=ledger.HANGS_AFTER)
    if process.returncode != 0 or [row["n_runs"] for row in table(folder)] != ["3"]:
        findings.append(f"the second sweep ended with {process.returncode}: {(out + err)[-1500:]}")
    if any(path.stat().st_mtime_ns != when for path, when in written.items()):
        findings.append("a finished job was repeated")
    if "Going on from" not in sweep.log(0):
        findings.append(f"the cancelled job began anew: {sweep.log(0)[-500:]}")
    return ledger.Outcome(kind=kind, tried=3, findings=findings, facts={"said at first": said_first})


def started_by_srun(folder: Path, environment: Mapping[str, str]) -> ledger.Outcome:
    """Two tasks of one job make one run."""
    import torch

    kind, findings = "two tasks of srun train one run", []
    run = [*JOB, "pretrain.iterations=20", "trainer.accelerator=cpu", "hydra.run.dir=run"]
    command = [
        "srun",
        "-N1",
        "--ntasks-per-node=2",
        "--cpus-per-task=1",
        sys.executable,
        "-m",
        "memcomp_lightning.cli.train",
        *run,
    ]
    wrong = subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True, check=False)
    remedy = ["trainer.devices=2", "trainer.num_nodes=1", "trainer.strategy=ddp"]
    if wrong.returncode == 0 or f"Add {' '.join(remedy)}" not in wrong.stderr:
        findings.append(f"without the settings for two processes it is not refused: {wrong.stderr[-800:]}")
    done = subprocess.run(
        [*command, *remedy], cwd=folder, env=environment, capture_output=True, text=True, check=False
    )
    if done.returncode != 0 or done.stdout.count("test accuracy") != 1:
        findings.append(f"it ended with {done.returncode}: {(done.stdout + done.stderr)[-1500:]}")
    else:
        one = [sys.executable, "-m", "memcomp_lightning.cli.train", *run[:-1], "hydra.run.dir=one"]
        subprocess.run(one, cwd=folder, env=environment, check=True, capture_output=True)
        found = [torch.load(folder / name / "weights/pretrain.pt", weights_only=True) for name in ("run", "one")]
        if all(found[0][name].equal(found[1][name]) for name in found[0]):
            findings.append("the weights are those of one process with its chains: nothing was shared")
    return ledger.Outcome(kind=kind, findings=findings)


CASES = {"requeued": requeued, "cancelled": cancelled, "srun": started_by_srun}


def attempt(case: str) -> ledger.Outcome:
    with tempfile.TemporaryDirectory() as place:
        folder = Path(place) / "work"
        folder.mkdir()
        with cluster(Path(place) / "slurm") as environment:
            try:
                return CASES[case](folder, environment)
            finally:
                if "--keep" in sys.argv:
                    shutil.copytree(folder, "kept", dirs_exist_ok=True)


def main() -> int:
    lines = ledger.parser(__doc__, count=len(CASES), what="cases")
    lines.add_argument("--keep", action="store_true", help="copy the folders of the runs to ./kept")
    given = lines.parse_args()
    status = ledger.run(given.out, [*CASES][: given.count], attempt, workers=1)
    for line in ledger.read(given.out / "ledger.jsonl"):
        print(json.dumps(line["facts"], indent=1))
    return status


if __name__ == "__main__":
    sys.exit(main())
