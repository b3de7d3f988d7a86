"""Training on two nodes: two network namespaces of one machine, a pair of virtual cards, torchrun in each.

``python tests/campaigns/two_nodes.py --out FOLDER`` (as root, which namespaces need) shows that

* the update of several processes is that of one,
* a node that dies or falls silent is named, and the same command goes on,
* bytes and messages of an update are those that the model of their cost says: what the collective operations carry
  is counted in the process, and what the wire carries by the card.

``--predict`` prints the model's table for more nodes and does nothing else. A ledger in FOLDER keeps what was
tried.
"""

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import ledger

ROOT = Path(__file__).parents[2]
NODES = ("a", "b")
ADDRESS = {"a": "10.77.0.1", "b": "10.77.0.2"}
PORT = 29511
HANGS_AFTER = 240
"""Seconds after which a run is given up."""

WORKER = Path(__file__).with_name("two_nodes_worker.py")
MODELS = ("cd", "pcd", "mode_assisted", "categories", "shared table")
COSTS = ("cd 784x500", "pcd 784x500", "ground_state 784x500", "cd 784x4096")


# ------------------------------------------------------------------------------------------------------- the nodes


def ip(*arguments: str, check: bool = True) -> None:
    subprocess.run(["ip", *arguments], check=check, capture_output=not check)


@contextmanager
def two_nodes() -> Iterator[None]:
    """Two namespaces, each with a card of its own at the two ends of one wire."""
    for node in NODES:
        ip("netns", "del", f"memcomp-{node}", check=False)
    try:
        for node in NODES:
            ip("netns", "add", f"memcomp-{node}")
        ip("link", "add", "va", "netns", "memcomp-a", "type", "veth", "peer", "name", "vb", "netns", "memcomp-b")
        for node in NODES:
            ip("-n", f"memcomp-{node}", "addr", "add", f"{ADDRESS[node]}/24", "dev", f"v{node}")
            ip("-n", f"memcomp-{node}", "link", "set", "lo", "up")
            ip("-n", f"memcomp-{node}", "link", "set", f"v{node}", "up")
        yield
    finally:
        for node in NODES:
            ip("netns", "del", f"memcomp-{node}", check=False)


def torchrun(node: str, each: int, log: Path, *program: str, **environment: str) -> "subprocess.Popen[bytes]":
    """Start a node's processes, ``each`` of them, in its namespace, under a host name of its own."""
    begin = f'hostname node-{node} && exec "$@"'
    command = [
        *("ip", "netns", "exec", f"memcomp-{node}", "unshare", "--uts", "sh", "-c", begin, "sh"),
        *(sys.executable, "-m", "torch.distributed.run", "--nnodes=2", f"--nproc-per-node={each}"),
        *(f"--node-rank={NODES.index(node)}", f"--master-addr={ADDRESS['a']}", f"--master-port={PORT}"),
        *program,
    ]
    own = {"GLOO_SOCKET_IFNAME": f"v{node}", "OMP_NUM_THREADS": "1", "PYTHONPATH": str(ROOT), **environment}
    with log.open("wb") as out:
        return subprocess.Popen(
            command, env={**os.environ, **own}, stdout=out, stderr=out, cwd=log.parent, start_new_session=True
        )


def pids(node: str) -> list[int]:
    """The processes that run in a namespace."""
    found = subprocess.run(["ip", "netns", "pids", f"memcomp-{node}"], capture_output=True, text=True, check=False)
    return [int(pid) for pid in found.stdout.split()]


def kill(node: str) -> None:
    """What a power cut does to a node's processes."""
    for pid in pids(node):
        with suppress(ProcessLookupError):
            os.kill(pid, signal.SIGKILL)


def ended(*processes: "subprocess.Popen[bytes]") -> list[int]:
    """Wait for both nodes; a node that hangs is killed, and has the status -9."""
    until = time.monotonic() + HANGS_AFTER
    for process in processes:
        with suppress(subprocess.TimeoutExpired):
            process.wait(max(0.1, until - time.monotonic()))
    for node in NODES:
        kill(node)
    return [process.wait() for process in processes]


def on_both(folder: Path, each: int, *program: str, **environment: str) -> list[str]:
    """Run a program on both nodes to its end; return what did not go well."""
    processes = [torchrun(node, each, folder / f"{node}.log", *program, **environment) for node in NODES]
    status = ended(*processes)
    return [
        f"node-{node} ended with {code}: {(folder / f'{node}.log').read_text()[-500:]}"
        for node, code in zip(NODES, status, strict=True)
        if code != 0
    ]


# ------------------------------------------------------------------------------------------------------- the cases


def update(model: str, n: int, folder: Path) -> ledger.Outcome:
    """Whether n processes on two nodes get the weights that one process gets from the same rows and chains."""
    kind = f"update of {n} processes: {model}"
    one = [sys.executable, str(WORKER), "alone", model, str(n), "one.pt"]
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"}
    alone = subprocess.run(one, cwd=folder, env=environment, capture_output=True, text=True, check=False)
    findings = [alone.stderr[-500:]] if alone.returncode else []
    findings += on_both(folder, n // 2, str(WORKER), "together", model, str(n), "several.pt")
    if findings:
        return ledger.Outcome(kind=kind, findings=findings)
    import torch

    facts: dict[str, float | str] = {}
    expected, found = (torch.load(folder / name, weights_only=True) for name in ("one.pt", "several.pt"))
    for precision, tolerance in (("32-true", 1e-5), ("64-true", 1e-12)):
        pairs = [(expected[precision][name], tensor) for name, tensor in found[precision].items()]
        moved = max(
            float((tensor - expected["begin"][name]).abs().max()) for name, tensor in found[precision].items()
        )
        apart = max(float((a - b).abs().max()) for a, b in pairs)
        facts |= {f"apart, {precision}": apart, f"moved, {precision}": moved}
        if not apart < tolerance * moved:
            findings.append(
                f"{precision}: {apart:.2g} apart after {expected['updates']} updates that moved {moved:.2g}"
            )
    return ledger.Outcome(kind=kind, findings=findings, facts=facts)


def cost(case: str, n: int, folder: Path) -> ledger.Outcome:
    """Whether bytes and messages of an update are those of the model of the cost."""
    sampler, size = case.split()
    kind = f"cost of an update of {n} processes: {sampler} {size}"
    program = [str(WORKER), "count", sampler, size, str(n), "count.json"]
    if n == 1:
        environment = {**os.environ, "PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"}
        done = subprocess.run(
            [sys.executable, *program], cwd=folder, env=environment, capture_output=True, check=False
        )
        findings = [done.stderr.decode()[-500:]] if done.returncode else []
    else:
        findings = on_both(folder, n // 2, *program)
    if findings:
        return ledger.Outcome(kind=kind, findings=findings)
    counted = json.loads((folder / "count.json").read_text())
    n_visible, n_hidden = map(int, size.split("x"))
    expected = Cost.of(n_visible, n_hidden, shared=sampler == "ground_state")
    facts: dict[str, float | str] = {**counted["facts"], "by name": json.dumps(counted["by_name"])}
    if n > 1:
        wire = expected.on_the_wire(n)
        facts |= {"bytes by the model": expected.payload, "bytes on the wire by the model": wire}
        for what, should, is_, within in (
            ("collective operations", expected.operations, counted["facts"]["operations"], 0),
            ("bytes that they carry", expected.payload, counted["facts"]["bytes"], 0.002),
            ("bytes that node a sends", wire, counted["facts"]["sent"], 0.05),
        ):
            if abs(is_ - should) > within * should:
                findings.append(f"{what} an update: {is_:,.1f}, by the model {should:,.1f}")
    elif counted["facts"]["operations"] or counted["facts"]["bytes"]:
        findings.append("a process alone sends something")
    return ledger.Outcome(kind=kind, findings=findings, facts=facts)


@dataclass(frozen=True)
class Cost:
    """What an update of an RBM sends, in single precision with the centred gradient, whatever the number of rows.

    Attributes:
        gradient: Bytes of the gradient: of all parameters of the stage.
        offsets: Bytes of the centres of the units, and of how much they count.
        gap: Bytes of the energy gap.
        answer: Bytes that the first process sends to all others, of a sampler that answers for all of them.
        signal: Bytes by which Lightning lets the first process tell the others that it has been asked to end.
    """

    gradient: int
    offsets: int
    gap: int = 4
    answer: int = 0
    signal: int = 8

    @classmethod
    def of(cls, n_visible: int, n_hidden: int, *, shared: bool = False) -> "Cost":
        units = n_visible + n_hidden
        return cls(
            4 * (n_visible * n_hidden + units), 4 * (units + 1), answer=8 * units + PICKLED if shared else 0
        )

    @property
    def operations(self) -> int:
        """Collective operations: gradient, centres, gap, signal; the size of an answer, and the answer."""
        return 6 if self.answer else 4

    @property
    def payload(self) -> int:
        """Bytes that go into them in each process."""
        return self.gradient + self.offsets + self.gap + self.signal + self.answer

    def on_the_wire(self, n: int) -> float:
        """Bytes that a process sends to the next one of the ring in which gloo adds up, the first one's others."""
        return 2 * (n - 1) / n * (self.gradient + self.offsets + self.gap) + self.signal + self.answer

    def seconds(self, n: int, *, latency: float, rate: float) -> float:
        """How long an update waits: 2 (n - 1) steps around the ring for each of three sums, and for the bytes."""
        return 3 * 2 * (n - 1) * latency + self.on_the_wire(n) / rate


PICKLED = 2014
"""Bytes that Python's way of writing objects adds to an answer, which it holds twice, and the size before it."""


TRAINING = [
    *("sampler=pcd", "callbacks=minimal", "logger=none", "preset=paper", "finetune.iterations=2"),
    *("trainer.num_nodes=2", "trainer.accelerator=cpu", "checkpoint_every=5", "hydra.run.dir=run"),
]
QUICK = "{_target_:lightning.pytorch.strategies.DDPStrategy,timeout:{_target_:datetime.timedelta,seconds:15}}"


def death(how: str, folder: Path) -> ledger.Outcome:
    """Whether the other node names the one that is lost, and the same command then ends with the same bits."""
    program = [
        "-m",
        "memcomp_lightning.cli.train",
        *TRAINING,
        f"trainer.strategy={QUICK}",
        "pretrain.iterations=400",
    ]
    kind, findings = f"a node {how}, the other names it, the run goes on", []
    whole, cut = folder / "whole", folder / "cut"
    whole.mkdir()
    cut.mkdir()
    findings += on_both(whole, 1, *program)
    processes = [torchrun(node, 1, cut / f"{node}.log", *program) for node in NODES]
    checkpoint = cut / "run/checkpoints/pretrain/last.ckpt"
    until = time.monotonic() + HANGS_AFTER
    while not checkpoint.exists() and time.monotonic() < until:
        time.sleep(0.02)
    time.sleep(0.2)
    if how == "dies":
        kill("b")
        named = ADDRESS["b"]
    else:
        ip("-n", "memcomp-b", "link", "set", "vb", "down")
        named = "node-b"
    began = time.monotonic()
    processes[0].wait(HANGS_AFTER)
    seconds = time.monotonic() - began
    kill("b")  # where it fell silent it waits for the first node
    ended(*processes)
    ip("-n", "memcomp-b", "link", "set", "vb", "up")
    said = [line for line in (cut / "a.log").read_text().splitlines() if line.startswith("memcomp-train: ")]
    if not said or named not in said[0] or "Start the same command again" not in said[0]:
        findings.append(
            f"what was said does not name {named} and what to type: {said or (cut / 'a.log').read_text()[-800:]}"
        )
    if (cut / "run/result.json").exists():
        findings.append("the run had ended before its node died: nothing was shown")
    findings += on_both(cut, 1, *program)
    if not findings:
        import torch

        for stage in ("pretrain", "finetune"):
            one, other = (torch.load(f / f"run/weights/{stage}.pt", weights_only=True) for f in (whole, cut))
            if not all(one[name].equal(other[name]) for name in one):
                findings.append(f"the weights of {stage} are not those of the run that was not interrupted")
    facts: dict[str, float | str] = {"seconds until the other had ended": seconds, "said": said[0] if said else ""}
    return ledger.Outcome(kind=kind, findings=findings, facts=facts)


def attempt(case: str) -> ledger.Outcome:
    import tempfile

    what, *rest = case.split("/")
    with tempfile.TemporaryDirectory() as place, two_nodes():
        folder = Path(place)
        if what == "update":
            return update(rest[0], int(rest[1]), folder)
        if what == "cost":
            return cost(rest[0], int(rest[1]), folder)
        return death(rest[0], folder)


def predicted() -> str:
    """The table of docs/scaling.md: where an update of n processes waits longer than it computes."""
    rows = [
        "| model | bytes an update | n | waits, 1 Gbit/s | waits, 10 Gbit/s | waits, 100 Gbit/s |",
        "| --- " * 6 + "|",
    ]
    links = ((1e9, 100e-6), (1e10, 50e-6), (1e11, 5e-6))
    for n_visible, n_hidden in ((32, 32), (784, 500), (784, 4096)):
        own = Cost.of(n_visible, n_hidden)
        for n in (2, 4, 16, 64):
            waits = [1e3 * own.seconds(n, latency=latency, rate=bits / 8) for bits, latency in links]
            cells = " | ".join(f"{wait:.2f} ms" for wait in waits)
            rows.append(f"| {n_visible}x{n_hidden} | {own.payload:,} | {n} | {cells} |")
    return "\n".join(rows)


def measured(folder: Path) -> str:
    """What the ledger holds of bytes and messages, as a table."""
    lines = [line for line in ledger.read(folder / "ledger.jsonl") if str(line["case"]).startswith("cost/")]
    rows = [
        "| case | operations | bytes they carry | node a sends | by the model | an update takes |",
        "| --- " * 6 + "|",
    ]
    for line in lines:
        facts: dict[str, Any] = line["facts"]  # type: ignore[assignment]
        wire = facts.get("bytes on the wire by the model", 0)
        numbers = f"{facts['operations']:.1f} | {facts['bytes']:,.0f} | {facts['sent']:,.0f} | {wire:,.0f}"
        rows.append(f"| {str(line['case'])[5:]} | {numbers} | {1e3 * facts['seconds']:.1f} ms |")
    return "\n".join(rows)


def main() -> int:
    if "--predict" in sys.argv:
        print(predicted())
        return 0
    cases = [
        *(f"update/{model}/{n}" for model in MODELS for n in (2, 4)),
        *(f"cost/{case}/{n}" for case in COSTS for n in (1, 2, 4)),
        *("death/dies", "death/falls silent"),
    ]
    lines = ledger.parser(__doc__, count=len(cases), what="cases")
    given = lines.parse_args()
    if os.geteuid() != 0:
        sys.exit("two_nodes.py: network namespaces need root: type sudo before the command.")
    status = ledger.run(given.out, cases[: given.count], attempt, workers=1)
    print(f"\n{measured(given.out)}")
    return status


if __name__ == "__main__":
    sys.exit(main())
