"""Alignments from files, as data of a training."""

import string
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from memcomp_lightning import rng
from memcomp_lightning.data.images import PixelLayout
from memcomp_lightning.data.rows import Rows
from memcomp_lightning.data.sequences.alignment import INSERTIONS, Alignment, aligned
from memcomp_lightning.data.sequences.alphabets import ALPHABETS
from memcomp_lightning.data.sequences.files import read_sequences
from memcomp_lightning.data.sequences.schema import SequenceSchema, rows_of
from memcomp_lightning.data.sequences.similarity import neighbours
from memcomp_lightning.errors import UserError, require, require_choice, require_count
from memcomp_lightning.models.units import Units


@dataclass(frozen=True, eq=False)
class SequenceData:
    """Aligned sequences as a training takes them.

    Attributes:
        train: Sequences, with weights where they are reweighted.
        test: Sequences, each of which counts once.
        validation: Sequences; None where none are given.
        schema: What the units are in the alignment.
        name: Of the data, for reports.
        similarity: Share of identical sites that makes two sequences alike; None without weights.
        layout: None: sites lie in no picture.
        ignored: What of the file is left out, and why.
        noted: What is read as something else.
    """

    train: Rows
    test: Rows
    validation: Rows | None
    schema: SequenceSchema
    name: str
    similarity: float | None = None
    layout: PixelLayout | None = None
    ignored: Mapping[str, str] = field(default_factory=dict)
    noted: Mapping[str, str] = field(default_factory=dict)

    @property
    def n_classes(self) -> int:
        """0: sequences have no labels."""
        return 0

    @property
    def n_sites(self) -> int:
        """Length of the sequences."""
        return self.schema.n_sites

    @property
    def effective_number(self) -> float:
        """Sum of the weights of the training sequences; their number where they have none."""
        return self.train.n if self.train.weight is None else float(self.train.weight.double().sum())

    def units(self) -> Units:
        """A category for each site."""
        return self.schema.units()

    def described(self) -> str:
        """What the file is taken for, for people."""
        counts = f"{self.train.n:,} sequences to train on, {self.test.n:,} to test on"
        if self.validation is not None:
            counts += f", {self.validation.n:,} to look at"
        lines = {"sites": str(self.n_sites), "alphabet": self.schema.known.described}
        if self.train.observed is not None:
            lines["missing"] = f"{1 - float(self.train.observed.float().mean()):.2%} of the letters"
        lines |= self.noted
        lines |= {name: f"ignored, {reason}" for name, reason in self.ignored.items()}
        lines["weights"] = "none"
        if self.similarity is not None:
            lines["weights"] = (
                f"1 / number of sequences with {100 * self.similarity:g} % identical sites or more; "
                f"effective number {self.effective_number:,.1f}"
            )
        return "\n".join([f"{self.name}: {counts}", *(f"  {name:<10}  {text}" for name, text in lines.items())])


@dataclass(frozen=True, kw_only=True)
class Sequences:
    """An alignment in a file: what ``data=sequences`` reads.

    Identical sequences are split off together, so that no test sequence has been trained on. Weights are those of
    the training sequences among themselves.

    Args:
        path: FASTA (also A2M, A3M; .gz), or a table with a column ``sequence``.
        alphabet: ``protein``, ``rna`` or ``dna``; None is found.
        validation: A file of sequences to look at while training.
        test: A file of test sequences; None splits off some of ``path``.
        test_fraction: Share of the sequences that is split off, in (0, 1).
        split_seed: Seed of that split.
        similarity: Share of identical sites, in (0, 1], from which sequences share one weight, see
            :func:`memcomp_lightning.data.sequences.neighbours`; None counts each one once.
        insertions: ``keep`` reads lower case letters as letters and points as gaps, ``remove`` takes both out;
            None keeps them where the sequences have one length so, and else takes them out.
    """

    path: str | None = None
    alphabet: str | None = None
    validation: str | None = None
    test: str | None = None
    test_fraction: float = 0.1
    split_seed: int = 0
    similarity: float | None = 0.8
    insertions: str | None = None

    def __post_init__(self) -> None:
        if self.path is None:
            raise UserError("data.path names no file: type data.path=FILE, as in data.path=family.fasta.")
        if self.alphabet is not None:
            require_choice("data.alphabet", self.alphabet, tuple(ALPHABETS))
        if self.insertions is not None:
            require_choice("data.insertions", self.insertions, INSERTIONS)
        in_range = isinstance(self.test_fraction, int | float) and 0 < self.test_fraction < 1
        require(in_range, "data.test_fraction", self.test_fraction, "a number in (0, 1)")
        require_count("data.split_seed", self.split_seed, 0)
        share = self.similarity
        in_range = share is None or (
            isinstance(share, int | float) and not isinstance(share, bool) and 0 < share <= 1
        )
        require(in_range, "data.similarity", share, "a number in (0, 1], or null for no weights")

    def load(self) -> SequenceData:
        """Read the files.

        Raises:
            UserError: A file, a sequence or a letter is not as it must be; the message names it.
        """
        path = Path(str(self.path))
        alignment = aligned(read_sequences(path), self.insertions)
        name = self.alphabet or alignment.alphabet.name
        schema = SequenceSchema(alignment.n_sites, name, self.insertions)
        numbers = schema.numbers(alignment)
        if self.test is None:
            is_test = _split(numbers, self.test_fraction, self.split_seed)
            train, test = numbers[~is_test], rows_of(numbers[is_test])
        else:
            train, test = numbers, schema.read(Path(self.test))
        weight = None
        if self.similarity is not None:
            weight = (1.0 / neighbours(train, self.similarity)).astype(np.float32)
        return SequenceData(
            rows_of(train, weight),
            test,
            None if self.validation is None else schema.read(Path(self.validation)),
            schema,
            path.name,
            self.similarity,
            ignored=_ignored(alignment),
            noted=_noted(alignment, schema),
        )


def _split(numbers: NDArray[np.uint8], test_fraction: float, seed: int) -> NDArray[np.bool_]:
    """Which sequences are split off: at random, the copies of one together, and no more than the share."""
    n, n_test = len(numbers), round(test_fraction * len(numbers))
    _, which, copies = np.unique(numbers, axis=0, return_inverse=True, return_counts=True)
    which = which.reshape(-1)
    order = torch.randperm(len(copies), generator=rng.stream(seed, "test rows"), device="cpu").tolist()
    chosen, left = np.zeros(len(copies), dtype=np.bool_), n_test
    for group in order:
        if copies[group] <= left:
            chosen[group] = True
            left -= int(copies[group])
    allowed = f"a share that leaves at least 1 of the {n} sequences, {len(copies)} different ones, on each side"
    require(bool(chosen.any()) and not bool(chosen.all()), "data.test_fraction", test_fraction, allowed)
    found: NDArray[np.bool_] = chosen[which]
    return found


def _ignored(alignment: Alignment) -> dict[str, str]:
    if not alignment.n_removed:
        return {}
    return {"insertions": f"{alignment.n_removed:,} lower case letters and points, which are no sites"}


def _noted(alignment: Alignment, schema: SequenceSchema) -> dict[str, str]:
    """What is read as something else."""
    signs = alignment.signs
    found = []
    for other, letter in schema.known.same:
        if n := signs[other] + signs[other.lower()]:
            found.append(f"{n:,} {other} as {letter}")
    if n := sum(signs[letter] for letter in string.ascii_lowercase):
        found.append(f"{n:,} lower case letters as upper case (insertions? data.insertions=remove)")
    if n := signs["."]:
        found.append(f"{n:,} points as gaps")
    return {"read": ", ".join(found)} if found else {}
