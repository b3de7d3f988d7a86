"""Another project uses the built wheel, in an environment of its own, with the release candidate of Hydra 1.4.

``tests/downstream`` is that project. Nothing of the checkout is on its path.
"""

import json
import os
import re
import shutil
import subprocess
import sys
from importlib.metadata import distribution
from pathlib import Path

import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name
from running import Program

import memcomp_lightning

pytestmark = pytest.mark.xdist_group("wheel")  # one worker, one wheel, one environment

ROOT = Path(memcomp_lightning.__file__).parents[1]
HYDRA = "1.4.0rc3"
OTHER_VERSIONS = r"hydra-.*|omegaconf|antlr4-.*|optuna"
"""What belongs to Hydra 1.3, with which all other tests run."""

FAST = [
    *("pretrain.iterations=2", "finetune.iterations=2", "solver.max_steps=20", "solver.n_restarts=5"),
    *("preset=paper", "callbacks=minimal", "logger=none"),
]


def environment() -> dict[str, str]:
    others = {name: value for name, value in os.environ.items() if not name.startswith(("PYTHON", "PYTEST_"))}
    return {**others, "OMP_NUM_THREADS": "1", "PIP_DISABLE_PIP_VERSION_CHECK": "1"}


def run(*command: str | Path, folder: Path, status: int = 0) -> str:
    """Output of a command that ends with ``status``; the checkout is not on its path."""
    done = subprocess.run([*map(str, command)], cwd=folder, env=environment(), capture_output=True, text=True)
    assert done.returncode == status, done.stdout[-3000:] + done.stderr[-3000:]
    return done.stdout + done.stderr


def run_warm(python: Path, *arguments: str | Path, folder: Path, **also: str) -> str:
    """Output of ``python ARGUMENTS``; torch, Lightning and our wheel are imported already."""
    program = Program([*map(str, arguments)], folder, {**environment(), **also}, str(python))
    out, err = program.communicate()
    assert program.returncode == 0, out[-3000:] + err[-3000:]
    return out + err


@pytest.fixture(scope="session")
def constraints(tmp_path_factory: pytest.TempPathFactory) -> Path:
    lines = (ROOT / "constraints.txt").read_text().splitlines(keepends=True)
    path = tmp_path_factory.mktemp("constraints") / "constraints.txt"
    path.write_text("".join(line for line in lines if not re.match(f"({OTHER_VERSIONS})==", line)))
    return path


@pytest.fixture(scope="session")
def requirements(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with what our package requires without its extras, by links: installing torch takes long."""
    folder, seen = tmp_path_factory.mktemp("requirements"), set()
    required = ["memcomp-lightning", "pytest"]
    while required:
        requirement = Requirement(required.pop())
        name = canonicalize_name(requirement.name)
        if re.fullmatch(OTHER_VERSIONS, name) or (name, *requirement.extras) in seen:
            continue
        seen.add((name, *requirement.extras))
        installed = distribution(name)
        for text in installed.requires or []:
            marker = Requirement(text).marker
            if marker is None or any(marker.evaluate({"extra": extra}) for extra in (*requirement.extras, "")):
                required.append(text)
        if name != "memcomp-lightning":
            for entry in {file.parts[0] for file in installed.files or []} - {"..", "__pycache__"}:
                if not entry.endswith(".pth") and not (folder / entry).is_symlink():
                    (folder / entry).symlink_to(installed.locate_file(entry))
    return folder


def new_environment(folder: Path, *packages: str | Path, below: list[Path], constraints: Path) -> Path:
    """Interpreter of an environment with some packages, in which those of the folders ``below`` are seen."""
    run(sys.executable, "-m", "venv", "--without-pip", folder, folder=folder.parent)
    python, version = folder / "bin/python", "python{}.{}".format(*sys.version_info)
    (folder / "lib" / version / "site-packages/below.pth").write_text("\n".join(map(str, below)))
    pip = [sys.executable, "-m", "pip", "--python", python]
    run(*pip, "install", "--no-compile", "-c", constraints, *packages, folder=folder)
    return python


@pytest.fixture(scope="session")
def project(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A copy of the project, far from the checkout."""
    return Path(shutil.copytree(ROOT / "tests/downstream", tmp_path_factory.mktemp("project") / "sparse-digits"))


@pytest.fixture(scope="session")
def python(
    wheel: Path, project: Path, requirements: Path, constraints: Path, tmp_path_factory: pytest.TempPathFactory
) -> Path:
    """Interpreter of an environment with the wheel, the project and what they require; pip sees to it."""
    folder = tmp_path_factory.mktemp("environment")
    run(sys.executable, "-m", "build", "--no-isolation", "--wheel", "--outdir", folder, ".", folder=project)
    packages = [f"hydra-core=={HYDRA}", "pytest", wheel, *folder.glob("*.whl")]
    return new_environment(folder / "venv", *packages, below=[requirements], constraints=constraints)


@pytest.fixture(scope="session")
def plugins(python: Path, requirements: Path, constraints: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Packages of a second environment on top of it, with the extra for sweeps."""
    site_packages = python.parents[1] / "lib/python{}.{}/site-packages".format(*sys.version_info)
    own = [f"hydra-{name}=={HYDRA}" for name in ("joblib-launcher", "optuna-sweeper", "submitit-launcher")]
    folder = tmp_path_factory.mktemp("plugins") / "venv"
    below = [site_packages, requirements]
    new_environment(folder, "memcomp-lightning[sweep]", *own, below=below, constraints=constraints)
    return folder / site_packages.relative_to(python.parents[1])


def test_it_is_the_wheel_with_hydra_1_4(python: Path, tmp_path: Path) -> None:
    code = "import hydra, memcomp_lightning as m; print(hydra.__version__, m.__version__, m.__file__)"
    version, own, file = run_warm(python, "-c", code, folder=tmp_path).split()
    assert (version, own) == (HYDRA, memcomp_lightning.__version__)
    assert Path(file).is_relative_to(python.parents[1])


def test_its_module_trains_with_our_callbacks(python: Path, tmp_path: Path) -> None:
    out = run_warm(python, python.parent / "sparse-digits", "max_epochs=3", "hydra.run.dir=run", folder=tmp_path)
    assert "RandomScan: sparsity 0." in out
    header = (tmp_path / "run/csv/version_0/metrics.csv").read_text().splitlines()[0].split(",")
    for name in ("reconstruction_error", "free_energy_gap", "energy_model", "negative_phase/bits_changed"):
        assert f"SparseRBM/{name}" in header


def test_its_multirun_takes_its_sampler_and_ours(python: Path, tmp_path: Path) -> None:
    sweep = ["-m", "sampler=random_scan,cd", "max_epochs=1"]
    out = run_warm(python, python.parent / "sparse-digits", *sweep, folder=tmp_path)
    assert re.findall(r"^(\w+): sparsity", out, flags=re.MULTILINE) == ["RandomScan", "CD"]


def test_its_sampler_pretrains_our_dbn(python: Path, tmp_path: Path) -> None:
    train = [python.parent / "memcomp-train", "hydra.searchpath=[pkg://sparse_digits.conf]", "sampler=random_scan"]
    out = run_warm(python, *train, *FAST, "hydra.run.dir=run", folder=tmp_path)
    assert "test accuracy" in out
    assert len(json.loads((tmp_path / "run/result.json").read_text())["stages"]["pretrain"]["energy_gap"]) == 2


def test_its_own_tests_pass(python: Path, project: Path) -> None:
    assert "4 passed" in run_warm(python, "-m", "pytest", "-q", "-p", "no:cacheprovider", folder=project)


def test_help_of_our_command(python: Path, tmp_path: Path) -> None:
    out = run_warm(python, python.parent / "memcomp-train", "--help", folder=tmp_path)
    assert "sampler: annealer, block_annealing, cd" in out
    assert "hparams: pretraining" in out


def test_our_types_are_seen(python: Path, project: Path, tmp_path: Path) -> None:
    wrong = tmp_path / "wrong.py"
    wrong.write_text("from memcomp_lightning.models import RBM\n\nRBM('three', 2)\n")
    mypy = [sys.executable, "-m", "mypy", "--python-executable", python, "--cache-dir", os.devnull]
    out = run(*mypy, "sparse_digits", wrong, folder=project, status=1)
    assert 'wrong.py:3: error: Argument 1 to "RBM" has incompatible type "str"; expected "int | None"' in out
    assert "Found 1 error in 1 file" in out


WITHOUT_EXTRAS = {
    "sampler=annealer": "dimod",
    "solver=dimod": "dimod",
    "model=zephyr": "dimod",
    "-m hydra/launcher=joblib": "sweep",
    "-m hydra/launcher=submitit_local": "sweep",
    "-m hparams=pretraining": "sweep",
}

EACH_IN_TURN = """
import contextlib, sys
from hydra.core.global_hydra import GlobalHydra
from memcomp_lightning.cli import train

for arguments in sys.argv[1:]:
    sys.argv[1:] = arguments.split()
    GlobalHydra.instance().clear()
    with contextlib.suppress(SystemExit):
        train.main()
"""


def test_without_an_extra_the_message_says_what_to_install(python: Path, tmp_path: Path) -> None:
    messages = run_warm(python, "-c", EACH_IN_TURN, *WITHOUT_EXTRAS, folder=tmp_path).splitlines()
    for message, extra in zip(messages, WITHOUT_EXTRAS.values(), strict=True):
        assert message.startswith("memcomp-train: ")
        assert message.endswith(f"pip install 'memcomp-lightning[{extra}]'.")


def test_imports_without_extras(python: Path, tmp_path: Path) -> None:
    code = """
import importlib, pkgutil, memcomp_lightning
needs = ("problems.bqm", "problems.cqm", "solvers.dimod", "samplers.annealer")
needs += ("interop.memcomp_sampler", "interop.qpu")
for module in pkgutil.walk_packages(memcomp_lightning.__path__, "memcomp_lightning."):
    if not module.name.endswith(needs) and ".data.tables" not in module.name:
        importlib.import_module(module.name)
named = {"solvers": ["DimodSolver"], "samplers": ["AnnealerSamples"], "interop": ["MemcompSampler", "QpuSampler"]}
named["data"] = ["Table"]
for package, name in [(package, name) for package, names in named.items() for name in names]:
    try:
        getattr(getattr(memcomp_lightning, package), name)
    except ModuleNotFoundError as error:
        print(name, error)
"""
    out = run_warm(python, "-c", code, folder=tmp_path)
    extras = re.findall(r"^(\w+) .*pip install 'memcomp-lightning\[(\w+)\]'\.$", out, flags=re.MULTILINE)
    names = ("DimodSolver", "AnnealerSamples", "MemcompSampler", "QpuSampler", "Table")
    assert extras == list(zip(names, ("dimod", "dimod", "dimod", "dwave", "tables"), strict=True))


def test_parallel_search_with_hydra_1_4(python: Path, plugins: Path, tmp_path: Path) -> None:
    train = ["-m", "memcomp_lightning.cli.train", "-m", "callbacks=minimal", *FAST]
    search = ["hparams=pretraining", "hydra.sweeper.n_trials=2", "hydra.sweeper.n_jobs=2", "hydra/launcher=joblib"]
    storage = ["hydra.sweeper.storage=sqlite:///study.db", "hydra.sweeper.study_name=trials"]
    own = {"folder": tmp_path, "PYTHONPATH": str(plugins)}
    run_warm(python, *train, "sampler=cd", *search, *storage, "hydra.sweep.dir=search", **own)
    assert "best_value" in (tmp_path / "search/optimization_results.yaml").read_text()
