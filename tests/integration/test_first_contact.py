"""What a new user meets first: other installations, other systems, other habits."""

import ctypes
import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest
from running import FAST, LOGGED, THREADS, Outcome

Run = Callable[..., Outcome]

WITHOUT = """
import importlib.util
import sys

class Absent:
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] in {names!r}:
            raise ModuleNotFoundError(f"No module named {{name!r}}", name=name)

sys.meta_path.insert(0, Absent())
known = importlib.util.find_spec
importlib.util.find_spec = lambda name, package=None: None if name in {names!r} else known(name, package)
"""


def train(
    folder: Path,
    *arguments: str,
    without: tuple[str, ...] = (),
    before: Callable[[], None] | None = None,
    **environment: str,
) -> Outcome:
    """Run ``memcomp-train`` as a process in which some packages are not installed."""
    place = folder / "without"
    place.mkdir(exist_ok=True)
    (place / "sitecustomize.py").write_text(WITHOUT.format(names=without))
    done = subprocess.run(
        [sys.executable, "-m", "memcomp_lightning.cli.train", *arguments],
        cwd=folder,
        env={**os.environ, "OMP_NUM_THREADS": THREADS, "PYTHONPATH": str(place), **environment},
        preexec_fn=before,
        capture_output=True,
        text=True,
        check=False,
    )
    return Outcome(done.returncode, done.stdout, done.stderr)


def test_without_tensorboard_the_error_says_what_to_install_or_choose(tmp_path: Path) -> None:
    absent = ("tensorboard", "tensorboardX")
    refused = train(tmp_path, "sampler=cd", *LOGGED, without=absent)
    assert refused.status == 2
    assert "TensorBoard is not installed: pip install tensorboard, or logger=csv" in refused.err
    assert "Traceback" not in refused.err
    trained = train(tmp_path, "sampler=cd", *LOGGED, "logger=csv", "hydra.run.dir=run", without=absent)
    assert trained.status == 0, trained.err
    assert "Run folder:   run" in trained.out
    assert "TensorBoard:" not in trained.out


def test_without_tensorboard_figures_have_their_pictures(tmp_path: Path) -> None:
    small = ["data=digits", "figure.passes=[1]", "figure.iterations=[1]", "figure/curves=none", "figure.workers=1"]
    outcome = train(
        tmp_path,
        "experiment=figure4",
        *small,
        "data.partitions=2",
        "solver.max_steps=20",
        "hydra.run.dir=run",
        without=("tensorboard", "tensorboardX"),
    )
    assert outcome.status == 0, outcome.err
    assert "run gets no event file. pip install tensorboard" in outcome.out + outcome.err
    assert (tmp_path / "run/report.html").stat().st_size > 0


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


def bound_by_permissions() -> None:
    """Root of Linux gives up writing where permissions say no (prctl PR_CAPBSET_DROP, CAP_DAC_OVERRIDE)."""
    if sys.platform == "linux" and os.geteuid() == 0:
        ctypes.CDLL(None).prctl(24, 1, 0, 0, 0)


def test_a_folder_without_permission_is_named(tmp_path: Path) -> None:
    (tmp_path / "closed").mkdir(mode=0o500)
    probe = subprocess.run(["touch", "closed/probe"], cwd=tmp_path, preexec_fn=bound_by_permissions, check=False)
    if probe.returncode == 0:
        pytest.skip("permissions do not bind this user")
    outcome = train(tmp_path, "sampler=cd", *FAST, "hydra.run.dir=closed/run", before=bound_by_permissions)
    assert outcome.status == 2
    assert outcome.err.startswith(f"memcomp-train: hydra.run.dir = {tmp_path}/closed/run is not allowed: ")
    assert outcome.err.endswith("(Permission denied). Choose another folder with hydra.run.dir=PATH.\n")
    assert "Traceback" not in outcome.err


def test_paths_of_windows_in_settings_are_taken_as_they_are(memcomp_train: Run) -> None:
    """Quoted, backslashes and a drive's colon stay; the file is looked for under that very name."""
    outcome = memcomp_train(r"model.weights='C:\models\dbn.pt'", *FAST)
    assert outcome.status == 2
    assert r"C:\models\dbn.pt does not exist" in outcome.err
