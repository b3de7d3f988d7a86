"""From the configuration of ``memcomp-solve`` to a problem and a solver."""

import json
from functools import lru_cache
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from omegaconf import DictConfig

from memcomp_lightning.configuration.hydra_versions import instantiate
from memcomp_lightning.configuration.values import check_values
from memcomp_lightning.errors import UserError, require, require_choice
from memcomp_lightning.files import stamp
from memcomp_lightning.problems import FORMATS, Problem, Score, read_problem
from memcomp_lightning.problems.labelled import Labelled
from memcomp_lightning.solvers import QuboSolver, Search
from memcomp_lightning.solvers.solving import check_memory

_OF_SEARCH = ("time_limit", "target", "n_solutions", "min_distance")

_SETTINGS = ("problem", "format", "maximise", "seed", "solver", "initial", *_OF_SEARCH)

PROBLEM_MISSING = (
    "problem=FILE is missing: name the file of a problem, as in memcomp-solve problem=G1.txt. Formats: "
    f"{', '.join(FORMATS)}; memcomp-solve --help describes them."
)


class Prepared(NamedTuple):
    """What a command line asks for.

    Attributes:
        problem: The problem.
        solver: What solves it.
        search: When to end, and what to keep.
        initial: States to begin with, ``(n_states, n)``.
    """

    problem: Problem
    solver: QuboSolver
    search: Search
    initial: NDArray[np.bool_] | None


def prepare(config: DictConfig) -> Prepared:
    """Read the file and build the solver; everything that can be refused is refused here.

    Raises:
        UserError, SettingError, ProblemFileError, InstantiationException: A setting does not exist or is out of
            range, or the file cannot be read.
    """
    solver = checked_solver(config)
    if not config.problem:
        raise UserError(PROBLEM_MISSING)
    path = Path(str(config.problem)).expanduser()
    problem = _read(path, stamp(path), config.format, config.maximise)
    check_memory(problem, solver)
    search = {name: config[name] for name in _OF_SEARCH}
    if search["target"] is not None:
        search["target"] = problem.objective.energy(Score(search["target"]))
    initial = None if config.initial is None else Labelled(problem=problem).read(_state(str(config.initial)))
    return Prepared(problem, solver, Search(**search), initial)


def checked_solver(config: DictConfig) -> QuboSolver:
    """Build the solver, and check what is set besides, but for the problem.

    Raises:
        SettingError, InstantiationException: A setting does not exist or is out of range.
    """
    for name in config:
        require_choice("setting", name, _SETTINGS)
    check_values(config)
    require(isinstance(config.maximise, bool), "maximise", config.maximise, "true or false")
    Search(**{name: config[name] for name in _OF_SEARCH})
    solver: QuboSolver = instantiate(config.solver)
    return solver


@lru_cache(maxsize=1)
def _read(path: Path, state: object, format: str | None, maximise: bool) -> Problem:
    """Read a file in one state once, for the check and for the run."""
    return read_problem(path, format, maximise=maximise)


def _state(file: str) -> list[int]:
    """An assignment from a ``solution.json``, or from a text of zeros and ones."""
    try:
        text = Path(file).expanduser().read_text()
        bits = json.loads(text)["assignment"] if text.startswith("{") else "".join(text.split())
        return [int(bit) for bit in bits]
    except OSError as error:
        raise UserError(f"initial={file} cannot be read ({error.strerror}).") from error
    except (KeyError, TypeError, ValueError):
        raise UserError(f"initial={file} holds no state: expected a solution.json, or zeros and ones.") from None
