"""100,000 updates and 1,000 jobs in one process: memory, open files and the time of an update stay as they were.

    python tests/campaigns/long_runs.py --out FOLDER --count 100000 --jobs 1000

Each case is a process of its own, which notes two hundred times how far it is, and what it holds then: its memory,
open files, threads and Python objects, and the processor's time. The second quarter of the notes is compared with
the last: by then everything is compiled, and what is allocated once is allocated. Event files must be readable to
their last update.
"""

import gc
import itertools
import json
import os
import shutil
import statistics
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import ledger
import lightning.pytorch as pl
import numpy as np
from numpy.typing import NDArray
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from memcomp_lightning.cli import solve, train
from memcomp_lightning.estimators import MemcompRBM
from memcomp_lightning.solvers import AlternatingDescent, QuboSolution
from memcomp_lightning.trained import load, sample

HERE = Path(__file__).parent

NOTES = 200
"""Of a case, about."""

MORE_MEMORY, MORE_OBJECTS, MORE_TIME = 8 * 2**20, 0.02, 1.25
"""What the last quarter may have more than the second: bytes, a share of the objects, a factor of the time."""

PAGE = os.sysconf("SC_PAGE_SIZE")


class Note(NamedTuple):
    """What a process holds after so many steps: of the processor's time in seconds, of memory in bytes."""

    step: int
    seconds: float
    memory: int
    files: int
    threads: int
    objects: int


def now(step: int, seconds: float) -> Note:
    gc.collect()
    memory = int(Path("/proc/self/statm").read_text().split()[1]) * PAGE
    files = len(os.listdir("/proc/self/fd"))  # noqa: PTH208 - a Path per file would be objects of ours
    return Note(step, seconds, memory, files, threading.active_count(), len(gc.get_objects()))


class Notebook:
    """Notes of this process, one whenever a further share of the steps is done."""

    def __init__(self, file: Path, steps: int) -> None:
        self.file, self.every, self.done = file, max(1, steps // NOTES), 0
        self.noting = 0.0

    def step(self) -> None:
        self.done += 1
        if self.done % self.every == 0:
            began = time.process_time()
            with self.file.open("a", encoding="utf-8") as lines:
                lines.write(json.dumps(now(self.done, began - self.noting)) + "\n")
            self.noting += time.process_time() - began


notebook: Notebook
"""That of this process, where it is one that is watched."""


class Updates(pl.Callback):
    """A step is an update."""

    def on_train_batch_end(self, *_: object) -> None:
        notebook.step()


class Jobs(pl.Callback):
    """A step is a training."""

    def on_fit_end(self, *_: object) -> None:
        notebook.step()


class Descent(AlternatingDescent):
    """A step is a problem that is solved."""

    def minimise(self, *arguments: Any, **settings: Any) -> QuboSolution:
        notebook.step()
        return super().minimise(*arguments, **settings)


# --------------------------------------------------------------------------------------------------- what is done

ROWS = 9_000
"""Of the data: a pass has a thousand updates of nine rows."""

BARS = ("data=shifting_bars", "data.source.copies=1000", "pretrain.batch_size=9", "model.hidden_sizes=[8]")
NO_CLASSES = ("finetune.iterations=0",)


def command(main: Callable[[], None], *arguments: str) -> None:
    sys.argv = ["memcomp", *arguments]
    main()


def training(*settings: str, stage: str = "pretrain", n: int) -> None:
    """A training of so many updates, with all callbacks and event files."""
    watch = f"+callbacks.{stage}.watch={{_target_: long_runs.Updates}}"
    passes = f"{stage}.iterations={n // (ROWS // 9)}"
    command(train.main, *settings, passes, watch, "hydra.run.dir=run")


def table(n: int) -> None:
    """A table of categories and gaps, in which a twelfth of the cells is missing."""
    draws = np.random.default_rng(0)
    words = np.array(["red", "green", "blue", ""])
    cells = [words[draws.choice(4, size=ROWS, p=[0.4, 0.3, 0.2, 0.1])] for _ in range(4)]
    heights = np.char.mod("%.3f", draws.normal(170, 9, size=ROWS))
    lines = [",".join(row) for row in zip(*cells, heights, strict=True)]
    Path("people.csv").write_text("\n".join(["a,b,c,d,height", *lines, ""]))
    whole = ("data.test_fraction=0.0001", "data.validation_fraction=0", "pretrain.batch_size=9")
    training("data=table", "data.path=people.csv", *whole, "model.hidden_sizes=[8]", *NO_CLASSES, n=n)


def sweep(n: int) -> None:
    watch = "+callbacks.pretrain.watch={_target_: long_runs.Jobs}"
    quick = ("data=bars_and_stripes", "model.hidden_sizes=[4]", "pretrain.iterations=1", *NO_CLASSES)
    command(train.main, "-m", f"seed=range({n})", *quick, watch, "hydra.sweep.dir=run")


def solving(n: int) -> None:
    Path("ring.txt").write_text("9 9\n" + "".join(f"{i} {i % 9 + 1} {1 + i % 3}\n" for i in range(1, 10)))
    seeds = ",".join(map(str, range(n)))
    descent = ("solver=alternating_descent", "solver._target_=long_runs.Descent", "solver.n_restarts=2")
    command(solve.main, "ring.txt", *descent, f"seed={seeds}", "--output", "run/results.csv")


def fits(n: int) -> None:
    rows = _bits(200)
    for seed in range(n):
        MemcompRBM(n_components=4, n_iter=2, random_state=seed).fit(rows).score_samples(rows)
        notebook.step()


def loads(n: int) -> None:
    quick = ("data=bars_and_stripes", "model.hidden_sizes=[4]", "pretrain.iterations=1", *NO_CLASSES)
    command(train.main, *quick, "hydra.run.dir=run", "callbacks=minimal", "logger=none")
    for seed in range(n):
        sample(load("run"), 5, seed=seed)
        notebook.step()


def _bits(n: int) -> NDArray[np.float32]:
    drawn: NDArray[np.float32] = np.random.default_rng(0).integers(0, 2, size=(n, 9)).astype(np.float32)
    return drawn


UPDATES: dict[str, Callable[..., None]] = {
    "CD-1": partial(training, *BARS, *NO_CLASSES, "sampler=cd"),
    "PCD-1": partial(training, *BARS, *NO_CLASSES, "sampler=pcd"),
    "parallel tempering": partial(training, *BARS, *NO_CLASSES, "sampler=tempering"),
    "mode-assisted": partial(training, *BARS, *NO_CLASSES, "sampler=mode_assisted_cd"),
    "joint": partial(training, *BARS[:-1], "model.hidden_sizes=[8,4]", "pretrain=joint", *NO_CLASSES),
    "machine": partial(
        training, *BARS[:-1], "model=boltzmann", "model.n_hidden=3", "pretrain=boltzmann", *NO_CLASSES
    ),
    "table with gaps": table,
    "fine-tuning": partial(training, *BARS, "pretrain.iterations=1", "finetune.batch_size=9", stage="finetune"),
}
"""A step is an update."""

JOBS: dict[str, Callable[[int], None]] = {
    "a sweep's jobs": sweep,
    "problems solved": solving,
    "fits of the estimator": fits,
    "runs loaded and sampled": loads,
}
"""A step is a job."""


def live(kind: str, steps: int, file: Path) -> None:
    """What the process of a case does: it is imported by the name under which its callbacks are asked for."""
    global notebook
    notebook = Notebook(file, steps)
    ({**UPDATES, **JOBS}[kind])(n=steps)


# ---------------------------------------------------------------------------------------------------- what is seen


def findings(notes: Sequence[Note], steps: int) -> Iterator[str]:
    """What is more at the end than it was before."""
    if not notes or notes[-1].step < steps * (1 - 2 / NOTES):
        yield f"it came to step {notes[-1].step if notes else 0} of {steps}"
        return
    before, after = quarter(notes, 1), quarter(notes, 3)
    more = median(after, "memory") - median(before, "memory")
    if more > MORE_MEMORY:
        yield f"memory grows by {more / 2**20:.1f} MiB in {between(notes)} steps"
    for what in ("files", "threads"):
        if max(getattr(note, what) for note in after) > max(getattr(note, what) for note in before):
            yield f"there are more {what}: {median(before, what):g}, then {median(after, what):g}"
    objects = median(after, "objects") / median(before, "objects") - 1
    if objects > MORE_OBJECTS:
        yield f"there are {objects:.1%} more Python objects after {between(notes)} steps"
    if (slower := of_a_step(after) / of_a_step(before)) > MORE_TIME:
        yield f"a step takes {slower:.2f} times as long"


def quarter(notes: Sequence[Note], number: int) -> Sequence[Note]:
    n = len(notes) // 4
    return notes[number * n : (number + 1) * n] if n else notes


def median(notes: Sequence[Note], what: str) -> float:
    return float(statistics.median(getattr(note, what) for note in notes))


def of_a_step(notes: Sequence[Note]) -> float:
    """Seconds of the processor, the median over the notes; a look of callbacks falls into few of them."""
    pairs = itertools.pairwise(notes)
    return statistics.median((b.seconds - a.seconds) / (b.step - a.step) for a, b in pairs)


def between(notes: Sequence[Note]) -> int:
    return int(median(quarter(notes, 3), "step") - median(quarter(notes, 1), "step"))


def unreadable(folder: Path, last_step: int) -> Iterator[str]:
    """What is wrong with the event files below a folder."""
    files = sorted(folder.rglob("events.out.tfevents*"))
    last = 0
    for file in files:
        events = EventAccumulator(str(file), size_guidance={"scalars": 0}).Reload()
        for tag in events.Tags()["scalars"]:
            at = [scalar.step for scalar in events.Scalars(tag)]
            if at != sorted(at):
                yield f"{file.name}: steps of {tag} fall"
            last = max(last, *at)
    if not files:
        yield "there is no event file"
    elif last < 0.99 * last_step:
        yield f"the event files end at step {last}"


def attempt(case: str, *, out: Path, updates: int, jobs: int) -> ledger.Outcome:
    steps = updates if case in UPDATES else jobs
    folder = out / "".join(sign if sign.isalnum() else "_" for sign in case)
    if folder.exists():  # of a campaign that was cut off here
        shutil.rmtree(folder)
    folder.mkdir(parents=True)
    file = folder / "notes.jsonl"
    code = f"import long_runs; from pathlib import Path; long_runs.live({case!r}, {steps}, Path('notes.jsonl'))"
    path = os.pathsep.join(filter(None, [str(HERE), str(HERE.parents[1]), os.environ.get("PYTHONPATH")]))
    with (folder / "said.txt").open("w") as said:
        ended = subprocess.run(
            [sys.executable, "-c", code],
            cwd=folder,
            env={**os.environ, "PYTHONPATH": path, "OMP_NUM_THREADS": "1"},
            stdout=said,
            stderr=said,
            check=False,
        )
    notes = [Note(*json.loads(line)) for line in file.read_text().splitlines()] if file.exists() else []
    found = [f"it ended with status {ended.returncode}"] if ended.returncode else []
    found += findings(notes, steps)
    if case in UPDATES:
        found += unreadable(folder / "run", steps)
    facts = dict(zip(("MiB", "MiB more", "files", "ms a step", "times as long"), facts_of(notes), strict=False))
    return ledger.Outcome(kind=case, tried=steps, findings=found, facts=facts)


def facts_of(notes: Sequence[Note]) -> list[float | str]:
    if len(notes) < 8:
        return []
    before, after = quarter(notes, 1), quarter(notes, 3)
    mebibytes = [median(part, "memory") / 2**20 for part in (before, after)]
    times = [of_a_step(part) for part in (before, after)]
    return [
        round(mebibytes[1]),
        round(mebibytes[1] - mebibytes[0], 1),
        max(note.files for note in after),
        round(1e3 * times[1], 3),
        round(times[1] / times[0], 2),
    ]


def main() -> int:
    lines = ledger.parser(__doc__, count=100_000, what="updates of a training")
    lines.add_argument("--jobs", type=int, default=1000, help="jobs of a process (default 1000)")
    lines.add_argument("--only", nargs="*", choices=[*UPDATES, *JOBS], default=[*UPDATES, *JOBS])
    typed = lines.parse_args()
    tried = partial(attempt, out=typed.out.absolute(), updates=typed.count, jobs=typed.jobs)
    status = ledger.run(typed.out, typed.only, tried, workers=typed.workers)
    print()
    print("| | steps | MiB | more in half of the steps | open files | ms a step | last to second quarter |")
    print("| --- | --- | --- | --- | --- | --- | --- |")
    for line in ledger.read(typed.out / "ledger.jsonl"):
        cells = [line["kind"], f"{line['tried']:,}", *dict(line["facts"]).values()]  # type: ignore[call-overload]
        print("| " + " | ".join(map(str, cells)) + " |")
    return status


if __name__ == "__main__":
    sys.exit(main())
