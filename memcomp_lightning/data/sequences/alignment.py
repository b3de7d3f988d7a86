"""From sequences as they stand in a file to numbers of letters, one column a site."""

import string
from collections import Counter
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from memcomp_lightning.data.sequences.alphabets import UNKNOWN, Alphabet, alphabet_of
from memcomp_lightning.data.sequences.files import SequenceFile
from memcomp_lightning.errors import UserError

INSERTIONS = ("keep", "remove")
"""What is done with lower case letters and points."""

_INSERTED = string.ascii_lowercase + "."
_REMOVE = str.maketrans("", "", _INSERTED)


@dataclass(frozen=True)
class Alignment:
    """Sequences of one length.

    Attributes:
        file: Where they stand.
        sequences: Their signs, one for each site.
        removed: Whether lower case letters and points were taken out as insertions.
    """

    file: SequenceFile
    sequences: list[str]
    removed: bool

    @property
    def n_sites(self) -> int:
        """Their length."""
        return len(self.sequences[0])

    @cached_property
    def signs(self) -> Counter[str]:
        """How often each sign is there."""
        found: Counter[str] = Counter()
        for sequence in self.sequences:
            found.update(sequence)
        return found

    @property
    def alphabet(self) -> Alphabet:
        """The one that they seem to be written in."""
        return alphabet_of(self.signs)

    @property
    def n_removed(self) -> int:
        """Signs that were taken out."""
        return sum(map(len, self.file.sequences)) - len(self.sequences) * self.n_sites

    def numbers(self, alphabet: Alphabet) -> NDArray[np.uint8]:
        """Number of each letter, ``(n, n_sites)``; 255 where it is missing.

        Raises:
            UserError: A sign is no letter of the alphabet; the message says where it stands.
        """
        table = alphabet.numbers
        text = "".join(self.sequences)
        if text.isascii():
            found: NDArray[np.uint8] = table[np.frombuffer(text.encode("ascii"), dtype=np.uint8)]
            if not (found == UNKNOWN).any():
                return found.reshape(len(self.sequences), self.n_sites)
        known = {chr(code) for code in range(128) if table[code] != UNKNOWN}
        for number, sequence in enumerate(self.file.sequences):
            for position, sign in enumerate(sequence):
                if sign not in known and not (self.removed and sign in _INSERTED):
                    raise UserError(
                        f"{self.file.place(number, position)}: {sign!r} is no letter of {alphabet.described}. "
                        f"Write {alphabet.missing} for a letter that is not known, or choose data.alphabet."
                    )
        raise AssertionError("an unknown sign that is in no sequence")


def aligned(file: SequenceFile, insertions: str | None = None, n_sites: int | None = None) -> Alignment:
    """Sequences of one length, as they are or without insertions.

    In the formats A2M and A3M lower case letters and points are insertions, which are no columns of the alignment;
    in others they are letters and gaps. Where nothing is said, sequences that have one length as they are stay so;
    those that have one length only without insertions lose them.

    Args:
        file: The sequences.
        insertions: ``"keep"`` or ``"remove"``; None decides by the lengths.
        n_sites: The length that they must have; None takes any.

    Raises:
        UserError: A sequence has another length.
    """
    for removed in (False, True):
        if insertions == INSERTIONS[not removed]:
            continue
        sequences = _without_insertions(file.sequences) if removed else file.sequences
        lengths = set(map(len, sequences))
        if len(lengths) == 1 and 0 not in lengths and n_sites in (None, *lengths):
            return Alignment(file, sequences, removed)
    raise _of_other_length(file, insertions, n_sites)


def _of_other_length(file: SequenceFile, insertions: str | None, n_sites: int | None) -> UserError:
    """The error that names the first sequence of a length that most do not have."""
    inserted = any(sequence != sequence.translate(_REMOVE) for sequence in file.sequences)
    without = _without_insertions(file.sequences)
    removed = insertions != "keep" and inserted and any(without)
    lengths = [len(sequence) for sequence in (without if removed else file.sequences)]
    usual = Counter(lengths).most_common(1)[0][0] if n_sites is None else n_sites
    others = "others have" if n_sites is None else "the model has"
    wrong = next((k for k, length in enumerate(lengths) if length != usual), 0)
    where = " without lower case letters and points" if removed else ""
    return UserError(
        f"{file.place(wrong)}: {lengths[wrong]} sites{where}, where {others} {usual}: expected an alignment, in "
        "which all have one length."
    )


def _without_insertions(sequences: list[str]) -> list[str]:
    return [sequence.translate(_REMOVE) for sequence in sequences]
