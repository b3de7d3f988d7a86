"""Work on a cluster: all of it is done, records come as they exist, and what is missing is said."""

import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest

from memcomp_lightning.errors import SettingError, UserError
from memcomp_lightning.studies.cluster import cluster
from memcomp_lightning.studies.records import Record, Records
from memcomp_lightning.studies.runner import runner

PLACES = {"dask": "DASK_SCHEDULER_ADDRESS", "ray": "RAY_ADDRESS"}


class Trial:
    title, n_updates = "a trial", 3

    def __init__(self, method: str) -> None:
        self.method = method

    def run(self, progress: Any) -> list[Record]:
        return [Record(method=self.method, at=[1], seconds=[0.0], measures={"x": [[1.0]]})]


class Future:
    def __init__(self, value: Any) -> None:
        self.value = value

    def result(self) -> Any:
        return self.value


class Client:
    def __init__(self, address: str) -> None:
        if address == "nowhere":
            raise OSError("Timed out")

    def submit(self, function: Any, one: Any, *, pure: bool) -> Future:
        assert not pure, "alike trials are not one"
        return Future(function(one))

    def __enter__(self) -> "Client":
        return self

    def __exit__(self, *_: object) -> None:
        pass


class Remote:
    def __init__(self, function: Any) -> None:
        self.remote = function


def stand_in(name: str) -> ModuleType:
    """As much of the package as is used: work is done at once, and the last comes first."""
    module: Any = ModuleType(name)
    if name == "distributed":
        module.Client, module.as_completed = Client, reversed
        return module

    def init(address: str, log_to_driver: bool) -> None:
        if address == "nowhere":
            raise ConnectionError("Could not find any running Ray instance")

    module.init, module.shutdown, module.get = init, lambda: None, lambda found: found
    module.remote = lambda **_: Remote
    module.wait = lambda waiting: (waiting[-1:], waiting[:-1])
    return module


@pytest.fixture(params=["dask", "ray"])
def name(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> Iterator[str]:
    package = {"dask": "distributed", "ray": "ray"}[request.param]
    monkeypatch.setitem(sys.modules, package, stand_in(package))
    monkeypatch.setenv(PLACES[request.param], "10.0.0.1:8786")
    return request.param


def test_all_trials_of_a_study_are_done(name: str, tmp_path: Path) -> None:
    records = Records(tmp_path)
    with runner("study", workers=name) as run:
        run([Trial("a"), Trial("b")], records)
        run([Trial("c")], records)
    assert [record.method for record in Records(tmp_path).all] == ["b", "a", "c"]


def test_a_cluster_that_does_not_answer(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(PLACES[name], "nowhere")
    with (
        pytest.raises(UserError, match=f"no {name} cluster answers at nowhere .*: set {PLACES[name]}="),
        cluster(name),
    ):
        pass


def test_nobody_said_where_it_is(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv(PLACES[name])
    with (
        pytest.raises(UserError, match=f"workers={name} needs a cluster that runs: set {PLACES[name]}="),
        cluster(name),
    ):
        pass


@pytest.mark.parametrize(("name", "package"), [("dask", "distributed"), ("ray", "ray")])
def test_a_package_that_is_not_installed(monkeypatch: pytest.MonkeyPatch, name: str, package: str) -> None:
    monkeypatch.setitem(sys.modules, package, None)
    with pytest.raises(UserError, match=f"not installed: pip install {package}"), cluster(name):
        pass


def test_other_words_are_refused() -> None:
    with (
        pytest.raises(
            SettingError, match="workers = 'four' is not allowed: expected an integer >= 1, dask or ray"
        ),
        runner("study", workers="four"),
    ):
        pass


def test_nothing_of_a_cluster_is_imported_without_one() -> None:
    code = "import sys, memcomp_lightning.studies; print({'ray', 'distributed'} & set(sys.modules))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout == "set()\n"
