"""What is there already is refused by every command, before a run is read: here there is none."""

from importlib import import_module
from pathlib import Path

import pytest

CASES = [
    *(("sample", [f"output=old{ending}"]) for ending in (".csv", ".npz", ".fasta")),
    ("impute", ["table.csv", "output=old.csv"]),
    ("impute", ["table.csv", "output=drawn.csv", "m=3"]),
    ("impute", ["table.csv", "probabilities=old.csv"]),
    ("impute", ["table.csv", "figures=looks"]),
    ("impute", ["table.csv", "figures=old.png"]),
    ("score", ["table.csv", "output=old.csv"]),
    ("score", ["table.csv", "figures=looks"]),
    ("score", ["table.csv", "figures=old.pdf"]),
    ("transform", ["table.csv", "output=old.csv"]),
    *(("export", [f"output=old{ending}"]) for ending in (".safetensors", ".pt2", ".pt", ".csv")),
]


@pytest.mark.parametrize(("name", "arguments"), CASES)
def test_what_is_there_stays(name, arguments, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    Path("looks").mkdir()
    endings = (".csv", ".npz", ".fasta", ".png", ".pdf", ".safetensors", ".pt2", ".pt")
    there = [Path(f"old{ending}") for ending in endings] + [Path("drawn-2.csv"), Path("looks/likelihoods.png")]
    for path in there:
        path.write_text("old")
    with pytest.raises(SystemExit) as ended:
        import_module(f"memcomp_lightning.cli.commands.{name}").main(["no run", *arguments])
    assert ended.value.code == 2
    said = capsys.readouterr().err
    assert "already. Choose another, or type overwrite=true." in said
    assert said.count("\n") == 1
    assert all(path.read_text() == "old" for path in there)
    assert sorted(path for path in Path().rglob("*") if path.is_file()) == sorted(there)
