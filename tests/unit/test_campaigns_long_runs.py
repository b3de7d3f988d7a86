"""The campaign of long runs sees memory that grows, files that stay open, and updates that get slower."""

import sys
from pathlib import Path

import pytest

sys.path.append(str(Path(__file__).parents[1] / "campaigns"))

import long_runs

STEADY = [long_runs.Note(500 * n, 0.5 * n, 2**29, 8, 4, 100_000) for n in range(1, 201)]


def grown(**by: float) -> list[long_runs.Note]:
    """Notes in which something grows by so much a step."""
    return [
        note._replace(**{what: type(getattr(note, what))(getattr(note, what) + each * note.step)})
        for note in STEADY
        for what, each in by.items()
    ]


def test_nothing_is_found_where_all_stays() -> None:
    assert list(long_runs.findings(STEADY, 100_000)) == []
    assert long_runs.facts_of(STEADY) == [512, 0.0, 8, 1.0, 1.0]


@pytest.mark.parametrize(
    ("by", "message"),
    [
        ({"memory": 200.0}, "memory grows by 9.5 MiB in 50000 steps"),
        ({"objects": 0.1}, "there are 4.8% more Python objects after 50000 steps"),
        ({"files": 1e-4}, "there are more files: 11, then 16"),
        ({"threads": 1e-5}, "there are more threads: 4, then 4"),
    ],
)
def test_what_grows_is_seen(by: dict[str, float], message: str) -> None:
    assert list(long_runs.findings(grown(**by), 100_000)) == [message]


def test_what_slows_down_is_seen() -> None:
    slower = [note._replace(seconds=note.seconds * (1 + note.step / 1e5)) for note in STEADY]
    assert list(long_runs.findings(slower, 100_000)) == ["a step takes 1.57 times as long"]


def test_what_ends_early_is_seen(tmp_path: Path) -> None:
    assert list(long_runs.findings(STEADY[:100], 100_000)) == ["it came to step 50000 of 100000"]
    assert list(long_runs.findings([], 100_000)) == ["it came to step 0 of 100000"]
    assert list(long_runs.unreadable(tmp_path, 10)) == ["there is no event file"]


def test_a_process_notes_what_it_holds(tmp_path: Path) -> None:
    notebook = long_runs.Notebook(tmp_path / "notes.jsonl", steps=400)
    for _ in range(5):
        notebook.step()
    assert len((tmp_path / "notes.jsonl").read_text().splitlines()) == 2
    with (tmp_path / "open").open("w"):
        assert long_runs.now(1, 0.0).files == long_runs.now(1, 0.0).files
        more = long_runs.now(1, 0.0).files
    assert long_runs.now(1, 0.0).files == more - 1
