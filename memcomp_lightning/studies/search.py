"""Search of settings, one axis after the other, by what held-out rows say; it can be taken up at any point."""

import json
from collections.abc import Mapping
from typing import Any

from memcomp_lightning.errors import require, require_some

Setting = dict[str, Any]
"""A value for each axis."""

Axes = dict[str, list[Any]]
"""The values of each axis in rising order; axes are searched in the order of the mapping."""


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
    one. It takes the values of an axis for a hill: a second one behind a valley is not found.

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
    present = dict(start)
    for name, values in axes.items():
        while True:
            at = values.index(present[name])
            around = [{**present, name: values[i]} for i in (at - 1, at, at + 1) if 0 <= i < len(values)]
            unknown = [setting for setting in around if text_of(setting) not in judged]
            if unknown:
                return present, unknown
            found = max(around, key=lambda setting: judged[text_of(setting)])
            if not judged[text_of(found)] > judged[text_of(present)]:
                break
            present = found
    return present, []
