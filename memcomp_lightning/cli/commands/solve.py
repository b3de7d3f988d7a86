"""``memcomp-solve``: look for the minimum of a problem that stands in a file."""

import math
import os
import sys
from collections import Counter
from functools import lru_cache
from pathlib import Path
from typing import Any

import hydra
from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig, OmegaConf
from torch import Tensor

from memcomp_lightning import rng
from memcomp_lightning.cli.arguments import read
from memcomp_lightning.cli.errors import refuse
from memcomp_lightning.cli.hydra_versions import MAIN, instantiate
from memcomp_lightning.cli.kinds import check_kinds
from memcomp_lightning.cli.output import make_tolerant, say
from memcomp_lightning.cli.overrides import CONFIG_MODULE, answering, check_command_line, check_finite, check_seed
from memcomp_lightning.errors import SettingError, UserError, require, require_choice
from memcomp_lightning.files import written_whole
from memcomp_lightning.plotting import plot_trajectory
from memcomp_lightning.problems import (
    FORMATS,
    Bipartite,
    Problem,
    ProblemFileError,
    Qubo,
    WeightedMaxSat,
    in_full,
    read_problem,
    to_qubo,
)
from memcomp_lightning.runs.table import short_path
from memcomp_lightning.solvers import (
    Answer,
    BranchAndBound,
    BruteForce,
    QuboSolution,
    QuboSolver,
    Trajectory,
    write_solution,
)
from memcomp_lightning.solvers.dmm import DmmSolver, default_steps

COMMAND = "memcomp-solve"

MOST_RECORDED = 4 * 2**30
"""Bytes of a trajectory that a common computer's memory holds."""

_SETTINGS = ("problem", "format", "maximise", "seed", "solver")
_LONGEST_PRINTED = 100


@hydra.main(config_path=f"pkg://{CONFIG_MODULE}", config_name="solve", **MAIN)
def solve(config: DictConfig) -> None:
    """One problem, or one job of a sweep."""
    settings = HydraConfig.get()
    make_tolerant()  # again: a job of a parallel launcher is in a process of its own
    os.chdir(settings.runtime.cwd)  # paths are meant from there, with hydra.job.chdir=true, too
    try:
        problem, solver = prepare(config)
        say("\n".join([f"{problem.name}: {_headline(problem)}", *_remarks(problem, solver)]))
        solution = _minimise(problem, solver, config.seed)
        _write(Path(settings.runtime.output_dir), config, problem, solution)
    except (UserError, SettingError, ProblemFileError) as error:
        refuse(COMMAND, error)


def prepare(config: DictConfig) -> tuple[Problem, QuboSolver]:
    """Read the file and build the solver; everything that can be refused is refused here.

    Raises:
        UserError, SettingError, ProblemFileError, InstantiationException: A setting does not exist or is out of
            range, or the file cannot be read.
    """
    for name in config:
        require_choice("setting", name, _SETTINGS)
    check_finite(config)
    check_kinds(config)
    check_seed(config.seed)
    require(isinstance(config.maximise, bool), "maximise", config.maximise, "true or false")
    if not config.problem:
        raise UserError(
            f"problem=FILE is missing: name the file of a problem, as in {COMMAND} problem=G1.txt. Formats: "
            f"{', '.join(FORMATS)}; {COMMAND} --help describes them."
        )
    solver: QuboSolver = instantiate(config.solver)
    problem = _read(str(config.problem), config.format, config.maximise)
    if not isinstance(solver, DmmSolver):
        _as_qubo(problem.problem)
    _check_memory(problem, solver)
    return problem, solver


@lru_cache(maxsize=1)
def _read(file: str, format: str | None, maximise: bool) -> Problem:
    """Read a file once, for the check and for the run."""
    return read_problem(Path(file).expanduser(), format, maximise=maximise)


def _minimise(problem: Problem, solver: QuboSolver, seed: int) -> QuboSolution:
    """The solver's answer; without variables there is one state, and no solver has to look for it."""
    generator, given = rng.stream(seed, "solver"), problem.problem
    if given.n == 0:
        return BruteForce().minimise(_as_qubo(given), generator=generator)
    try:
        if isinstance(solver, DmmSolver):
            return solver.minimise(given, generator=generator)
        exact = problem.integers if isinstance(solver, BruteForce) and not problem.resolved else None
        return solver.minimise(_as_qubo(given) if exact is None else exact, generator=generator)
    except (MemoryError, RuntimeError) as error:
        if isinstance(error, MemoryError) or "memory" in str(error):
            raise UserError(_too_large(problem, solver)) from error
        raise


def _as_qubo(problem: Qubo | WeightedMaxSat) -> Qubo:
    """What every solver takes; the machine takes clauses as they are."""
    return problem if isinstance(problem, Qubo) else to_qubo(problem)


def _check_memory(problem: Problem, solver: QuboSolver) -> None:
    """Refuse what no memory holds: a recorded trajectory, or the states of all restarts."""
    given = problem.problem
    if isinstance(solver, DmmSolver) and solver.record is not None:
        n_bytes = solver.n_restarts * (solver.max_steps or default_steps(given)) * given.n
        require(
            n_bytes // solver.record.every <= MOST_RECORDED,
            "solver.record.every",
            solver.record.every,
            f"at least {1 + n_bytes // MOST_RECORDED}, for a trajectory of at most {MOST_RECORDED // 2**30} GiB",
            "solver=dmm records nothing.",
        )
    if _memory(given, solver) > _installed():
        raise UserError(_too_large(problem, solver))


def _memory(problem: Qubo | WeightedMaxSat, solver: QuboSolver) -> int:
    """About the bytes that a solver works with: a few numbers a variable and a coupling, each restart."""
    if isinstance(solver, (BruteForce, BranchAndBound)):
        return 0
    longer = () if isinstance(problem, Qubo) else problem.longer
    pairs = 0 if isinstance(problem.graph, Bipartite) else math.prod(problem.graph.edge_shape)
    numbers = problem.n + pairs + sum(block.variables.numel() for block in longer)
    return _NUMBERS_EACH * 8 * int(getattr(solver, "n_restarts", 1)) * numbers


_NUMBERS_EACH = 5
"""Of eight bytes, for a variable or a coupling of a restart; measured."""


def _installed() -> float:
    """Bytes of memory of this computer; infinite where it does not tell."""
    try:
        return float(os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES"))
    except (AttributeError, OSError, ValueError):
        return math.inf


def _too_large(problem: Problem, solver: QuboSolver) -> str:
    """Why the solver does not fit, and what to do."""
    sizes = ", ".join(f"{number} {kind.replace('_', ' ')}" for kind, number in problem.sizes.items())
    restarts = getattr(solver, "n_restarts", None)
    each = "" if restarts is None else f" with solver.n_restarts = {restarts}"
    remedy = "a smaller problem" if restarts in (None, 1) else "fewer restarts, as solver.n_restarts=1"
    needed, installed = (
        f"{n_bytes / 2**30:.0f} GiB" for n_bytes in (_memory(problem.problem, solver), _installed())
    )
    return (
        f"{problem.path}: {sizes}. {type(solver).__name__}{each} needs about {needed} of memory, "
        f"more than there is ({installed}): try {remedy}."
    )


def _headline(problem: Problem) -> str:
    sizes = dict(problem.sizes)
    n_hard = sizes.pop("hard_clauses", 0)
    counts = ", ".join(f"{number} {kind}" for kind, number in sizes.items())
    return f"{counts}{f' ({n_hard} hard)' if n_hard else ''}; format {problem.format}, {problem.path}"


def _remarks(problem: Problem, solver: QuboSolver) -> list[str]:
    """What a person should know before the solver begins, a line each."""
    remarks = list(problem.remarks)
    if problem.n_unused:
        remarks.append(
            f"{problem.n_unused} of the variables are not used: they cost nothing, and are reported as 0."
        )
    if (needed := _memory(problem.problem, solver)) >= 2**30:
        remarks.append(f"The solver needs about {needed / 2**30:.0f} GiB of memory.")
    return [f"Note: {remark}" for remark in remarks]


def _table(problem: Problem, answer: Answer, wall_time_s: float) -> str:
    """The answer as names and values."""
    broken = answer.score.hard_unsatisfied
    rows = [(problem.objective.name, f"{in_full(answer.score.value)}  ({problem.objective.direction})")]
    if "hard_clauses" in problem.sizes:
        rows.append(("hard clauses", f"{broken} unsatisfied{': this is no solution' if broken else ''}"))
    status = Counter(sorted(answer.status))
    rows += [
        ("energy", f"{in_full(answer.energy)}  (reached by {answer.n_reached} of {answer.n_run} restarts)"),
        ("wall time", f"{wall_time_s:.2f} s"),
        *((f"{count} x {ended.name}", ended.advice) for ended, count in status.items()),
    ]
    if 0 < problem.n <= _LONGEST_PRINTED:
        rows.append(("assignment", _bits(answer.assignment)))
    width = max(len(name) for name, _ in rows)
    return "\n".join(f"  {name.ljust(width)}  {value}" for name, value in rows)


def _bits(x: Tensor) -> str:
    return "".join("1" if bit else "0" for bit in x.tolist())


def _write(folder: Path, config: DictConfig, problem: Problem, solution: QuboSolution) -> None:
    """Solution and picture; then the table, and where they are. What cannot be written is printed all the more."""
    solver = OmegaConf.to_container(config.solver, resolve=True)
    assert isinstance(solver, dict)
    settings: dict[str, Any] = {str(name): value for name, value in solver.items()}
    file, written, picture, lost = folder / "solution.json", False, None, ""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        write_solution(file, problem, solution, solver=settings, seed=config.seed)
        written = True
        if solution.trajectory is not None:
            picture = _draw(folder, problem.name, solution.trajectory)
    except OSError as error:
        lost = f"folder {folder} cannot be written ({error.strerror}): choose another with hydra.run.dir=PATH"
    answer = Answer.of(problem, solution)
    say(f"\n{_table(problem, answer, solution.wall_time_s)}\n")
    holds = "" if problem.n <= _LONGEST_PRINTED else "  (the assignment, among the rest)"
    if written:
        say(f"Solution:    {short_path(file)}{holds}")
    elif holds:
        say(f"Assignment:  {_bits(answer.assignment)}")
    if picture is not None:
        say(f"Trajectory:  {short_path(picture)}, .svg")
    if lost:
        raise UserError(lost)


def _draw(folder: Path, title: str, trajectory: Trajectory) -> Path:
    """Write the picture for the screen and the one for print; return the first."""
    figure = plot_trajectory(trajectory, title=title)
    picture = folder / "trajectory.png"
    for path in (picture, picture.with_suffix(".svg")):
        with written_whole(path) as partial:
            figure.savefig(partial, format=path.suffix[1:], dpi=200)
    return picture


def main() -> None:
    """Check everything, solve, and end with a table or a message."""
    try:
        line = check_command_line(
            read(sys.argv[1:]),
            config_name="solve",
            check=lambda config, _: prepare(config),
            folders=("solve", "solve"),
        )
        sys.argv[1:] = line.arguments
        with answering(line):
            solve()
    except UserError as error:
        refuse(COMMAND, error)
    except KeyboardInterrupt as interrupt:
        rest = "Finished jobs keep their solutions." if "--multirun" in sys.argv else "No solution is written."
        raise KeyboardInterrupt(rest) from interrupt
