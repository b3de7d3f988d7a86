"""Lets ``set_params`` and searches reach into samplers, which are frozen dataclasses: ``sampler__k``."""

import dataclasses
from abc import abstractmethod
from typing import Any

from sklearn.base import BaseEstimator

from memcomp_lightning.training import Sampler


class NestedSettings(BaseEstimator):  # type: ignore[misc]
    """An estimator whose samplers, and what is inside them, have names like ``sampler__inner__k``."""

    @abstractmethod
    def _default_sampler(self) -> Sampler:
        """What ``sampler=None`` stands for."""

    def _negative_phase(self) -> Sampler:
        return self._default_sampler() if self.sampler is None else self.sampler

    def get_params(self, deep: bool = True) -> dict[str, Any]:
        """Return all settings; with ``deep`` those of the sampler as well, the default one where it is None."""
        params: dict[str, Any] = super().get_params(deep=deep)
        if deep:
            for name, value in list(params.items()):
                params |= _listed(name, self._negative_phase() if name == "sampler" else value)
        return params

    def set_params(self, **params: Any) -> "NestedSettings":
        """Set settings by name; ``sampler__k`` replaces the sampler by one that differs in ``k``.

        Raises:
            ValueError: There is no such setting.
            SettingError: A sampler refuses the value.
        """
        super().set_params(**{name: value for name, value in params.items() if "__" not in name})
        nested: dict[str, dict[str, Any]] = {}
        for name, value in params.items():
            outer, nests, inner = name.partition("__")
            if nests:
                nested.setdefault(outer, {})[inner] = value
        for outer, values in nested.items():
            held = self._negative_phase() if outer == "sampler" else getattr(self, outer, None)
            if _is_settings(held):
                setattr(self, outer, _replaced(outer, held, values))
            elif hasattr(self, outer) and not hasattr(held, "set_params"):
                names = ", ".join(f"{outer}__{inner}" for inner in values)
                raise ValueError(f"Invalid parameter {names}: {outer} = {held!r} has no settings that have names.")
            else:
                super().set_params(**{f"{outer}__{inner}": value for inner, value in values.items()})
        return self


def _is_settings(value: object) -> bool:
    return dataclasses.is_dataclass(value) and not isinstance(value, type)


def _names(settings: Any) -> list[str]:
    return [field.name for field in dataclasses.fields(settings) if field.init]


def _listed(prefix: str, value: object) -> dict[str, Any]:
    if not _is_settings(value):
        return {}
    found: dict[str, Any] = {}
    for name in _names(value):
        inner = getattr(value, name)
        found |= {f"{prefix}__{name}": inner, **_listed(f"{prefix}__{name}", inner)}
    return found


def _replaced(prefix: str, settings: Any, values: dict[str, Any]) -> Any:
    """Settings that differ in these values, outer ones first."""
    for name in sorted(values, key=lambda name: name.count("__")):
        outer, _, inner = name.partition("__")
        known = _names(settings)
        if outer not in known or (inner and not _is_settings(getattr(settings, outer))):
            raise ValueError(
                f"Invalid parameter {prefix}__{name}: {type(settings).__name__} has {known or 'no settings'}"
                f"{'' if outer not in known else f', and {outer} has none that can be set by name'}."
            )
        value = _replaced(f"{prefix}__{outer}", getattr(settings, outer), {inner: values[name]}) if inner else None
        settings = dataclasses.replace(settings, **{outer: value if inner else values[name]})
    return settings
