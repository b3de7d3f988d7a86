"""The letters of proteins and nucleic acids: which one a file is written in, and the number of each letter."""

from collections import Counter
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

MISSING, UNKNOWN = 255, 254
"""Numbers of a letter that is not known, and of a sign that is none."""


@dataclass(frozen=True)
class Alphabet:
    """Letters that a site can have.

    Attributes:
        name: Its word in ``data.alphabet``.
        letters: In the order of their numbers, the gap last.
        missing: The letter for one that is not known; ``?`` is read as well.
        same: Letters that are read as others: T is U in RNA.
    """

    name: str
    letters: str
    missing: str
    same: tuple[tuple[str, str], ...] = ()

    @property
    def q(self) -> int:
        """Number of letters."""
        return len(self.letters)

    @property
    def described(self) -> str:
        """Name and letters, for people."""
        return f"{self.name}: {self.letters}; {self.missing} and ? are missing values"

    @property
    def numbers(self) -> NDArray[np.uint8]:
        """Number of each ASCII sign in either case; ``.`` is a gap."""
        found = np.full(256, UNKNOWN, dtype=np.uint8)
        signs = {letter: number for number, letter in enumerate(self.letters)}
        signs |= {".": signs["-"], self.missing: MISSING, "?": MISSING}
        signs |= {other: signs[letter] for other, letter in self.same}
        for sign, number in signs.items():
            found[[ord(sign), ord(sign.lower())]] = number
        return found


ALPHABETS = {
    alphabet.name: alphabet
    for alphabet in (
        Alphabet("protein", "ACDEFGHIKLMNPQRSTVWY-", "X"),
        Alphabet("rna", "ACGU-", "N", (("T", "U"),)),
        Alphabet("dna", "ACGT-", "N", (("U", "T"),)),
    )
}
"""By name."""

OF_NUCLEOTIDES = 0.9
"""Share of the letters from which A, C, G, T, U and N are taken for nucleotides; of proteins they are a third."""


def alphabet_of(signs: Counter[str]) -> Alphabet:
    """The alphabet that signs are written in, by how often each one is there.

    T and U are the same letter; the one that is more frequent is kept.

    >>> alphabet_of(Counter("GATTACA-")).name
    'dna'
    """
    upper: Counter[str] = Counter()
    for sign, n in signs.items():
        if sign.isalpha():
            upper[sign.upper()] += n
    nucleotides = sum(upper[letter] for letter in "ACGTUN")
    if nucleotides < OF_NUCLEOTIDES * upper.total():
        return ALPHABETS["protein"]
    return ALPHABETS["rna" if upper["U"] > 0 and upper["U"] >= upper["T"] else "dna"]
