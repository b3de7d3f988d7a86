"""The campaign of releases sees an archive that differs, a file too many, and a command that does not end well."""

import sys
import zipfile
from pathlib import Path

import pytest

sys.path.append(str(Path(__file__).parents[1] / "campaigns"))

import releases


def archive(path: Path, **parts: str) -> Path:
    path.parent.mkdir(exist_ok=True)
    with zipfile.ZipFile(path, "w") as wheel:
        for name, text in parts.items():
            wheel.writestr(zipfile.ZipInfo(name, (2020, 2, 2, 0, 0, 0)), text)
    return path


def test_archives_are_compared_byte_by_byte(tmp_path: Path) -> None:
    first = archive(tmp_path / "a/x.whl", one="1", two="2")
    assert releases.differing(first, archive(tmp_path / "b/x.whl", one="1", two="2")) is None
    assert releases.differing(first, archive(tmp_path / "c/x.whl", one="1", two="3")) == "x.whl: two"
    told = releases.differing(first, archive(tmp_path / "d/x.whl", two="2", one="1"))
    assert told == "x.whl: order, times or permissions"
    assert releases.differing(first, archive(tmp_path / "e/y.whl", one="1", two="2")) == "x.whl and y.whl"


def test_files_that_are_missing_or_too_many_are_named(tmp_path: Path) -> None:
    about = f"memcomp_lightning-{releases.PROJECT['version']}.dist-info"
    names = [*(f"{about}/{name}" for name in ("METADATA", "WHEEL", "RECORD", "entry_points.txt"))]
    names += [f"{about}/licenses/LICENSE", "memcomp_lightning/a.py", "memcomp_lightning/conf/b.yaml"]
    files = [
        Path("memcomp_lightning/a.py"),
        Path("conf/b.yaml"),
        Path("memcomp_lightning/conf"),
        Path("tests/c.py"),
    ]
    whole = archive(tmp_path / "x.whl", **dict.fromkeys(names, ""))
    assert releases.misplaced(whole, files) == []
    other = archive(tmp_path / "y.whl", **dict.fromkeys([*names[:-1], "tests/c.py"], ""))
    assert releases.misplaced(other, files) == [
        "y.whl lacks memcomp_lightning/conf/b.yaml",
        "y.whl holds tests/c.py",
    ]
    for name in ("PKG-INFO", "memcomp_lightning/a.py", "conf/b.yaml", "tests/c.py"):
        (tmp_path / "unpacked" / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / "unpacked" / name).touch()
    assert releases.stray(tmp_path / "unpacked", files) == []
    (tmp_path / "unpacked/tests/c.py").rename(tmp_path / "unpacked/d.py")
    assert releases.stray(tmp_path / "unpacked", files) == [
        *("the source archive holds d.py", "the source archive lacks tests/c.py"),
    ]


def test_a_command_that_fails_is_a_finding_with_what_it_said(tmp_path: Path) -> None:
    environment = releases.Environment(tmp_path, sys.executable, "uv")
    code = "import sys; print('so far'); sys.exit('the cause')"
    environment.attempt(sys.executable, "-c", code, folder=tmp_path)
    environment.attempt(sys.executable, "-c", "print('well')", folder=tmp_path)
    assert len(environment.tried) == 2
    (finding,) = environment.findings
    assert "ended with 1: so far / the cause" in finding
    assert releases.attempt("none", {"none": lambda folder: _fails()}).findings == ["no network"]


def _fails() -> releases.ledger.Outcome:
    raise releases.FailedError("no network")


def test_what_a_session_has_set_does_not_reach_the_commands(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("PYTHONPATH", "/elsewhere")
    monkeypatch.setenv("MEMCOMP_DATA_DIR", "/elsewhere")
    code = "import os; print(os.environ.get('PYTHONPATH'), os.environ.get('MEMCOMP_DATA_DIR'))"
    assert releases.said(sys.executable, "-c", code, folder=tmp_path).split() == ["None", "None"]


def test_cases_have_names_of_their_own_and_the_oldest_are_tried_once() -> None:
    names = [*releases.cases(["python3.11", "python3.12"], "uv", ())]
    assert len(names) == 13
    assert [name for name in names if name.startswith("oldest")] == ["oldest/python3.11"]
    assert list(releases.chosen(names, ["wheel", "metadata"])) == [
        *("metadata", "wheel/uv/python3.11", "wheel/uv/python3.12"),
    ]
