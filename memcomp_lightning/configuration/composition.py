"""Configurations composed by Hydra: of this package's groups, of the user's, and one curve's or method's own."""

import functools
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager
from contextvars import ContextVar

from hydra import compose, initialize_config_module
from hydra.errors import ConfigCompositionException
from omegaconf import DictConfig, OmegaConf

from memcomp_lightning.configuration.hydra_versions import INITIALIZE
from memcomp_lightning.errors import require

CONFIG_MODULE = "memcomp_lightning.conf"
"""Where our groups are."""

SEARCH_PATH = "hydra.searchpath="
"""Begins the override that says where else groups are looked for."""

STUDIES = ("worth", "density", "few_labels", "figure")
"""Settings that an experiment of many runs fills, each with a study of its own; null in a single run."""

_OF_MANY_RUNS = ("hydra.", *(f"{name}{mark}" for name in STUDIES for mark in "./"))
"""Overrides that say nothing of a single run."""


Check = Callable[[DictConfig, Sequence[str]], object]
"""Raises if a configuration may not be built; it gets the overrides of the curve or method as well."""

_check: ContextVar[Check] = ContextVar("check", default=lambda config, overrides: None)


@contextmanager
def checking(check: Check | None) -> Iterator[None]:
    """Let the configuration of each curve or method be checked: its overrides are texts in those of a study."""
    if check is None:
        yield
        return
    before = _check.set(check)
    try:
        yield
    finally:
        _check.reset(before)


def composing() -> AbstractContextManager[None]:
    """The context in which :func:`composed_for` and Hydra's ``compose`` find our groups, outside of a command."""
    return initialize_config_module(CONFIG_MODULE, **INITIALIZE)


def study_of(config: DictConfig) -> str | None:
    """The setting of many runs that an experiment has filled; None in a single run."""
    return next((name for name in STUDIES if config.get(name) is not None), None)


def search_paths(overrides: Iterable[str]) -> list[str]:
    """The overrides that say where to look for groups."""
    return [override for override in overrides if override.startswith(SEARCH_PATH)]


def composed_for(common: Iterable[str], own: Iterable[str] = ()) -> DictConfig:
    """The configuration of one curve or method, without settings of its study; cached, so do not change it.

    It raises what :func:`checking` raises.

    Overrides of the whole study that this curve or method has no setting for are left out: ``solver.max_steps``
    where its solver is descent. Its own must apply.
    """
    common = tuple(common)
    of_one = tuple(o for o in common if not o.lstrip("+~").startswith(_OF_MANY_RUNS))
    own = tuple(own)
    found = _composed(tuple(search_paths(common)), of_one, own)
    _check.get()(found, own)
    return found


@functools.cache
def _composed(search_path: tuple[str, ...], common: tuple[str, ...], own: tuple[str, ...]) -> DictConfig:
    try:
        composed = compose("config", [*search_path, *common, *own])
    except ConfigCompositionException:
        groups = (o for o in (*common, *own) if "." not in o.partition("=")[0])
        bare = compose("config", [*search_path, *groups])
        applying = (o for o in common if _applies(o.partition("=")[0], bare))
        composed = compose("config", [*search_path, *applying, *own])
    for study in STUDIES:
        composed[study] = None
    return composed


def _applies(name: str, config: DictConfig) -> bool:
    if "." not in name or name.startswith("+"):
        return True
    parent, _, key = name.rpartition(".")
    node = OmegaConf.select(config, parent)
    return isinstance(node, DictConfig) and key in node


def settings_of_comparison(passes: int) -> tuple[str, ...]:
    """No fine-tuning, plain gradient descent at a rate that falls to a hundredth, for so many passes."""
    decay = "{_target_:memcomp_lightning.training.LearningRateDecay,n_passes:" + str(passes) + "}"
    return (
        f"pretrain.iterations={passes}",
        "finetune.iterations=0",
        "pretrain.schedules.momentum=null",
        "pretrain.keep_best=false",
        f"pretrain.schedules.decay={decay}",
    )


def check_not_given(overrides: Iterable[str], instead: Mapping[str, str], of: str) -> None:
    """Refuse overrides of what a study of this kind sets itself.

    ``instead`` says what to do in their place, by setting; OVERRIDE in it stands for what was typed.
    """
    for override in overrides:
        typed = override.lstrip("+")
        name, _, value = typed.partition("=")
        remedy = instead.get(name, "").replace("OVERRIDE", typed)
        require(name not in instead, name, value, f"nothing in {of}", remedy)
