"""What a new user meets first: other installations, other systems, other habits."""

import json
import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest
from running import FAST, LOGGED, THREADS, Outcome, python

Run = Callable[..., Outcome]

EACH_IN_TURN_WITHOUT_TENSORBOARD = """
import contextlib, importlib.util, json, sys

NAMES = ("tensorboard", "tensorboardX")

class Absent:
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] in NAMES:
            raise ModuleNotFoundError(f"No module named {name!r}", name=name)

sys.meta_path.insert(0, Absent())
known = importlib.util.find_spec
importlib.util.find_spec = lambda name, package=None: None if name in NAMES else known(name, package)

from hydra.core.global_hydra import GlobalHydra
from memcomp_lightning.cli import train

for name, arguments in json.loads(sys.argv[1]).items():
    sys.argv[1:], status = arguments, 0
    GlobalHydra.instance().clear()
    with open(f"{name}.txt", "w") as file, contextlib.redirect_stdout(file), contextlib.redirect_stderr(file):
        try:
            train.main()
        except SystemExit as stop:
            status = stop.code
        file.flush()
    print(name, status)
"""


def train(folder: Path, *arguments: str, before: str = "", **environment: str) -> Outcome:
    """Run ``memcomp-train`` as a process that starts with some code."""
    start = f"{before}\nfrom memcomp_lightning.cli import train\ntrain.main()"
    process = python("-c", start, *arguments, folder=folder, **environment)
    out, err = process.communicate()
    assert process.returncode is not None
    return Outcome(process.returncode, out, err)


def test_without_tensorboard(tmp_path: Path) -> None:
    """What to install or to choose; another logger, and figures with their pictures."""
    small = ["data=digits", "data.partitions=2", "figure.passes=[1]", "figure.iterations=[1]", "figure.workers=1"]
    commands = {
        "refused": ["sampler=cd", *LOGGED],
        "trained": ["sampler=cd", *LOGGED, "logger=csv", "hydra.run.dir=trained"],
        "figure": [
            *("experiment=figure4", "figure/curves=none", *small, "solver.max_steps=20", "hydra.run.dir=figure")
        ],
    }
    done = subprocess.run(  # one that has imported nothing: whether TensorBoard is there is asked on import
        [sys.executable, "-c", EACH_IN_TURN_WITHOUT_TENSORBOARD, json.dumps(commands)],
        cwd=tmp_path,
        env={**os.environ, "OMP_NUM_THREADS": THREADS},
        capture_output=True,
        text=True,
        check=False,
    )
    said = {name: (tmp_path / f"{name}.txt").read_text() for name in commands}
    assert done.stdout == "refused 2\ntrained 0\nfigure 0\n", (done.stderr, said)
    assert "TensorBoard is not installed: pip install tensorboard, or logger=csv" in said["refused"]
    assert "Traceback" not in said["refused"]
    assert "Run folder:   trained" in said["trained"]
    assert "TensorBoard:" not in said["trained"]
    assert "figure gets no event file. pip install tensorboard" in said["figure"]
    assert (tmp_path / "figure/report.html").stat().st_size > 0


@pytest.mark.parametrize(
    ("typed", "meant"),
    [
        ("sampler=cdd", "sampler=cd"),
        ("experiment=figur4", "experiment=figure4"),
        ("solver/field=claus", "solver/field=clause"),
        ("samplr=cd", "sampler"),
    ],
)
def test_a_misspelt_group_or_option_suggests_the_nearest(memcomp_train: Run, typed: str, meant: str) -> None:
    outcome = memcomp_train(typed)
    assert outcome.status == 2
    assert f"does not exist. Did you mean {meant}? Known here: " in outcome.err
    # Of a sweep, the job is named.
    assert f"Did you mean {meant}?" in memcomp_train("-m", "seed=0,1", typed).err


def test_a_terminal_without_colours_gets_none(tmp_path: Path) -> None:
    outcome = train(tmp_path, "sampler=cd", *LOGGED, TERM="dumb", NO_COLOR="1")
    assert outcome.status == 0, outcome.err
    assert "\x1b" not in outcome.out + outcome.err


BOUND_BY_PERMISSIONS = """
import ctypes, os, sys
if sys.platform == "linux" and os.geteuid() == 0:  # root gives up all that it may do more than others
    ctypes.CDLL(None).capset((ctypes.c_uint32 * 2)(0x20080522, 0), (ctypes.c_uint32 * 6)())
"""


@pytest.mark.parametrize("mode", [0o500, 0o600], ids=["not to be written", "not to be entered"])
def test_a_folder_without_permission_is_named(tmp_path: Path, mode: int) -> None:
    (tmp_path / "closed").mkdir(mode=mode)
    probe = python("-c", f"{BOUND_BY_PERMISSIONS}\nopen('closed/probe', 'w')", folder=tmp_path)
    probe.communicate()
    if probe.returncode == 0:
        pytest.skip("permissions do not bind this user")
    outcome = train(tmp_path, "sampler=cd", *FAST, "hydra.run.dir=closed/run", before=BOUND_BY_PERMISSIONS)
    assert outcome.status == 2
    assert outcome.err.startswith(f"memcomp-train: hydra.run.dir = {tmp_path}/closed/run is not allowed: ")
    assert outcome.err.endswith("(Permission denied). Choose another folder with hydra.run.dir=PATH.\n")
    assert "Traceback" not in outcome.err
    outcome = train(tmp_path, "resume=closed/run", before=BOUND_BY_PERMISSIONS)
    assert outcome.status == 2
    assert outcome.err.startswith("memcomp-train: ")
    assert "closed/run" in outcome.err
    assert "Traceback" not in outcome.err


def test_paths_of_windows_in_settings_are_taken_as_they_are(memcomp_train: Run) -> None:
    """Quoted, backslashes and a drive's colon stay; the file is looked for under that very name."""
    outcome = memcomp_train(r"model.weights='C:\models\dbn.pt'", *FAST)
    assert outcome.status == 2
    assert r"C:\models\dbn.pt does not exist" in outcome.err
