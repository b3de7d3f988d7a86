"""The kinds of columns: how a cell becomes a number of a unit, and a number a cell."""

import math
from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from memcomp_lightning.data.tables.cells import CellError, Cells
from memcomp_lightning.errors import require, require_choice
from memcomp_lightning.files import made_of

FARTHEST = 1e15
"""Standard deviations from the mean: sums of squares of such numbers still fit single precision."""

EXACT = 2**53
"""Whole numbers up to it are told apart by float64."""

Numbers = NDArray[np.float32]
Word = str | float | int


@dataclass(frozen=True, slots=True)
class Column(ABC):
    """A column that the model has a site for.

    Attributes:
        name: As the user calls it.
    """

    kind: ClassVar[str]
    """Its word in ``data.columns``."""

    name: str

    @abstractmethod
    def read(self, cells: Cells) -> Numbers:
        """Numbers of the units, NaN where a cell is empty.

        Raises:
            CellError: A cell that the column cannot have.
        """

    @abstractmethod
    def write(self, numbers: NDArray[np.floating[Any]]) -> NDArray[Any]:
        """Cells, as the user writes them; None or NaN where a number is NaN."""

    @property
    def entries(self) -> list[str]:
        """Names of the units of this column."""
        return [self.name]

    @property
    def described(self) -> str:
        """What it holds, for the table that is shown before training."""
        return ""

    def as_json(self) -> dict[str, Any]:
        """Plain values, with the kind."""
        return {"kind": self.kind, **asdict(self)}


@dataclass(frozen=True, slots=True)
class Words(Column):
    """A column of few different values: texts, or numbers that stand for themselves.

    Attributes:
        words: The values, in rising order.
    """

    words: tuple[Word, ...]

    def __post_init__(self) -> None:
        object.__setattr__(self, "words", tuple(self.words))
        texts = [isinstance(word, str) for word in self.words]
        alike = len(self.words) > 0 and len(set(texts)) == 1 and len(set(self.words)) == len(self.words)
        finite = all(texts) or all(math.isfinite(word) for word in self.words if not isinstance(word, str))
        allowed = "one text or more, or one number, each once"
        require(alike and finite, f"words of column {self.name!r}", self.words, allowed)

    @property
    def of_numbers(self) -> bool:
        """Whether the words are numbers."""
        return not isinstance(self.words[0], str)

    def read(self, cells: Cells) -> Numbers:
        """The number of each word."""
        found = cells.index_of(self.words)
        unknown = np.isnan(found) & ~cells.empty
        if unknown.any():
            shown = ", ".join(map(str, self.words[:10])) + (", ..." if len(self.words) > 10 else "")
            raise CellError(int(unknown.argmax()), f"one of the values of the training data: {shown}")
        return found

    def write(self, numbers: NDArray[np.floating[Any]]) -> NDArray[Any]:
        """The word of each number."""
        missing = np.isnan(numbers)
        at = np.where(missing, 0, numbers).round().astype(np.int64)
        whole = self.of_numbers and all(float(w).is_integer() and abs(float(w)) <= EXACT for w in self.words)
        if whole and not missing.any():
            return np.array([int(word) for word in self.words], dtype=np.int64)[at]
        if self.of_numbers:
            return np.where(missing, math.nan, np.array(self.words, dtype=np.float64)[at])
        cells = np.array(self.words, dtype=object)[at]
        cells[missing] = None
        return cells

    @property
    def described(self) -> str:
        """The words."""
        shown = ", ".join(map(str, self.words[:6]))
        return shown + (f", ... ({len(self.words)} values)" if len(self.words) > 6 else "")


@dataclass(frozen=True, slots=True)
class Binary(Words):
    """Two values: a unit in {0, 1}."""

    kind: ClassVar[str] = "binary"


@dataclass(frozen=True, slots=True)
class Category(Words):
    """A categorical unit, with a state for each value."""

    kind: ClassVar[str] = "category"

    @property
    def entries(self) -> list[str]:
        """A unit for each word."""
        return [f"{self.name}={word}" for word in self.words]


@dataclass(frozen=True, slots=True)
class SpinColumn(Column):
    """-1 and +1: a spin."""

    kind: ClassVar[str] = "spin"

    def read(self, cells: Cells) -> Numbers:
        """The numbers themselves."""
        return _within(cells, lambda x: np.abs(x) == 1, "-1 or 1")

    def write(self, numbers: NDArray[np.floating[Any]]) -> NDArray[Any]:
        """Whole numbers."""
        return numbers if np.isnan(numbers).any() else numbers.round().astype(np.int64)

    @property
    def described(self) -> str:
        """Both values."""
        return "-1, 1"


@dataclass(frozen=True, slots=True)
class Probability(Column):
    """A number in [0, 1], the mean of a unit in {0, 1}, as grey values are."""

    kind: ClassVar[str] = "probability"

    def read(self, cells: Cells) -> Numbers:
        """The numbers themselves."""
        return _within(cells, lambda x: (x >= 0) & (x <= 1), "a number in [0, 1]")

    def write(self, numbers: NDArray[np.floating[Any]]) -> NDArray[Any]:
        """The numbers themselves."""
        return numbers

    @property
    def described(self) -> str:
        """Its range."""
        return "0 to 1"


@dataclass(frozen=True, slots=True)
class Real(Column):
    """A real number; the unit has it in standard deviations from the mean of the training data.

    Attributes:
        mean: Of the training data.
        scale: Its standard deviation, > 0.
        whole: Whether all cells are whole numbers, so that new ones are rounded.
    """

    kind: ClassVar[str] = "real"

    mean: float
    scale: float
    whole: bool = False

    def __post_init__(self) -> None:
        known = math.isfinite(self.mean) and 0 < self.scale < math.inf
        require(known, f"mean and scale of column {self.name!r}", (self.mean, self.scale), "numbers, scale > 0")

    def read(self, cells: Cells) -> Numbers:
        """Deviations from the mean."""
        found = (cells.numbers() - self.mean) / self.scale
        far = np.abs(found) > FARTHEST
        if far.any():
            raise CellError(int(far.argmax()), f"a number within {FARTHEST:g} standard deviations of the mean")
        return found.astype(np.float32)

    def write(self, numbers: NDArray[np.floating[Any]]) -> NDArray[Any]:
        """In the user's units, to the seven digits that single precision has; whole where all cells are."""
        found = numbers.astype(np.float64) * self.scale + self.mean
        if not self.whole:
            return _rounded(found)
        found = found.round()
        exact = np.abs(found) <= EXACT  # not where NaN, either
        return found.astype(np.int64) if exact.all() else found

    @property
    def described(self) -> str:
        """Mean and standard deviation."""
        return f"{self.mean:.4g} +- {self.scale:.3g}"


KINDS: dict[str, type[Column]] = {kind.kind: kind for kind in (Binary, SpinColumn, Probability, Category, Real)}
"""In the order in which the units stand side by side."""


def column_of(content: Mapping[str, Any]) -> Column:
    """The column that :meth:`Column.as_json` wrote."""
    settings = dict(content)
    kind = str(settings.pop("kind", None))
    require_choice("kind of a column", kind, tuple(KINDS))
    return made_of(KINDS[kind], settings)


def _rounded(x: NDArray[np.float64], digits: int = 7) -> NDArray[np.float64]:
    """Numbers to so many significant digits, each the float that is nearest to them."""
    size = np.floor(np.log10(np.abs(np.where(np.isfinite(x) & (x != 0), x, 1.0))))
    places = np.clip(digits - 1 - size, -300, 300)
    unit = 10.0 ** np.abs(places)  # exact up to 10^22: one rounding each way
    found: NDArray[np.float64] = np.where(places >= 0, np.round(x * unit) / unit, np.round(x / unit) * unit)
    return found


def _within(cells: Cells, allowed: Any, words: str) -> Numbers:
    found = cells.numbers()
    wrong = ~cells.empty & ~allowed(np.where(cells.empty, 1.0, found))
    if wrong.any():
        raise CellError(int(wrong.argmax()), words)
    return found.astype(np.float32)
