"""What the units of a model are in aligned sequences."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from memcomp_lightning.data.rows import UNLABELLED, Rows
from memcomp_lightning.data.schema import MOST_SITES
from memcomp_lightning.data.sequences.alignment import INSERTIONS, Alignment, aligned
from memcomp_lightning.data.sequences.alphabets import ALPHABETS, MISSING, Alphabet
from memcomp_lightning.data.sequences.files import read_sequences
from memcomp_lightning.data.written import SEQUENCE
from memcomp_lightning.errors import UserError, require, require_choice
from memcomp_lightning.files import made_of
from memcomp_lightning.models.units import Categorical


@dataclass(frozen=True)
class SequenceSchema:
    """Aligned sequences: a site is a column of the alignment, its states are the letters.

    Attributes:
        n_sites: Length of the sequences.
        alphabet: ``"protein"``, ``"rna"`` or ``"dna"``.
        insertions: What is done with lower case letters and points, see
            :func:`memcomp_lightning.data.sequences.alignment.aligned`.
    """

    n_sites: int
    alphabet: str
    insertions: str | None = None

    @property
    def known(self) -> Alphabet:
        """The alphabet with its letters."""
        return ALPHABETS[self.alphabet]

    @property
    def letters(self) -> str:
        """Letters in the order of their numbers, the gap last."""
        return self.known.letters

    @property
    def n_classes(self) -> int:
        """0: sequences have no labels."""
        return 0

    @property
    def class_names(self) -> list[str]:
        """None."""
        return []

    @property
    def site_names(self) -> list[str]:
        """Numbers of the sites, from 1."""
        return [str(site + 1) for site in range(self.n_sites)]

    @property
    def entry_names(self) -> list[str]:
        """``site=letter`` of each visible unit."""
        return [f"{site}={letter}" for site in self.site_names for letter in self.letters]

    @property
    def log_scale(self) -> float:
        """0: letters have probabilities."""
        return 0.0

    def units(self) -> Categorical:
        """A category for each site."""
        return Categorical(self.n_sites, q=len(self.letters))

    def read(self, path: Path, *, complete: bool = True) -> Rows:
        """Sequences of a file; a letter that is not known is missing.

        Args:
            path: FASTA, or a table with a column ``sequence``.
            complete: Whether a sequence must have a known letter.

        Raises:
            UserError: The file does not fit, with sequence and line.
        """
        alignment = aligned(read_sequences(path), self.insertions, self.n_sites)
        return rows_of(self.numbers(alignment, complete=complete))

    def numbers(self, alignment: Alignment, *, complete: bool = True) -> NDArray[np.uint8]:
        """Numbers of the letters of an alignment, ``(n, n_sites)``; 255 where one is missing."""
        found = alignment.numbers(self.known)
        empty = (found == MISSING).all(axis=1)
        if complete and empty.any():
            place = alignment.file.place(int(empty.argmax()))
            raise UserError(f"{place}: every letter is missing. Leave out the sequence.")
        return found

    def decode(self, v: Tensor) -> dict[str, NDArray[Any]]:
        """One column, ``sequence``; where a letter is missing, X of proteins and N of nucleic acids.

        Args:
            v: Numbers of the letters, ``(n, n_sites)``; NaN is missing.
        """
        numbers = v.detach().cpu().double().numpy()
        at = np.where(np.isnan(numbers), len(self.letters), numbers).round().astype(np.int64)
        signs = np.array([*self.letters, self.known.missing])[at]
        found = np.empty(len(signs), dtype=object)
        found[:] = ["".join(row) for row in signs]
        return {SEQUENCE: found}

    def filled(self, path: Path, v: Tensor) -> dict[str, NDArray[Any]]:
        """Completed sequences of a file with their names, or with the other columns of their table.

        Args:
            path: The file that v was read from.
            v: Numbers of the letters, ``(n, n_sites)``.
        """
        file, found = read_sequences(path), self.decode(v)
        if not file.is_table:
            return {"name": np.array(file.names, dtype=object), **found}
        from memcomp_lightning.data.tables.filled import others  # Arrow is an extra

        return {**others(path, ()), **found}

    def others(self, path: Path) -> dict[str, NDArray[Any]]:
        """Names of the sequences of a file, or the other columns of their table."""
        none = torch.zeros(0, self.n_sites)
        own = self.decode(none)
        return {name: column for name, column in self.filled(path, none).items() if name not in own}

    def as_json(self) -> dict[str, Any]:
        """Plain values, from which :meth:`from_json` makes the schema again."""
        return {
            "data": "sequences",
            "n_sites": self.n_sites,
            "alphabet": self.alphabet,
            "letters": self.letters,
            "insertions": self.insertions,
        }

    @classmethod
    def from_json(cls, content: Mapping[str, Any]) -> "SequenceSchema":
        """The schema that was written."""
        plain = made_of(_Plain, dict(content))
        require(1 <= plain.n_sites <= MOST_SITES, "n_sites of a schema", plain.n_sites, f"1 to {MOST_SITES:,}")
        require_choice("alphabet of a schema", plain.alphabet, ALPHABETS)
        if plain.insertions is not None:
            require_choice("insertions of a schema", plain.insertions, INSERTIONS)
        found = cls(plain.n_sites, plain.alphabet, plain.insertions)
        if plain.letters != found.letters:
            raise UserError(
                f"the schema has the letters {plain.letters} in this order, and {found.alphabet} has "
                f"{found.letters}: it is that of another version."
            )
        return found


@dataclass(frozen=True)
class _Plain:
    """A schema of sequences as it is written."""

    data: str
    n_sites: int
    alphabet: str
    letters: str
    insertions: str | None


def rows_of(numbers: NDArray[np.uint8], weight: NDArray[np.float32] | None = None) -> Rows:
    """Rows of numbers of letters, of which 255 is missing."""
    missing = torch.from_numpy(numbers == MISSING)
    v = torch.from_numpy(numbers.astype(np.float32)).masked_fill_(missing, 0.0)
    label = torch.full((len(v),), UNLABELLED, device="cpu")
    observed = ~missing if bool(missing.any()) else None
    return Rows(v, label, observed, None if weight is None else torch.from_numpy(weight))
