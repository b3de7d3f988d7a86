"""Mutants: small changes of the package's text, each of which some test must refuse.

``python tests/campaigns/mutants.py --out FOLDER --count 1000`` (``pip install cosmic-ray coverage``). A case is
``FILE:LINE/OPERATOR/NUMBER``: one change that an operator of cosmic-ray makes of one file, drawn from all of them
with a fixed seed. The folder gets a copy of the package and its tests, where texts are changed. Each file of tests
is run once there, to see which lines each test runs; a mutant meets the tests that run its statement, the quickest
of each function first, up to the first that fails. Numba's compilation is off. What kills is run once more without
a mutant, and must pass.

With ``--again FOLDER`` the cases are those that survived in another folder, in the texts as they are now; what the
other folder knows of tests that have not changed is kept.
"""

import difflib
import json
import os
import random
import shutil
import sys
import time
from collections.abc import Iterable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager
from functools import cache, partial
from itertools import accumulate, islice
from pathlib import Path
from typing import Any

import forked_tests
import ledger
from forked_tests import in_a_fork
from ledger import Outcome
from mutations import Mutant, is_python, mutants, statement

ROOT = Path(__file__).resolve().parents[2]
PACKAGES = ("models", "samplers", "likelihood", "problems", "training")
SOURCES = [f"memcomp_lightning/{package}/*" for package in PACKAGES]
TESTS = ("unit", "exact", "statistical")
COPIED = ("memcomp_lightning", "tests", "conf", "docs", "experiments", "notebooks", "pyproject.toml", "README.md")
SEED = 0
FIRST = 2.0
"""Seconds of files of tests, with their collection, that are tried in one process before all others are."""
MOST_SECONDS = 60
"""Of tests for one mutant; those of module level could be all."""
PATIENCE = 5
"""Times the usual duration after which a mutant counts as killed by time."""
START = 60
"""Seconds for imports and collection, beside the duration of the tests."""


# ------------------------------------------------------------------------------------------------------ the copy


def copied(folder: Path) -> Path:
    """A copy of the project, made once: what is tried in this folder stays the same."""
    tree = folder / "tree"
    if not tree.exists():
        part = folder / "tree.part"
        shutil.rmtree(part, ignore_errors=True)
        part.mkdir(parents=True)
        for name in COPIED:
            if (ROOT / name).is_dir():
                ignored = shutil.ignore_patterns("__pycache__", ".*", "_site")
                shutil.copytree(ROOT / name, part / name, symlinks=True, ignore=ignored)
            else:
                shutil.copy2(ROOT / name, part / name)
        part.replace(tree)
    return tree


def sources(tree: Path) -> list[Path]:
    """The files of the packages, by name."""
    return sorted(file for package in PACKAGES for file in (tree / "memcomp_lightning" / package).rglob("*.py"))


# ------------------------------------------------------------------------------------------- which tests run what


def test_files(tree: Path) -> list[str]:
    return [str(f.relative_to(tree)) for part in TESTS for f in sorted((tree / "tests" / part).rglob("test_*.py"))]


def _map_file(folder: Path, tree: Path, test_file: str, texts: str) -> Path:
    own = forked_tests.digest([tree / test_file])
    return folder / "map" / f"{test_file.replace('/', '.')}-{own}-{texts}.json"


def map_one(test_file: str, *, folder: Path, tree: Path, texts: str) -> None:
    place = _map_file(folder, tree, test_file, texts)
    if place.exists():
        return
    began = time.monotonic()
    log = folder / "logs" / f"map-{os.getpid()}.txt"
    found = in_a_fork(lambda: forked_tests.mapped(tree, test_file, SOURCES), seconds=1800, log=log)
    found = found or {"seconds": {}, "bad": ["all: more than 1800 s"], "lines": {}}
    write(found, place)
    took = time.monotonic() - began
    print(
        f"{test_file}: {len(found['seconds'])} tests in {took:.0f} s, {len(found['bad'])} not asked",
        file=sys.stderr,
    )


def write(found: object, place: Path) -> None:
    """As JSON, whole or not at all."""
    part = place.with_suffix(".part")
    part.write_text(json.dumps(found))
    part.replace(place)


class Map:
    """Which tests run which lines, how long each takes, and how long the collection of each file takes."""

    def __init__(self, files: Iterable[Path]) -> None:
        self.seconds: dict[str, float] = {}
        self.collecting: dict[str, float] = {}
        self.tests: dict[str, dict[str, frozenset[int]]] = {}
        self.imported: dict[str, set[int]] = {}
        for file in files:
            found = json.loads(file.read_text())
            self.seconds |= found["seconds"]
            self.collecting |= {_file(test): found["collecting"] for test in found["seconds"]}
            for source, tests in found["lines"].items():
                self.imported.setdefault(source, set()).update(tests.pop("", ()))
                self.tests.setdefault(source, {}).update((test, frozenset(lines)) for test, lines in tests.items())

    def of(self, source: str, lines: range) -> tuple[list[str], list[str]]:
        """Tests for a change in these lines: those to begin with, and the others.

        What runs when its module is imported concerns each test that runs some line of the file. One begins with
        the quickest of each test function, in the files that are quickest with their collection.
        """
        tests = self.tests.get(source, {})
        chosen = [test for test, run in tests.items() if not run.isdisjoint(lines)]
        if not self.imported.get(source, set()).isdisjoint(lines):
            chosen = list(tests)
        chosen.sort(key=self.seconds.__getitem__)
        first: dict[str, str] = {}
        for test in chosen:
            first.setdefault(test.partition("[")[0], test)
        total = dict.fromkeys(map(_file, chosen), 0.0)
        for test in first.values():
            total[_file(test)] += self.seconds[test]
        files = sorted(total, key=lambda file: self.collecting[file] + total[file])
        spent = accumulate(self.collecting[file] + total[file] for file in files)
        begun = {
            file for number, (file, s) in enumerate(zip(files, spent, strict=True)) if not number or s < FIRST
        }
        begin = [test for test in first.values() if _file(test) in begun]
        spent = accumulate(self.seconds[test] for test in chosen)
        others = [test for test, s in zip(chosen, spent, strict=True) if s < MOST_SECONDS and test not in {*begin}]
        return begin, others

    def expected(self, tests: Iterable[str]) -> float:
        """Seconds for the collection of their files and for the tests."""
        tests = list(tests)
        return sum(self.collecting[file] for file in {*map(_file, tests)}) + sum(self.seconds[t] for t in tests)


def _file(test: str) -> str:
    return test.partition("::")[0]


@cache
def whole_map(folder: Path, tree: Path) -> Map:
    texts = forked_tests.digest(sources(tree))
    files = [_map_file(folder, tree, name, texts) for name in test_files(tree)]
    return Map(file for file in files if file.exists())


# ------------------------------------------------------------------------------------------------------- a mutant


def sample(tree: Path, count: int) -> list[str]:
    """The first so many of all mutants, shuffled, that are Python: some change the ``*`` of a signature."""
    package = tree / "memcomp_lightning"
    texts = {file: file.read_text(encoding="utf-8") for file in sources(tree)}
    every = [(file, mutant) for file, text in texts.items() for mutant in mutants(text)]
    random.Random(SEED).shuffle(every)
    drawn = (pair for pair in every if is_python(pair[1].of(texts[pair[0]])))
    return [
        f"{file.relative_to(package)}:{mutant.line}/{mutant.operator.partition('/')[2]}/{mutant.occurrence}"
        for file, mutant in islice(drawn, count)
    ]


@cache
def own_tree(folder: Path, process: int) -> Path:
    """A copy for this process alone."""
    own = folder / f"tree-{process}"
    shutil.rmtree(own, ignore_errors=True)
    shutil.copytree(folder / "tree", own, symlinks=True)
    return own


def attempt(case: str, *, folder: Path) -> Outcome:
    """Change the text, and see whether a test says so."""
    tree = own_tree(folder, os.getpid())
    place, operator, occurrence = case.rsplit("/", 2)
    name, _, line = place.rpartition(":")
    file = tree / "memcomp_lightning" / name
    mutant = Mutant(f"core/{operator}", int(occurrence), int(line))
    found = tried(mutant, file, tree=tree, known=whole_map(folder, folder / "tree"), folder=folder)
    findings = (
        [f"{found['outcome']}: {found['change']}"] if found["outcome"] in ("survived", "not covered") else []
    )
    return Outcome(kind=name.partition("/")[0], findings=findings, facts=found)


def tried(mutant: Mutant, file: Path, *, tree: Path, known: Map, folder: Path) -> dict[str, float | str]:
    """What becomes of a mutant: killed (by which test), killed by time, survived, or not covered."""
    began = time.monotonic()
    original = file.read_text(encoding="utf-8")
    source = str(file.relative_to(tree))
    begin, others = known.of(source, statement(original, mutant.line))
    changed = mutant.of(original)
    said: dict[str, float | str] = {"outcome": "survived", "change": _difference(original, changed)}
    said |= {"tests": len(begin) + len(others), "ran": 0}
    if not begin:
        return said | {"outcome": "not covered"}
    with mutated(file, changed):
        for some in filter(None, (begin, others)):
            killed_by = _killer(some, tree, known, folder)
            said["ran"] = int(said["ran"]) + len(some)
            if killed_by is not None:
                said |= {"outcome": "killed by time" if killed_by == "time" else "killed", "by": killed_by}
                break
    return said | {"seconds": round(time.monotonic() - began, 1)}


def _killer(tests: Sequence[str], tree: Path, known: Map, folder: Path) -> str | None:
    seconds = START + PATIENCE * known.expected(tests)
    log = folder / "logs" / f"mutant-{os.getpid()}.txt"
    try:
        found = in_a_fork(lambda: forked_tests.outcome(tree, tests), seconds=seconds, log=log)
    except RuntimeError:
        return "the process died"
    if found is None:
        return "time"
    if found["status"] == 0:
        return None
    return found["failed"] or "collection"


@contextmanager
def mutated(file: Path, text: str) -> Iterator[None]:
    """The file has another text within, and is newer than its bytecode."""
    original, stat = file.read_bytes(), file.stat()
    try:
        file.write_text(text, encoding="utf-8")
        os.utime(file, (stat.st_atime, stat.st_mtime + 1000))
        yield
    finally:
        file.write_bytes(original)
        os.utime(file, (stat.st_atime, stat.st_mtime))


def _difference(before: str, after: str) -> str:
    """The lines that differ, before and after."""
    lines = list(difflib.unified_diff(before.splitlines(), after.splitlines(), n=0, lineterm=""))[3:]
    old, new = (" ".join(line[1:].strip() for line in lines if line[0] == sign) for sign in "-+")
    return f"`{old}` -> `{new}`"


# -------------------------------------------------------------------------------------------------- the campaign


def table(lines: Iterable[dict[str, Any]]) -> str:
    """By package: how many mutants, what became of them, and the share that was killed."""
    columns = ("killed", "killed by time", "survived", "not covered")
    counts: dict[str, dict[str, int]] = {}
    for line in lines:
        for row in (line["kind"], "all"):
            of_row = counts.setdefault(row, dict.fromkeys(columns, 0))
            of_row[line["facts"]["outcome"]] += 1
    rows = []
    for row in sorted(counts, key=lambda name: (name == "all", name)):
        found = [counts[row][column] for column in columns]
        share = (found[0] + found[1]) / sum(found)
        rows.append(f"| {row} | {sum(found):,} | " + " | ".join(f"{n:,}" for n in found) + f" | {share:.1%} |")
    head = "| | mutants | " + " | ".join(columns) + " | share killed |"
    return "\n".join([head, "| --- " * 7 + "|", *rows])


def unsound(lines: Iterable[dict[str, Any]], folder: Path) -> Iterator[str]:
    """Killing tests that fail without a mutant, too."""
    killers: dict[str, set[str]] = {}
    for line in lines:
        test = str(line["facts"].get("by"))
        if line["facts"]["outcome"] == "killed" and "::" in test:
            killers.setdefault(_file(test), set()).add(test)
    place = folder / "sound.json"
    sound = set(json.loads(place.read_text())) if place.exists() else set()
    for tests in killers.values():
        left = sorted(tests - sound)
        while left:
            run = partial(forked_tests.outcome, folder / "tree", left)
            found = in_a_fork(run, seconds=600, log=folder / "logs" / "sound.txt")
            failed = None if found and found["status"] == 0 else (found or {}).get("failed") or left[0]
            passed = left[: left.index(failed)] if failed else left
            sound |= {*passed}
            write(sorted(sound), place)
            if failed:
                yield failed
            left = left[len(passed) + 1 :]


def main() -> int:
    lines = ledger.parser(__doc__, count=1000, what="mutants")
    lines.add_argument("--again", type=Path, help="folder of a campaign whose survivors are tried anew")
    arguments = lines.parse_args()
    folder: Path = arguments.out.resolve()
    if arguments.again and not (folder / "map").exists():
        shutil.copytree(arguments.again / "map", folder / "map")
    (folder / "map").mkdir(parents=True, exist_ok=True)
    (folder / "logs").mkdir(exist_ok=True)
    tree = copied(folder)
    forked_tests.warm_up()
    texts = forked_tests.digest(sources(tree))
    mapping = partial(map_one, folder=folder, tree=tree, texts=texts)
    with ProcessPoolExecutor(arguments.workers) as pool:
        list(pool.map(mapping, test_files(tree)))
    if arguments.again:
        before = ledger.read(arguments.again / "ledger.jsonl")
        cases = [str(line["case"]) for line in before if line["findings"]]
    else:
        cases = sample(tree, arguments.count)
    try:
        status = ledger.run(folder, cases, partial(attempt, folder=folder), workers=arguments.workers)
    finally:
        for own in folder.glob("tree-*"):
            shutil.rmtree(own)
    known = ledger.read(folder / "ledger.jsonl")
    print(table(known))
    for test in unsound(known, folder):
        print(f"fails without a mutant: {test}")
    return status


if __name__ == "__main__":
    sys.exit(main())
