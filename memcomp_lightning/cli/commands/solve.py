"""``memcomp-solve``: look for the minimum of a problem that stands in a file."""

import math
import os
import shlex
import sys
from collections import Counter
from dataclasses import replace
from pathlib import Path
from typing import Any

import hydra
import numpy as np
from hydra.core.hydra_config import HydraConfig
from hydra.types import RunMode
from numpy.typing import NDArray
from omegaconf import DictConfig, OmegaConf

from memcomp_lightning.cli import batch
from memcomp_lightning.cli.arguments import read
from memcomp_lightning.cli.output import NOT_FEASIBLE, make_tolerant, refuse, say
from memcomp_lightning.cli.overrides import answering, check_command_line
from memcomp_lightning.cli.problem_files import problem_files
from memcomp_lightning.configuration.composition import CONFIG_MODULE
from memcomp_lightning.configuration.hydra_versions import MAIN
from memcomp_lightning.configuration.problems import prepare
from memcomp_lightning.configuration.quoting import with_path
from memcomp_lightning.errors import SettingError, UserError
from memcomp_lightning.files import written_whole
from memcomp_lightning.problems import Problem, ProblemFileError, in_full
from memcomp_lightning.runs.table import short_path
from memcomp_lightning.solvers import Answer, Found, QuboSolver, Status, write_solution
from memcomp_lightning.solvers.dmm import Trajectory
from memcomp_lightning.solvers.solving import memory_needed

COMMAND = "memcomp-solve"

_LONGEST_PRINTED = 100


@hydra.main(config_path=f"pkg://{CONFIG_MODULE}", config_name="solve", **MAIN)
def solve(config: DictConfig) -> None:
    """One problem, or one job of a sweep."""
    settings = HydraConfig.get()
    make_tolerant()  # again: a job of a parallel launcher is in a process of its own
    os.chdir(settings.runtime.cwd)  # paths are meant from there, with hydra.job.chdir=true, too
    try:
        problem, solver, search, initial = prepare(config)
        say("\n".join([f"{problem.name}: {_headline(problem)}", *_remarks(problem, solver)]))
        found = search.run(problem, solver, seed=config.seed, initial=initial)
        answer = _write(Path(settings.runtime.output_dir), config, problem, found)
        if found.interrupted:
            raise KeyboardInterrupt("The best so far is written.")
    except (UserError, SettingError, ProblemFileError) as error:
        refuse(COMMAND, error)
    if answer.score.hard_unsatisfied and settings.mode is RunMode.RUN:  # a sweep goes on
        sys.exit(NOT_FEASIBLE)


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
    if (needed := memory_needed(problem.problem, solver)) >= 2**30:
        remarks.append(f"The solver needs about {needed / 2**30:.0f} GiB of memory.")
    return [f"Note: {remark}" for remark in remarks]


def _table(problem: Problem, answer: Answer, found: Found) -> str:
    """The answer as names and values."""
    broken = answer.score.hard_unsatisfied
    rows = [(problem.objective.name, f"{in_full(answer.score.value)}  ({problem.objective.direction})")]
    if "hard_clauses" in problem.sizes:
        rows.append(("hard clauses", f"{broken} unsatisfied{': this is no solution' if broken else ''}"))
    status = Counter(sorted(answer.status))
    rows += [
        ("energy", f"{in_full(answer.energy)}  (reached by {answer.n_reached} of {answer.n_run} restarts)"),
        ("wall time", f"{found.wall_time_s:.2f} s"),
        *((f"{count} x {ended.name}", ended.advice) for ended, count in status.items()),
    ]
    if found.conclusion not in status:
        rows.append((found.conclusion.name, found.conclusion.advice))
    if math.isfinite(found.lower_bound) and found.conclusion is not Status.OPTIMAL:
        rows.append(("lower bound", f"{found.lower_bound:.12g}: no state has a lower energy"))
    if len(found.states) > 1:
        rows.append(("solutions", f"{len(found.states)}, energies up to {in_full(found.states[-1].energy)}"))
    if 0 < problem.n <= _LONGEST_PRINTED:
        rows.append(("assignment", _bits(answer.assignment)))
    width = max(len(name) for name, _ in rows)
    return "\n".join(f"  {name.ljust(width)}  {value}" for name, value in rows)


def _bits(x: NDArray[np.bool_]) -> str:
    return "".join("1" if bit else "0" for bit in x.tolist())


def _write(folder: Path, config: DictConfig, problem: Problem, found: Found) -> Answer:
    """Write solution and picture, then print table and paths; the table is printed even if writing fails."""
    solver = OmegaConf.to_container(config.solver, resolve=True)
    assert isinstance(solver, dict)
    settings: dict[str, Any] = {str(name): value for name, value in solver.items()}
    file, written, picture, lost = folder / "solution.json", False, None, ""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        write_solution(file, problem, found, solver=settings, seed=config.seed)
        written = True
        if isinstance(found.trajectory, Trajectory):
            picture = _draw(folder, problem.name, found.trajectory)
    except OSError as error:
        lost = f"folder {folder} cannot be written ({error.strerror}): choose another with hydra.run.dir=PATH"
    answer = Answer.of(problem, found)
    say(f"\n{_table(problem, answer, found)}\n")
    holds = "" if problem.n <= _LONGEST_PRINTED else "  (the assignment, among the rest)"
    if written:
        say(f"Solution:    {short_path(file)}{holds}")
    elif holds:
        say(f"Assignment:  {_bits(answer.assignment)}")
    if picture is not None:
        say(f"Trajectory:  {short_path(picture)}, .svg")
    if lost:
        raise UserError(lost)
    return answer


def _draw(folder: Path, title: str, trajectory: Trajectory) -> Path:
    """Write the picture for the screen and the one for print; return the first."""
    from memcomp_lightning.plotting import plot_trajectory  # matplotlib, which few runs need

    figure = plot_trajectory(trajectory, title=title)
    picture = folder / "trajectory.png"
    for path in (picture, picture.with_suffix(".svg")):
        with written_whole(path) as partial:
            figure.savefig(partial, format=path.suffix[1:], dpi=200)
    return picture


def main() -> None:
    """Check everything, solve, and end with a table or a message."""
    try:
        options, arguments = batch.taken(sys.argv[1:])
        line = read(arguments, takes_problems=True)
        problems = problem_files(line.problems)
        if batch.is_many(line, problems, options):
            sys.exit(batch.solve_many(line, problems, options, command=COMMAND))
        line = replace(line, overrides=(*line.overrides, *(with_path("problem", file) for file in problems)))
        line = check_command_line(
            line,
            config_name="solve",
            check=lambda config, _: prepare(config),
            folders=("solve", "solve"),
        )
        sys.argv[1:] = line.arguments
        with answering(line, COMMAND):
            solve()
    except (UserError, SettingError, ProblemFileError) as error:
        refuse(COMMAND, error)
    except KeyboardInterrupt as interrupt:
        kept = "Finished jobs keep their solutions." if "--multirun" in sys.argv else "No solution is written."
        again = shlex.join([COMMAND, *sys.argv[1:]])
        raise KeyboardInterrupt(str(interrupt) or f"{kept} Go on with: {again}") from interrupt
