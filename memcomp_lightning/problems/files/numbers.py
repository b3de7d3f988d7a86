"""Numbers of a file, kept as they stand there: integers over a power of ten."""

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass
from fractions import Fraction
from typing import Any

import numpy as np
from numpy.typing import NDArray

NUMBER = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?", re.ASCII)

Exact = int | Fraction
"""A number without rounding."""

LARGEST_INT64 = 2**63 - 1

MOST_DIGITS = 1000
"""Most digits of a number in a file. float64 reaches 1e308; Python converts no more than 4300 digits."""


def fits(word: str) -> bool:
    """Whether a word is a number that float64 can hold: it neither overflows nor, unless it is 0, becomes 0."""
    if len(word) > MOST_DIGITS or NUMBER.fullmatch(word) is None:
        return False
    size = abs(float(word))
    return size < math.inf and (size > 0 or not re.search("[1-9]", re.split("[eE]", word)[0]))


def number(word: str) -> Exact:
    """The number that a word means; :func:`fits` says whether there is one."""
    if word.isdecimal():
        return int(word)
    if float(word) == 0:  # whatever its power of ten, which may be huge
        return 0
    return whole_if_so(Fraction(word))


def whole_if_so(value: Fraction) -> Exact:
    """A fraction, as an integer if it is one."""
    return value.numerator if value.denominator == 1 else value


@dataclass(frozen=True, slots=True, eq=False)
class Numbers:
    """``integers / 10^decimals``.

    Attributes:
        integers: int64 if sums of any of them fit, else Python's integers in an array of objects.
        decimals: >= 0.
    """

    integers: NDArray[Any]
    decimals: int = 0

    @staticmethod
    def of(values: Sequence[Exact]) -> "Numbers":
        """Keep numbers whose denominators have the prime factors 2 and 5, as those of decimal fractions."""
        decimals = max((_decimals(value.denominator) for value in values), default=0)
        scale = 10**decimals
        return Numbers(smallest([int(value * scale) for value in values]), decimals)

    @staticmethod
    def whole(integers: NDArray[np.int64]) -> "Numbers":
        """Integers as they are."""
        fit = np.abs(integers).sum(dtype=np.float64) < 2**62
        return Numbers(integers if fit else smallest(integers.tolist()))

    @staticmethod
    def read(words: Sequence[str]) -> "Numbers":
        """Keep what the words say; :func:`fits` is true of each."""
        parts = [_digits_and_power(word) for word in words]
        decimals = max([0, *(-power for _, power in parts)])
        integers = [digits * 10 ** (decimals + power) for digits, power in parts]
        while decimals and all(value % 10 == 0 for value in integers):
            integers, decimals = [value // 10 for value in integers], decimals - 1
        return Numbers(smallest(integers), decimals)

    def times(self, factors: NDArray[np.int64]) -> "Numbers":
        """Each number times its factor, small integers >= 0."""
        if self.total * int(factors.max(initial=1)) <= LARGEST_INT64:
            return Numbers(self.integers * factors, self.decimals)
        return Numbers(self.integers.astype(object) * factors.astype(object), self.decimals)

    @property
    def total(self) -> int:
        """Sum of the sizes of the integers."""
        return int(np.abs(self.integers).sum()) if self.integers.size else 0

    def exact(self, integer: int) -> Exact:
        """What a sum of the integers is worth."""
        return whole_if_so(Fraction(integer, 10**self.decimals))

    def double(self) -> NDArray[np.float64]:
        """Each number rounded to float64, once."""
        if self.integers.dtype != object and self.decimals <= 22 and self.total <= 2**53:
            return self.integers.astype(np.float64) / 10.0**self.decimals  # both are exact: one rounding
        scale = 10**self.decimals
        return np.array([value / scale for value in self.integers.tolist()], np.float64)


def smallest(values: Sequence[int]) -> NDArray[Any]:
    """Integers as int64 if all their sums fit, else as objects."""
    within = sum(map(abs, values)) <= LARGEST_INT64
    array = np.empty(len(values), np.int64 if within else object)
    array[:] = values
    return array


def _digits_and_power(word: str) -> tuple[int, int]:
    """A number as an integer times a power of ten."""
    mantissa, _, power = word.lower().partition("e")
    whole, _, fraction = mantissa.partition(".")
    digits = int(whole + fraction)
    return (digits, int(power or 0) - len(fraction)) if digits else (0, 0)


def _decimals(denominator: int) -> int:
    """Digits behind the point of a decimal fraction with this denominator."""
    twos = (denominator & -denominator).bit_length() - 1
    fives, rest = 0, denominator >> twos
    while rest > 1:
        rest, fives = rest // 5, fives + 1
    return max(twos, fives)


def in_full(value: Exact | float) -> str:
    """A number as text, every digit of it; of a float as many as tell it from its neighbours.

    >>> in_full(18014398509482284), in_full(Fraction(194, 10)), in_full(-5.0)
    ('18014398509482284', '19.4', '-5')
    """
    if isinstance(value, int):
        return str(value)
    if isinstance(value, float):
        return str(int(value)) if value.is_integer() and abs(value) <= 2**53 else repr(value)
    decimals = _decimals(value.denominator)
    digits = str(abs(int(value * 10**decimals))).rjust(decimals + 1, "0")
    return f"{'-' if value < 0 else ''}{digits[:-decimals]}.{digits[-decimals:]}"
