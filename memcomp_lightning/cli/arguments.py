"""Reads what was typed: Hydra's flags, and overrides, rewritten so that Hydra reads them as they were meant."""

import difflib
import glob
import os
import re
import shlex
import unicodedata
from collections.abc import Sequence
from dataclasses import dataclass
from fnmatch import fnmatch
from pathlib import Path
from typing import Any, NamedTuple, NoReturn

from hydra._internal.utils import get_args_parser
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Glob, Override
from hydra.core.plugins import Plugins
from hydra.errors import HydraException
from hydra.plugins.completion_plugin import CompletionPlugin

from memcomp_lightning.configuration.quoting import hydra_value, quoted, with_path
from memcomp_lightning.errors import UserError
from memcomp_lightning.runs.addresses import is_address
from memcomp_lightning.runs.paths import is_path

SHOWING = ("help", "hydra_help", "cfg", "info", "shell_completion")
"""Flags that show something and run nothing; the settings are checked all the same."""

REFUSED = {
    "config_name": "The configuration has one name. Put settings of your own in a file experiment/NAME.yaml of a "
    "folder, and choose it with --config-dir FOLDER experiment=NAME.",
    "config_path": "The configuration is part of the package. Add a folder of your own with --config-dir FOLDER.",
    "experimental_rerun": "A run of memcomp-train is repeated, or goes on, with resume=FOLDER.",
}
"""Flags that would leave the checks behind, and what to do instead."""

_NEVER_SWEPT = ("hydra.run.dir", "hydra.sweep.dir", "resume", "continue")
_SEARCH_PATH = "hydra.searchpath"
# Code points, as many of these signs look like others: dashes and the minus sign; quotation marks.
_DASHES = "".join(map(chr, (*range(0x2010, 0x2016), 0x2212, 0xFE58, 0xFE63, 0xFF0D)))
_QUOTES = "".join(map(chr, (*range(0x2018, 0x2020), 0xAB, 0xBB)))


class Planned(NamedTuple):
    """A job of a sweep.

    Attributes:
        folder: Its name in the folder of the sweep; None where it is known to the job alone.
        overrides: Its own settings.
    """

    folder: str | None
    overrides: tuple[str, ...]


@dataclass(frozen=True)
class CommandLine:
    """What was typed.

    Attributes:
        overrides: As Hydra reads them.
        multirun: Whether they stand for many jobs.
        shows: The flag that shows something in place of a run, with its value; none in a run.
        config_dir: A folder of configurations, absolute.
        package: The part of the configuration that is shown, None for all of it.
        problems: Files, folders and patterns as typed, of a command that takes them, in a run.
        claimed: The folder that was made for this command, None before that or where the arguments name one.
        planned: The jobs of a sweep, once it is checked; none of a search, which decides as it goes.
    """

    overrides: tuple[str, ...]
    multirun: bool
    shows: tuple[str, ...]
    config_dir: Path | None
    package: str | None
    problems: tuple[str, ...] = ()
    claimed: Path | None = None
    planned: tuple[Planned, ...] = ()

    @property
    def arguments(self) -> list[str]:
        """For Hydra."""
        folder = ["--config-dir", str(self.config_dir)] if self.config_dir is not None else []
        package = ["--package", self.package] if self.package is not None else []
        return [*self.shows, *package, *folder, *(["--multirun"] if self.multirun else []), *self.overrides]

    def value(self, name: str) -> str | None:
        """The text that a setting is given, None if it is not among the overrides."""
        texts = [text for key, _, text in (o.partition("=") for o in self.overrides) if key == name]
        return unquoted(texts[-1]) if texts else None


def read(arguments: Sequence[str], *, takes_problems: bool = False) -> CommandLine:
    """Read a command line.

    A command that takes problems has them among its settings or as ``problem=``; without ``--multirun`` they are
    kept as typed, and settings may have several values all the same.

    Raises:
        UserError: Naming the argument, and how to write it.
    """
    for argument in arguments:
        _check_signs(argument)
    parser = get_args_parser()
    parser.allow_abbrev = False
    parser.error = _refuse_flag  # type: ignore[method-assign]
    given, unknown = parser.parse_known_intermixed_args(list(arguments))
    if unknown:
        _refuse_unknown(unknown[0], sorted(parser._option_string_actions))
    for name, remedy in REFUSED.items():
        if getattr(given, name) is not None:
            raise UserError(f"{_flag(name)} {getattr(given, name)} is not possible. {remedy}")
    mode = next((o for o in reversed(given.overrides) if o.startswith("hydra.mode=")), "").upper()
    multirun = given.multirun or mode == "HYDRA.MODE=MULTIRUN"
    shown = [name for name in SHOWING if getattr(given, name) not in (None, False)]
    if len(shown) + multirun + given.run > 1:
        typed = [*map(_flag, shown), *["--run"] * given.run, *["-m"] * multirun]
        raise UserError(f"{' and '.join(typed)}: take one of them at a time.")
    if given.package is not None and not given.cfg:
        raise UserError(f"--package {given.package} is a part of what --cfg shows: add --cfg job.")
    if given.resolve and not (given.cfg or given.help):
        raise UserError("--resolve is for what --cfg and --help show: add --cfg job.")
    shows = [*map(_flag, shown), *(value for value in (given.cfg, given.info) if value is not None)]
    shows += ["--resolve"] if given.resolve else []
    overrides, problems = given.overrides, list[str]()
    if given.shell_completion:
        _check_completion(overrides)
    else:
        _check_blanks(overrides)
        if takes_problems := takes_problems and not (multirun or shows):
            problems = [o.removeprefix("problem=") for o in overrides if _names_problem(o)]
            overrides = [o for o in overrides if not _names_problem(o)]
        overrides = [_readable(override, multirun=multirun or takes_problems) for override in overrides]
    folder = None if given.config_dir is None else Path(expanded("--config-dir", given.config_dir)).absolute()
    return CommandLine(tuple(overrides), multirun, tuple(shows), folder, given.package, tuple(problems))


def _names_problem(argument: str) -> bool:
    """Whether an argument is a problem: given by name, or without, as a file is."""
    name, equals, _ = argument.partition("=")
    plain = not equals and argument[:1] not in ("", "+", "~")
    return plain or name == "problem" or argument.startswith("~/") or is_file(argument)


def _flag(name: str) -> str:
    return f"--{name.replace('_', '-')}"


def unquoted(text: str) -> str:
    """A value as Hydra reads it, where that is a text; else as it stands."""
    value = hydra_value(text)
    return value if isinstance(value, str) else text


def from_folder(override: str, folder: Path) -> str:
    """An override as it is typed here, that was typed in another folder: relative paths were meant from there."""
    name, _, text = override.partition("=")
    if folder == Path.cwd() or not is_path(name) or name.startswith("~"):
        return override
    value = hydra_value(text)
    if not isinstance(value, str) or not value or value.startswith(("/", "~", "${")) or is_address(value):
        return override
    return with_path(name, folder / value)


def parse(override: str) -> Override:
    """An override, parsed; where that is not possible, a UserError says how to write it."""
    try:
        return OverridesParser.create().parse_override(override)
    except HydraException:
        raise UserError(f"{override} cannot be read: {_trouble(override)}") from None


def _readable(override: str, *, multirun: bool) -> str:
    """An override that Hydra reads as it was meant."""
    name, equals, text = override.partition("=")
    name = name.strip()
    if not equals:
        if name.startswith("~"):
            parse(name)
        elif is_file(override):
            raise UserError(f"{override} is no setting: expected NAME=VALUE. Did you mean problem={override}?")
        else:
            raise UserError(f"{override or 'An empty argument'} is no setting: expected NAME=VALUE.")
        return name
    if not name.lstrip("+~"):
        raise UserError(f"{override} has no name before the =: expected NAME=VALUE.")
    if name == _SEARCH_PATH:
        return _absolute_search_path(override)
    if is_path(name) and not name.startswith("~"):
        swept = multirun and name not in _NEVER_SWEPT and not is_file(text)
        return _path(name, text, swept=swept)
    text = text.strip()
    if name == "copy_to" and is_address(unquoted(text)):
        return with_path(name, unquoted(text))
    readable = f"{name}={'null' if text == 'None' else text}"
    if parse(readable).is_sweep_override() and not multirun:
        hint = _one_value(name, text)
        raise UserError(f"{override} has several values, which are jobs of a sweep: add -m.{hint}")
    return readable


def _one_value(name: str, text: str) -> str:
    """How one value is written that looks like several."""
    if re.fullmatch(r"[-+]?\d+,\d+", text) and "." in name:
        return f" A decimal number has a point: {name}={text.replace(',', '.')}."
    if "(" in text or "." not in name:
        return ""
    return f" One list is {name}=[{text}]; a text with commas stands in quotes: {_for_shell(name, text)}."


def _path(name: str, text: str, *, swept: bool) -> str:
    """A path, in quotes where Hydra needs them, so that a file may have any name."""
    if not text.strip(" '\"") and name != "problem":
        raise UserError(f"{name}={text} names no path: write {name}=PATH")
    text = "null" if text.strip() == "None" and not is_file(text) else text
    value = hydra_value(text)
    if value is None or (isinstance(value, bool | list | dict) and not is_file(text)):
        return f"{name}={text}"
    if isinstance(value, str) and value != text:  # in quotes already
        return with_path(name, expanded(name, value)) if value.startswith("~") else f"{name}={text.strip()}"
    if isinstance(value, Glob) and not Path(text).exists():
        files = matching(value)
        if not files:
            raise UserError(f"{name}={text} matches no file in {Path.cwd()}.")
        if len(files) > 1 and not swept:
            raise UserError(f"{name}={text} stands for {len(files)} files, the jobs of a sweep: add -m.")
        return f"{name}={','.join(map(quoted, files))}"
    if swept and ("," in text or "(" in text):
        if re.search(r"['\"()\[\]{}]", text):
            parse(f"{name}={text}")
            return f"{name}={text}"
        paths = [expanded(name, part.strip()) for part in text.split(",")]
        return f"{name}={','.join(map(quoted, paths))}"
    return with_path(name, expanded(name, text))


def expanded(name: str, text: str) -> str:
    """A path as typed, but for a ~ that is somebody's folder; a UserError where there is no such user."""
    path = Path(text)
    try:
        return text if not text.startswith("~") or path.exists() else str(path.expanduser())
    except RuntimeError:
        raise UserError(
            f"{name}={text}: {path.parts[0]} is the folder of a user, and there is no such user. A file whose "
            f"name begins with ~ is written {name}=./{text}"
        ) from None


def matching(pattern: Glob) -> list[str]:
    """The files that a ``glob(...)`` stands for."""
    found = sorted({file for included in pattern.include for file in glob.glob(included, recursive=True)})  # noqa: PTH207
    excluded = pattern.exclude
    return [file for file in found if Path(file).is_file() and not any(fnmatch(file, name) for name in excluded)]


def _absolute_search_path(override: str) -> str:
    """Folders of configurations by their whole path: a job may compose once more, elsewhere."""
    value = parse(override).value()
    places = []
    for place in value if isinstance(value, list) else [value]:
        scheme, separator, rest = str(place).rpartition("://")
        places.append(str(place) if separator and scheme != "file" else f"file://{Path(rest).absolute()}")
    return f"{_SEARCH_PATH}=[{','.join(map(quoted, places))}]"


is_file = os.path.isfile
"""Unlike the method of a path, it raises for no name: one that is too long, or has a zero in it."""


def _check_signs(argument: str) -> None:
    """Refuse what came with a copy from a document or a script of another system."""
    shown = argument.encode("utf-8", "backslashreplace").decode()
    if argument.strip("\r\n") != argument:
        remedy = "a script has the line endings of another system: write them anew (dos2unix)"
        raise UserError(f"{argument.strip()} is followed by a line break ({argument!r}): {remedy}.")
    if argument.startswith(tuple(_DASHES)):
        raise UserError(f"{argument} begins with {_named(argument[0])}: write {_with_hyphens(argument)}")
    for sign in argument:
        if unicodedata.category(sign) == "Cc" and sign != "\t":
            raise UserError(f"{argument!r} has a sign that cannot be seen ({sign!r}): write it without.")
        if unicodedata.category(sign) == "Cs":
            raise UserError(f"{shown} has bytes that are no UTF-8: give the file a name without them.")
    name, equals, value = argument.partition("=")
    if equals and is_path(name):
        return
    for sign in argument:
        if sign in _QUOTES:
            plain = "".join("'" if sign in _QUOTES else sign for sign in argument)
            raise UserError(f"{argument} has {_named(sign)}: write {plain}")
        if sign in _DASHES and value.startswith(sign):
            raise UserError(f"{argument} has {_named(sign)}: write {_with_hyphens(argument)}")
        if unicodedata.category(sign) == "Zs" and sign != " ":
            raise UserError(f"{argument} has {_named(sign)}: write {argument.replace(sign, '')}")


def _named(sign: str) -> str:
    return f"the sign {sign!r} (U+{ord(sign):04X}, {unicodedata.name(sign, 'no name')})"


def _with_hyphens(argument: str) -> str:
    plain = "".join("-" if sign in _DASHES else sign for sign in argument)
    return f"-{plain}" if re.fullmatch(r"-[a-z]{2,}.*", plain) else plain


def _check_blanks(overrides: Sequence[str]) -> None:
    """Refuse ``seed = 3``, which a shell takes for three arguments."""
    for before, argument, after in zip(["", *overrides], overrides, [*overrides[1:], ""], strict=False):
        parts = [argument]
        if argument.startswith("=") and "=" not in before:
            parts.insert(0, before)
        if argument.endswith("=") and after and "=" not in after:
            parts.append(after)
        if argument == "=" or (len(parts) > 1 and all(parts)):
            raise UserError(f"{' '.join(parts)} has blanks around the =: write {''.join(parts)}")


def _check_completion(arguments: Sequence[str]) -> None:
    """Refuse what --shell-completion does not take."""
    plugins: Any = Plugins.instance().discover(CompletionPlugin)
    shells = sorted(plugin.provides() for plugin in plugins)
    allowed = [f"{what}={shell}" for what in ("install", "uninstall", "query") for shell in shells]
    if len(arguments) != 1 or arguments[0] not in allowed:
        raise UserError(f"--shell-completion {' '.join(arguments)}: expected one of {', '.join(allowed)}.")


def _refuse_flag(message: str) -> NoReturn:
    raise UserError(f"{message.removeprefix('argument ')}. --hydra-help lists the options.")


def _refuse_unknown(argument: str, flags: Sequence[str]) -> NoReturn:
    name = argument.lstrip("-").partition("=")[0].replace("-", "_")
    close = difflib.get_close_matches(argument, flags, n=1) if argument.startswith("--") else []
    remedy = f"Did you mean {close[0]}?" if close else ""
    if not close and len(name) > 1:
        remedy = f"Settings have no dashes before them: {name}=VALUE."
    raise UserError(f"{argument} is no option. {remedy} Options: {', '.join(flags)}.".replace("  ", " "))


def _trouble(override: str) -> str:
    """What is wrong with an override that Hydra cannot parse, and what to type."""
    name, _, text = override.partition("=")
    text = text.strip()
    for kind, opening, closing in (("bracket", "[", "]"), ("brace", "{", "}"), ("parenthesis", "(", ")")):
        if text.count(opening) != text.count(closing):
            wrong = "not closed" if text.count(opening) > text.count(closing) else "not opened"
            return f"a {kind} is {wrong}."
    for quote in ("'", '"'):
        if text.count(quote) % 2:
            return f"a quotation mark ({quote}) is not closed."
    if text.endswith(",") or text.startswith(",") or ",," in text:
        meant = ",".join(part for part in text.split(",") if part.strip())
        return f"a comma has no value beside it. Write {name}={meant}"
    if text.startswith("="):
        return f"it has two =. Write {name}={text.lstrip('=')}"
    if not re.fullmatch(r"[+~]{0,2}[\w./@:-]+", name):
        return f"{name} is no name of a setting: expected NAME=VALUE."
    if text.endswith("()"):
        return f"{text} has no values."
    return f"a text with such signs needs quotes. Write {_for_shell(name, text)}"


def _for_shell(name: str, text: str) -> str:
    return shlex.quote(f'{name}="{text}"' if '"' not in text else f"{name}='{text}'")
