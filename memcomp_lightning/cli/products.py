"""What the commands that use a trained run have in common: ``memcomp-NAME RUN [FILE] setting=value ...``."""

import dataclasses
import inspect
import re
import shlex
import sys
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass, is_dataclass
from pathlib import Path
from typing import Generic, TypeVar

from omegaconf import OmegaConf
from omegaconf.errors import OmegaConfBaseException
from yaml import YAMLError

from memcomp_lightning.cli.output import refuse, say
from memcomp_lightning.configuration.errors import in_words
from memcomp_lightning.configuration.values import filled
from memcomp_lightning.errors import SettingError, UserError, lost
from memcomp_lightning.files import written_together
from memcomp_lightning.modules import CheckpointError
from memcomp_lightning.trained.alone import LoadWarning
from memcomp_lightning.trained.run import Run, load

T = TypeVar("T")


@dataclass(frozen=True)
class OfRun:
    """Settings of every command that uses a trained run.

    Attributes:
        replica: Which of the networks of a run with data.partitions, from 0.
        schema: The schema.json of the run folder, where RUN is a weight file or a checkpoint that lies elsewhere.
        trusted: Packages of your own whose parts the run may name, '[your_package]'; parts of others are refused.
    """

    replica: int | None = None
    schema: str | None = None
    trusted: list[str] | None = None

    def load(self, path: str) -> Run:
        """The run, or the file, that was typed."""
        return load(path, replica=self.replica, schema=self.schema, trusted=self.trusted or ())


@dataclass(frozen=True)
class Usage(Generic[T]):
    """How a command is called.

    Attributes:
        command: Its name.
        purpose: What it does, a sentence.
        places: Names of what comes before the settings: ``("RUN",)`` or ``("RUN", "TABLE")``.
        settings: A dataclass; its docstring's section *Attributes*, and those of its bases, explain them.
        examples: Lines that people may type, each with what it does.
        optional: How many of the places, from the end, may be left out.
    """

    command: str
    purpose: str
    places: tuple[str, ...]
    settings: type[T]
    examples: Sequence[tuple[str, str]] = ()
    optional: int = 0

    def read(self, arguments: Sequence[str]) -> tuple[list[str], T]:
        """What was typed: the places, and the settings.

        Raises:
            UserError, SettingError: A place is missing, a setting does not exist or has a wrong value.
        """
        at = next((k for k, text in enumerate(arguments) if re.match(r"\w+=", text)), len(arguments))
        places, pairs = list(arguments[:at]), list(arguments[at:])
        if (said := self._trouble(places, pairs)) is not None:
            raise UserError(f"{said}: type {self.line}. {self.command} --help shows the settings.")
        for pair in pairs:
            try:
                OmegaConf.from_dotlist([pair])
            except (YAMLError, OmegaConfBaseException) as error:
                name, _, value = pair.partition("=")
                quoted = value.replace("'", "''")
                raise UserError(
                    f"{pair} cannot be read. A text with such signs stands in quotes, which the shell must leave: "
                    f"\"{name}='{quoted}'\""
                ) from error
        try:
            return places, filled(self.settings, OmegaConf.from_dotlist(pairs), self.command)
        except SettingError as error:
            said = str(error).replace(f"{self.command}.", "", 1)
            raise SettingError(said.replace("settings by name with a _target_", "'{NAME: VALUE}'")) from error

    def _trouble(self, places: Sequence[str], pairs: Sequence[str]) -> str | None:
        """What is wrong with the number of places, or with what is no pair."""
        missing = self.places[len(places) : len(self.places) - self.optional]
        if missing:
            return f"{' and '.join(missing)} {'is' if len(missing) == 1 else 'are'} missing before the settings"
        odd = [*places[len(self.places) :], *(pair for pair in pairs if "=" not in pair)]
        return f"{odd[0]!r} is no setting" if odd else None

    @property
    def line(self) -> str:
        """The command in one line."""
        n = len(self.places) - self.optional
        shown = [*self.places[:n], *(f"[{place}]" for place in self.places[n:])]
        return " ".join([self.command, *shown, "[setting=value ...]"])

    @property
    def help(self) -> str:
        """What ``--help`` prints."""
        texts = (inspect.cleandoc(kind.__doc__ or "") for kind in self.settings.__mro__ if is_dataclass(kind))
        explained = "\n".join(inspect.cleandoc(text.partition("Attributes:\n")[2]) for text in texts)
        defaults = {
            field.name: field.default
            for field in dataclasses.fields(self.settings)  # type: ignore[arg-type]
        }
        lines = []
        for line in explained.splitlines():
            name = re.match(r"(\w+): ", line)
            if name and name[1] in defaults:
                value = defaults[name[1]]
                shown = str(value).lower() if isinstance(value, bool) else "null" if value is None else value
                lines.append(f"  {name[1]}={shown}\n      {line[name.end() :]}")
            else:
                lines.append(f"      {line.strip()}")
        examples = [f"  {typed}\n      {does}" for typed, does in self.examples]
        return "\n".join([f"{self.command}: {self.purpose}", "", f"  {self.line}", "", *examples, "", *lines])


def existing(path: str) -> Path:
    """The path of a file that was typed.

    Raises:
        UserError: There is none.
    """
    if not Path(path).is_file():
        raise UserError(f"{path}: {'this is a folder' if Path(path).is_dir() else 'there is no such file'}.")
    return Path(path)


def carry_out(
    usage: Usage[T], act: Callable[[list[str], T], None], arguments: Sequence[str] | None = None
) -> None:
    """Read the command line, and act; what the user can put right ends it by one line, with no file written."""
    typed = sys.argv[1:] if arguments is None else list(arguments)
    again = shlex.join([usage.command, *typed])
    if {"--help", "-h"} & set(typed):
        say(usage.help)
        return
    try:
        places, settings = usage.read(typed)
        with written_together(), warnings.catch_warnings():
            warnings.simplefilter("always", LoadWarning)
            warnings.showwarning = lambda message, *_, **__: say(
                f"{usage.command}: warning: {message}", error=True
            )
            act(places, settings)
    except KeyboardInterrupt as stop:
        raise KeyboardInterrupt(f"No file was written. Go on with: {again}") from stop
    except OSError as error:
        said = lost(error)
        rest = f" No file was written. Go on with: {again}"
        refuse(usage.command, UserError(in_words(error) if said is None else said + rest))
    except (UserError, SettingError, CheckpointError) as error:
        refuse(usage.command, UserError(in_words(error)))
    except (MemoryError, RuntimeError) as error:
        if not isinstance(error, MemoryError) and "allocate memory" not in str(error):
            raise
        refuse(usage.command, UserError("there is not enough memory for so many numbers: ask for fewer rows."))
