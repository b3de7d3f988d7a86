"""Two families of sequences from the command line: train, draw, score."""

import os
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from commands import Used, command
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


WAYS = ("auto", "gibbs")
"""How rows are drawn: as the command does of itself, and by plain chains whether or not they mix."""


def of_family(
    rows: Indices, alphabet: str, folder: Path, *, passes: int, n: int, settings: tuple[str, ...] = ()
) -> Iterator[dict[str, Any]]:
    """A row for each way to draw: what the three commands took, and what came out."""
    split = parts(rows, len(alphabet))
    train, test = split["train"], split["test"]
    write(folder / "train.fasta", train, alphabet)
    write(folder / "test.fasta", test, alphabet)
    files = ["data.path=train.fasta", "data.test=test.fasta", "hydra.run.dir=run"]
    trained = command("train", "data=sequences", *files, f"pretrain.iterations={passes}", *settings, folder=folder)
    scored = command("score", "run", "test.fasta", "output=scores.csv", folder=folder)
    likelihood = pd.read_csv(folder / "scores.csv")["log_likelihood"]
    base = alone(train, test, len(alphabet))
    floor = compare(independent(train, len(alphabet), n), test, train, len(alphabet))
    for way in reversed(WAYS):  # the quick one first
        drawn = command("sample", "run", f"n={n}", f"method={way}", f"output={way}.fasta", folder=folder)
        share, found = valid(folder / f"{way}.fasta", alphabet, rows.shape[1])
        near = compare(found, test, train, len(alphabet))
        yield {
            "training rows": len(train),
            "log-likelihood": f"{likelihood.mean():.2f}",
            "independent sites": f"{base:.2f}",
            "s to train": f"{trained.core_seconds:.0f}",
            "s to score": f"{scored.core_seconds:.0f}",
            "method": way,
            "s to draw": f"{drawn.core_seconds:.0f}",
            "R-hat": r_hat(drawn),
            "valid": f"{share:.1%}",
            "distinct": len(np.unique(found, axis=0)),
            "two sites": f"{near['two_site_pearson']:.3f}",
            "of training rows": f"{near['ceiling_two_site_pearson']:.3f}",
            "of independent ones": f"{floor['two_site_pearson']:.3f}",
        }


def r_hat(drawn: Used) -> str:
    """R-hat of the chains, as memcomp-sample says it; nothing of independent rows."""
    lines = [line.split() for line in drawn.out.splitlines()]
    return next((line[1] for line in lines if line[:1] == ["R-hat"]), "")


def measure(*, quick: bool) -> Iterator[dict[str, Any]]:
    """A row for each family."""
    if quick:
        rows = np.random.default_rng(0).integers(0, 5, (60, 6))
        with tempfile.TemporaryDirectory() as folder:
            for row in of_family(
                rows, FAMILIES["RF00379"], Path(folder), passes=1, n=10, settings=("callbacks=minimal",)
            ):
                yield {"family": "made up"} | row
        return
    for family, alphabet in FAMILIES.items():
        rows = read_fasta(Path(os.environ["MEMCOMP_DATA_DIR"]) / "sequences" / f"{family}.fasta.gz", alphabet)
        with tempfile.TemporaryDirectory() as folder:
            for row in of_family(rows, alphabet, Path(folder), passes=20, n=10_000):
                yield {"family": family} | row
