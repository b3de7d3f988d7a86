"""``resume=FOLDER``, ``continue=FOLDER``: settings of a run, which name no code of others unless it is trusted."""

import re
import shlex
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from hydra import compose
from omegaconf import DictConfig

from memcomp_lightning.cli.arguments import expanded, from_folder, parse, read, unquoted
from memcomp_lightning.cli.overrides import with_search_path
from memcomp_lightning.configuration.composition import SEARCH_PATH, search_paths
from memcomp_lightning.configuration.continued import finished
from memcomp_lightning.configuration.errors import CONFIGURATION_ERRORS
from memcomp_lightning.configuration.quoting import with_path
from memcomp_lightning.errors import UserError
from memcomp_lightning.runs.folder import RunFolder
from memcomp_lightning.runs.trust import foreign

_BEGINS = ("continue", "model.weights")
"""Settings that say where a run began."""

_TRUSTED = "trusted="

_ACTING = ("callbacks", "launcher", "sweeper", "job_logging", "hydra_logging")
"""Parts of Hydra's settings that name code."""


@dataclass(frozen=True)
class Written:
    """What a command takes from a run folder, which may come from a stranger.

    Attributes:
        setting: ``resume`` or ``continue``.
        folder: The run folder.
        typed: What was typed beside it.
        trusted: What the run may name beside parts of this package.
    """

    setting: str
    folder: RunFolder
    typed: Sequence[str]
    trusted: Collection[str]

    def overrides(self) -> list[str]:
        """Those of the run, as they are typed here.

        Raises:
            UserError: They set what Hydra does, or look for settings where nobody trusts them.
        """
        found = [from_folder(override, self.folder.typed_in) for override in self.folder.overrides or []]
        for override in found:
            parsed = parse(override)
            if "hydra" in (
                re.split("[./]", name)[0] for name in (parsed.key_or_group or "", parsed.package or "")
            ):
                if override.startswith(SEARCH_PATH):
                    continue
                raise UserError(
                    f"{self.setting}={self.folder.path}: {override} sets what Hydra does, which no run keeps: "
                    "somebody wrote it there."
                )
        places = foreign(DictConfig({}), _search_path(found), self.folder.path)
        self._refuse({place: where for place, where in places.items() if place not in self._places_typed()})
        return found

    def check(self, config: DictConfig, overrides: Sequence[str]) -> None:
        """Raise a UserError where settings name what neither this package has, nor was typed, nor is trusted."""
        self._refuse_other_hydra(overrides)
        names = foreign(config, _search_path(overrides), self.folder.path)
        if names.keys() - set(self.trusted):
            names = {name: where for name, where in names.items() if name not in self._names_typed()}
        self._refuse(names)

    def _refuse_other_hydra(self, overrides: Sequence[str]) -> None:
        """Raise where a file among the run's own settings sets what Hydra does."""
        if not search_paths(overrides):
            return
        typed = [override for override in self._overrides_typed() if override.lstrip("+~").startswith("hydra")]
        here, ours = (compose("config", list(some), return_hydra_config=True).hydra for some in (overrides, typed))
        for part in _ACTING:
            if here.get(part) != ours.get(part):
                raise UserError(
                    f"{self.setting}={self.folder.path}: a file of its settings sets hydra.{part}, which no run "
                    "needs: somebody wrote it there."
                )

    def _overrides_typed(self) -> list[str]:
        line = read(self.typed)
        return with_search_path(line.overrides, line.config_dir)

    def _places_typed(self) -> Collection[str]:
        return foreign(DictConfig({}), _search_path(self._overrides_typed()), self.folder.path)

    def _names_typed(self) -> Collection[str]:
        """What was typed is trusted like code."""
        try:
            config = compose("config", self._overrides_typed())
        except CONFIGURATION_ERRORS:
            return self._places_typed()
        return {**foreign(config, (), self.folder.path), **dict.fromkeys(self._places_typed())}

    def _refuse(self, names: Mapping[str, str]) -> None:
        if unknown := [name for name in names if name not in self.trusted]:
            line = [f"{self.setting}={self.folder.path}", f"{_TRUSTED}[{','.join(names)}]", *self.typed]
            raise UserError(
                f"{self.setting}={self.folder.path}: its settings name {names[unknown[0]]}, which is no part of "
                f"this package and could do anything. If you trust it, type memcomp-train {shlex.join(line)}"
            )


def with_settings_of_run(arguments: Sequence[str]) -> tuple[list[str], Written | None]:
    """Put the settings of the run that ``resume=FOLDER`` or ``continue=FOLDER`` names before what is typed.

    ``trusted=NAME`` says what a run may name beside parts of this package.

    Returns:
        All arguments, and what is to be checked before anything is built of them; None without a run.

    Raises:
        UserError: It is no run, has not finished, or has overrides that no run keeps.
    """
    typed = [argument for argument in arguments if not argument.startswith(_TRUSTED)]
    trusted = [name for a in arguments if a.startswith(_TRUSTED) for name in _names(a.removeprefix(_TRUSTED))]
    resumed, continued = (_named(setting, typed) for setting in ("resume", "continue"))
    if resumed is not None:
        return _resumed(resumed, typed, trusted)
    if continued not in (None, "null", "None"):
        return _continued(continued, typed, trusted)
    if trusted:
        raise UserError(f"trusted={','.join(trusted)} is for resume=FOLDER and continue=FOLDER: leave it out.")
    return typed, None


def to_trust(config: DictConfig, overrides: Sequence[str], folder: Path) -> list[str]:
    """Arguments that a command needs to go on with a run: what it names that is not of this package."""
    names = foreign(config, _search_path(overrides), folder)
    return [f"{_TRUSTED}[{','.join(names)}]"] if names else []


def _named(setting: str, arguments: Sequence[str]) -> str | None:
    """The folder that a setting names, None where it is not typed."""
    names = [a.partition("=")[2] for a in arguments if a.startswith(f"{setting}=")]
    if names and not unquoted(names[-1]):
        raise UserError(
            f"{setting}= names no folder: write {setting}=FOLDER, the folder of a run of memcomp-train."
        )
    return unquoted(names[-1]) if names else None


def _resumed(name: str, arguments: Sequence[str], trusted: Collection[str]) -> tuple[list[str], Written]:
    """The overrides and the folder of a run that has not finished."""
    if {"-m", "--multirun"} & set(arguments):
        raise UserError(
            f"resume={name} goes on with one run, without -m; a sweep goes on when the same command is given with "
            "hydra.sweep.dir=FOLDER."
        )
    folder = RunFolder(Path(expanded("resume", name)))
    if folder.overrides is None:
        raise UserError(
            f"resume={folder.path}: there is no overrides.json. Name the folder of a run of memcomp-train; a "
            "sweep goes on when the same command is given with hydra.sweep.dir=FOLDER."
        )
    typed = [argument for argument in arguments if not argument.startswith("resume=")]
    written = Written("resume", folder, typed, trusted)
    return [*written.overrides(), *typed, with_path("hydra.run.dir", folder.path)], written


def _continued(name: str, arguments: Sequence[str], trusted: Collection[str]) -> tuple[list[str], Written]:
    """The settings of a finished run, and what is typed in place of some of them.

    What is typed takes the place of a setting of the run, another option of a group that of all settings in it.
    A setting that the run chose by held-out images keeps the value that was chosen.
    """
    folder = finished(Path(expanded("continue", name)).absolute())
    typed = [argument for argument in arguments if not argument.startswith("continue=")]
    written = Written("continue", folder, typed, trusted)
    earlier = written.overrides()
    if choice := (folder.result or {}).get("choice"):
        chosen = [f"{choice['setting']}={choice['value']}", "choose=null"]
        earlier = [*(o for o in earlier if _name(o) not in map(_name, chosen)), *chosen]
    options, given = ({_name(o): o.partition("=")[2] for o in some} for some in (earlier, typed))
    own = given.get("hydra.run.dir")
    if own is not None and Path(unquoted(own)).resolve() == folder.path.resolve():
        raise UserError(
            f"continue={name}: a run that goes on has a folder of its own: choose another hydra.run.dir."
        )
    anew = tuple(f"{name}." for name, option in given.items() if "." not in name and options.get(name) != option)
    kept = [o for o in earlier if _name(o) not in {*given, *_BEGINS} and not _name(o).startswith(anew)]
    return [*kept, *typed, with_path("continue", folder.path)], written


def _search_path(overrides: Sequence[str]) -> list[str]:
    """Where else the overrides look for groups of settings."""
    found = [parse(override).value() for override in search_paths(overrides)]
    return [str(entry) for value in found for entry in (value if isinstance(value, list) else [value])]


def _names(text: str) -> list[str]:
    return [unquoted(name.strip()) for name in text.strip("[]").split(",") if name.strip()]


def _name(override: str) -> str:
    return override.lstrip("+~").partition("=")[0]
