"""Search of settings, axis by axis in turns, by what held-out rows say; it can be taken up at any point."""

import json
import math
from collections.abc import Mapping
from typing import Any

from memcomp_lightning.errors import require, require_some

Setting = dict[str, Any]
"""A value for each axis."""

Axes = dict[str, list[Any]]
"""The values of each axis in rising order; a round goes through the axes in the order of the mapping."""


def checked_start(axes: Axes, start: Setting, at: str) -> Setting:
    """The start, with the values of the axes as these have them: 1 is 1.0 on an axis of real numbers.

    Raises:
        SettingError: An axis has no values, or its start is none of them.
    """
    for name, values in axes.items():
        require_some(f"{at}: axis {name}", values, "a list of values")
        require(
            start.get(name) in values, f"{at}: axis {name}", values, f"values with the start, {start.get(name)}"
        )
    return {**start, **{name: values[values.index(start[name])] for name, values in axes.items()}}


def text_of(setting: Setting) -> str:
    """A setting as text that tells settings apart: the same for equal ones."""
    return json.dumps(setting, sort_keys=True)


def missing(axes: Axes, start: Setting, judged: Mapping[str, float]) -> list[Setting]:
    """What must be tried next; nothing once the search is over.

    On each axis in turn the search walks from where it stands to the neighbour that is better, as long as there is
    one, and it goes round the axes until a round moves nothing: more hidden units may want a lower rate. It takes
    the values of an axis for a hill: a second one behind a valley is not found.

    Args:
        axes: See :data:`Axes`.
        start: Where the search starts.
        judged: What held-out rows said of each setting that was tried, by its text; more is better.

    >>> axes, judged = {"rate": [1, 2, 3]}, {}
    >>> while new := missing(axes, {"rate": 1}, judged):
    ...     judged |= {text_of(setting): setting["rate"] for setting in new}
    >>> sorted(judged.values()), best_of(axes, {"rate": 1}, judged)
    ([1, 2, 3], {'rate': 3})
    """
    return _walk(axes, start, judged)[1]


def best_of(axes: Axes, start: Setting, judged: Mapping[str, float]) -> Setting:
    """Where a search stands; its result once nothing is missing."""
    return _walk(axes, start, judged)[0]


def _walk(axes: Axes, start: Setting, judged: Mapping[str, float]) -> tuple[Setting, list[Setting]]:
    """Where the search stands, and what it needs to go on."""
    present, before = dict(start), None
    while present != before:
        before = present
        for name, values in axes.items():
            present, unknown = _climb(name, values, present, judged)
            if unknown:
                return present, unknown
    return present, []


def _climb(
    name: str, values: list[Any], present: Setting, judged: Mapping[str, float]
) -> tuple[Setting, list[Setting]]:
    """The top of the hill on one axis, or as far as it is known, and what to try before going on."""
    while True:
        at = values.index(present[name])
        around = [{**present, name: values[i]} for i in (at - 1, at, at + 1) if 0 <= i < len(values)]
        unknown = [setting for setting in around if text_of(setting) not in judged]
        found = max(around, key=lambda setting: judged.get(text_of(setting), -math.inf))
        if unknown or not judged[text_of(found)] > judged[text_of(present)]:
            return present, unknown
        present = found
