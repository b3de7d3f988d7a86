"""The campaigns of fuzzing run, and see what is wrong: a reader that lies, crashes, hangs or takes too much."""

import gzip
import json
import sys
import time
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from memcomp_lightning.errors import UserError
from memcomp_lightning.problems import read_problem

sys.path.insert(0, str(Path(__file__).parents[1] / "campaigns"))

import fuzz_bytes
import fuzz_structured
import judged
import obvious_readers
import readers

N = 10
NEED_A_RUN = ("settings", "run", "schema of a run", "overrides", "schema")


@pytest.fixture
def plain(monkeypatch):
    """Neither atheris nor hypothesis: what everybody can run."""
    for module in (fuzz_bytes, fuzz_structured):
        monkeypatch.setattr(module, "find_spec", lambda name: None)


@pytest.mark.parametrize("name", [name for name in readers.READERS if name not in NEED_A_RUN])
def test_bytes_are_read_or_refused(tmp_path, plain, name):
    if (needed := readers.READERS[name].needs) is not None:
        pytest.importorskip(needed)
    fuzz_bytes.batch(name, 0, N if readers.READERS[name].share >= 1 else 3, tmp_path, tmp_path)
    assert not list(tmp_path.glob("findings/*"))


@pytest.mark.parametrize("name", fuzz_structured.KINDS)
def test_files_are_read_as_they_were_made(tmp_path, plain, name):
    if (needed := fuzz_structured.KINDS[name].needs) is not None:
        pytest.importorskip(needed)
    assert fuzz_structured.tried(name, "0", N, tmp_path) == []


@pytest.mark.parametrize("name", ["gset", "wcnf"])
def test_with_hypothesis(tmp_path, name):
    pytest.importorskip("hypothesis")
    assert fuzz_structured.tried(name, "0", N, tmp_path) == []


def test_a_batch_is_a_process_of_its_own(tmp_path, plain, monkeypatch):
    def dies(path):
        raise SystemExit(9)

    reader = readers.Reader("dies.txt", dies, lambda: [b"x"])
    monkeypatch.setitem(readers.READERS, "dies", reader)
    outcome = fuzz_bytes.attempt("dies/0/5", folder=tmp_path)
    assert (outcome.kind, outcome.tried) == ("dies", 1)
    assert "status 9" in outcome.findings[0]
    assert "--again" in outcome.findings[0]


def lying(path, format):
    """A reader that takes 0 for 1."""
    problem = read_problem(path, format)
    changed = SimpleNamespace(**{name: getattr(problem, name) for name in ("problem", "objective", "variables")})
    changed.n, changed.score = problem.n, lambda x: problem.score(1 - np.asarray(x))
    return changed


@pytest.mark.parametrize("name", ["beasley", "coo", "cnf"])
def test_a_reader_that_lies_is_found(tmp_path, plain, name):
    def check(name, path, given):
        fuzz_structured.check_problem(name, path, given, read=lying)

    kind = fuzz_structured.KINDS[name]._replace(check=check)
    (found, *_) = fuzz_structured.tried(name, "0", N, tmp_path, kind)
    assert "was read wrongly" in found
    assert list(tmp_path.glob("findings/*.bin"))


def raises(error):
    raise error


def too_long():
    while True:
        pass


@pytest.mark.parametrize(
    ("read", "said"),
    [
        (lambda: raises(KeyError("x")), "KeyError at"),
        (lambda: raises(UserError("one\ntwo")), "several lines"),
        (lambda: raises(UserError("")), "says nothing"),
        (lambda: np.float32(1) / np.zeros(1), "RuntimeWarning"),
        (lambda: np.ones(2**30), "512 MiB"),
        (too_long, "took more than"),
    ],
    ids=["crash", "lines", "nothing", "overflow", "memory", "hang"],
)
def test_what_is_wrong_is_seen(monkeypatch, read, said):
    monkeypatch.setattr(judged, "SECONDS", 0.05)
    assert said in judged.judge(read).text


def test_slow_reading_is_seen(monkeypatch):
    monkeypatch.setattr(judged, "SECONDS", 0.02)

    def slow():
        began = time.process_time()
        while time.process_time() - began < 0.03:
            pass

    assert "took 0.0 s" in judged.judge(slow).text


def test_what_is_right_is_no_finding():
    assert judged.judge(lambda: 1) is None
    assert judged.judge(lambda: raises(UserError("FILE, line 3: found x, expected a number."))) is None


def test_a_kept_input_is_read_again(tmp_path):
    folder = tmp_path / "again"
    folder.mkdir()
    assert fuzz_bytes.show("gset", b"2 1\n1 2 3\n", folder) is None
    fuzz_bytes.keep(tmp_path, "gset", b"3", "mark", "is wrong")
    (note,) = tmp_path.glob("findings/*.json")
    assert json.loads(note.read_text())["again"].endswith(".bin")


def test_second_readers_know_the_formats():
    meant = obvious_readers.gset(b"3 2\n1 2 2.5\n2 3 -1\n")
    assert (meant.n, meant.score([1, 0, 0])[0]) == (3, 2.5)
    with pytest.raises(obvious_readers.RefusedError):
        obvious_readers.cnf(b"p cnf 1 1\n2 0\n")


# What the campaigns found, and no other test of the parts shows.


@pytest.mark.parametrize("suffix", [".gset.gz"])
def test_a_small_packed_file_takes_little_memory(tmp_path, suffix):
    path = tmp_path / f"a{suffix}"
    path.write_bytes(gzip.compress(b"2 1\n1 2 3\n"))
    assert judged.judge(lambda: read_problem(path)) is None
