"""From the configuration of ``memcomp-solve`` to a problem and a solver."""

from functools import lru_cache
from pathlib import Path

from omegaconf import DictConfig

from memcomp_lightning.configuration.hydra_versions import instantiate
from memcomp_lightning.configuration.values import check_values
from memcomp_lightning.errors import UserError, require, require_choice
from memcomp_lightning.problems import FORMATS, Problem, read_problem
from memcomp_lightning.solvers import QuboSolver
from memcomp_lightning.solvers.solving import check_memory

_SETTINGS = ("problem", "format", "maximise", "seed", "solver")


def prepare(config: DictConfig) -> tuple[Problem, QuboSolver]:
    """Read the file and build the solver; everything that can be refused is refused here.

    Raises:
        UserError, SettingError, ProblemFileError, InstantiationException: A setting does not exist or is out of
            range, or the file cannot be read.
    """
    for name in config:
        require_choice("setting", name, _SETTINGS)
    check_values(config)
    require(isinstance(config.maximise, bool), "maximise", config.maximise, "true or false")
    if not config.problem:
        raise UserError(
            "problem=FILE is missing: name the file of a problem, as in memcomp-solve problem=G1.txt. Formats: "
            f"{', '.join(FORMATS)}; memcomp-solve --help describes them."
        )
    solver: QuboSolver = instantiate(config.solver)
    problem = _read(str(config.problem), config.format, config.maximise)
    check_memory(problem, solver)
    return problem, solver


@lru_cache(maxsize=1)
def _read(file: str, format: str | None, maximise: bool) -> Problem:
    """Read a file once, for the check and for the run."""
    return read_problem(Path(file).expanduser(), format, maximise=maximise)
