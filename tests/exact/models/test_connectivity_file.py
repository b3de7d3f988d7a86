"""Edges of a graph of one's own, from a text file."""

from pathlib import Path

import pytest

from memcomp_lightning.errors import SettingError
from memcomp_lightning.models.connectivity import from_file


def test_edges_of_a_file(tmp_path: Path) -> None:
    path = tmp_path / "bonds.txt"
    path.write_text("# a path\n0 1\n2,1\n\n 3 2  # the last one\n")
    assert from_file(path, 4).tolist() == [[0, 1], [1, 2], [2, 3]]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("0 1\n0 1 2\n", "line 2 = '0 1 2' is not allowed: expected two numbers of units, from 0"),
        ("0 -1\n", "line 1"),
        ("a b\n", "line 1"),
        ("0 4\n", "0 to n_units - 1 = 3"),
        ("1 1\n", "two different units"),
        ("0 1\n1 0\n", "each pair once"),
    ],
)
def test_what_is_no_edge(tmp_path: Path, text: str, message: str) -> None:
    path = tmp_path / "bonds.txt"
    path.write_text(text)
    with pytest.raises(SettingError) as refused:
        from_file(path, 4)
    assert message in str(refused.value)


def test_no_file(tmp_path: Path) -> None:
    for path in (None, tmp_path / "none.txt", tmp_path):
        with pytest.raises(SettingError, match="a text file of edges"):
            from_file(path, 4)
