"""Read benchmark problems from files, and score assignments as the files' authors do."""

import difflib
import math
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from memcomp_lightning.arrays import Array, to_numpy
from memcomp_lightning.errors import require, require_choice
from memcomp_lightning.problems.files.formats import FORMATS, guess
from memcomp_lightning.problems.files.objective import ClauseList, Parsed, Score
from memcomp_lightning.problems.files.source import ProblemFileError, Source, stem, unpacked


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class Problem(Parsed):
    """A problem and the file that it comes from: :class:`Parsed`, what stands there, with its name.

    Attributes:
        path: The file.
        format: Its format, a key of :data:`FORMATS`.
    """

    path: Path
    format: str

    @property
    def name(self) -> str:
        """The file's name without its suffixes."""
        return stem(self.path).stem

    @property
    def sizes(self) -> dict[str, int]:
        """How many variables, and couplings or clauses."""
        if not isinstance(self.objective.counting, ClauseList):
            return {"variables": self.n, "couplings": math.prod(self.problem.graph.edge_shape)}
        hard = self.objective.counting.hard
        sizes, n_hard = {"variables": self.n, "clauses": len(hard)}, int(hard.sum())
        return {**sizes, "hard_clauses": n_hard} if n_hard else sizes

    @property
    def n_unused(self) -> int:
        """Number of variables that the file does not use: any value of theirs does."""
        return self.n - self.problem.n

    def expand(self, x: Array) -> NDArray[Any]:
        """A state of the problem's variables ``(n_used,)`` as one of the file's ``(n,)``; unused ones are 0."""
        state = to_numpy(x)
        whole = np.zeros(self.n, state.dtype)
        whole[self.variables] = state
        return whole

    def score(self, x: Array) -> Score:
        """Count as the file's authors do, without rounding.

        ``x`` is one state in {0, 1}: of the file's variables ``(n,)``, or of the problem's ``(n_used,)``.
        """
        sizes = f"({self.n},)" + (f" or ({self.problem.n},)" if self.n_unused else "")
        require(tuple(x.shape) in ((self.n,), (self.problem.n,)), "shape of x", tuple(x.shape), sizes)
        state = to_numpy(x) > 0.5
        return self.objective.counting.count(state[self.variables] if len(state) == self.n else state)


def read_problem(path: str | Path, format: str | None = None, *, maximise: bool = False) -> Problem:
    """Read a benchmark problem from a file, plain or packed with gzip, xz or bzip2.

    Args:
        path: The file.
        format: A key of :data:`FORMATS`; None goes by the file's suffix, or by its first lines where there is
            none or it is ``.txt``.
        maximise: Whether the file's objective is to be maximised: files of the formats ``beasley``, ``coo``,
            ``qbsolv`` and ``mtx`` come in both kinds, and do not say which. The energy to minimise is then minus
            the objective.

    Raises:
        ProblemFileError: The file is missing or malformed; one line with the file, the line's number, what was
            found and what was expected.
        SettingError: There is no such format, or its objective is not to be maximised.
    """
    path = Path(path)
    if format is not None:
        require_choice("format", format, FORMATS)
    source = Source(path, _read(path))
    name = _format_of(source) if format is None else format
    fits = not maximise or FORMATS[name].either_way or name == "gset"
    require(fits, "maximise", maximise, f"false for a file of format {name!r}")
    parsed = FORMATS[name].parse(source, maximise)
    return Problem(path=path, format=name, **{part.name: getattr(parsed, part.name) for part in fields(parsed)})


def is_problem_file(path: Path) -> bool:
    """Whether a file of a folder is a problem, by its suffix; of ``.txt`` and without one, by its first lines.

    What may be one of several formats, or is damaged, counts as one: :func:`read_problem` says what is wrong.
    """
    if path.name.startswith(".") or not path.is_file():
        return False
    suffix = stem(path).suffix.lower()
    if suffix not in ("", ".txt"):
        return any(suffix in row.suffixes for row in FORMATS.values())
    try:
        return guess(Source(path, _read(path))) is not None
    except ProblemFileError:
        return True


def _read(path: Path) -> bytes:
    """The uncompressed bytes of a file."""
    try:
        data = path.read_bytes()
    except FileNotFoundError as error:
        raise ProblemFileError(f"{path}: there is no such file. {_near(path)}") from error
    except OSError as error:
        raise ProblemFileError(f"{path}: cannot be read ({error.strerror}).") from error
    return unpacked(path, data)


def _near(path: Path) -> str:
    """What the user may have meant by a file that does not exist."""
    folder = path.parent
    if not folder.is_dir():
        return f"The folder {folder} does not exist either."
    names = difflib.get_close_matches(path.name, [file.name for file in folder.iterdir()], n=3, cutoff=0.3)
    return f"Near it: {', '.join(names)}." if names else f"Nothing in the folder {folder} is called nearly so."


def _format_of(source: Source) -> str:
    """The format by the file's name, or by its first lines."""
    suffix = stem(source.path).suffix.lower()
    for name, format_ in FORMATS.items():
        if suffix in format_.suffixes:
            return name
    known = "; ".join(f"{name} ({', '.join(row.suffixes)}: {row.layout})" for name, row in FORMATS.items())
    # G1.txt and G1 are both in use; of "bench-1.0" Path takes ".0" for a suffix.
    if suffix not in ("", ".txt") and not suffix[1:].isdecimal():
        raise source.fault(f"the suffix {suffix}", f"one of the known ones, or format=NAME of these: {known}")
    name_ = guess(source)
    if name_ is None:
        raise source.fault("first lines of no known format", f"one of these, to choose with format=NAME: {known}")
    return name_
