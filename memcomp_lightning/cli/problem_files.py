"""Which files of problems a command line names: one by one, in lists, folders and patterns."""

import glob
from collections.abc import Sequence
from pathlib import Path
from typing import NoReturn

from hydra.core.override_parser.types import Glob

from memcomp_lightning.cli.arguments import expanded, is_file, matching
from memcomp_lightning.configuration.quoting import hydra_value
from memcomp_lightning.errors import UserError
from memcomp_lightning.problems import is_problem_file


def problem_files(texts: Sequence[str]) -> list[Path]:
    """The files that are meant, each once, as they were typed; those of a folder and of a pattern by name.

    Raises:
        UserError: A pattern or a folder stands for none.
    """
    return list(dict.fromkeys(Path(file) for text in texts for file in _meant(text)))


def _meant(text: str) -> list[str]:
    value = text if is_file(text) else hydra_value(text)
    if value is None:
        return []
    if isinstance(value, list):
        return [file for item in value for file in _meant(str(item))]
    if isinstance(value, Glob):
        return matching(value) or _refuse(text)
    path = expanded("problem", value if isinstance(value, str) else text)
    if is_file(path) or not path:
        return [path] if path else []
    if Path(path).is_dir():
        return [str(file) for file in sorted(Path(path).iterdir()) if is_problem_file(file)] or _refuse(text)
    parts = [part.strip() for part in path.split(",")]
    if all(map(is_file, parts)):
        return parts
    if glob.has_magic(path):
        return sorted(filter(is_file, glob.glob(path, recursive=True))) or _refuse(text)  # noqa: PTH207
    return [path]


def _refuse(text: str) -> NoReturn:
    where = "" if Path(text).is_absolute() else f" in {Path.cwd()}"
    raise UserError(f"{text} stands for no file of a problem{where}.")
