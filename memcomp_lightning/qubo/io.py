"""Problems from files, solutions to files."""

import difflib
import gzip
import json
import math
import zlib
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

from torch import Tensor

from memcomp_lightning import __version__
from memcomp_lightning.errors import require, require_choice
from memcomp_lightning.files import write_text
from memcomp_lightning.qubo.formats import FORMATS, Objective, ProblemFileError, Source, guess
from memcomp_lightning.qubo.maxsat import WeightedMaxSat
from memcomp_lightning.qubo.qubo import Qubo, QuboSolution, Status


class Score(NamedTuple):
    """An assignment in the terms of the problem's file.

    Attributes:
        value: The objective, such as the cut weight; of MAX-SAT what the unsatisfied soft clauses weigh.
        hard_unsatisfied: Number of unsatisfied hard clauses; the value counts for nothing unless it is 0.
    """

    value: float
    hard_unsatisfied: int = 0


@dataclass(frozen=True, slots=True, eq=False)
class Problem:
    """A problem and the file that it comes from.

    Attributes:
        problem: What to minimise, in float64 (MAX-SAT: torch's default).
        path: The file.
        format: Its format, a key of :data:`FORMATS`.
        objective: What the file's authors count.
    """

    problem: Qubo | WeightedMaxSat
    path: Path
    format: str
    objective: Objective

    @property
    def name(self) -> str:
        """The file's name without its suffixes."""
        return _stem(self.path).stem

    @property
    def sizes(self) -> dict[str, int]:
        """How many variables, and couplings or clauses."""
        clauses = self.objective.clauses
        if clauses is None:
            return {"variables": self.problem.n, "couplings": math.prod(self.problem.graph.edge_shape)}
        n_hard = int(clauses.hard.sum())
        sizes = {"variables": self.problem.n, "clauses": len(clauses.hard)}
        return {**sizes, "hard_clauses": n_hard} if n_hard else sizes

    def score(self, x: Tensor) -> Score:
        """Count as the file's authors do.

        Args:
            x: One state ``(n,)`` in {0, 1}.
        """
        if (clauses := self.objective.clauses) is None:
            energy = float(self.problem.energy(x.unsqueeze(0)))
            return Score(0.0 - energy if self.objective.maximised else energy)
        unsatisfied = clauses.unsatisfied(x.cpu())
        return Score(float(clauses.weight[unsatisfied].sum()), int((unsatisfied & clauses.hard).sum()))


def read_problem(path: str | Path, format: str | None = None, *, maximise: bool = False) -> Problem:
    """Read a benchmark problem, packed with gzip or not.

    Args:
        path: The file.
        format: A key of :data:`FORMATS`; None is told by the file's name, of ``.txt`` and no suffix by its
            first lines.
        maximise: Whether the file's objective is to be maximised: files of the formats ``beasley`` and ``coo``
            come in both kinds, and do not say which. The energy to minimise is then minus the objective.

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
    require(
        not maximise or FORMATS[name].either_way or name == "gset",
        "maximise",
        maximise,
        f"false for a file of format {name!r}",
    )
    problem, objective = FORMATS[name].parse(source, maximise)
    return Problem(problem, path, name, objective)


def write_solution(
    path: Path, problem: Problem, solution: QuboSolution, *, solver: Mapping[str, Any], seed: int
) -> None:
    """Write a solver's answer as JSON, whole or not at all.

    Args:
        path: Where to.
        problem: What was solved: one problem.
        solution: The answer to it.
        solver: Settings of the solver, as JSON can hold them.
        seed: The seed of its random stream.

    Raises:
        SettingError: The answer is to more than one problem.
    """
    require(solution.energies.ndim == 1, "energies' shape", tuple(solution.energies.shape), "(n_restarts,)")
    score = problem.score(solution.best)
    objective: dict[str, Any] = {
        "name": problem.objective.name,
        "direction": problem.objective.direction,
        "value": score.value,
    }
    if "hard_clauses" in problem.sizes:
        objective["hard_clauses_unsatisfied"] = score.hard_unsatisfied
    content = {
        "problem": {
            "file": str(problem.path),
            "name": problem.name,
            "format": problem.format,
            **{f"n_{kind}": number for kind, number in problem.sizes.items()},
        },
        "energy": float(solution.best_energy),
        "objective": objective,
        "assignment": [int(bit) for bit in solution.best.tolist()],
        "restarts": {
            "energy": [energy if math.isfinite(energy) else None for energy in solution.energies.tolist()],
            "status": [Status(status).name for status in solution.status.tolist()],
            "steps": solution.steps.tolist(),
        },
        "wall_time_s": solution.wall_time_s,
        "solver": dict(solver),
        "seed": seed,
        "memcomp_lightning": __version__,
    }
    lines = ",\n".join(f" {json.dumps(name)}: {json.dumps(value)}" for name, value in content.items())
    write_text(path, f"{{\n{lines}\n}}\n")


def _read(path: Path) -> bytes:
    """The uncompressed bytes of a file."""
    try:
        data = path.read_bytes()
    except FileNotFoundError as error:
        raise ProblemFileError(f"{path}: there is no such file. {_near(path)}") from error
    except OSError as error:
        raise ProblemFileError(f"{path}: cannot be read ({error.strerror}).") from error
    if data[:2] != b"\x1f\x8b" and path.suffix != ".gz":
        return data
    try:
        return gzip.decompress(data)
    except (EOFError, OSError, zlib.error) as error:
        raise ProblemFileError(f"{path}: found {error}, expected a complete gzip stream.") from error


def _near(path: Path) -> str:
    """What the user may have meant by a file that does not exist."""
    folder = path.parent
    if not folder.is_dir():
        return f"The folder {folder} does not exist either."
    names = difflib.get_close_matches(path.name, [file.name for file in folder.iterdir()], n=3, cutoff=0.3)
    return f"Near it: {', '.join(names)}." if names else f"Nothing in the folder {folder} is called nearly so."


def _format_of(source: Source) -> str:
    """The format by the file's name, or by its first lines."""
    suffix = _stem(source.path).suffix.lower()
    for name, format_ in FORMATS.items():
        if suffix in format_.suffixes:
            return name
    known = "; ".join(f"{name} ({', '.join(row.suffixes)}: {row.layout})" for name, row in FORMATS.items())
    # G1.txt and G1 are both in use; of "bench-1.0" Path takes ".0" for a suffix.
    if suffix not in ("", ".txt") and not suffix[1:].isdecimal():
        raise source.fault(f"the suffix {suffix}", f"one of the known ones, or format=NAME of these: {known}")
    name_ = guess(source.lines())
    if name_ is None:
        raise source.fault("first lines of no known format", f"one of these, to choose with format=NAME: {known}")
    return name_


def _stem(path: Path) -> Path:
    """The path without a ``.gz`` at its end."""
    return path.with_suffix("") if path.suffix == ".gz" else path
