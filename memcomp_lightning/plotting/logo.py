"""Sequence logos: letters as high as the information that they carry."""

from collections.abc import Mapping

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.font_manager import FontProperties
from matplotlib.patches import PathPatch
from matplotlib.path import Path as Outline
from matplotlib.textpath import TextPath
from matplotlib.transforms import Affine2D
from numpy.typing import NDArray

from memcomp_lightning.errors import require
from memcomp_lightning.plotting.alphabet import letters_of

_COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#56B4E9", "#E69F00", "#000000", "#8C6BB1")
_SMALLEST = 0.01
"""Letters lower than this share of the axis are not drawn: nobody could read them."""


def plot_logo(frequencies: Mapping[str, NDArray[np.floating]], *, alphabet: str | None = None) -> Figure:
    r"""A row of letters for each name, the frequent ones on top.

    A site with shares p has the height ``log2 q + \sum p log2 p`` in bits, which its letters share by p (Schneider
    & Stephens 1990, without their correction for small samples).

    Args:
        frequencies: By name, ``(n_sites, q)`` each; NaN where a site has fewer states.
        alphabet: Letters of the states; None takes digits and then capitals.

    Raises:
        SettingError: No name, or more states than letters.
    """
    require(bool(frequencies), "frequencies", list(frequencies), "one table or more")
    n_sites, q = next(iter(frequencies.values())).shape
    letters = letters_of(q, alphabet)
    glyphs = [_glyph(letter) for letter in letters]
    size = (max(3.6, min(0.2 * n_sites + 1.0, 14)), 1.5 * len(frequencies) + 0.4)
    figure = Figure(figsize=size, layout="constrained")
    panels = figure.subplots(len(frequencies), 1, sharex=True, squeeze=False)[:, 0]
    heights = {name: letter_heights(table) for name, table in frequencies.items()}
    top = max(0.1, *(float(np.nansum(own, axis=1).max()) for own in heights.values()))
    for axes, (name, own) in zip(panels, heights.items(), strict=True):
        for site, row in enumerate(own):
            _stack(axes, glyphs, site, row, _SMALLEST * top)
        axes.set(xlim=(-0.6, n_sites - 0.4), ylim=(0, 1.05 * top), ylabel=f"{name}\nbits")
        axes.spines[["top", "right"]].set_visible(False)
    panels[-1].set_xlabel("site")
    return figure


def letter_heights(frequencies: NDArray[np.floating]) -> NDArray[np.float64]:
    """Height of each letter in bits, ``(n_sites, q)``; NaN as in the frequencies.

    >>> letter_heights(np.array([[0.5, 0.5, 0.0, 0.0]])).tolist()
    [[0.5, 0.5, 0.0, 0.0]]
    """
    p = np.asarray(frequencies, dtype=np.float64)
    n_states = (~np.isnan(p)).sum(axis=1, keepdims=True)
    logs = np.log2(p, out=np.zeros_like(p), where=p > 0)
    information = np.log2(n_states) + np.nansum(p * logs, axis=1, keepdims=True)
    heights: NDArray[np.float64] = p * np.maximum(information, 0.0)
    return heights


def _glyph(letter: str) -> Outline:
    """The outline of a letter, of which the box is one wide and one high."""
    path = TextPath((0, 0), letter, size=1, prop=FontProperties(family="DejaVu Sans", weight="bold"))
    box = path.get_extents()
    # A dash stays a dash in the middle, and the I a bar.
    width, height = max(box.width, 0.6), box.height if box.height > 0.3 else 0.6
    middle, bottom = box.x0 + box.width / 2, box.y0 if box.height > 0.3 else box.y0 + box.height / 2 - 0.3
    return Affine2D().translate(-middle, -bottom).scale(1 / width, 1 / height).transform_path(path)


def _stack(axes: Axes, glyphs: list[Outline], site: int, heights: NDArray[np.float64], smallest: float) -> None:
    """The letters of one site, the highest on top."""
    below = 0.0
    for state in np.argsort(np.nan_to_num(heights)):
        height = float(np.nan_to_num(heights[state]))
        if height > smallest:
            place = Affine2D().scale(0.9, 0.97 * height).translate(site, below)
            colour = _COLOURS[state % len(_COLOURS)]
            axes.add_patch(PathPatch(place.transform_path(glyphs[state]), facecolor=colour, linewidth=0))
        below += height
