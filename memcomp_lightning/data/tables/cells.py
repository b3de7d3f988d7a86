"""The cells of a column in some rows, whatever they were read from."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from numpy.typing import NDArray

TRUTH = ("false", "true")
"""Words that are one in any case."""

EMPTY = ("", "NA", "N/A", "NaN", "nan", "null", "NULL", "None", "?")
"""Texts that stand for a missing value."""

LARGEST = 1e30
"""Of numbers: squares of them still fit single precision's range after scaling."""

_NUMBER = r"^[-+]?([0-9]+\.?[0-9]*|\.[0-9]+)([eE][-+]?[0-9]+)?$"


class CellError(ValueError):
    """A cell that is not allowed: which one of those read, and what would be."""

    def __init__(self, row: int, expected: str) -> None:
        super().__init__(f"row {row}: expected {expected}")
        self.row, self.expected = row, expected


@dataclass(frozen=True)
class Cells:
    """Cells of one column.

    Attributes:
        array: Texts, numbers or truth values of Arrow; null is empty.
    """

    array: Any

    @cached_property
    def plain(self) -> Any:
        """Texts without blanks around them, or float64 numbers, NaN being null."""
        array = self.array
        if pa.types.is_dictionary(array.type):
            array = array.dictionary_decode()
        if pa.types.is_nested(array.type) or pa.types.is_binary(array.type):
            raise CellError(0, "a text, a number or a date")
        if pa.types.is_boolean(array.type) or pa.types.is_temporal(array.type):
            array = pc.cast(array, pa.string())
        if _is_text(array.type):
            array = pc.utf8_trim_whitespace(pc.cast(array, pa.string()))
            lower = pc.utf8_lower(array)
            # Truth values, as programs spell them: False, FALSE and false are one word.
            array = pc.if_else(pc.is_in(lower, value_set=pa.array(TRUTH)), lower, array)
            empty = pc.is_in(array, value_set=pa.array(EMPTY))
            return pc.if_else(pc.fill_null(empty, True), pa.scalar(None, pa.string()), array)
        numbers = pc.cast(array, pa.float64(), safe=False)
        return pc.if_else(pc.fill_null(pc.is_nan(numbers), True), pa.scalar(None, pa.float64()), numbers)

    @property
    def are_texts(self) -> bool:
        """Whether they came as texts, which may spell numbers."""
        return bool(pa.types.is_string(self.plain.type))

    @cached_property
    def empty(self) -> NDArray[np.bool_]:
        """Which cells are empty."""
        found: NDArray[np.bool_] = self.plain.is_null().to_numpy(zero_copy_only=False)
        return found

    @cached_property
    def spell_numbers(self) -> NDArray[np.bool_]:
        """Which cells are finite numbers."""
        if self.are_texts:
            found = pc.fill_null(pc.match_substring_regex(self.plain, _NUMBER), False)
        else:
            found = pc.fill_null(pc.is_finite(self.plain), False)
        spelt: NDArray[np.bool_] = found.to_numpy(zero_copy_only=False)
        return spelt

    def numbers(self) -> NDArray[np.float64]:
        """Numbers, NaN where a cell is empty.

        Raises:
            CellError: A cell is something else.
        """
        plain = self.plain
        if self.are_texts:
            try:
                plain = pc.cast(plain, pa.float64())
            except pa.ArrowInvalid:
                wrong = ~self.spell_numbers & ~self.empty
                raise CellError(int(wrong.argmax()), "a number") from None
        found: NDArray[np.float64] = pc.fill_null(plain, np.nan).to_numpy(zero_copy_only=False)
        infinite = (np.abs(found) > LARGEST) | (np.isnan(found) & ~self.empty)
        if infinite.any():
            raise CellError(int(infinite.argmax()), f"a finite number, at most {LARGEST:g}")
        return found

    def index_of(self, words: Sequence[Any]) -> NDArray[np.float32]:
        """Number of each cell's word; NaN where it is empty or none of them."""
        if isinstance(words[0], str):
            folded = [word.lower() if word.lower() in TRUTH else word for word in words]
            plain, known = pc.cast(self.plain, pa.string()), pa.array(folded, pa.string())
        else:
            plain = self.plain
            if self.are_texts:
                spelt = pa.array(self.spell_numbers)
                plain = pc.cast(pc.if_else(spelt, plain, pa.scalar(None, pa.string())), pa.float64())
            known = pa.array([float(word) for word in words], pa.float64())
        found = pc.cast(pc.index_in(plain, value_set=known, skip_nulls=True), pa.float32())
        numbers: NDArray[np.float32] = pc.fill_null(found, np.nan).to_numpy(zero_copy_only=False)
        return numbers

    def distinct(self) -> set[Any]:
        """The different cells that are not empty."""
        return {value for value in pc.unique(self.plain).to_pylist() if value is not None}


def _is_text(kind: Any) -> bool:
    return any(check(kind) for check in (pa.types.is_string, pa.types.is_large_string, pa.types.is_string_view))
