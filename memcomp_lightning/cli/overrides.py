"""The command line before Hydra sees it: every job is composed and checked, and nothing is written."""

import hashlib
import math
import tempfile
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from importlib.resources import files
from pathlib import Path
from typing import Any

from hydra import compose, initialize_config_module
from hydra.conf import HydraConf
from hydra.core.global_hydra import GlobalHydra
from omegaconf import DictConfig, OmegaConf

from memcomp_lightning.cli.errors import CONFIGURATION_ERRORS, UserError, explain, unknown_setting
from memcomp_lightning.cli.hydra_versions import INITIALIZE, register_resolver
from memcomp_lightning.cli.search import planned_jobs
from memcomp_lightning.errors import require, require_choice

CONFIG_MODULE = "memcomp_lightning.conf"

MULTIRUN_FLAGS = {"-m", "--multirun"}

_SEARCH_PATH = "hydra.searchpath="
_SEARCHES = ("hparams=", "hydra/sweeper=")

LONGEST_NAME = 150
"""Characters of a job's folder; file systems allow 255."""


def job_folder(overrides: str) -> str:
    """Name of a job's folder: its overrides, as one path component that every file system takes.

    >>> job_folder("sampler=cd,model.weights=runs/a.pt")
    'sampler=cd,model.weights=runs_a.pt'
    """
    name = overrides.replace("/", "_").replace("\\", "_")
    if len(name) > LONGEST_NAME:
        name = f"{name[:LONGEST_NAME]}_{hashlib.sha256(overrides.encode()).hexdigest()[:8]}"
    return name or "job"


register_resolver("memcomp_job_folder", job_folder, replace=True)


def is_multirun(arguments: Sequence[str]) -> bool:
    """Whether the command line asks for a sweep."""
    return bool(MULTIRUN_FLAGS & set(arguments))


def check_command_line(
    arguments: Sequence[str],
    *,
    config_name: str,
    check: Callable[[DictConfig, Sequence[str]], object],
    folders: tuple[str, str],
    check_searchable: Callable[[DictConfig], object] | None = None,
) -> None:
    """Check every job that the arguments stand for, and do none; with other flags, such as --help, nothing.

    Args:
        arguments: As typed, without the program's name.
        config_name: The configuration that the overrides are for.
        check: Builds what a job needs, from its configuration and overrides, or raises one of
            ``CONFIGURATION_ERRORS``.
        folders: Where a run and a sweep write, unless the arguments say it.
        check_searchable: Raises if a job returns nothing that a search could go by; None if none does.

    Raises:
        UserError: Naming the setting, its value, what is allowed and, in a sweep, the job.
    """
    multirun = is_multirun(arguments)
    overrides = _as_overrides(arguments)
    if overrides is None:
        return
    _check_writable(overrides, *(("hydra.sweep.dir", folders[1]) if multirun else ("hydra.run.dir", folders[0])))
    with initialize_config_module(CONFIG_MODULE, **INITIALIZE):
        paths = search_paths(overrides)
        try:
            jobs, searches = [list(overrides)], False
            if not multirun and any(o.startswith(_SEARCHES) and o != "hparams=null" for o in overrides):
                raise UserError("a search is a multirun: add -m.")
            if multirun:
                jobs, searches = planned_jobs(overrides, config_name=config_name)
                if searches and check_searchable is None:
                    raise UserError("this command returns nothing that a search could go by; memcomp-train does.")
        except CONFIGURATION_ERRORS as error:
            raise UserError(explain(error)) from error
        for job in jobs:
            try:
                config = _composed(config_name, job, paths)
                if searches and check_searchable is not None:
                    check_searchable(config)
                check(config, job)
            except CONFIGURATION_ERRORS as error:
                where = f" (job {' '.join(job)})" if multirun else ""
                raise UserError(explain(error) + where) from error


def _composed(config_name: str, job: Sequence[str], paths: Sequence[str]) -> DictConfig:
    """The configuration of a job; where there is none, and a name is not known, say which are."""
    try:
        return compose(config_name, list(job))
    except CONFIGURATION_ERRORS:
        groups = GlobalHydra.instance().config_loader().list_groups("")
        plain = compose(config_name, list(paths))
        _raise_first(unknown_setting(o, plain, groups) for o in job if "." not in o.partition("=")[0])
        defaults = compose(config_name, [*paths, *(o for o in job if _chooses_group(o))])
        _raise_first(unknown_setting(override, defaults, groups) for override in job)
        raise


def _as_overrides(arguments: Sequence[str]) -> list[str] | None:
    """The overrides, with a ``--config-dir`` as one of them; None if there are other flags than of multirun."""
    overrides, flags = [], set()
    left = iter(arguments)
    for argument in left:
        name, equals, value = argument.partition("=")
        if name in ("--config-dir", "-cd"):
            folder = Path(value if equals else next(left, "")).absolute()
            _check_groups(folder)
            overrides.append(_searching(f"file://{folder}"))
        elif argument.startswith("-"):
            flags.add(argument)
        else:
            overrides.append(argument)
    one_path = len(search_paths(overrides)) <= 1
    return overrides if flags <= MULTIRUN_FLAGS and one_path else None


def _check_groups(folder: Path) -> None:
    """Raise unless a folder of configurations is there, with names of its own."""
    if not folder.is_dir():
        raise UserError(f"--config-dir {folder}: there is no such folder.")
    ours = Path(str(files(CONFIG_MODULE)))
    for path in sorted(folder.glob("*/**/*.yaml")):
        if (ours / path.relative_to(folder)).exists():
            raise UserError(
                f"{path} would not be used: memcomp_lightning has a file of this name. Give it another."
            )


def search_path(settings: HydraConf) -> list[str]:
    """Where a run looks for groups besides our own, by ``--config-dir`` or ``hydra.searchpath``, as an override.

    Args:
        settings: Hydra's, of a run.
    """
    sources = [source for source in settings.runtime.config_sources if "command-line" in source.provider]
    return [_searching(*(f"{source.schema}://{source.path}" for source in sources))] if sources else []


def search_paths(overrides: Iterable[str]) -> list[str]:
    """The overrides that say where to look for groups."""
    return [override for override in overrides if override.startswith(_SEARCH_PATH)]


def _searching(*places: str) -> str:
    return f"{_SEARCH_PATH}{list(places)}"


def _check_writable(overrides: Sequence[str], key: str, default: str) -> None:
    """Raise unless a file can be made where the run folder will be."""
    given = dict(override.split("=", 1) for override in overrides if override.startswith(f"{key}="))
    folder = Path(given.get(key, default).strip("'\"")).absolute()
    existing = next(path for path in (folder, *folder.parents) if path.exists())
    try:
        with tempfile.TemporaryFile(dir=existing):
            pass
    except OSError as error:
        raise UserError(
            f"{key} = {folder} is not allowed: no file can be written in {existing} ({error.strerror}). Choose "
            f"another folder with {key}=PATH."
        ) from error


def _chooses_group(override: str) -> bool:
    name, _, value = override.partition("=")
    return "." not in name and name not in ("seed",) and bool(value)


def _raise_first(messages: Iterable[str | None]) -> None:
    for message in messages:
        if message is not None:
            raise UserError(message)


def check_not_given(overrides: Iterable[str], instead: Mapping[str, str], of: str) -> None:
    """Refuse overrides of what runs of many networks set themselves.

    Args:
        overrides: As typed.
        instead: What to do in their place, by setting; OVERRIDE in it stands for what was typed.
        of: The kind of run.
    """
    for override in overrides:
        typed = override.lstrip("+")
        name, _, value = typed.partition("=")
        remedy = instead.get(name, "").replace("OVERRIDE", typed)
        require(name not in instead, name, value, f"nothing in {of}", remedy)


def check_entry(name: str, settings: DictConfig, known: Collection[str]) -> None:
    """Refuse unknown settings of a curve, a data set or a method, and one without its label or overrides."""
    for key in settings:
        require_choice(f"setting of {name}", str(key), known)
    for key in ("label", "overrides"):
        require(key in settings, f"{name}.{key}", None, "a setting of each")


def check_finite(node: Any, name: str = "") -> None:
    """Refuse NaN and infinity anywhere: optimisers, samplers and solvers would take some of them."""
    if isinstance(node, DictConfig):
        for key in node:
            if not OmegaConf.is_interpolation(node, str(key)):
                check_finite(node[key], f"{name}.{key!s}".lstrip("."))
    elif isinstance(node, float):
        require(math.isfinite(node), name, node, "a finite number")


def check_seed(seed: object) -> None:
    """Refuse a seed that is no integer."""
    require(isinstance(seed, int) and not isinstance(seed, bool), "seed", seed, "an integer")
