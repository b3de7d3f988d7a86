"""Nothing is lost because a line cannot be printed; Ctrl-C, folders of one second, advice that is pasted."""

import errno
import json
import logging
import os
import re
import shlex
import signal
import subprocess
import sys
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from datetime import datetime, timedelta
from pathlib import Path
from typing import Any

import pytest
from numba import njit
from running import Outcome

from memcomp_lightning import compiling, plotting
from memcomp_lightning.cli.commands import solve as solving
from memcomp_lightning.cli.output import say, tolerant_streams
from memcomp_lightning.cli.overrides import claimed
from memcomp_lightning.compiling import seconds_spent, told
from memcomp_lightning.configuration import trainers
from memcomp_lightning.errors import UserError
from memcomp_lightning.runs import pipeline
from memcomp_lightning.studies import report as study_report

Run = Callable[..., Outcome]
SHORT = ["sampler=cd", "pretrain.iterations=1", "finetune.iterations=1", "callbacks=minimal", "logger=none"]
EDGE = "3 2\n1 2 1\n2 3 1\n"

# What a command does with its streams, without what it imports: lines of a table, of a log, of a bar; its work.
PRINTING = """
import logging, sys
from pathlib import Path
from tqdm import tqdm
from memcomp_lightning.cli.output import say, tolerant_streams

with tolerant_streams() as failures:
    logging.basicConfig(stream=sys.stdout, level=logging.INFO)
    for _ in tqdm(range(3)):
        say("a table: \\N{PLUS-MINUS SIGN} \\N{BOX DRAWINGS LIGHT HORIZONTAL} \\N{GREEK SMALL LETTER PHI}")
        logging.info("a line of a log")
        print("a line of a library " * 20000)  # more than a pipe holds
    say("an error", error=True)
    print("no flush", end="")
Path("done").write_text(str([failure.errno for failure in failures]))
"""

SHELL = {
    "> /dev/full": [errno.ENOSPC],
    "> /dev/full 2>&1": [errno.ENOSPC],
    "| head -1": [errno.EPIPE],
    "2>&1 | head -1": [errno.EPIPE],
    ">&-": [],
    "2>&-": [],
    ">&- 2>&- <&-": [],
}


@pytest.mark.parametrize("unbuffered", ["", "1"], ids=["buffered", "unbuffered"])
@pytest.mark.parametrize("redirection", SHELL)
def test_output_that_cannot_be_written_costs_nothing_else(
    tmp_path: Path, redirection: str, unbuffered: str
) -> None:
    command = f"set -o pipefail; {shlex.quote(sys.executable)} program.py {redirection}"
    (tmp_path / "program.py").write_text(PRINTING)
    environment = {**os.environ, "PYTHONUNBUFFERED": unbuffered}
    done = subprocess.run(
        ["bash", "-c", command], cwd=tmp_path, capture_output=True, text=True, check=False, env=environment
    )
    assert done.returncode == 0, done.stderr
    assert json.loads((tmp_path / "done").read_text()) == SHELL[redirection]
    for word in ("Traceback", "Exception", "Error"):
        assert word not in done.stderr


@pytest.mark.parametrize(
    ("encoding", "signs"), [("utf-8", "± ─ φ"), ("cp1252", "± - \\u03c6"), ("ascii", "+- - \\u03c6")]
)
def test_signs_that_an_encoding_lacks_are_spelt_out(tmp_path: Path, encoding: str, signs: str) -> None:
    (tmp_path / "program.py").write_text(PRINTING)
    environment = {**os.environ, "PYTHONIOENCODING": encoding}
    done = subprocess.run(
        [sys.executable, "program.py"], cwd=tmp_path, capture_output=True, check=False, env=environment
    )
    assert done.returncode == 0, done.stderr
    assert done.stdout.decode(encoding).count(f"a table: {signs}\n") == 3


class Broken:
    """A stream of a program that runs a command."""

    encoding = "utf-8"

    def write(self, text: str) -> int:
        raise BrokenPipeError(errno.EPIPE, "Broken pipe")

    def flush(self) -> None:
        raise ValueError("I/O operation on closed file")


def test_lines_are_lost_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "stdout", Broken())
    monkeypatch.setattr(sys, "stderr", Broken())
    say("lost")
    say("lost", error=True)
    monkeypatch.setattr(sys, "stdout", None)
    say("lost")


def test_a_command_in_a_pipe_ends_well(tmp_path: Path) -> None:
    """Real commands: solutions, and jobs of a sweep with their table, are there, and nothing is said of it."""
    (tmp_path / "edge.txt").write_text(EDGE)
    python, environment = shlex.quote(sys.executable), {**os.environ, "OMP_NUM_THREADS": "1"}
    start = f"{python} -m memcomp_lightning.cli"
    solve = f"{start}.solve problem=edge.txt solver=brute_force hydra.run.dir=solved > /dev/full"
    train = f"{start}.train -m {shlex.join(SHORT)} seed=0,1 hydra.sweep.dir=all | head -1"
    lines = f"set -o pipefail; ({solve}; echo $? > status) & ({train}); echo $? >> trained; wait"
    environment["PYTHONIOENCODING"] = "cp1252"
    done = subprocess.run(
        ["bash", "-c", lines], cwd=tmp_path, capture_output=True, text=True, check=False, env=environment
    )
    assert (tmp_path / "solved/solution.json").exists()
    assert len(list(tmp_path.glob("all/*/result.json"))) == 2
    assert (tmp_path / "all/table.csv").exists()
    assert not list(tmp_path.glob("all/*/error.json"))
    assert [(tmp_path / name).read_text() for name in ("status", "trained")] == ["0\n", "0\n"]
    assert done.stderr == "memcomp-solve: not all of the output could be written (No space left on device).\n"


def test_a_solution_that_cannot_be_written_is_printed_whole(
    memcomp_solve: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(*_: object, **__: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    Path("long.txt").write_text("101 1\n1 101 1\n")
    monkeypatch.setattr(solving, "write_solution", full)
    outcome = memcomp_solve("problem=long.txt", "solver=alternating_descent", "hydra.run.dir=run")
    assert outcome.status == 2
    assert re.search(r"Assignment:  [01]{101}\n", outcome.out)
    assert "Solution:" not in outcome.out
    assert "run cannot be written (No space left on device)" in outcome.err
    monkeypatch.undo()


def test_a_picture_that_cannot_be_written_costs_the_picture_alone(
    memcomp_solve: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(*_: object, **__: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    Path("edge.txt").write_text(EDGE)
    monkeypatch.setattr(plotting, "plot_trajectory", full)
    recorded = ["solver=dmm_recorded", "solver.max_steps=40"]
    outcome = memcomp_solve("problem=edge.txt", *recorded, "hydra.run.dir=run")
    assert outcome.status == 2
    assert Path("run/solution.json").exists()
    assert "Solution:    run/solution.json" in outcome.out
    assert "No space left on device" in outcome.err


INTERRUPTED = """
import importlib, os, signal, sys, time
from memcomp_lightning.cli import {command}

def slowly(name):
    try:
        os.kill(os.getpid(), signal.SIGINT)
        time.sleep(5)
    except KeyboardInterrupt:
        raise ImportError("libraries do this")

importlib.import_module = slowly
signal.signal(signal.SIGINT, signal.default_int_handler)
{command}.main()
"""


@pytest.mark.parametrize("command", ["train", "solve", "report"])
def test_ctrl_c_while_modules_are_imported(tmp_path: Path, command: str) -> None:
    program = INTERRUPTED.format(command=command)
    done = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, check=False, cwd=tmp_path
    )
    assert done.returncode == 130
    assert done.stderr == f"\nmemcomp-{command}: interrupted, nothing was written.\n"


def test_commands_start_before_anything_heavy_is_imported() -> None:
    program = (
        "import sys; before = set(sys.modules)\n"
        "import memcomp_lightning.cli.train, memcomp_lightning.cli.solve, memcomp_lightning.cli.report\n"
        "print(*sorted(name for name in set(sys.modules) - before))"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    others = {name.partition(".")[0] for name in done.stdout.split()} - {"memcomp_lightning"}
    assert others <= {"signal", "_signal", "enum", "types", "operator", "functools", "collections", "errno"} | {
        "keyword",
        "reprlib",
        "_collections",
        "_functools",
        "_operator",
        "itertools",
        "atexit",
        "gc",
    }


def test_ctrl_c_while_a_command_is_checked(memcomp_train: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    def interrupt(*_: object, **__: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(trainers, "check_trainer", interrupt)
    outcome = memcomp_train(*SHORT)
    assert outcome.status == 130
    assert outcome.err == f"\nmemcomp-train: interrupted. Go on with: memcomp-train {shlex.join(SHORT)}\n"


def test_folders_are_claimed_by_one_alone(tmp_path: Path) -> None:
    with ThreadPoolExecutor(8) as pool:
        folders = list(pool.map(claimed, [tmp_path / "runs/day/second"] * 24))
    assert len(set(folders)) == 24
    assert all(folder.is_dir() for folder in folders)
    assert tmp_path / "runs/day/second" in folders
    assert tmp_path / "runs/day/second_24" in folders
    (tmp_path / "file").touch()
    with pytest.raises(UserError, match="cannot be made"):
        claimed(tmp_path / "file/second")


def seconds_ahead(n: int) -> list[datetime]:
    now = datetime.now()
    return [now + timedelta(seconds=k) for k in range(n)]


def test_commands_of_one_second_have_folders_of_their_own(memcomp_train: Run, tmp_path: Path) -> None:
    for second in seconds_ahead(120):
        for kind in ("runs", "multirun"):
            (tmp_path / f"{kind}/{second:%Y-%m-%d/%H-%M-%S}").mkdir(parents=True)
    assert memcomp_train(*SHORT).status == 0
    outcome = memcomp_train("-m", *SHORT, "seed=0,1")
    assert outcome.status == 0, outcome.err
    assert re.search(r"Run folder:   multirun/[\d-]+/[\d-]+_2\n", outcome.out)
    written = [str(path.relative_to(tmp_path)) for path in tmp_path.rglob("result.json")]
    assert len([name for name in written if re.fullmatch(r"runs/[\d-]+/[\d-]+_2/result.json", name)]) == 1
    assert len([name for name in written if re.match(r"multirun/[\d-]+/[\d-]+_2/", name)]) == 2
    given = memcomp_train(*SHORT, "hydra.run.dir=mine")
    assert given.status == 0
    again = memcomp_train(*SHORT, "hydra.run.dir=mine")
    assert "is finished already" in again.out, "a folder that is given is that folder"


class Shell:
    """A shell in which commands note how they were called."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder / "shims"
        self.folder.mkdir()

    def arguments(self, command: str) -> list[str]:
        """Arguments that a program of this command gets."""
        program = shlex.split(command)[0]
        shim = self.folder / Path(program).name
        shim.write_text(f"#!{sys.executable}\nimport json, sys\nprint(json.dumps(sys.argv[1:]))\n")
        shim.chmod(0o755)
        environment = {**os.environ, "PATH": f"{self.folder}:{os.environ['PATH']}"}
        typed = command.replace(program, Path(program).name, 1)
        done = subprocess.run(["bash", "-c", typed], capture_output=True, text=True, check=True, env=environment)
        arguments: list[str] = json.loads(done.stdout)
        return arguments


@pytest.fixture
def shell(tmp_path: Path) -> Shell:
    return Shell(tmp_path)


AWKWARD = 'my runs/it\'s $no, "so"'  # Lightning's TensorBoardLogger puts in variables that exist


def interrupting(monkeypatch: pytest.MonkeyPatch) -> None:
    def interrupt(*_: object, **__: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(pipeline, "run", interrupt)


@pytest.mark.parametrize("chdir", ["false", "true"])
def test_advice_after_ctrl_c_works_when_pasted(
    memcomp_train: Run, shell: Shell, monkeypatch: pytest.MonkeyPatch, chdir: str
) -> None:
    run, sweep = [*SHORT, f"hydra.run.dir={AWKWARD}"], ["-m", *SHORT, "seed=0,1", f"hydra.sweep.dir={AWKWARD} s"]
    for typed in (run, sweep):
        with monkeypatch.context() as patch:
            interrupting(patch)
            outcome = memcomp_train(*typed, f"hydra.job.chdir={chdir}")
        assert outcome.status == 130
        advice = outcome.err.splitlines()[-1].partition("Go on with: ")[2]
        assert advice.startswith("memcomp-train ")
        outcome = memcomp_train(*shell.arguments(advice))
        assert outcome.status == 0, outcome.err
        place = typed[-1].partition("=")[2]
        assert list(Path(place).rglob("result.json"))


def test_advice_to_look_works_when_pasted(memcomp_train: Run, shell: Shell) -> None:
    outcome = memcomp_train(*SHORT[:-1], "logger=tensorboard", f"hydra.run.dir={AWKWARD}")
    assert outcome.status == 0, outcome.err
    advice = outcome.out.partition("TensorBoard:  ")[2].splitlines()[0]
    flag, folder = shell.arguments(advice)
    assert flag == "--logdir"
    assert any(Path(folder).glob("events.out.tfevents.*"))


def test_advice_of_the_report_works_when_pasted(
    shell: Shell, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    class Nothing:
        curves = data_sets = ()

    folder = tmp_path / AWKWARD
    folder.mkdir(parents=True)
    monkeypatch.setattr(study_report, "read_results", lambda _: Nothing())
    monkeypatch.setattr(study_report, "read_worth", lambda _: Nothing())
    for name in ("figure.json", "worth.json"):
        (folder / name).touch()
        with pytest.raises(UserError) as refused:
            study_report.write_report(folder)
        assert shell.arguments(str(refused.value).partition("go on with ")[2]) == [f"resume={folder}"]


def test_advice_to_install_works_when_pasted(shell: Shell) -> None:
    """Every command of this kind in the package's messages."""
    root = Path(compiling.__file__).parent
    found = {
        command
        for path in root.rglob("*.py")
        for command in re.findall(r"pip install ('[^']+'|[\w-]+)", path.read_text())
    }
    assert "'memcomp-lightning[sweep]'" in found
    for what in found:
        assert shell.arguments(f"pip install {what}") == ["install", what.strip("'")]


def kernel(module: str) -> Any:
    def increment(x: int) -> int:
        return x + 1

    increment.__module__ = module
    return njit(increment)


@pytest.fixture
def unannounced() -> None:
    compiling.announce_compilation()
    compiling._log_once.cache_clear()


@pytest.mark.usefixtures("unannounced")
def test_compilation_is_said_in_one_line(capfd: pytest.CaptureFixture[str]) -> None:
    of = "memcomp_lightning.solvers"
    one, other = kernel(f"{of}.dmm.kernels.rows"), kernel(f"{of}.kernels.branch_and_bound")
    with told(lambda text: say(f"memcomp-train: {text}", error=True)):
        kernel("of.others")(1)
        assert capfd.readouterr().err == ""
        before = seconds_spent()
        one(1)
        other(1)
        one(2)
        said = capfd.readouterr().err
        assert seconds_spent() > before  # what solvers do not count as their time
    assert said == "memcomp-train: compiling the solver's kernels for this processor, once (about half a minute)\n"


@pytest.mark.usefixtures("unannounced")
def test_compilation_is_information_in_python(caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.INFO, "memcomp_lightning")
    fresh = kernel("memcomp_lightning.likelihood.kernel")
    fresh(1)
    fresh(2)
    (record,) = caplog.records
    assert record.levelno == logging.INFO
    assert record.getMessage().startswith("compiling the likelihood's kernel")


def test_closed_streams_are_given_back() -> None:
    before = sys.stdout, sys.stderr
    with tolerant_streams() as failures:
        print("kept")
    assert (sys.stdout, sys.stderr) == before
    assert failures == []


def test_the_first_signal_handler_stays() -> None:
    """A program that calls a command keeps its own answer to Ctrl-C."""
    program = (
        "import signal, sys\nfrom memcomp_lightning.cli import train\nsys.argv[1:] = ['--version']\n"
        "mine = lambda *_: None\nfor handler in (mine, signal.SIG_IGN, signal.default_int_handler):\n"
        "    signal.signal(signal.SIGINT, handler)\n    try:\n        train.main()\n    except SystemExit: pass\n"
        "    assert signal.getsignal(signal.SIGINT) is handler\n"
    )
    subprocess.run([sys.executable, "-c", program], check=True, capture_output=True)
    assert signal.getsignal(signal.SIGINT) is not None
