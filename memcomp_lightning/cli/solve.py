"""``memcomp-solve``: look for the minimum of a problem that stands in a file."""

import sys
from functools import lru_cache
from pathlib import Path
from typing import Any

import hydra
import torch
from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig, OmegaConf
from torch import Tensor

from memcomp_lightning import rng
from memcomp_lightning.cli.errors import INTERRUPTED, UserError, refuse
from memcomp_lightning.cli.hydra_versions import MAIN, instantiate
from memcomp_lightning.cli.overrides import (
    CONFIG_MODULE,
    check_command_line,
    check_finite,
    check_seed,
    is_multirun,
)
from memcomp_lightning.cli.table import short_path
from memcomp_lightning.dmm import DmmSolver, default_steps
from memcomp_lightning.errors import SettingError, require, require_choice
from memcomp_lightning.files import written_whole
from memcomp_lightning.plotting import plot_trajectory
from memcomp_lightning.qubo import (
    FORMATS,
    Problem,
    ProblemFileError,
    Qubo,
    QuboSolution,
    QuboSolver,
    Trajectory,
    WeightedMaxSat,
    read_problem,
    to_qubo,
    write_solution,
)

COMMAND = "memcomp-solve"

MOST_RECORDED = 4 * 2**30
"""Bytes of a trajectory that a common computer's memory holds."""

_SETTINGS = ("problem", "format", "maximise", "seed", "solver")
_LONGEST_PRINTED = 100


@hydra.main(config_path=f"pkg://{CONFIG_MODULE}", config_name="solve", **MAIN)
def solve(config: DictConfig) -> None:
    """One problem, or one job of a sweep."""
    try:
        problem, solver = prepare(config)
        print(f"{problem.name}: {_headline(problem)}", flush=True)
        solution = _minimise(problem.problem, solver, config.seed)
        print(f"\n{_table(problem, solution)}\n", flush=True)
        folder = Path(HydraConfig.get().runtime.output_dir)
        _write(folder, config, problem, solution)
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
    check_seed(config.seed)
    require(isinstance(config.maximise, bool), "maximise", config.maximise, "true or false")
    if not config.problem:
        raise UserError(
            f"problem=FILE is missing: name the file of a problem, as in {COMMAND} problem=G1.txt. Formats: "
            f"{', '.join(FORMATS)}; {COMMAND} --help describes them."
        )
    solver: QuboSolver = instantiate(config.solver)
    problem = _read(str(config.problem), config.format, config.maximise)
    if isinstance(solver, DmmSolver):
        _check_memory(problem.problem, solver)
    else:
        _as_qubo(problem.problem)
    return problem, solver


@lru_cache(maxsize=1)
def _read(file: str, format: str | None, maximise: bool) -> Problem:
    """Read a file once, for the check and for the run."""
    return read_problem(Path(file).expanduser(), format, maximise=maximise)


def _minimise(problem: Qubo | WeightedMaxSat, solver: QuboSolver, seed: int) -> QuboSolution:
    generator = rng.stream(seed, "solver")
    if isinstance(solver, DmmSolver):
        return solver.minimise(problem, generator=generator)
    return solver.minimise(_as_qubo(problem), generator=generator)


def _as_qubo(problem: Qubo | WeightedMaxSat) -> Qubo:
    """What every solver takes; the machine takes clauses as they are."""
    return problem if isinstance(problem, Qubo) else to_qubo(problem)


def _check_memory(problem: Qubo | WeightedMaxSat, solver: DmmSolver) -> None:
    """Refuse to record a trajectory that no memory holds."""
    if solver.record is not None:
        n_bytes = solver.n_restarts * (solver.max_steps or default_steps(problem)) * problem.n
        require(
            n_bytes // solver.record.every <= MOST_RECORDED,
            "solver.record.every",
            solver.record.every,
            f"at least {1 + n_bytes // MOST_RECORDED}, for a trajectory of at most {MOST_RECORDED // 2**30} GiB",
            "solver=dmm records nothing.",
        )


def _headline(problem: Problem) -> str:
    sizes = dict(problem.sizes)
    n_hard = sizes.pop("hard_clauses", 0)
    counts = ", ".join(f"{number} {kind}" for kind, number in sizes.items())
    return f"{counts}{f' ({n_hard} hard)' if n_hard else ''}; format {problem.format}, {problem.path}"


def _table(problem: Problem, solution: QuboSolution) -> str:
    """The answer as names and values."""
    score = problem.score(solution.best)
    rows = [(problem.objective.name, f"{score.value:.10g}  ({problem.objective.direction})")]
    if "hard_clauses" in problem.sizes:
        rows.append(("hard clauses", f"{score.hard_unsatisfied} unsatisfied"))
    best = float(solution.best_energy)
    reached = torch.isclose(solution.energies, solution.best_energy, rtol=1e-9, atol=1e-9)
    run = solution.energies.isfinite()
    messages = [(message.partition(": "), count) for message, count in solution.messages().items()]
    rows += [
        ("energy", f"{best:.10g}  (reached by {int(reached.sum())} of {int(run.sum())} restarts)"),
        ("wall time", f"{solution.wall_time_s:.2f} s"),
        *((f"{count} x {name}", advice) for (name, _, advice), count in messages),
    ]
    if problem.problem.n <= _LONGEST_PRINTED:
        rows.append(("assignment", _bits(solution.best)))
    width = max(len(name) for name, _ in rows)
    return "\n".join(f"  {name.ljust(width)}  {value}" for name, value in rows)


def _bits(x: Tensor) -> str:
    return "".join("1" if bit else "0" for bit in (x > 0.5).tolist())


def _write(folder: Path, config: DictConfig, problem: Problem, solution: QuboSolution) -> None:
    """Solution and picture, and say where they are."""
    solver = OmegaConf.to_container(config.solver, resolve=True)
    assert isinstance(solver, dict)
    settings: dict[str, Any] = {str(name): value for name, value in solver.items()}
    file = folder / "solution.json"
    try:
        folder.mkdir(parents=True, exist_ok=True)
        write_solution(file, problem, solution, solver=settings, seed=config.seed)
        holds = "" if problem.problem.n <= _LONGEST_PRINTED else "  (the assignment, among the rest)"
        print(f"Solution:    {short_path(file)}{holds}", flush=True)
        if solution.trajectory is not None:
            picture = _draw(folder, problem.name, solution.trajectory)
            print(f"Trajectory:  {short_path(picture)}, .svg", flush=True)
    except OSError as error:
        raise UserError(
            f"folder {folder} cannot be written ({error.strerror}): choose another with hydra.run.dir=PATH"
        ) from error


def _draw(folder: Path, title: str, trajectory: Trajectory) -> Path:
    """Write the picture for the screen and the one for print; return the first."""
    figure = plot_trajectory(trajectory, title=title)
    picture = folder / "trajectory.png"
    for path in (picture, picture.with_suffix(".svg")):
        with written_whole(path) as partial:
            figure.savefig(partial, format=path.suffix[1:], dpi=200)
    return picture


def _as_hydra_reads(argument: str, *, multirun: bool) -> str:
    """``problem=FILE`` in quotes, so that a file may have commas, brackets and = in its name.

    In a sweep the commas are between files, unless there is a file of the whole name.
    """
    name, equals, value = argument.partition("=")
    if name == "problem" and value[:1] not in ("", "'", '"') and (not multirun or _is_file(value)):
        quoted = value.replace("'", r"\'")
        return f"problem='{quoted}'"
    if not equals and _is_file(argument):
        raise UserError(f"{argument} is no setting: expected NAME=VALUE. Did you mean problem={argument}?")
    return argument


def _is_file(name: str) -> bool:
    try:
        return Path(name).is_file()
    except OSError:  # the name is too long
        return False


def main() -> None:
    """Entry point: check everything, solve, and end with a table or a message."""
    try:
        multirun = is_multirun(sys.argv)
        sys.argv[1:] = [_as_hydra_reads(argument, multirun=multirun) for argument in sys.argv[1:]]
        check_command_line(
            sys.argv[1:], config_name="solve", check=lambda config, _: prepare(config), folders=("solve", "solve")
        )
        solve()
    except UserError as error:
        refuse(COMMAND, error)
    except KeyboardInterrupt:
        print(f"\n{COMMAND}: interrupted, no solution is written.", file=sys.stderr)
        sys.exit(INTERRUPTED)


if __name__ == "__main__":
    main()
