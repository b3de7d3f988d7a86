"""Arrays of NumPy's files, read with care: a stranger's file runs no code, and takes no more memory than bytes."""

import math
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any
from zipfile import ZipFile

import numpy as np
from numpy.lib import format as npy
from numpy.typing import NDArray


class ArrayFileError(ValueError):
    """A file, or a part of one, that is no array of numbers or texts, and why."""


@dataclass(frozen=True)
class Arrays:
    """The arrays of a file.

    Attributes:
        names: Of the arrays of an ``.npz`` file, in their order.
        alone: The array of an ``.npy`` file; None of an ``.npz`` file.
    """

    names: tuple[str, ...]
    alone: NDArray[Any] | None = None
    _archive: Any = None

    def __getitem__(self, name: str) -> NDArray[Any]:
        """Read an array of an ``.npz`` file.

        Raises:
            ArrayFileError: It is damaged, or no array of numbers or texts.
        """
        with _faults(f"{name}: "):
            packed: ZipFile = self._archive.zip
            member = packed.getinfo(f"{name}.npy")
            with packed.open(member) as stream:
                _check_header(stream, member.file_size)
            found: NDArray[Any] = self._archive[name]
            return found


@contextmanager
def opened_arrays(file: Path | IO[bytes], *, mapped: bool = False) -> Iterator[Arrays]:
    """The arrays of an ``.npy`` or ``.npz`` file, those of the second read when they are asked for.

    Args:
        file: A path, or a file that is open for reading.
        mapped: Whether an array that is alone stays in the file until its rows are used.

    Raises:
        ArrayFileError: It is damaged, or holds no arrays of numbers or texts.
        OSError: It cannot be opened.
    """
    with file.open("rb") if isinstance(file, Path) else nullcontext(file) as stream:
        with _faults():
            in_place = _checked_alone(stream) and mapped and isinstance(file, Path)
            found: Any = np.load(
                file if in_place else stream, mmap_mode="r" if in_place else None, allow_pickle=False
            )
        if isinstance(found, np.ndarray):
            yield Arrays((), found)
            return
        with found:
            yield Arrays(tuple(found.files), None, found)


def _checked_alone(stream: IO[bytes]) -> bool:
    """Whether a file holds one array, with as many bytes as its header says; archives have the sizes of theirs."""
    alone = stream.read(len(npy.MAGIC_PREFIX)) == npy.MAGIC_PREFIX
    size = stream.seek(0, 2)
    stream.seek(0)
    if alone:
        _check_header(stream, size)
        stream.seek(0)
    return alone


def _check_header(stream: IO[bytes], size: int) -> None:
    version = npy.read_magic(stream)
    if version not in _HEADERS:
        raise ArrayFileError(f"its version, {version[0]}.{version[1]}, is not one of plain arrays")
    shape, _, dtype = _HEADERS[version](stream)
    if dtype.hasobject:
        raise ArrayFileError("it holds Python objects (pickle), which are never read")
    if math.prod(shape) * dtype.itemsize > size or min(shape, default=0) < 0:
        raise ArrayFileError(f"its {size} bytes are fewer than an array of shape {shape} and {dtype} has")


_HEADERS: dict[tuple[int, int], Any] = {(1, 0): npy.read_array_header_1_0, (2, 0): npy.read_array_header_2_0}


@contextmanager
def _faults(where: str = "") -> Iterator[None]:
    """NumPy and zipfile raise a dozen kinds of errors for damaged files."""
    try:
        yield
    except Exception as error:
        reason = str(error).strip().partition("\n")[0] or type(error).__name__
        raise ArrayFileError(f"{where}{reason}") from error
