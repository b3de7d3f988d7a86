"""What the settings of a run folder may name: the folder may come from a stranger, whose code must not run."""

from collections.abc import Collection, Iterator
from dataclasses import dataclass
from pathlib import Path
from pkgutil import resolve_name
from types import ModuleType
from typing import Any

from omegaconf import DictConfig, ListConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from memcomp_lightning import __version__
from memcomp_lightning.errors import UserError
from memcomp_lightning.runs.paths import is_path


@dataclass(frozen=True)
class Allowed:
    """What settings may name without being trusted.

    Attributes:
        packages: Their classes may be named: making one does no more than hold numbers or read data.
        functions: Functions, and classes of other packages, by their whole names; one that ends with a point
            stands for all that a module defines.
    """

    packages: tuple[str, ...]
    functions: tuple[str, ...]


_OURS = "memcomp_lightning."
_PARTS = ("models", "data", "objective", "training", "samplers")
_EDGES = (f"{_OURS}interop.annealer_graph", f"{_OURS}models.connectivity.")
"""Functions that list pairs of units, for a machine's connectivity."""

OF_MODELS = Allowed(
    packages=(*(f"{_OURS}{name}." for name in _PARTS), "torch.optim."),
    functions=_EDGES,
)
"""For those who load a run."""

OF_TRAININGS = Allowed(
    packages=(
        *OF_MODELS.packages,
        *(f"{_OURS}{name}." for name in ("solvers", "callbacks", "studies.few_labels")),
        "dwave.samplers.",
    ),
    functions=(
        *_EDGES,
        "lightning.pytorch.Trainer",
        "lightning.pytorch.loggers.TensorBoardLogger",
        "lightning.pytorch.loggers.CSVLogger",
    ),
)
"""For those who go on with a run."""

_PROGRAMS = ("density.peers", "density.peers_python")
"""Settings that name a program, which would run."""

_WRITING = ("logger", "trainer", "callbacks")
"""Parts that write files."""

_OUTPUT = "${hydra:runtime.output_dir}"
"""The run folder, as settings name it."""

_REFERENCE = "${"
"""Begins what stands for something else, which may be known later alone, or be code."""


def check_targets(node: Any, name: str, path: Path, trusted: Collection[str] = ()) -> None:
    """Refuse settings that name other code than parts of a model.

    Args:
        node: Settings, resolved.
        name: Of them.
        path: The run folder.
        trusted: Packages, any part of which may be named.

    Raises:
        UserError: It says which part it is, and how to trust it.
    """
    for where, target in _targets(node, name):
        if _is_allowed(target, OF_MODELS) or target.startswith(tuple(f"{package}." for package in trusted)):
            continue
        if _is_lost(target):
            raise UserError(
                f"{path}: {where} is {target}, which this version, {__version__}, does not have: the run is of "
                "another one, which can still use it."
            )
        package = target.partition(".")[0]
        raise UserError(
            f"{path}: {where} is {target}, which is no part of a model of this package. If you trust it, add "
            f"trusted=[{package}] to the command; in Python type load({str(path)!r}, trusted=[{package!r}])."
        )


def resolved(settings: Any, name: str, path: Path) -> Any:
    """Settings as plain values, with what references stand for.

    Raises:
        UserError: A text would be a reference again, once it is read anew.
    """
    found = OmegaConf.to_container(settings, resolve=True)
    for where, text in _texts(found, name):
        if _REFERENCE in text:
            raise UserError(f"{path}: {where} is {text!r}, which could stand for anything: write what it means.")
    return found


def foreign(config: DictConfig, folder: Path) -> dict[str, str]:
    """What the settings of a training name that is not of this package, each with the setting that names it.

    Packages, programs and places: what must be trusted before the training goes on.

    Args:
        config: All settings, without Hydra's own.
        folder: Of the run: what writes elsewhere must be trusted as well.
    """
    found: dict[str, str] = {}
    for where, target in _targets(config, ""):
        if not _is_allowed(target, OF_TRAININGS):
            found.setdefault(target.partition(".")[0], f"{where}={target}")
    for where, value in _texts(config, ""):
        if where in _PROGRAMS or (where.startswith(_WRITING) and _leads_out(where, value, folder)):
            found.setdefault(value, f"{where}={value}")
    return found


def require_no_links(folder: Path) -> None:
    """Raise a UserError where a folder holds a link: what is written through it would lie elsewhere."""
    for path in folder.rglob("*"):
        if path.is_symlink():
            raise UserError(f"{path} is a link, which no run makes: put what it points to in its place.")


def forget_lost_initialisers(model: DictConfig) -> None:
    """Leave out how weights began where this version has no such initialiser: they are those of the file."""
    for name in ("weight_init", "output_init"):
        settings = model.get(name)
        if isinstance(settings, DictConfig) and _is_lost(str(settings.get("_target_"))):
            model[name] = None


def _children(node: Any, name: str) -> Iterator[tuple[str, Any]]:
    """What a node holds, by name; interpolations that nothing is known about as they stand."""
    if isinstance(node, DictConfig | ListConfig):
        if node._is_none() or node._is_missing():
            return
        keys = list(node) if isinstance(node, DictConfig) else list(range(len(node)))
        plain: Any = OmegaConf.to_container(node, resolve=False)
        for key in keys:
            try:
                value = node[key]
            except OmegaConfBaseException:
                value = plain[key]
            yield f"{name}.{key}".lstrip("."), value
    elif isinstance(node, dict | list):
        pairs = node.items() if isinstance(node, dict) else enumerate(node)
        yield from ((f"{name}.{key}".lstrip("."), value) for key, value in pairs)


def _leaves(node: Any, name: str) -> Iterator[tuple[str, Any]]:
    for where, value in _children(node, name):
        if isinstance(value, DictConfig | ListConfig | dict | list):
            yield from _leaves(value, where)
        else:
            yield where, value


def _targets(node: Any, name: str) -> Iterator[tuple[str, str]]:
    """The names of code that settings hold, each with the setting that it is of."""
    for where, value in _leaves(node, name):
        parent, _, key = where.rpartition(".")
        if key == "_target_" and value is not None:
            yield parent, str(value)


def _texts(node: Any, name: str) -> Iterator[tuple[str, str]]:
    return ((where, value) for where, value in _leaves(node, name) if isinstance(value, str))


def _leads_out(where: str, value: str, folder: Path) -> bool:
    """Whether a text names a place outside of the run folder."""
    if _REFERENCE in value.removeprefix(_OUTPUT):
        return True
    if value.startswith(_OUTPUT):
        place = folder / value.removeprefix(_OUTPUT).lstrip("/")
    elif is_path(where):
        place = Path(value)
    elif value in ("..", "~") or {"/", "\\"} & set(value):
        place = folder / value.replace("\\", "/")
    else:
        return False
    return value != "" and not place.resolve().is_relative_to(folder.resolve())


def _is_lost(target: str) -> bool:
    """Whether a name of this package is that of nothing in this version."""
    return target.startswith(_OURS) and _named(target) is None


def _is_allowed(target: str, allowed: Allowed) -> bool:
    """Whether a name is that of a class, or function, that is allowed.

    Looked at before anything is imported: the modules of others run code when they are.
    """
    if any(target == name or (name.endswith(".") and target.startswith(name)) for name in allowed.functions):
        return callable(_named(target)) and _is_of(target, (f"{target.partition('.')[0]}.",))
    if not target.startswith(allowed.packages):
        return False
    return isinstance(_named(target), type) and _is_of(target, allowed.packages)


def _is_of(target: str, packages: tuple[str, ...]) -> bool:
    """Whether one of the packages defines what has this name, and does not only import it."""
    return f"{getattr(_named(target), '__module__', '')}.".startswith(packages)


def _named(target: str) -> Any:
    """What has this name; a function rather than the module that it is named as."""
    try:
        found = resolve_name(target)
    except (ImportError, AttributeError, ValueError):
        return None
    return getattr(found, target.rpartition(".")[2], found) if isinstance(found, ModuleType) else found
