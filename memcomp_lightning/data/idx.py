"""The IDX format of the MNIST files: big-endian header, then bytes."""

import gzip
import hashlib
import math
import struct
import zlib

import torch
from jaxtyping import UInt8
from torch import Tensor

from memcomp_lightning.errors import Told

_UNSIGNED_BYTE = 0x08
"""The type code of unsigned bytes, the third byte of the header."""


class CorruptFileError(Told, ValueError):
    """A data file whose bytes are not what they must be."""


def unpacked(data: bytes, source: str) -> bytes:
    """Return the content of a gzip stream; raise a CorruptFileError, which names the source, if it has none."""
    try:
        return gzip.decompress(data)
    except (EOFError, OSError, zlib.error) as error:
        raise CorruptFileError(f"{source}: expected a complete gzip stream, got: {error}.") from error


def checked(data: bytes, md5: str, source: str) -> bytes:
    """Return the bytes as they are; raise a CorruptFileError, which names the source, if their MD5 is another."""
    found = hashlib.md5(data, usedforsecurity=False).hexdigest()
    if found != md5:
        raise CorruptFileError(
            f"{source}: expected uncompressed bytes with MD5 {md5}, got {len(data)} bytes with MD5 {found}."
        )
    return data


def parse(data: bytes, n_axes: int, source: str) -> UInt8[Tensor, "..."]:
    """Return the array in the bytes of an IDX file.

    Two zero bytes, a type code and the number of axes make the magic number; the length of each axis
    follows as a 32-bit integer, then the values.

    Args:
        data: Uncompressed bytes.
        n_axes: Number of axes the array must have.
        source: Name of the file, for errors.

    Raises:
        CorruptFileError: The magic number, the number of axes or the number of bytes is another.

    >>> parse(bytes([0, 0, 8, 1, 0, 0, 0, 2, 5, 7]), n_axes=1, source="two labels").tolist()
    [5, 7]
    """
    header = 4 + 4 * n_axes
    if len(data) < header:
        raise CorruptFileError(f"{source}: expected a header of {header} bytes, got {len(data)} bytes in all.")
    magic, *shape = struct.unpack(f">I{n_axes}I", data[:header])
    expected = _UNSIGNED_BYTE << 8 | n_axes
    if magic != expected:
        raise CorruptFileError(
            f"{source}: expected the magic number {expected:#010x} (unsigned bytes, {n_axes} axes), "
            f"got {magic:#010x}."
        )
    n_values = math.prod(shape)
    if not n_values:
        raise CorruptFileError(f"{source}: expected values, got the shape {tuple(shape)} in its header.")
    if len(data) != header + n_values:
        raise CorruptFileError(
            f"{source}: expected {n_values} bytes for the shape {tuple(shape)} in its header, "
            f"got {len(data) - header}."
        )
    # frombuffer wants writable bytes and at least one: the bytearray is a copy, so no one else holds it.
    buffer = bytearray(data)
    values = torch.frombuffer(buffer, dtype=torch.uint8)[header:]
    return values.view(shape)
