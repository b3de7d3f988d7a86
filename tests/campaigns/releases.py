"""What is released, in empty environments: built, installed, and with the newest and the oldest libraries allowed.

    pip install 'memcomp-lightning[campaigns]'
    python tests/campaigns/releases.py --out FOLDER --pythons python3.11 python3.12 python3.13

* The wheel is built from two copies of the tree in different folders and from the source archive, and is the same
  byte by byte; so is the source archive. It holds what the tree has, and nothing else.
* Wheel and source archive are installed into an empty environment of each Python. There, in a folder far from the
  tree, the first commands of the README run; of the source archive, whose wheel is the same, the first one.
* All extras are resolved and installed with the newest versions of everything, and, on the first Python, with the
  oldest that ``pyproject.toml`` allows. Every module and every required library is imported, the commands run, and
  tests of the tree (``--tests``).

uv makes the environments: one copy of torch on the disk serves all of one Python. ``--installer pip`` does it as
most people do. ``UV_TORCH_BACKEND=cpu`` takes torch without CUDA, a tenth of its gigabytes. The ledger keeps what
was installed.
"""

import filecmp
import os
import shutil
import subprocess
import sys
import tarfile
import tempfile
import tomllib
import zipfile
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path

import ledger

ROOT = Path(__file__).resolve().parents[2]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
EXTRAS = sorted(PROJECT["optional-dependencies"])
GIVEN_UP_AFTER = 3600
"""Seconds; downloads of several gigabytes are meant to end."""

TESTS = ("tests/unit", "tests/exact")

RING = "9 9\n" + "".join(f"{i} {i % 9 + 1} {1 + i % 3}\n" for i in range(1, 10))
PEOPLE = "age,sex,colour\n" + "".join(
    f"{20 + 7 * (i % 5) + i % 3},{'fm'[i % 2]},{['red', 'green', '', 'blue'][i % 4]}\n" for i in range(60)
)

IMPORTS = """
import importlib, pkgutil, memcomp_lightning
names = [found.name for found in pkgutil.walk_packages(memcomp_lightning.__path__, "memcomp_lightning.")]
for name in names:
    importlib.import_module(name)
assert len(names) > 200, names
print(memcomp_lightning.__version__, memcomp_lightning.__file__)
"""
REQUIRED = """
import importlib, re
from importlib.metadata import packages_distributions, requires

def plain(name):
    return re.split("[^a-z0-9_]", name.lower().replace("-", "_"))[0]

direct, failed = set(map(plain, requires("memcomp-lightning"))), {}
for name, distributions in packages_distributions().items():
    if name.isidentifier() and not name.startswith("_") and direct & set(map(plain, distributions)):
        try:
            importlib.import_module(name)
        except Exception as error:
            failed[name] = f"{type(error).__name__}: {error}"
assert not failed, failed
"""
"""Modules of the package import those of its extras when they need them: each is imported by name."""

LOADS = """
import memcomp_lightning
run = memcomp_lightning.load("run")
print(run.model.energy, run.classifier, run.schema)
"""
_QUICK = ("data=digits", "pretrain.iterations=1", "callbacks=minimal", "logger=none")
_CLASSES, _NO_CLASSES = "finetune.iterations=1", "finetune.iterations=0"
_FIGURE = (
    *("experiment=figure4", "figure/curves=none", "data=digits", "data.partitions=2", "figure.passes=[1]"),
    *("figure.seeds=[0]", "figure.iterations=[1]", "solver.max_steps=20", "solver.n_restarts=3"),
    "figure.workers=1",
)
FIRST = (
    ("memcomp-train", "--help"),
    ("memcomp-train", "sampler=dmm_qubo", *_QUICK, _CLASSES, "hydra.run.dir=dbn"),
    ("memcomp-train", "model=rbm", "sampler=pcd", *_QUICK, _NO_CLASSES, "hydra.run.dir=run"),
    ("python", "-c", LOADS),
    ("memcomp-sample", "run", "n=5", "output=digits.npz"),
    ("memcomp-train", "resume=run"),
    ("memcomp-train", "continue=run", "pretrain.iterations=2", "hydra.run.dir=second"),
    ("memcomp-solve", "ring.txt"),
    ("memcomp-train", *_FIGURE, "hydra.run.dir=figure"),
    ("memcomp-report", "figure"),
)
"""The first commands of the README."""

_TABLE = (
    *("data=table", "data.path=people.csv", "model.hidden_sizes=[4]", "pretrain.updates=50"),
    *("pretrain.iterations=null", _NO_CLASSES, "callbacks=minimal"),
)
_SWEEP = ("-m", "sampler=cd,pcd", *_QUICK, _CLASSES, "hydra/launcher=joblib", "hydra.launcher.n_jobs=2")
WITH_EXTRAS = (
    ("memcomp-train", *_TABLE, "hydra.run.dir=table"),
    ("memcomp-sample", "table", "n=5", "output=rows.csv"),
    ("memcomp-score", "table", "people.csv", "output=scores.csv"),
    ("memcomp-impute", "table", "people.csv", "output=filled.csv"),
    ("memcomp-transform", "table", "filled.csv", "output=features.parquet"),
    *(
        ("memcomp-export", "run", f"format={name}", f"output=model.{ending}")
        for name, ending in (("safetensors", "safetensors"), ("onnx", "onnx"), ("rbms", "h5"))
    ),
    ("memcomp-train", *_SWEEP, "hydra.sweep.dir=sweep"),
    ("memcomp-solve", "ring.txt", "solver=dimod"),
)
"""What the extras are for: tables, exported models, sweeps, solvers of others."""


class FailedError(Exception):
    """A program that did not end well, with the last lines that it said."""


def said(*command: str | Path, folder: Path, **environment: str) -> str:
    """Run a program in a folder; what it printed.

    Raises:
        FailedError: It ended with another status than 0.
    """
    kept = {name: value for name, value in os.environ.items() if name not in ("PYTHONPATH", "MEMCOMP_DATA_DIR")}
    done = subprocess.run(
        command,
        cwd=folder,
        env={**kept, "OMP_NUM_THREADS": "1", **environment},
        capture_output=True,
        text=True,
        timeout=GIVEN_UP_AFTER,
        check=False,
    )
    if done.returncode != 0:
        line = " ".join(map(str, command)).replace("\n", " ")[:120]
        last = " / ".join((done.stdout + done.stderr).strip().splitlines()[-12:])[-2000:]
        raise FailedError(f"{line} ended with {done.returncode}: {last}")
    return done.stdout


# ----------------------------------------------------------------------------------------------------------- built


def tracked(root: Path = ROOT) -> list[Path]:
    """Files and links of the tree, from its root."""
    listed = said("git", "ls-files", "-z", folder=root).split("\0")
    return [Path(name) for name in listed if name and (root / name).exists()]


def copied(files: Sequence[Path], folder: Path, *, mode: int) -> Path:
    """A copy of the tree, of other times and permissions."""
    for name in files:
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(ROOT / name, folder / name, follow_symlinks=False)
        if not (folder / name).is_symlink():
            (folder / name).chmod(mode)
    return folder


def built(tree: Path, out: Path, *kinds: str) -> list[Path]:
    """The archives of a tree, as CONTRIBUTING.md says that a release is built."""
    time = said("git", "log", "-1", "--format=%ct", folder=ROOT).strip()
    build = (sys.executable, "-m", "build", "--no-isolation", *kinds, "--outdir", str(out), str(tree))
    said(*build, folder=tree, SOURCE_DATE_EPOCH=time)
    return sorted(out.iterdir())


def differing(first: Path, second: Path) -> str | None:
    """In what two archives differ; None if no byte does."""
    if first.name != second.name:
        return f"{first.name} and {second.name}"
    if filecmp.cmp(first, second, shallow=False):
        return None
    parts = [_parts(path) for path in (first, second)]
    names = sorted(name for name in parts[0].keys() | parts[1].keys() if parts[0].get(name) != parts[1].get(name))
    return f"{first.name}: {', '.join(names[:5]) or 'order, times or permissions'}"


def _parts(archive: Path) -> dict[str, bytes]:
    if archive.suffix == ".whl":
        with zipfile.ZipFile(archive) as wheel:
            return {name: wheel.read(name) for name in wheel.namelist()}
    with tarfile.open(archive) as source:
        members = [member for member in source.getmembers() if member.isfile()]
        return {member.name: source.extractfile(member).read() for member in members}  # type: ignore[union-attr]


def misplaced(wheel: Path, files: Sequence[Path]) -> list[str]:
    """What a wheel lacks of the package's files, and what it has beside them."""
    expected = {
        ("memcomp_lightning/" if name.parts[0] == "conf" else "") + name.as_posix()
        for name in files
        if name.parts[0] in ("memcomp_lightning", "conf") and name.as_posix() != "memcomp_lightning/conf"
    }
    about = f"memcomp_lightning-{PROJECT['version']}.dist-info"
    expected |= {f"{about}/{name}" for name in ("METADATA", "WHEEL", "RECORD", "entry_points.txt")}
    expected |= {f"{about}/licenses/LICENSE"}
    found = set(_parts(wheel))
    return [
        *(f"{wheel.name} lacks {name}" for name in sorted(expected - found)),
        *(f"{wheel.name} holds {name}" for name in sorted(found - expected)),
    ]


def reproducible(folder: Path) -> ledger.Outcome:
    """The archives of two copies of the tree and of the source archive, held against each other."""
    files, findings = tracked(), []
    trees = [copied(files, folder / "a", mode=0o644), copied(files[::-1], folder / "other/b", mode=0o600)]
    archives = [built(tree, folder / f"dist_{number}") for number, tree in enumerate(trees)]
    wheels_of = [next(path for path in some if path.suffix == ".whl") for some in archives]
    with tarfile.open(next(path for path in archives[0] if path.suffix == ".gz")) as source:
        source.extractall(folder / "unpacked", filter="data")
    unpacked = next((folder / "unpacked").iterdir())
    directly = built(trees[1], folder / "dist_2", "--wheel")
    findings += stray(unpacked, files)
    pairs = [*zip(*archives, strict=True), (wheels_of[0], directly[0])]
    findings += [f"differs: {where}" for pair in pairs if (where := differing(*pair)) is not None]
    findings += misplaced(wheels_of[0], files)
    sizes: dict[str, float | str] = {path.name: float(path.stat().st_size) for path in archives[0]}
    return ledger.Outcome(kind="archives built twice", tried=len(pairs), findings=findings, facts=sizes)


def stray(unpacked: Path, files: Sequence[Path]) -> list[str]:
    """What a source archive holds beside the tree's own files, and what it lacks of them."""
    found = {path.relative_to(unpacked) for path in unpacked.rglob("*") if path.is_file() or path.is_symlink()}
    # How the project's own machines run it, and the link for editable installs.
    expected = {name for name in files if name.parts[0] != ".ci" and name != Path("memcomp_lightning/conf")}
    return [
        *(f"the source archive holds {name}" for name in sorted(found - expected - {Path("PKG-INFO")})),
        *(f"the source archive lacks {name}" for name in sorted(expected - found)),
    ]


def described(folder: Path) -> ledger.Outcome:
    """twine on both archives: an index shows the README and takes the metadata."""
    archives = built(ROOT, folder / "dist")
    said(sys.executable, "-m", "twine", "check", "--strict", *archives, folder=folder)
    return ledger.Outcome(kind="metadata", tried=len(archives))


# ------------------------------------------------------------------------------------------------------- installed


@dataclass(frozen=True)
class Environment:
    """An empty environment in a folder, and the folder far from the tree in which its commands run."""

    folder: Path
    python: str
    installer: str
    tried: list[str] = field(default_factory=list)
    findings: list[str] = field(default_factory=list)

    @property
    def own(self) -> Path:
        return self.folder / "environment/bin/python"

    def make(self) -> None:
        (self.folder / "far").mkdir(parents=True)
        (self.folder / "far/ring.txt").write_text(RING)
        (self.folder / "far/people.csv").write_text(PEOPLE)
        making = {"uv": (*_UV, "venv", "--python", self.python), "pip": (self.python, "-m", "venv")}
        said(*making[self.installer], self.folder / "environment", folder=self.folder)

    def install(self, *what: str | Path, folder: Path = ROOT) -> None:
        commands = {
            "uv": (*_UV, "pip", "install", "--python", self.own),
            "pip": (self.own, "-m", "pip", "install"),
        }
        said(*commands[self.installer], *what, folder=folder)

    def try_all(self, commands: Sequence[Sequence[str]]) -> None:
        """Run commands, of which each finds what the ones before have left."""
        for name, *arguments in commands:
            self.attempt(self.own.with_name(name), *arguments, folder=self.folder / "far")

    def attempt(self, *command: str | Path, folder: Path, **environment: str) -> None:
        self.tried.append(Path(command[0]).name)
        try:
            said(*command, folder=folder, MPLBACKEND="agg", **environment)
        except (FailedError, subprocess.TimeoutExpired) as error:
            self.findings.append(str(error))

    def outcome(self, kind: str) -> ledger.Outcome:
        listed = said(*_UV, "pip", "list", "--python", self.own, "--format", "freeze", folder=self.folder)
        facts: dict[str, float | str] = {
            "python": said(self.own, "-V", folder=self.folder).strip(),
            "installed": " ".join(listed.split()),
        }
        return ledger.Outcome(kind=kind, tried=len(self.tried), findings=self.findings, facts=facts)


_UV = (sys.executable, "-m", "uv", "--quiet")


def installed(archive: str, folder: Path, python: str, installer: str) -> ledger.Outcome:
    """An archive alone in an empty environment."""
    ending = {"wheel": ".whl", "source archive": ".gz"}[archive]
    path = next(path for path in built(ROOT, folder / "dist") if path.suffix == ending)
    environment = Environment(folder, python, installer)
    environment.make()
    environment.install(path)
    # The wheel that is made of the source archive is the same byte by byte: its commands are tried once.
    environment.try_all(FIRST if archive == "wheel" else FIRST[:1])
    return environment.outcome(f"{archive} by {installer}, {said(python, '-V', folder=folder).strip()}")


def resolved(
    resolution: str, folder: Path, python: str, installer: str, tests: Sequence[str] = TESTS
) -> ledger.Outcome:
    """All extras, with the newest or the oldest versions, and the wheel."""
    wheel = built(ROOT, folder / "dist", "--wheel")[0]
    environment = Environment(folder, python, "uv" if resolution == "oldest" else installer)
    environment.make()
    if resolution == "oldest":
        oldest = ("--resolution", "lowest-direct", "--all-extras", "--requirements", str(ROOT / "pyproject.toml"))
        environment.install(*oldest)
        environment.install("--no-deps", wheel)
    else:
        environment.install(f"{wheel}[{','.join(EXTRAS)}]")
    environment.try_all([("python", "-c", IMPORTS), ("python", "-c", REQUIRED), *FIRST, *WITH_EXTRAS])
    for test in tests:
        pytest = ("-m", "pytest", "-q", "-n", "0", "-p", "no:cacheprovider", test)
        environment.attempt(environment.own, *pytest, folder=ROOT, PYTHONPATH=str(ROOT))
    return environment.outcome(f"{resolution} versions, all extras, {said(python, '-V', folder=folder).strip()}")


def each_resolves(resolution: str, folder: Path, python: str) -> ledger.Outcome:
    """Each extra alone, and none, without installing anything."""
    findings, version = [], said(python, "-V", folder=folder).split()[1]
    newest_or_oldest = {"newest": "highest", "oldest": "lowest-direct"}[resolution]
    options = ("--python-version", version, "--resolution", newest_or_oldest, "--output-file", "found.txt")
    for extra in (None, *EXTRAS):
        chosen = () if extra is None else ("--extra", extra)
        try:
            said(*_UV, "pip", "compile", *options, *chosen, ROOT / "pyproject.toml", folder=folder)
        except FailedError as error:
            findings.append(str(error))
        (folder / "found.txt").unlink(missing_ok=True)
    kind = f"{resolution} versions, each extra resolved alone"
    return ledger.Outcome(kind=kind, tried=1 + len(EXTRAS), findings=findings)


# ---------------------------------------------------------------------------------------------------- the campaign

Attempt = Callable[[Path], ledger.Outcome]


def cases(pythons: Sequence[str], installer: str, tests: Sequence[str]) -> dict[str, Attempt]:
    """What is tried, by name; environments with torch in them come last."""
    found: dict[str, Attempt] = {"reproducible": reproducible, "metadata": described}
    for python in pythons:
        for resolution in ("newest", "oldest"):
            found[f"each extra/{resolution}/{python}"] = partial(each_resolves, resolution, python=python)
    for python in pythons:
        for archive in ("wheel", "source archive"):
            made = partial(installed, archive, python=python, installer=installer)
            found[f"{archive}/{installer}/{python}"] = made
        made = partial(resolved, "newest", python=python, installer=installer, tests=tests)
        found[f"newest/{installer}/{python}"] = made
    found[f"oldest/{pythons[0]}"] = partial(resolved, "oldest", python=pythons[0], installer="uv", tests=tests)
    return found


def attempt(case: str, attempts: dict[str, Attempt]) -> ledger.Outcome:
    """One case, in a folder that goes away with its environment."""
    with tempfile.TemporaryDirectory(prefix="memcomp_release_") as folder:
        try:
            return attempts[case](Path(folder))
        except (FailedError, subprocess.TimeoutExpired) as error:
            return ledger.Outcome(kind=case, findings=[str(error)])


def chosen(names: Sequence[str], only: Sequence[str]) -> Iterator[str]:
    """Cases whose names begin with one of these words."""
    return (name for name in names if not only or name.startswith(tuple(only)))


def main() -> int:
    lines = ledger.parser(__doc__, count=100, what="cases")
    lines.add_argument("--pythons", nargs="+", default=[sys.executable], help="interpreters, the oldest first")
    lines.add_argument("--installer", choices=("uv", "pip"), default="uv", help="what installs (default uv)")
    lines.add_argument(
        "--tests", nargs="*", default=TESTS, help=f"tests of all extras (default {' '.join(TESTS)})"
    )
    lines.add_argument("--only", nargs="*", default=(), help="cases whose names begin so")
    given = lines.parse_args()
    attempts = cases(given.pythons, given.installer, given.tests)
    names = list(chosen([*attempts], given.only))[: given.count]
    return ledger.run(given.out, names, partial(attempt, attempts=attempts), workers=1)


if __name__ == "__main__":
    sys.exit(main())
