"""Settings against the kinds that the constructors ask for, before one of them is called."""

import inspect
import types
import typing
from collections.abc import Collection, Iterable, Mapping, Sequence
from functools import cache
from importlib import import_module
from os import PathLike
from typing import Any, Literal

from omegaconf import DictConfig, ListConfig, OmegaConf
from torch import Tensor

from memcomp_lightning.errors import require

_CHECKED = ("memcomp_lightning.", "torch.optim.", "lightning.pytorch.Trainer")
"""Where annotations say what is accepted; those of other packages are theirs."""

_WORDS = {int: "an integer", float: "a number", bool: "true or false", str: "text", types.NoneType: "null"}


def check_kinds(settings: DictConfig, name: str = "") -> None:
    """Refuse text in place of a number, a list in place of one value, a word in place of a part, and so on.

    Whether a value of the right kind is in its range is for the constructor to say.

    Args:
        settings: Any node of a configuration; those with a ``_target_`` are held against its annotations.
        name: Its full name.

    Raises:
        SettingError: Naming the setting, its value and what is expected.
    """
    hints = _hints(settings.get("_target_"))
    for key in settings:
        if OmegaConf.is_interpolation(settings, str(key)):
            continue
        full_name, value = f"{name}.{key!s}".lstrip("."), settings[key]
        # What is left null may be filled in later.
        if key in hints and value is not None and not _fits(value, hints[key]):
            plain = OmegaConf.to_container(value) if isinstance(value, ListConfig) else value
            require(False, full_name, plain, _in_words(hints[key]))
        for part, own in _parts(value, full_name):
            check_kinds(part, own)


def _parts(value: Any, name: str) -> list[tuple[DictConfig, str]]:
    if isinstance(value, DictConfig):
        return [(value, name)]
    if isinstance(value, ListConfig):
        return [(part, f"{name}.{i}") for i, part in enumerate(value) if isinstance(part, DictConfig)]
    return []


def _hints(target: object) -> dict[str, Any]:
    """The annotated arguments of a target; none of what is not ours to judge, or is not there."""
    if not isinstance(target, str) or not target.startswith(_CHECKED):
        return {}
    try:
        return _annotations(target)
    except Exception:  # the constructor's own failure has a better message
        return {}


@cache
def _annotations(target: str) -> dict[str, Any]:
    module, _, name = target.rpartition(".")
    made = getattr(import_module(module), name)
    makers = (made.__init__, made.__new__) if inspect.isclass(made) else (made,)
    hints = next(filter(None, map(typing.get_type_hints, makers)), {})
    hints.pop("return", None)
    return hints


def _fits(value: Any, hint: Any) -> bool:
    """Whether a value may be of the kind; where that cannot be told, yes."""
    alternatives = _alternatives(hint)
    if isinstance(value, DictConfig) and "_target_" in value:
        return not all(kind in _WORDS for kind in alternatives)
    if isinstance(value, DictConfig):
        return not all(kind in _WORDS or (_is_part(kind) and not _is_mapping(kind)) for kind in alternatives)
    if isinstance(value, ListConfig):
        return not all(kind in _WORDS or kind is Literal or _is_part(kind) for kind in alternatives)
    return any(_is(value, kind) for kind in alternatives)


def _is(value: Any, kind: Any) -> bool:
    """Whether one value, or none, may be of one kind."""
    if kind in (int, float):  # 2.0 for an integer is refused by its constructor, which knows the range too
        return isinstance(value, int | float) and not isinstance(value, bool)
    if kind in _WORDS:
        return isinstance(value, kind)
    return not (_is_part(kind) or _is_list(kind))


def _is_part(kind: Any) -> bool:
    """Whether it is a class, a callable or a mapping: nothing that one value could stand for."""
    origin = typing.get_origin(kind) or kind
    if not inspect.isclass(origin) or origin in (object, *_WORDS):
        return False
    return not (issubclass(origin, PathLike) or _is_list(kind))


def _is_mapping(kind: Any) -> bool:
    return issubclass(typing.get_origin(kind) or kind, Mapping)


def _is_list(kind: Any) -> bool:
    origin = typing.get_origin(kind) or kind
    return inspect.isclass(origin) and origin in (list, tuple, set, Sequence, Iterable, Collection)


def _alternatives(hint: Any) -> list[Any]:
    if typing.get_origin(hint) in (typing.Union, types.UnionType):
        return [kind for part in typing.get_args(hint) for kind in _alternatives(part)]
    if typing.get_origin(hint) is Literal:
        return [Literal]  # the constructor lists what there is
    return [hint]


def _in_words(hint: Any) -> str:
    words = []
    for kind in _alternatives(hint):
        if kind in _WORDS:
            words.append(_WORDS[kind])
        elif _is_list(kind):
            words.append("a list")
        elif _is_part(kind) and not _is_tensor(kind):
            words.append("settings by name with a _target_")
    return ", or ".join(dict.fromkeys(words)) or "another kind of value"


def _is_tensor(kind: Any) -> bool:
    """Torch's optimisers take these for numbers; a configuration has none."""
    return isinstance(kind, type) and issubclass(kind, Tensor)
