"""Composes and checks every job of a command line before Hydra starts one, so that mistakes show at once."""

import hashlib
import itertools
import os
import re
import shlex
import tempfile
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import replace
from functools import cache
from importlib.resources import files
from pathlib import Path
from types import NoneType

from hydra import compose
from hydra.conf import HydraConf
from hydra.core.global_hydra import GlobalHydra
from hydra.errors import HydraException
from omegaconf import DictConfig, ListConfig, OmegaConf, open_dict
from omegaconf.errors import OmegaConfBaseException

from memcomp_lightning.cli.arguments import CommandLine, Planned, parse
from memcomp_lightning.cli.search import named_by_time, planned_jobs
from memcomp_lightning.configuration.composition import (
    CONFIG_MODULE,
    SEARCH_PATH,
    STUDIES,
    composing,
    search_paths,
)
from memcomp_lightning.configuration.errors import CONFIGURATION_ERRORS, check_exists, explain
from memcomp_lightning.configuration.hydra_versions import register_resolver
from memcomp_lightning.configuration.quoting import with_path
from memcomp_lightning.errors import UserError, lost
from memcomp_lightning.runs.addresses import is_address
from memcomp_lightning.runs.paths import is_path

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


def check_command_line(
    line: CommandLine,
    *,
    config_name: str,
    check: Callable[[DictConfig, Sequence[str]], object],
    folders: tuple[str, str],
    check_searchable: Callable[[DictConfig], object] | None = None,
) -> CommandLine:
    """Check every job that a command line stands for, and do none.

    With a flag that shows something, such as --help, the settings are checked, and nothing is built.

    ``check`` builds what a job needs, from its configuration and overrides, or raises one of
    ``CONFIGURATION_ERRORS``; ``check_searchable`` raises if a job returns nothing that a search could go by, and
    is None if none does. A run and a sweep write into ``folders``, unless the arguments say it.

    Returns:
        The line with a folder that is this command's alone: where the settings name it by the time, it is made
        here, and a second command of the same second gets another. That of a sweep is told from the root, as
        launchers start jobs in other working directories; its jobs are listed.

    Raises:
        UserError: Naming the setting, its value, what is allowed and, in a sweep, the job.
    """
    if {"--shell-completion", "--hydra-help"} & set(line.shows):
        return line
    overrides = list(line.overrides)
    if line.config_dir is not None:
        _check_groups(line.config_dir)
        overrides = with_search_path(overrides, line.config_dir)
    key = "hydra.sweep.dir" if line.multirun else "hydra.run.dir"
    if not line.shows:
        check_is_folder(key, line.value(key))
        _check_writable(Path(line.value(key) or folders[line.multirun]), key)
    folder: str | None = None
    root: Path | None = None
    planned = list[Planned]()
    with composing():
        paths = search_paths(overrides)
        try:
            _check_options(overrides, config_name, paths)
            jobs, searches = [overrides], False
            if line.multirun:
                jobs, searches, folder = planned_jobs(overrides, config_name=config_name)
                if searches and check_searchable is None:
                    raise UserError("this command returns nothing that a search could go by; memcomp-train does.")
            elif any(o.startswith(("hparams=", "hydra/sweeper=")) and o != "hparams=null" for o in overrides):
                raise UserError("a search is a multirun: add -m.")
        except CONFIGURATION_ERRORS as error:
            raise UserError(explain(error)) from error
        for job in jobs:
            try:
                config = _composed(config_name, job, paths)
                if not line.multirun:
                    folder = named_by_time(config.hydra.run)
                if line.shows:
                    _check_package(config, line.package)
                    continue
                if line.multirun:
                    root = _folder(config.hydra.sweep)
                    planned.append(
                        Planned(_named(config.hydra.sweep), tuple(o for o in job if not o.startswith("hydra.")))
                    )
                with open_dict(config):
                    del config["hydra"]
                if searches and check_searchable is not None:
                    check_searchable(config)
                check(config, job)
            except Exception as error:
                message = _of_another_kind(config_name, job, paths)
                if message is None and not isinstance(error, CONFIGURATION_ERRORS):
                    raise
                where = f" (job {' '.join(job)})" if line.multirun else ""
                if message is None:
                    own = isinstance(error, UserError)
                    message = explain(error) if own else _naming_override(explain(error), job)
                raise UserError(message + where) from error
    if line.shows:
        return line
    if line.value(key) is None and folder is not None:
        path = claimed(Path(folder))
        line = replace(line, overrides=(*line.overrides, with_path(key, path)), claimed=path)
    if not line.multirun:
        return line
    line = replace(line, planned=() if searches else tuple(planned))
    if (whole := line.claimed or root) is None:
        return line
    others = tuple(o for o in line.overrides if o.partition("=")[0] != key)
    return replace(line, overrides=(*others, with_path(key, whole.absolute())))


def _folder(sweep: DictConfig) -> Path | None:
    """The folder of a sweep, for all its jobs; None where Hydra fills in a path from the root."""
    typed = str(OmegaConf.to_container(sweep, resolve=False)["dir"])  # type: ignore[call-overload, index]
    if "${hydra" not in typed:
        return Path(str(sweep.dir))
    if not typed.startswith("/"):
        raise UserError(
            f"hydra.sweep.dir = {typed} is not allowed: expected a path from the root where Hydra fills it in, as "
            f"jobs may start in other folders: hydra.sweep.dir={Path.cwd()}/NAME"
        )
    return None


def _named(sweep: DictConfig) -> str | None:
    """Name of a job's folder, where it does not depend on the number of the job."""
    try:
        return str(sweep.subdir)
    except OmegaConfBaseException:
        return None


@contextmanager
def answering(line: CommandLine, command: str) -> Iterator[None]:
    """Turn what Hydra raises on a checked command line into a UserError; take an unused folder away again.

    What the machine did not give, room on a disk or memory, is told with the command that goes on.
    """
    before = os.environ.get(_AS_RAISED)
    os.environ[_AS_RAISED] = "1"
    try:
        with going_on(lambda: shlex.join([command, *line.arguments])):
            yield
    except (HydraException, OmegaConfBaseException) as error:
        raise UserError(explain(error)) from error
    except ValueError as error:
        if not line.shows:
            raise
        raise UserError(" ".join(str(error).split())) from error
    finally:
        os.environ.pop(_AS_RAISED)
        if before is not None:
            os.environ[_AS_RAISED] = before
        if line.claimed is not None:
            with suppress(OSError):  # it is in use
                line.claimed.rmdir()


_AS_RAISED = "HYDRA_FULL_ERROR"
"""Lets Hydra raise what it would print as a traceback."""


@contextmanager
def going_on(command: Callable[[], str], *, any_file: bool = False) -> Iterator[None]:
    """Turn what the machine did not give into a UserError that names the command that goes on: see ``lost``."""
    try:
        yield
    except Exception as error:
        if (said := lost(error, any_file=any_file)) is None:
            raise
        raise UserError(f"{said} Go on with: {command()}") from error


def claimed(folder: Path) -> Path:
    """Make a folder that nobody else has made: ``folder``, or the first free of ``folder_2``, ``folder_3``."""
    try:
        folder.parent.mkdir(parents=True, exist_ok=True)
        for number in itertools.count(1):
            path = folder if number == 1 else folder.with_name(f"{folder.name}_{number}")
            with suppress(FileExistsError):
                path.mkdir()
                return path
    except OSError as error:
        raise UserError(f"folder {folder} cannot be made ({error.strerror}).") from error
    raise AssertionError


def _composed(config_name: str, job: Sequence[str], paths: Sequence[str]) -> DictConfig:
    """The configuration of a job, and Hydra's; where there is none, and a name is not known, say which are."""
    try:
        return compose(config_name, list(job), return_hydra_config=True)
    except CONFIGURATION_ERRORS:
        groups = GlobalHydra.instance().config_loader().list_groups("")
        plain = compose(config_name, list(paths))
        for override in job:
            if "." not in override.partition("=")[0]:
                check_exists(override, plain, groups)
        defaults = compose(config_name, [*paths, *(o for o in job if _chooses_group(o))])
        for override in job:
            check_exists(override, defaults, groups)
        raise


def _check_options(overrides: Sequence[str], config_name: str, paths: Sequence[str]) -> None:
    """Refuse to take a group away, to add it a second time, or to give it anything but the name of an option."""
    parsed = [parse(override) for override in overrides]
    if not any(o.key_or_group and "." not in o.key_or_group for o in parsed):
        return
    loader = GlobalHydra.instance().config_loader()
    groups = loader.list_groups("")

    @cache
    def plain() -> DictConfig:
        """Composed only where an override asks for it: that takes a quarter of a second."""
        return compose(config_name, list(paths), return_hydra_config=True)

    for override in parsed:
        name, typed = override.key_or_group, override.input_line
        if "/" in name or "@" in name or override.package is not None:
            continue
        adds = override.is_add() or override.is_force_add()
        known = f"Known here: {', '.join(loader.get_group_options(name))}." if name in groups else ""
        if override.is_delete() and name in plain():
            instead = f"Choose another option with {name}=NAME. {known}" if known else f"Give it: {name}=VALUE."
            raise UserError(f"{typed} is not possible: {name} is needed. {instead}")
        if name in groups and adds and name in plain().hydra.runtime.choices:
            raise UserError(f"{typed} is not possible: {name} has one option. Write {str(typed).lstrip('+')}")
        if name in STUDIES and not adds:
            experiments = ", ".join(name for name in loader.get_group_options("experiment") if name != "none")
            remedy = f"Write experiment=NAME. Known here: {experiments}."
            raise UserError(f"{typed} is not possible: an experiment sets it. {remedy}")
        if name in groups and not override.is_delete() and not override.is_sweep_override():
            value = override.value()
            allowed = value is None and plain().hydra.runtime.choices.get(name) is None
            if not (isinstance(value, str | list) or allowed):
                raise UserError(f"{typed} is not possible: {name} is given the name of an option. {known}")


def _check_package(config: DictConfig, package: str | None) -> None:
    if package not in (None, "_global_") and OmegaConf.select(config, package) is None:
        known = ", ".join(str(key) for key in config)
        raise UserError(f"--package {package}: there is no such part. Known here: {known}.")


def _of_another_kind(config_name: str, job: Sequence[str], paths: Sequence[str]) -> str | None:
    """Return a message if an override gives one value where a list or settings by name are expected."""
    try:
        defaults = compose(config_name, [*paths, *(o for o in job if _chooses_group(o))])
    except CONFIGURATION_ERRORS:
        return None
    for override in job:
        name, equals, text = override.partition("=")
        name = name.lstrip("+")
        if not equals or "." not in name or name.startswith("hydra."):
            continue
        before = OmegaConf.select(defaults, name, throw_on_resolution_failure=False)
        value = parse(override).value()
        if isinstance(before, ListConfig) and not isinstance(value, list | NoneType):
            return f"{name} = {value!r} is not allowed: expected a list. Write {name}=[{text.strip('()')}]"
        if isinstance(before, DictConfig) and not isinstance(value, dict | NoneType):
            known = ", ".join(f"{name}.{key!s}" for key in before)
            group = name.replace(".", "/")
            options = GlobalHydra.instance().config_loader().get_group_options(group)
            choice = f"Choose with {group}=NAME: {', '.join(options)}. " if options else ""
            return f"{name} = {value!r} is not allowed: expected settings by name. {choice}Known here: {known}."
    return None


def _naming_override(message: str, job: Sequence[str]) -> str:
    """A message that names the override it is about, where a library repeats the value alone."""
    if " is not allowed: expected " in message:  # our own
        return message
    given = {o: o.lstrip("+~").partition("=")[::2] for o in job}
    if any(name in message or f"{name.rpartition('.')[0] or name}:" in message for name, _ in given.values()):
        return message
    meant = [
        (override, value)
        for override, (name, value) in given.items()
        if value and not is_path(name) and re.search(rf"(?<!\w){re.escape(value)}(?!\w)", message)
    ]
    if len(meant) != 1:
        return message
    override, value = meant[0]
    remedy = " Write true or false." if value.lower() in ("yes", "no", "on", "off") else ""
    return f"{override}: {message}{remedy}"


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
    """Where a run looks for groups besides ours, by ``--config-dir`` or ``hydra.searchpath``, as an override."""
    sources = [source for source in settings.runtime.config_sources if "command-line" in source.provider]
    places = [f"{source.schema}://{source.path}" for source in sources]
    return [f"{SEARCH_PATH}{places}"] if places else []


def with_search_path(overrides: Sequence[str], folder: Path | None) -> list[str]:
    """The overrides with a folder of ``--config-dir`` as one of the places where they look for groups."""
    if folder is None:
        return list(overrides)
    given = search_paths(overrides)
    others = parse(given[-1]).value() if given else []
    assert isinstance(others, list)
    places = [f"file://{folder}", *map(str, others)]
    return [f"{SEARCH_PATH}{places}", *(o for o in overrides if o not in given)]


def check_is_folder(name: str, value: str | None) -> None:
    """Raise a UserError for the address of an object store, which would become a folder of that name."""
    if value is not None and is_address(value):
        raise UserError(
            f"{name} = {value} is not allowed: expected a folder of a file system. A run renames and links files, "
            f"which object stores cannot do. Let it be copied there: {name}=runs/mine copy_to={value}"
        )


def _check_writable(folder: Path, key: str) -> None:
    """Raise unless a file can be made where the run folder will be."""
    folder = folder.absolute()
    # Path.exists raises where a folder on the way may not be entered.
    existing = next(path for path in (folder, *folder.parents) if os.path.exists(path))  # noqa: PTH110
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
    return "." not in name and name != "seed" and bool(value)
