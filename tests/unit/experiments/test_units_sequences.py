"""Aligned sequences: reading, parts without near copies, and a short training whose samples are sequences."""

import gzip
import json
import sys
from pathlib import Path

import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).parents[3] / "experiments" / "units"))
import sequences
from site_statistics import RNA

N_SITES = 10


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """An alignment of sixty families of rows, each of a row twice and one that differs from it at one site."""
    generator = np.random.default_rng(0)
    lines = []
    for number in range(60):
        row = generator.integers(5, size=N_SITES)
        near = row.copy()
        near[3] = (near[3] + 1) % 5
        for kind, states in (("a", row), ("b", row), ("c", near)):
            text = "".join(RNA[state] for state in states)
            lines += [f">>{number}{kind}", text[:6], text[6:]]
    (tmp_path / "sequences").mkdir()
    with gzip.open(tmp_path / "sequences" / "RF00379.fasta.gz", "wt") as file:
        file.write("\n".join(lines) + "\n")
    monkeypatch.setenv("MEMCOMP_DATA_DIR", str(tmp_path))
    sequences.main(["split", "--family", "RF00379", "--out", str(tmp_path / "parts")])
    return tmp_path / "parts"


def shared(one, other):
    """How many sites the nearest rows of two sets have in common."""
    return max(int((a == b).sum()) for a in one for b in other)


def test_parts_have_each_row_once_and_no_near_copies_of_each_other(folder):
    parts = {name: sequences.load(folder / f"{name}.npz")[0] for name in ("test", "validation", "fit", "train")}
    assert len(parts["test"]) + len(parts["train"]) == 120
    assert len(parts["fit"]) + len(parts["validation"]) == len(parts["train"])
    assert len(np.unique(np.concatenate([parts["test"], parts["train"]]), axis=0)) == 120
    assert 18 <= len(parts["test"]) <= 32
    for one, other in (("test", "train"), ("validation", "fit")):
        assert shared(parts[one], parts[other]) < 8
    assert shared(parts["fit"][:1], parts["fit"]) == N_SITES


def test_clusters_hold_neighbours_of_neighbours():
    rows = np.zeros((4, 10), int)
    rows[1, :2], rows[2, :4], rows[3, :7] = 1, 1, 1
    assert sequences.clusters(rows, 2).tolist() == [0, 0, 0, 3]


@pytest.mark.parametrize(
    ("model", "settings"),
    [
        ("rbm", {"n_hidden": 5}),
        ("rbm", {"n_hidden": 5, "hidden": "relu", "rate": 0.01}),
        ("potts", {}),
        ("potts", {"sampler": "pseudo", "centring": None, "l2": 0.01}),
    ],
)
def test_samples_are_sequences(folder, model, settings, capsys):
    out = folder / "samples.npz"
    given = ["train", "--model", model, "--train", folder / "train.npz", "--out", out, "--updates", 3]
    given += ["--samples", 20, "--sweeps", 3, "--settings", json.dumps(settings | {"n_chains": 10})]
    sequences.main([str(word) for word in given])
    report = json.loads(out.with_suffix(".json").read_text())
    assert (report["valid"], report["samples"], report["updates"]) == (1.0, 20, 3)
    assert np.load(out)["indices"].shape == (20, N_SITES)
    sequences.main(["judge", str(folder), "--samples", str(out)])
    assert "| samples |" in capsys.readouterr().out
    sequences.main(
        ["likelihood", str(folder), "--models", str(out.with_suffix(".pt")), "--chains", "5", "--betas", "20"]
    )
    found = json.loads(capsys.readouterr().out.splitlines()[-1])
    assert found["pseudo, held out"] < 0
    assert ("log Z" in found) == (model == "rbm")


def test_independent_sites_have_the_frequencies_of_the_rows():
    rows = np.array([[0, 1]] * 3 + [[2, 1]])
    drawn = sequences.independent(rows, 3, 4000)
    assert (drawn[:, 1] == 1).all()
    assert not (drawn[:, 0] == 1).any()
    assert abs((drawn[:, 0] == 0).mean() - 0.75) < 0.04
