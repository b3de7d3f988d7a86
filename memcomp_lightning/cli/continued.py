"""``resume=FOLDER``, ``continue=FOLDER``: settings of a run, which name no code of others unless it is trusted."""

import re
import shlex
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from hydra import compose
from omegaconf import DictConfig

from memcomp_lightning.cli.arguments import expanded, from_folder, parse, read, unquoted
from memcomp_lightning.cli.launched import launched
from memcomp_lightning.cli.overrides import check_is_folder, with_search_path
from memcomp_lightning.configuration.composition import SEARCH_PATH, search_paths
from memcomp_lightning.configuration.continued import finished
from memcomp_lightning.configuration.errors import CONFIGURATION_ERRORS
from memcomp_lightning.configuration.quoting import with_path
from memcomp_lightning.errors import UserError
from memcomp_lightning.runs.addresses import BEGUN, address_of, fetch, is_address, name_of, read_at
from memcomp_lightning.runs.folder import RunFolder
from memcomp_lightning.runs.paths import is_path
from memcomp_lightning.runs.trust import foreign, require_no_links

_BEGINS = ("continue", "model.weights")
"""Settings that say where a run began."""

_TRUSTED = "trusted="

_PLAIN = re.compile(r"[\w./:@+~ -]+")
"""What a name may consist of to be told as one to trust."""


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
        self._require_said_where(found)
        anew = {"copy_to", *({"copy_every"} & set(map(_name, self.typed)))}
        found = [override for override in found if _name(override) not in anew]
        if self.setting == "continue" and (choice := (self.folder.result or {}).get("choice")):
            if type(choice.get("value")) not in (int, float):
                raise UserError(f"continue={self.folder.path}: result.json is damaged: its choice is no number.")
            chosen = [f"{choice['setting']}={choice['value']}", "choose=null"]
            found = [*(o for o in found if _name(o) not in map(_name, chosen)), *chosen]
        for override in found:
            self._check_text(override)
        self._refuse({entry: f"{entry}, where settings would be looked for" for entry in self._places(found)})
        return found

    def _require_said_where(self, overrides: Sequence[str]) -> None:
        """Raise a UserError where a run was copied somewhere, and who goes on does not say whether it is to be."""
        typed = [unquoted(o.partition("=")[2]) for o in overrides if _name(o) == "copy_to"]
        address = address_of(self.folder.path) or next((text for text in typed if is_address(text)), None)
        if self.setting != "resume" or address is None or "copy_to" in map(_name, self.typed):
            return
        at = f"resume={self.folder.path}"
        line = shlex.join(["memcomp-train", at, with_path("copy_to", address), *self.typed])
        raise UserError(
            f"{at}: this run was copied to {address}. Copy it there again with {line}, or type copy_to=null for "
            "none."
        )

    def _check_text(self, override: str) -> None:
        """Raise a UserError for what could stand for anything, or lead Hydra elsewhere."""
        parsed, name = parse(override), _name(override)
        key, text = parsed.key_or_group or "", override.partition("=")[2]
        names = re.split("[./@]", f"{key}.{parsed.package}")
        of_group = "." not in key and isinstance(parsed.value(), str)
        says = None
        if "hydra" in names and not override.startswith(SEARCH_PATH):
            says = "sets what Hydra does"
        elif "${" in text:
            says = "could stand for anything"
        elif not is_path(name) and (".." in re.split(r"[^\w.]", text) or (of_group and {"/", "\\"} & set(text))):
            says = "leads to another folder"
        if says is not None:
            at = f"{self.setting}={self.folder.path}"
            remedy = f"If it was you, give the whole command again, with hydra.run.dir={self.folder.path}."
            raise UserError(f"{at}: {override!r} {says}; somebody typed or wrote it. {remedy}")

    def _places(self, overrides: Sequence[str]) -> list[str]:
        """Places where the run, and nobody who typed, looks for groups of settings."""
        return [entry for entry in _search_path(overrides) if entry not in _search_path(self._overrides_typed())]

    def check(self, config: DictConfig, own: Sequence[str] = ()) -> None:
        """Raise a UserError where settings name what neither this package has, nor was typed, nor is trusted.

        Args:
            config: All settings of a command, or of a curve or method of a study.
            own: Overrides of the curve or method, which stand as texts in the settings of its study.
        """
        for override in own:
            self._check_text(override)
        names = foreign(config, self.folder.path)
        if names.keys() - set(self.trusted):
            names = {name: where for name, where in names.items() if name not in self._names_typed()}
        self._refuse(names)

    def _overrides_typed(self) -> list[str]:
        line = read(self.typed)
        return with_search_path(line.overrides, line.config_dir)

    def _names_typed(self) -> Collection[str]:
        """What was typed is trusted like code."""
        try:
            return foreign(compose("config", self._overrides_typed()), self.folder.path)
        except CONFIGURATION_ERRORS:
            return ()

    def _refuse(self, names: Mapping[str, str]) -> None:
        unknown = [name for name in names if name not in self.trusted]
        if not unknown:
            return
        shown = repr(names[unknown[0]])[1:-1]  # without what moves a terminal's cursor
        said = f"{self.setting}={self.folder.path}: its settings name {shown}, which is no part of this"
        if not all(_PLAIN.fullmatch(name) for name in names):
            raise UserError(f"{said} package and could do anything.")
        line = [f"{self.setting}={self.folder.path}", f"{_TRUSTED}[{','.join(names)}]", *self.typed]
        raise UserError(
            f"{said} package and could do anything. If you trust it, type memcomp-train {shlex.join(line)}"
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
    names = [*foreign(config, folder), *_search_path(overrides)]
    return [f"{_TRUSTED}[{','.join(names)}]"] if names else []


def _named(setting: str, arguments: Sequence[str]) -> str | None:
    """The folder that a setting names, None where it is not typed."""
    names = [a.partition("=")[2] for a in arguments if a.startswith(f"{setting}=")]
    if names and not unquoted(names[-1]):
        raise UserError(
            f"{setting}= names no folder: write {setting}=FOLDER, the folder of a run of memcomp-train."
        )
    if not names:
        return None
    return unquoted(names[-1])


def _resumed(name: str, arguments: Sequence[str], trusted: Collection[str]) -> tuple[list[str], Written]:
    """The overrides and the folder of a run that has not finished."""
    if {"-m", "--multirun"} & set(arguments):
        raise UserError(
            f"resume={name} goes on with one run, without -m; a sweep goes on when the same command is given with "
            "hydra.sweep.dir=FOLDER."
        )
    own = [] if not is_address(name) else _brought_here(name, arguments)
    arguments = [*arguments, *(override for override in own if _name(override) not in map(_name, arguments))]
    here = unquoted(own[0].partition("=")[2]) if own else expanded("resume", name)
    folder = RunFolder(Path(here))
    if folder.overrides is None:
        raise UserError(
            f"resume={folder.path}: there is no overrides.json. Name the folder of a run of memcomp-train; a "
            "sweep goes on when the same command is given with hydra.sweep.dir=FOLDER."
        )
    require_no_links(folder.path)
    typed = [argument for argument in arguments if not argument.startswith("resume=")]
    written = Written("resume", folder, typed, trusted)
    return [*written.overrides(), *typed, with_path("hydra.run.dir", folder.path)], written


def _brought_here(address: str, arguments: Sequence[str]) -> list[str]:
    """Fetch a run from an address; return the overrides that say where it is now, and where it is copied to.

    Raises:
        UserError: Another run is in the way, or several processes would fetch it.
    """
    typed = [a.partition("=")[2] for a in arguments if a.startswith("hydra.run.dir=")]
    folder = Path("runs", name_of(address))
    if typed:
        check_is_folder("hydra.run.dir", unquoted(typed[-1]))
        folder = Path(expanded("hydra.run.dir", unquoted(typed[-1])))
    own = [with_path("hydra.run.dir", folder), with_path("copy_to", address)]
    if not (folder / BEGUN).is_file():
        if launched() is not None:
            line = shlex.join(["memcomp-train", f"resume={address}", own[0], "--cfg", "job"])
            raise UserError(f"resume={address}: several processes would fetch it. Let one fetch it: {line}")
        fetch(address, folder)
    elif address_of(folder) != address:
        raise UserError(
            f"resume={address}: {folder} holds another run. Let this one be fetched to another folder with "
            "hydra.run.dir=FOLDER."
        )
    return own


def _continued(name: str, arguments: Sequence[str], trusted: Collection[str]) -> tuple[list[str], Written]:
    """The settings of a finished run, and what is typed in place of some of them.

    What is typed takes the place of a setting of the run, another option of a group that of all settings in it.
    A setting that the run chose by held-out images keeps the value that was chosen.
    """
    place = name if is_address(name) else str(Path(expanded("continue", name)).absolute())
    with read_at(place) as there:
        folder = finished(there)
    typed = [argument for argument in arguments if not argument.startswith("continue=")]
    written = Written("continue", folder, typed, trusted)
    earlier = written.overrides()
    options, given = ({_name(o): o.partition("=")[2] for o in some} for some in (earlier, typed))
    own = given.get("hydra.run.dir")
    if own is not None and Path(unquoted(own)).resolve() == folder.path.resolve():
        raise UserError(
            f"continue={name}: a run that goes on has a folder of its own: choose another hydra.run.dir."
        )
    anew = tuple(f"{name}." for name, option in given.items() if "." not in name and options.get(name) != option)
    kept = [o for o in earlier if _name(o) not in {*given, *_BEGINS} and not _name(o).startswith(anew)]
    return [*kept, *typed, with_path("continue", place)], written


def _search_path(overrides: Sequence[str]) -> list[str]:
    """Where else the overrides look for groups of settings."""
    found = [parse(override).value() for override in search_paths(overrides)]
    return [str(entry) for value in found for entry in (value if isinstance(value, list) else [value])]


def _names(text: str) -> list[str]:
    return [unquoted(name.strip()) for name in text.strip("[]").split(",") if name.strip()]


def _name(override: str) -> str:
    return override.lstrip("+~").partition("=")[0]
