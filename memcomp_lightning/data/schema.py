"""What the units of a trained model stand for: kept with it, so that what comes out is in the user's own terms."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from memcomp_lightning.array_files import ArrayFileError, opened_arrays
from memcomp_lightning.data.images import ImageData, PixelLayout
from memcomp_lightning.data.rows import UNLABELLED, Rows
from memcomp_lightning.errors import UserError, require, require_choice
from memcomp_lightning.files import made_of
from memcomp_lightning.models.units import Units

Columns = dict[str, NDArray[Any]]
"""Columns of a table by name, of one length; None and NaN are empty cells."""


class Schema(Protocol):
    """What a kind of data knows of its units; it is written as JSON beside the weights."""

    @property
    def n_sites(self) -> int:
        """Numbers of a row: sites of the visible units."""

    @property
    def n_classes(self) -> int:
        """Number of classes, 0 without labels."""

    @property
    def class_names(self) -> list[str]:
        """The classes in words."""

    @property
    def site_names(self) -> list[str]:
        """Names of the sites."""

    @property
    def entry_names(self) -> list[str]:
        """Names of the visible units: a category has one for each of its values."""

    @property
    def log_scale(self) -> float:
        """What a log density of the units is above one in the user's units."""

    def units(self) -> Units | None:
        """Visible units; None where the settings of the run say them."""

    def read(self, path: Path, *, complete: bool = True) -> Rows:
        """Rows of a file; columns and values may be missing, whole rows too unless ``complete``.

        Raises:
            UserError: The file does not fit, with column and row.
        """

    def decode(self, v: Tensor) -> Columns:
        """Numbers of the sites, ``(n, n_sites)``, in the user's columns and words; NaN is an empty cell."""

    def as_json(self) -> dict[str, Any]:
        """Plain values, from which :func:`schema_of` makes it again."""


@dataclass(frozen=True)
class ImageSchema:
    """Pictures: a site is a pixel, its number a grey value.

    Attributes:
        layout: Which pixels the sites are.
        n_classes: Number of classes.
    """

    layout: PixelLayout
    n_classes: int

    @classmethod
    def of(cls, images: ImageData) -> "ImageSchema":
        """That of a data set."""
        return cls(images.layout, images.n_classes)

    @property
    def n_sites(self) -> int:
        """Number of pixels."""
        return self.layout.n_visible

    @property
    def class_names(self) -> list[str]:
        """The numbers of the classes."""
        return [str(k) for k in range(self.n_classes)]

    @property
    def site_names(self) -> list[str]:
        """``row,column`` of each pixel."""
        pixels = (
            range(self.layout.height * self.layout.width) if self.layout.pixels is None else self.layout.pixels
        )
        return [f"{pixel // self.layout.width},{pixel % self.layout.width}" for pixel in pixels]

    @property
    def entry_names(self) -> list[str]:
        """As the sites."""
        return self.site_names

    @property
    def log_scale(self) -> float:
        """0: grey values are what they are."""
        return 0.0

    def units(self) -> None:
        """The run's settings say which kind of units has the grey values."""
        return

    def read(self, path: Path, *, complete: bool = True) -> Rows:
        """Grey values of an array of rows or of pictures, ``.npy`` or ``.npz``; NaN is missing."""
        array = _array(path)
        array = array.reshape(len(array), -1) if array.ndim > 1 and array.size else array
        if array.ndim != 2 or array.shape[1] != self.n_sites or not len(array):
            raise UserError(f"{path} has the shape {array.shape}: expected rows of {self.n_sites} pixels.")
        if array.dtype.kind not in "biuf":
            raise UserError(f"{path} has values of the kind {array.dtype}: expected numbers in [0, 1].")
        outside = ~((array >= 0) & (array <= 1)) & ~np.isnan(array)
        if outside.any():
            row, pixel = np.argwhere(outside)[0].tolist()
            value = array[row, pixel]
            raise UserError(f"{path}, row {row + 1}, pixel {pixel}: {value} is not a number in [0, 1].")
        v = torch.from_numpy(np.ascontiguousarray(array, dtype=np.float32))
        observed = None if not bool(v.isnan().any()) else ~v.isnan()
        return Rows(v.nan_to_num(nan=0.0), torch.full((len(v),), UNLABELLED, device="cpu"), observed)

    def decode(self, v: Tensor) -> Columns:
        """Grey values by pixel."""
        numbers = v.detach().cpu().numpy()
        return {name: numbers[:, k] for k, name in enumerate(self.site_names)}

    def as_json(self) -> dict[str, Any]:
        """Plain values."""
        pixels = None if self.layout.pixels is None else list(self.layout.pixels)
        size = {"height": self.layout.height, "width": self.layout.width, "pixels": pixels}
        return {"data": "images", **size, "n_classes": self.n_classes}

    @classmethod
    def from_json(cls, content: Mapping[str, Any]) -> "ImageSchema":
        """The schema that was written."""
        plain = made_of(_Plain, dict(content))
        layout = PixelLayout(plain.height, plain.width, None if plain.pixels is None else tuple(plain.pixels))
        for name, value in (("height * width", plain.height * plain.width), ("n_classes", plain.n_classes)):
            require(0 <= value <= MOST_SITES, f"{name} of a schema", value, f"at most {MOST_SITES:,}")
        return cls(layout, plain.n_classes)


@dataclass(frozen=True)
class _Plain:
    """A schema of pictures as it is written."""

    data: str
    height: int
    width: int
    pixels: list[int] | None
    n_classes: int


MOST_SITES = 1_000_000
"""Of a schema that a file holds: more are taken for a misprint."""


def _array(path: Path) -> NDArray[Any]:
    """The array of a file ``.npy`` or ``.npz``: the only one, or ``x``."""
    try:
        with opened_arrays(path) as found:
            if found.alone is not None:
                return found.alone
            names = found.names
            if len(names) == 1 or "x" in names:
                return found["x" if "x" in names else names[0]]
    except (OSError, ArrayFileError) as error:
        reason = "it is no .npy or .npz of numbers" if "pickle" in str(error) else error
        raise UserError(f"{path} cannot be read as an array of pictures: {reason}") from error
    raise UserError(f"{path} holds the arrays {', '.join(names) or 'none'}: call the one of the pictures x.")


def schema_of(content: Mapping[str, Any]) -> Schema:
    """The schema that ``as_json`` wrote."""
    kind = content.get("data")
    require_choice("data of a schema", kind, ("images", "table", "sequences"))
    if kind == "table":
        from memcomp_lightning.data.tables import TableSchema  # Arrow is an extra

        return TableSchema.from_json(content)
    if kind == "sequences":
        from memcomp_lightning.data.sequences import SequenceSchema  # which writes columns, as defined here

        return SequenceSchema.from_json(content)
    return ImageSchema.from_json(content)
