"""Problems from files, solutions to files."""

import difflib
import json
import math
from collections.abc import Mapping
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from memcomp_lightning import __version__
from memcomp_lightning.errors import require, require_choice
from memcomp_lightning.files import write_text
from memcomp_lightning.qubo.files.formats import FORMATS, guess
from memcomp_lightning.qubo.files.numbers import Exact, in_full
from memcomp_lightning.qubo.files.objective import ClauseList, Objective, Score
from memcomp_lightning.qubo.files.source import ProblemFileError, Source, stem, unpacked
from memcomp_lightning.qubo.maxsat import WeightedMaxSat
from memcomp_lightning.qubo.qubo import Qubo, QuboSolution, Status


@dataclass(frozen=True, slots=True, eq=False)
class Answer:
    """A solver's answer in the terms of the problem's file, counted without rounding.

    Attributes:
        assignment: The best one, of all variables of the file, ``(n,)`` bool. Feasibility ranks before cost.
        score: Its score.
        energy: Its energy: the score's value, or minus it, and the penalty of unsatisfied hard clauses.
        energies: Of each restart; None where it was not run.
        status: Of each restart. OPTIMAL is left where it is proven and no hard clause is unsatisfied.
    """

    assignment: Tensor
    score: Score
    energy: Exact | float
    energies: list[Exact | float | None]
    status: list[Status]

    @property
    def n_run(self) -> int:
        """Number of restarts that were run."""
        return sum(energy is not None for energy in self.energies)

    @property
    def n_reached(self) -> int:
        """Number of restarts that end at the best energy."""
        return self.energies.count(self.energy)

    @property
    def optimal(self) -> bool:
        """Whether this is proven to be the best that there is."""
        return Status.OPTIMAL in self.status


@dataclass(frozen=True, slots=True, eq=False)
class Problem:
    """A problem and the file that it comes from.

    Attributes:
        problem: What to minimise, in float64, over those variables that the file uses.
        path: The file.
        format: Its format, a key of :data:`FORMATS`.
        objective: What the file's authors count.
        n: Number of variables of the file.
        variables: ``(n_used,)`` int64, the variables of ``problem`` among those of the file, counted from 0.
        remarks: What a person should know of how the file was read, a sentence each.
        integers: ``problem`` as integers, for solvers that prove; None where int64 does not hold its sums, or for
            clauses of three literals and more.
        resolved: Whether energies that differ do so in float64.
    """

    problem: Qubo | WeightedMaxSat
    path: Path
    format: str
    objective: Objective
    n: int
    variables: Tensor
    remarks: tuple[str, ...] = ()
    integers: Qubo | None = None
    resolved: bool = True

    @property
    def name(self) -> str:
        """The file's name without its suffixes."""
        return stem(self.path).stem

    @property
    def sizes(self) -> dict[str, int]:
        """How many variables, and couplings or clauses."""
        if not isinstance(self.objective.counting, ClauseList):
            return {"variables": self.n, "couplings": math.prod(self.problem.graph.edge_shape)}
        n_hard = self.objective.counting.n_hard
        sizes = {"variables": self.n, "clauses": len(self.objective.counting.hard)}
        return {**sizes, "hard_clauses": n_hard} if n_hard else sizes

    @property
    def n_unused(self) -> int:
        """Number of variables that the file does not use: any value of theirs does."""
        return self.n - self.problem.n

    def expand(self, x: Tensor) -> Tensor:
        """A state of the problem's variables ``(n_used,)`` as one of the file's ``(n,)``; unused ones are 0."""
        return x.new_zeros(self.n).index_copy(0, self.variables.to(x.device), x)

    def score(self, x: Tensor) -> Score:
        """Count as the file's authors do, without rounding.

        Args:
            x: One state in {0, 1}: of the file's variables ``(n,)``, or of the problem's ``(n_used,)``.
        """
        sizes = f"({self.n},)" + (f" or ({self.problem.n},)" if self.n_unused else "")
        require(tuple(x.shape) in ((self.n,), (self.problem.n,)), "shape of x", tuple(x.shape), sizes)
        used = x[self.variables.to(x.device)] if len(x) == self.n else x
        return self.objective.counting.count((used > 0.5).cpu().numpy())

    def answer(self, solution: QuboSolution) -> Answer:
        """What a solver found, in the file's terms.

        Args:
            solution: Of ``problem``, or of ``integers``.

        Raises:
            SettingError: The solution is of more than one problem.
        """
        require(solution.energies.ndim == 1, "energies' shape", tuple(solution.energies.shape), "(n_restarts,)")
        # Solvers return the dtype of what they were given: integers were compared as integers.
        exact = self.resolved or solution.assignments.dtype == torch.int64
        scores: list[Score | None] = []
        status: list[Status] = []
        for x, energy, code in zip(
            solution.assignments, solution.energies.tolist(), solution.status.tolist(), strict=True
        ):
            score = self.score(x) if math.isfinite(energy) else None
            scores.append(score)
            proven = code == Status.OPTIMAL and score is not None
            if proven and score is not None and score.hard_unsatisfied and exact:
                code = Status.INFEASIBLE
            elif proven and not exact:
                code = Status.ROUNDED
            status.append(Status(code))
        energies = [None if score is None else self.objective.energy(score) for score in scores]
        ran = [k for k, energy in enumerate(energies) if energy is not None]
        best = min(ran, key=lambda k: energies[k])  # type: ignore[return-value, arg-type]
        chosen = scores[best]
        assert chosen is not None
        assignment = self.expand(solution.assignments[best] > 0.5)
        return Answer(assignment, chosen, self.objective.energy(chosen), energies, status)


def read_problem(path: str | Path, format: str | None = None, *, maximise: bool = False) -> Problem:
    """Read a benchmark problem, packed with gzip, xz or bzip2 or not.

    Args:
        path: The file.
        format: A key of :data:`FORMATS`; None is told by the file's name, of ``.txt`` and no suffix by its
            first lines.
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
    require(
        not maximise or FORMATS[name].either_way or name == "gset",
        "maximise",
        maximise,
        f"false for a file of format {name!r}",
    )
    parsed = FORMATS[name].parse(source, maximise)
    return Problem(
        problem=parsed.problem,
        path=path,
        format=name,
        objective=parsed.objective,
        n=parsed.n,
        variables=torch.from_numpy(parsed.variables),
        remarks=parsed.remarks,
        integers=parsed.integers,
        resolved=parsed.resolved,
    )


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
    answer = problem.answer(solution)
    objective = {
        "name": problem.objective.name,
        "direction": problem.objective.direction,
        **_in_json("value", answer.score.value),
    }
    if "hard_clauses" in problem.sizes:
        objective["hard_clauses_unsatisfied"] = answer.score.hard_unsatisfied
    sizes = {f"n_{kind}": number for kind, number in problem.sizes.items()}
    if problem.n_unused:
        sizes["n_unused_variables"] = problem.n_unused
    content = {
        "problem": {
            "file": str(problem.path),
            "name": problem.name,
            "format": problem.format,
            **sizes,
            **({"remarks": problem.remarks} if problem.remarks else {}),
        },
        **_in_json("energy", answer.energy),
        "objective": objective,
        "assignment": answer.assignment,
        "restarts": {
            "energy": [None if energy is None else _nearest(energy) for energy in answer.energies],
            "status": [status.name for status in answer.status],
            "steps": solution.steps.tolist(),
        },
        "wall_time_s": solution.wall_time_s,
        "solver": dict(solver),
        "seed": seed,
        "memcomp_lightning": __version__,
    }
    lines = ",\n".join(f" {json.dumps(name)}: {_json(value)}" for name, value in content.items())
    write_text(path, f"{{\n{lines}\n}}\n")


def _json(value: object) -> str:
    """A value as JSON; an assignment digit by digit, as it may have millions."""
    if isinstance(value, Tensor):
        return f"[{', '.join(map(str, value.to(torch.uint8).tolist()))}]"
    return json.dumps(value, allow_nan=False)


def _nearest(value: Exact | float) -> int | float:
    """A number that JSON has: integers whole, fractions rounded to float64."""
    whole = isinstance(value, float) and value.is_integer() and abs(value) <= 2**53
    return int(value) if whole else float(value) if isinstance(value, Fraction) else value


def _in_json(name: str, value: Exact | float) -> dict[str, Any]:
    """A number, and all digits of a fraction that float64 rounds."""
    written: dict[str, Any] = {name: _nearest(value)}
    if isinstance(value, Fraction) and Fraction(repr(float(value))) != value:
        written[f"{name}_in_full"] = in_full(value)
    return written


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
