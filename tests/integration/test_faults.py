"""What the machine does not give ends a command by one line: the cause, and the command that goes on."""

import errno
import json
import logging
import re
import shlex
import signal
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from running import QUIET, Outcome, launch

from memcomp_lightning import files
from memcomp_lightning.cli.commands import report
from memcomp_lightning.errors import LostError
from memcomp_lightning.modules import weights
from memcomp_lightning.runs import pipeline

Run = Callable[..., Outcome]
SMALL = [
    *(*QUIET, "data=shifting_bars", "data.source.copies=3", "sampler=pcd", "sampler.n_chains=7"),
    *("model.hidden_sizes=[5,4]", "pretrain.iterations=3", "finetune.iterations=2", "checkpoint_every=1"),
]


def named(outcome: Outcome) -> list[str]:
    """The arguments of the command that goes on, of a message of one line."""
    assert outcome.status != 0
    assert "Traceback" not in outcome.err
    (line,) = re.findall(r"Go on with: memcomp-\w+ (.*)", outcome.err)
    return shlex.split(line)


def test_a_full_disk_at_any_file(memcomp_train: Run) -> None:
    """Each file in turn cannot be written; the command of each message goes on with what is there."""
    assert memcomp_train(*SMALL, "hydra.run.dir=whole").status == 0
    replace, given, broken = Path.replace, [*SMALL, "hydra.run.dir=run"], set[str]()

    def full(path: Path, target: Path) -> Path:
        name = f"{target.parent.name}/{target.name}"
        if name not in broken:
            broken.add(name)
            raise OSError(errno.ENOSPC, "No space left on device", path)
        return replace(path, target)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Path, "replace", full)
        while (outcome := memcomp_train(*given)).status != 0:
            assert "(No space left on device)" in outcome.err
            assert ".partial" not in outcome.err
            given = named(outcome)
            assert given == ["resume=run"] or re.search("settings.yaml|overrides.json", outcome.err)
    assert {"pretrain/last.ckpt", "weights/finetune.pt", "run/stages.json", "run/result.json"} <= broken
    for name in ("pretrain", "finetune"):
        found, expected = (torch.load(f"{run}/weights/{name}.pt", weights_only=True) for run in ("run", "whole"))
        assert all(found[key].equal(expected[key]) for key in expected)
    assert not list(Path("run").rglob("*.partial"))


def test_torch_says_that_the_disk_is_full(tmp_path: Path) -> None:
    class Full:
        def write(self, _: bytes) -> int:
            raise OSError(errno.ENOSPC, "No space left on device")

        def flush(self) -> None:
            pass

    with pytest.raises(OSError, match="No space left"):
        weights.save_tensors({"x": torch.zeros(100_000)}, Full())  # type: ignore[arg-type]


@pytest.mark.parametrize(
    "error", [MemoryError(), RuntimeError("DefaultCPUAllocator: can't allocate memory: you tried ...")]
)
def test_memory_that_runs_out(memcomp_train: Run, monkeypatch: pytest.MonkeyPatch, error: Exception) -> None:
    def hungry(*_: Any, **__: Any) -> None:
        raise error

    monkeypatch.setattr(pipeline, "run", hungry)
    outcome = memcomp_train(*SMALL, "hydra.run.dir=run")
    assert outcome.err.endswith("memcomp-train: memory ran out. Go on with: memcomp-train resume=run\n")


def test_a_folder_that_vanishes_is_not_made_anew(memcomp_train: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    def taken(*arguments: Any) -> None:
        if Path("run").exists():
            Path("run").rename("elsewhere")
        kept(*arguments)

    kept = pipeline._keep_chains
    monkeypatch.setattr(pipeline, "_keep_chains", taken)
    outcome = memcomp_train(*SMALL, "hydra.run.dir=run")
    assert "run/weights cannot be read or written (No such file or directory)" in outcome.err
    assert not Path("run").exists()
    Path("elsewhere").rename("run")
    monkeypatch.setattr(pipeline, "_keep_chains", kept)
    assert memcomp_train(*named(outcome)).status == 0


def test_jobs_of_a_sweep_that_vanish_are_missed(memcomp_train: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    def taken(*arguments: Any, **settings: Any) -> Any:
        if Path("sweep").exists() and len(list(Path("sweep").glob("*/result.json"))) == 1:
            Path("sweep").rename("elsewhere")
        return run(*arguments, **settings)

    run = pipeline.run
    monkeypatch.setattr(pipeline, "run", taken)
    outcome = memcomp_train("-m", *SMALL, "seed=0,1,2", "hydra.sweep.dir=sweep")
    assert "sweep vanished while jobs ran" in outcome.err
    assert f"hydra.sweep.dir={Path('sweep').absolute()}" in named(outcome)


@pytest.mark.parametrize(("number", "status"), [(signal.SIGTERM, 143), (signal.SIGINT, 130)])
def test_signals_that_come_twice(tmp_path: Path, number: int, status: int) -> None:
    """The first is answered; the second comes while the command ends."""
    process = launch(*SMALL[:-2], "finetune.iterations=100000", "hydra.run.dir=run", folder=tmp_path)
    while not list(tmp_path.glob("run/checkpoints/finetune")):
        assert process.stdout.closed is False
    for _ in range(2):
        process.send_signal(number)
    out, err = process.communicate()
    outcome = Outcome(process.returncode or 0, out, err)
    assert outcome.status == status
    assert ("terminated" if number == signal.SIGTERM else "interrupted") in err
    assert named(outcome) == ["resume=run"]


def test_the_last_record_ends_its_line(tmp_path: Path) -> None:
    """A disk that was full took a whole record, but not the end of its line."""
    from memcomp_lightning.studies import Record, Records

    record = Record(method="a", at=[1], seconds=[1.0], measures={})
    Records(tmp_path).append([record])
    path = tmp_path / "records.jsonl"
    path.write_text(path.read_text().removesuffix("\n"))
    Records(tmp_path).append([record])
    assert len(Records(tmp_path).all) == 2
    assert [json.loads(line)["method"] for line in path.read_text().splitlines()] == ["a", "a"]


def test_an_error_names_the_file_and_not_the_one_beside_it(tmp_path: Path) -> None:
    with pytest.raises(OSError, match="No space") as caught, files.written_whole(tmp_path / "a"):
        raise OSError(errno.ENOSPC, "No space left on device")
    assert caught.value.filename == str(tmp_path / "a")


@pytest.mark.parametrize(
    ("error", "said"),
    [
        (
            OSError(errno.ENOSPC, "No space left on device", "run/figure4.svg"),
            "run/figure4.svg cannot be written (No space left on device).",
        ),
        (LostError("a process was ended from outside."), "a process was ended from outside."),
    ],
)
def test_a_figure_that_ends_before_its_page(
    memcomp_train: Run, monkeypatch: pytest.MonkeyPatch, error: Exception, said: str
) -> None:
    """Its run goes on, not the report alone, and not the same command in another folder."""

    def ended(*_: Any) -> None:
        raise error

    figure = ["experiment=figure4", "figure/curves=none", "data=digits", "data.partitions=2", "figure.passes=[1]"]
    small = ["figure.seeds=[0]", "figure.workers=1", "figure.iterations=[1]", "solver.max_steps=5"]
    monkeypatch.setattr(report, "write_report", ended)
    outcome = memcomp_train(*figure, *small, "solver.n_restarts=2", "hydra.run.dir=run")
    assert f"memcomp-train: {said} Go on with" in outcome.err
    assert named(outcome) == ["resume=run"]


def test_a_log_that_cannot_be_written_costs_its_lines(memcomp_train: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(handler: logging.Handler, record: logging.LogRecord) -> None:
        try:
            raise OSError(errno.ENOSPC, "No space left on device")
        except OSError:
            handler.handleError(record)

    monkeypatch.setattr(logging.FileHandler, "emit", full)
    assert memcomp_train(*SMALL, "hydra.run.dir=run").status == 0
    outcome = memcomp_train("resume=run")  # which logs that it is finished
    assert outcome.status == 0
    assert "Logging error" not in outcome.err
