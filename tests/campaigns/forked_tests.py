"""Tests in forks of a process that has imported what the package imports, and nothing of the package.

Torch, Lightning and the rest take most of the seconds of a short test run; here a child begins after them, and
imports the package of the tree in which it stands.
"""

import gc
import hashlib
import importlib
import json
import os
import resource
import select
import signal
import sys
import time
import traceback
from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

import pytest

WARM = (
    *("numpy", "scipy.sparse", "scipy.optimize", "scipy.stats", "torch", "torchvision", "lightning.pytorch"),
    *("jaxtyping", "beartype", "numba", "hydra", "omegaconf", "matplotlib.pyplot", "sklearn.datasets", "pandas"),
    *("pyarrow.parquet", "coverage", "networkx", "dimod"),
)
MOST_MEMORY = 16 * 2**30
MOST_SECONDS_OF_A_TEST = 15
"""Without numba a few tests would take an hour: what takes longer is not asked."""


def warm_up() -> None:
    """Import what children need; numba compiles nothing from now on, and one thread computes."""
    os.environ |= {"NUMBA_DISABLE_JIT": "1", "OMP_NUM_THREADS": "1", "MPLBACKEND": "agg"}
    os.environ.pop("MEMCOMP_DATA_DIR", None)
    for module in WARM:
        with suppress(ImportError):
            importlib.import_module(module)
    gc.freeze()  # children do not look through it: pytest collects garbage twice


class Wanted:
    """Runs tests in the order of their names, and nothing else; knows the first that failed."""

    def __init__(self, names: Sequence[str] | None) -> None:
        self.places = None if names is None else {name: place for place, name in enumerate(names)}
        self.failed: str | None = None
        self.ran = 0

    def pytest_collection_modifyitems(self, items: list[pytest.Item]) -> None:
        places = self.places
        if places is not None:
            items[:] = sorted((i for i in items if i.nodeid in places), key=lambda i: places[i.nodeid])

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        self.ran += report.when == "call"
        if report.failed and self.failed is None:
            self.failed = report.nodeid


def in_a_fork(work: Callable[[], Any], *, seconds: float, log: Path) -> Any:
    """What ``work`` returns, as JSON has it, in a child process; None if it takes longer, and it is killed then.

    Raises:
        RuntimeError: The child died; the log says why.
    """
    reading, writing = os.pipe()
    child = os.fork()
    if child == 0:
        told = os.open(log, os.O_CREAT | os.O_WRONLY | os.O_TRUNC)
        try:
            os.setsid()
            os.close(reading)
            os.dup2(told, 1)
            os.dup2(told, 2)
            resource.setrlimit(resource.RLIMIT_AS, (MOST_MEMORY, MOST_MEMORY))
            resource.setrlimit(resource.RLIMIT_CPU, (int(seconds) + 1,) * 2)  # should its parent be killed
            with os.fdopen(writing, "w") as pipe:
                json.dump(work(), pipe)
                pipe.flush()
        except BaseException:
            os.write(told, traceback.format_exc().encode())
        finally:
            os._exit(0)
    os.close(writing)
    until, parts = time.monotonic() + seconds, []
    with os.fdopen(reading, "rb", buffering=0) as pipe:
        while (left := until - time.monotonic()) > 0:
            if select.select([pipe], [], [], left)[0]:
                parts.append(pipe.read(2**20))
                if not parts[-1]:
                    break
    with suppress(ProcessLookupError):
        os.killpg(child, signal.SIGKILL)
    os.waitpid(child, 0)
    if left <= 0:
        return None
    if not any(parts):
        raise RuntimeError(f"a child died: {log.read_text(errors='replace')[-2000:]}")
    return json.loads(b"".join(parts))


def outcome(tree: Path, names: Sequence[str], *, bytecode: bool = False) -> dict[str, Any]:
    """Run tests up to the first that fails, in this process: pytest's status, how many ran, which one failed."""
    wanted = Wanted(names)
    status = _pytest(tree, sorted({name.partition("::")[0] for name in names}), [wanted], "-x", bytecode=bytecode)
    return {"status": status, "ran": wanted.ran, "failed": wanted.failed}


def _pytest(tree: Path, files: Iterable[str], plugins: list[object], *options: str, bytecode: bool) -> int:
    """Pytest in this process, which is to end soon; bytecode is written for texts that stay."""
    os.chdir(tree)
    os.environ["PYTHONPATH"] = str(tree)
    sys.path.insert(0, str(tree))
    sys.dont_write_bytecode = not bytecode
    if not bytecode:
        os.environ["PYTHONDONTWRITEBYTECODE"] = "1"  # of processes that tests start
    quietly = ("-n", "0", "-q", "--tb=short", "-W", "ignore::pytest.PytestAssertRewriteWarning")
    return int(pytest.main([*files, *quietly, *options], plugins=plugins))


class Mapped:
    """Which lines each test runs, and how long it takes; what fixtures of several tests run counts for each."""

    def __init__(self, coverage: Any) -> None:
        self.coverage = coverage
        self.seconds: dict[str, float] = defaultdict(float)
        self.bad: set[str] = set()
        self.fixtures: dict[str, list[str]] = {}
        self.now = ""
        self.collecting = 0.0

    @pytest.hookimpl(wrapper=True)
    def pytest_collection(self) -> Iterator[Any]:
        began = time.monotonic()
        try:
            return (yield)
        finally:
            self.collecting = time.monotonic() - began

    def _switch(self, context: str) -> None:
        self.coverage.switch_context(context)
        self.now = context

    @pytest.hookimpl(wrapper=True)
    def pytest_runtest_protocol(self, item: pytest.Item) -> Iterator[Any]:
        info = getattr(item, "_fixtureinfo", None)
        shared = info.name2fixturedefs.values() if info else ()
        self.fixtures[item.nodeid] = [f"{d[-1].baseid}|{d[-1].argname}" for d in shared]
        self._switch(item.nodeid)
        signal.signal(signal.SIGALRM, self._too_long)
        signal.alarm(MOST_SECONDS_OF_A_TEST)
        try:
            return (yield)
        finally:
            signal.alarm(0)
            self._switch("")

    @pytest.hookimpl(wrapper=True)
    def pytest_fixture_setup(self, fixturedef: Any) -> Iterator[Any]:
        before = self.now
        if fixturedef.scope != "function":
            self._switch(f"{fixturedef.baseid}|{fixturedef.argname}")
        try:
            return (yield)
        finally:
            self._switch(before)

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        self.seconds[report.nodeid] += report.duration
        if not report.passed:
            self.bad.add(report.nodeid)

    @staticmethod
    def _too_long(*_: object) -> None:
        raise TimeoutError("a test takes too long without numba")

    def lines(self, tree: Path) -> dict[str, dict[str, list[int]]]:
        """Of each file the tests that run some of it, with the lines; imports count as the test ''."""
        data = self.coverage.get_data()
        found: dict[str, dict[str, list[int]]] = {}
        for file in data.measured_files():
            of_context: dict[str, set[int]] = defaultdict(set)
            for line, contexts in data.contexts_by_lineno(file).items():
                for context in contexts:
                    of_context[context].add(line)
            tests = {"": of_context.get("", set())}
            for test, fixtures in self.fixtures.items():
                if test not in self.bad:
                    tests[test] = set().union(*(of_context.get(name, ()) for name in (test, *fixtures)))
            found[str(Path(file).relative_to(tree))] = {t: sorted(lines) for t, lines in tests.items() if lines}
        return found


def mapped(tree: Path, test_file: str, sources: Sequence[str]) -> dict[str, Any]:
    """Run one file of tests in this process: how long its collection and each test take, which lines each runs."""
    import coverage

    measuring = coverage.Coverage(
        data_file=None, include=[f"{tree}/{part}" for part in sources], config_file=False
    )
    measuring.start()
    plugin = Mapped(measuring)
    _pytest(tree, [test_file], [plugin], bytecode=True)
    measuring.stop()
    seconds = {test: s for test, s in plugin.seconds.items() if test not in plugin.bad}
    found = {"collecting": plugin.collecting, "seconds": seconds, "bad": sorted(plugin.bad)}
    return found | {"lines": plugin.lines(tree)}


def digest(files: Iterable[Path]) -> str:
    """A short name for the texts of files."""
    found = hashlib.sha256()
    for file in files:
        found.update(file.read_bytes())
    return found.hexdigest()[:12]
