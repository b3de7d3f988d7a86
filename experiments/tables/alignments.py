"""Two families of sequences from the command line: train, draw, score."""

import os
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from commands import command
from numpy.typing import NDArray

sys.path.append(str(Path(__file__).parents[1] / "units"))
from sequences import FAMILIES, independent, parts, read_fasta
from site_statistics import compare, one_site

Indices = NDArray[np.int64]


def write(path: Path, rows: Indices, alphabet: str) -> None:
    """Sequences as FASTA."""
    letters = np.array(list(alphabet))[rows]
    path.write_text("".join(f">{k}\n{''.join(row)}\n" for k, row in enumerate(letters)))


def valid(path: Path, alphabet: str, length: int) -> tuple[float, Indices]:
    """Share of the records of a FASTA file that are sequences of this length and alphabet, and those."""
    records = [record.partition("\n")[2].replace("\n", "") for record in path.read_text().split(">")[1:]]
    known = [record for record in records if len(record) == length and set(record) <= set(alphabet)]
    return len(known) / len(records), np.array([[alphabet.index(letter) for letter in record] for record in known])


def alone(train: Indices, test: Indices, n_states: int) -> float:
    """Mean log-likelihood of independent sites, each letter counted once more than it was seen."""
    share = (one_site(train, n_states) * len(train) + 1) / (len(train) + n_states)
    return float(np.log(share[np.arange(train.shape[1]), test]).sum(-1).mean())


def of_family(
    rows: Indices, alphabet: str, folder: Path, *, passes: int, n: int, settings: tuple[str, ...] = ()
) -> dict[str, Any]:
    """One row: what the three commands took, and what came out."""
    split = parts(rows, len(alphabet))
    train, test = split["train"], split["test"]
    write(folder / "train.fasta", train, alphabet)
    write(folder / "test.fasta", test, alphabet)
    files = ["data.path=train.fasta", "data.test=test.fasta", "hydra.run.dir=run"]
    used = {
        "train": command(
            "train", "data=sequences", *files, f"pretrain.iterations={passes}", *settings, folder=folder
        ),
        "sample": command("sample", "run", f"n={n}", "output=drawn.fasta", folder=folder),
        "score": command("score", "run", "test.fasta", "output=scores.csv", folder=folder),
    }
    share, drawn = valid(folder / "drawn.fasta", alphabet, rows.shape[1])
    likelihood = pd.read_csv(folder / "scores.csv")["log_likelihood"]
    base = alone(train, test, len(alphabet))
    near = compare(drawn, test, train, len(alphabet))
    floor = compare(independent(train, len(alphabet), n), test, train, len(alphabet))
    return {
        "training rows": len(train),
        "valid": f"{share:.1%}",
        "distinct": len(np.unique(drawn, axis=0)),
        "log-likelihood": f"{likelihood.mean():.2f}",
        "independent sites": f"{base:.2f}",
        "two sites": f"{near['two_site_pearson']:.3f}",
        "of training rows": f"{near['ceiling_two_site_pearson']:.3f}",
        "of independent ones": f"{floor['two_site_pearson']:.3f}",
        **{f"s, {name}": f"{one.core_seconds:.0f}" for name, one in used.items()},
    }


def measure(*, quick: bool) -> Iterator[dict[str, Any]]:
    """A row for each family."""
    if quick:
        rows = np.random.default_rng(0).integers(0, 5, (60, 6))
        with tempfile.TemporaryDirectory() as folder:
            yield {"family": "made up"} | of_family(
                rows, FAMILIES["RF00379"], Path(folder), passes=1, n=10, settings=("callbacks=minimal",)
            )
        return
    for family, alphabet in FAMILIES.items():
        rows = read_fasta(Path(os.environ["MEMCOMP_DATA_DIR"]) / "sequences" / f"{family}.fasta.gz", alphabet)
        with tempfile.TemporaryDirectory() as folder:
            yield {"family": family} | of_family(rows, alphabet, Path(folder), passes=20, n=10_000)
