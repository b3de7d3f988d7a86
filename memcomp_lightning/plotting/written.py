"""Writes figures to files, by their ending."""

import io
from collections.abc import Mapping
from pathlib import Path

import numpy as np
from matplotlib.backends.backend_pdf import PdfPages
from matplotlib.figure import Figure
from matplotlib.image import imsave

from memcomp_lightning.errors import UserError, require
from memcomp_lightning.files import written_whole
from memcomp_lightning.plotting.rendering import rendered

ENDINGS = (".png", ".pdf")
"""Of files that hold all figures."""

_DPI = 150


def check_figures(output: Path, *, overwrite: bool) -> None:
    """Refuse, before anything is computed, a place where figures cannot be written or are already.

    Raises:
        UserError: It says what to type.
    """
    is_file = output.suffix.lower() in ENDINGS
    if output.suffix and not is_file and not output.is_dir():
        raise UserError(f"figures={output}: expected a folder, or a file that ends in {' or '.join(ENDINGS)}.")
    if is_file and output.is_dir():
        raise UserError(f"figures={output}: this is a folder.")
    if not is_file and output.is_file():
        raise UserError(f"figures={output}: this is a file. Choose a folder, or a file that ends in .png or .pdf.")
    if not output.parent.is_dir():
        raise UserError(f"figures={output}: there is no folder {output.parent}.")
    there = output.exists() if is_file else output.is_dir() and any(output.glob("*.png"))
    if there and not overwrite:
        what = "the file is there already" if is_file else "there are figures already"
        raise UserError(f"figures={output}: {what}. Choose another, or type overwrite=true.")


def write_figures(figures: Mapping[str, Figure], output: Path, *, overwrite: bool = False) -> None:
    """Write figures: ``NAME.png`` each in a folder, or all in one file.

    Args:
        figures: By name, one or more.
        output: A folder, which is made; a file ``.pdf`` with a page for each; or ``.png``, one below the other.
        overwrite: Whether what is there is replaced.

    Raises:
        UserError: See :func:`check_figures`.
    """
    require(bool(figures), "figures", list(figures), "one or more")
    check_figures(output, overwrite=overwrite)
    ending = output.suffix.lower()
    if ending == ".pdf":
        files = {output: _as_pdf(figures)}
    elif ending == ".png":
        files = {output: _as_one_picture(figures)}
    else:
        files = {output / f"{name}.png": _as_png(figure) for name, figure in figures.items()}
        output.mkdir(exist_ok=True)
    for path, content in files.items():
        with written_whole(path) as partial:
            partial.write_bytes(content)


def _as_png(figure: Figure) -> bytes:
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=_DPI)
    return buffer.getvalue()


def _as_pdf(figures: Mapping[str, Figure]) -> bytes:
    """A page for each."""
    buffer = io.BytesIO()
    with PdfPages(buffer) as pages:
        for figure in figures.values():
            pages.savefig(figure)
    return buffer.getvalue()


def _as_one_picture(figures: Mapping[str, Figure]) -> bytes:
    """One below the other, on white."""
    for figure in figures.values():
        figure.set_dpi(_DPI)
    tiles = [rendered(figure) for figure in figures.values()]
    width = max(tile.shape[1] for tile in tiles)
    wide = [np.pad(x, ((0, 0), (0, width - x.shape[1]), (0, 0)), constant_values=255) for x in tiles]
    buffer = io.BytesIO()
    imsave(buffer, np.concatenate(wide), format="png")
    return buffer.getvalue()
