"""Checks the values of settings against what their constructors accept, before one of them is called."""

import dataclasses
import inspect
import math
import types
import typing
from collections.abc import Collection, Iterable, Mapping, Sequence
from functools import cache
from importlib import import_module
from os import PathLike
from typing import Any, Literal, TypeVar

from omegaconf import DictConfig, ListConfig, OmegaConf

from memcomp_lightning.errors import require, require_choice

T = TypeVar("T")

_CHECKED = ("memcomp_lightning.", "torch.optim.", "lightning.pytorch.Trainer")
"""Where annotations say what is accepted; those of other packages are theirs."""

_WORDS = {int: "an integer", float: "a number", bool: "true or false", str: "text", types.NoneType: "null"}


def check_values(settings: DictConfig) -> None:
    """Refuse values that no constructor could take: of another kind, not finite; a seed that is no integer.

    Raises:
        SettingError: Naming the setting, its value and what is expected.
    """
    _check_finite(settings)
    check_kinds(settings)
    seed = settings.seed
    require(isinstance(seed, int) and not isinstance(seed, bool), "seed", seed, "an integer")


def require_held_out(config: DictConfig, where: str, chosen: str) -> None:
    """Refuse a run without held-out images to choose something by."""
    share, allowed = config.data.validation_fraction, f"a share above 0 of the training images {where}"
    has_file = config.data.get("validation") is not None
    remedy = f"The test images would choose the {chosen}."
    if "validation" in config.data:
        remedy += " Or give rows to judge by: data.validation=FILE."
    require(has_file or (share or 0) > 0, "data.validation_fraction", share, allowed, remedy)


def _check_finite(node: Any, name: str = "") -> None:
    """Refuse NaN and infinity, which some optimisers, samplers and solvers would accept."""
    if isinstance(node, DictConfig):
        for key in node:
            if not OmegaConf.is_interpolation(node, str(key)):
                _check_finite(node[key], f"{name}.{key!s}".lstrip("."))
    elif isinstance(node, float):
        require(math.isfinite(node), name, node, "a finite number")


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


def filled(schema: type[T], settings: DictConfig, name: str) -> T:
    """Fill a dataclass from settings; its fields say which settings there are, and of which kind.

    Args:
        schema: The dataclass, perhaps of dataclasses; its constructor says what is in range.
        settings: Its fields; those with a default may be left out.
        name: Of the settings, for messages.

    Raises:
        SettingError: Naming the setting that is unknown, missing, or of another kind.
    """
    hints, known = typing.get_type_hints(schema), dataclasses.fields(schema)  # type: ignore[arg-type]
    for key in settings:
        require_choice(f"setting of {name}", str(key), tuple(hints))
    for field in known:
        given = field.name in settings or field.default is not dataclasses.MISSING
        require(given, f"{name}.{field.name}", None, "a value, because it has no default")
    return schema(**{str(key): _as(hints[str(key)], settings[key], f"{name}.{key!s}") for key in settings})


def _as(hint: Any, value: Any, name: str) -> Any:
    """A value of a setting as what a field asks for: dataclasses, lists and dictionaries of them, or itself."""
    for kind in _alternatives(hint):
        origin, parts = typing.get_origin(kind), typing.get_args(kind)
        if isinstance(value, DictConfig) and isinstance(kind, type) and dataclasses.is_dataclass(kind):
            return filled(kind, value, name)
        if isinstance(value, DictConfig) and origin is dict:
            return {str(key): _as(parts[1], value[key], f"{name}.{key!s}") for key in value}
        if isinstance(value, ListConfig) and origin is list:
            return [_as(parts[0], one, name) for one in value]
    plain = OmegaConf.to_container(value, resolve=True) if OmegaConf.is_config(value) else value
    require(_fits(value, hint), name, plain, _in_words(hint))
    return plain


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
    if not inspect.isclass(origin) or origin in (object, Any, *_WORDS):
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
    return isinstance(kind, type) and "Tensor" in {base.__name__ for base in kind.__mro__}
