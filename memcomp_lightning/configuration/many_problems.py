"""From many files and configurations of ``memcomp-solve`` to the rows of a table."""

import hashlib
import json
import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import cache
from importlib.resources import files
from pathlib import Path
from typing import Any, NamedTuple

from omegaconf import DictConfig, OmegaConf

from memcomp_lightning import __version__
from memcomp_lightning.compiling import told
from memcomp_lightning.configuration.composition import CONFIG_MODULE
from memcomp_lightning.configuration.problems import checked_solver, prepare
from memcomp_lightning.errors import SettingError, UserError
from memcomp_lightning.problems import ProblemFileError, in_full
from memcomp_lightning.problems.files.source import stem
from memcomp_lightning.runs.solve_table import COLUMNS, Row, key, read_best_known
from memcomp_lightning.solvers import Answer, write_solution
from memcomp_lightning.solvers.compiled import obstacle


class Combination(NamedTuple):
    """One combination of settings: the solver's name, what else was typed, the configuration."""

    solver: str
    settings: str
    config: dict[str, Any]

    @staticmethod
    def of(config: DictConfig, job: Sequence[str]) -> "Combination":
        """What a job of ``memcomp-solve`` sets, checked, but for its problem."""
        checked_solver(config)
        solver = [override.partition("=")[2] for override in job if override.startswith("solver=")]
        settings = [override for override in job if not override.startswith(("solver=", "seed=", "hydra."))]
        content: Any = OmegaConf.to_container(config, resolve=True)
        return Combination(solver[-1] if solver else _default_solver(), " ".join(settings), content)


@cache
def _default_solver() -> str:
    defaults = OmegaConf.load(str(files(CONFIG_MODULE) / "solve.yaml")).defaults
    return next(str(entry.solver) for entry in defaults if "solver" in entry)


class Task(NamedTuple):
    """One row to be, which processes hand to each other: what is known of it, and where the solution goes."""

    row: Row
    config: dict[str, Any]
    solution: Path

    def is_done(self, rows: Mapping[tuple[str, ...], Row]) -> bool:
        """Whether a table has the answer, made of the same file by the same settings and version."""
        row = rows.get(key(self.row))
        return row is not None and not row["error"] and row["fingerprint"] == self.row["fingerprint"]


def _content(file: Path) -> str:
    """A hash of what stands in a file."""
    try:
        return hashlib.sha256(file.read_bytes()).hexdigest()
    except OSError as error:
        raise UserError(f"{file} cannot be read ({error.strerror}).") from error


def tasks_of(file: Path, combinations: Sequence[Combination], table: Path, folder: Path) -> Iterator[Task]:
    """The rows of a file, with a fingerprint of all that decides on the answer."""
    content, name = _content(file), stem(file).stem
    for solver, settings, config in combinations:
        settled = {setting: value for setting, value in config.items() if setting != "problem"}
        if settled.get("initial") is not None:
            settled["initial"] = _content(Path(str(settled["initial"])).expanduser())
        made_of = json.dumps([content, seen_from(table, file), settled, __version__], sort_keys=True, default=str)
        fingerprint = hashlib.sha256(made_of.encode()).hexdigest()[:16]
        solution = folder / f"{name}.{solver}.{config['seed']}.{fingerprint[:6]}.json"
        row = dict.fromkeys(COLUMNS, "") | {
            "problem": name,
            "file": seen_from(table, file),
            "solver": solver,
            "settings": settings,
            "seed": str(config["seed"]),
            "solution": seen_from(table, solution),
            "fingerprint": fingerprint,
        }
        yield Task(row, config | {"problem": str(file)}, solution)


def seen_from(table: Path, file: Path) -> str:
    """A path as seen from the folder of the table."""
    return Path(os.path.relpath(file, table.parent)).as_posix()


@contextmanager
def answers(tasks: Sequence[Task], workers: int, heard: Callable[[str], object]) -> Iterator[Iterator[Row]]:
    """Yield the rows of tasks, as they come, from one process or several, whose remarks are ``heard`` here."""
    if workers == 1 or len(tasks) < 2:
        yield map(_solved, tasks)
        return
    from memcomp_lightning.processes import processes  # joblib, which few runs need

    with processes(min(workers, len(tasks)), heard) as do:
        yield do(_solved_in_worker, tasks)


def _solved_in_worker(task: Task) -> Row:
    from memcomp_lightning import processes

    with told(processes.say):
        return _solved(task)


def _solved(task: Task) -> Row:
    """The row of a task; what is wrong with the problem takes the place of an answer."""
    obstacle("cpu")  # imports numba, which is no part of the first answer's time
    config = OmegaConf.create(task.config)
    try:
        problem, solver, search, initial = prepare(config)
        found = search.run(problem, solver, seed=config.seed, initial=initial)
    except (UserError, SettingError, ProblemFileError) as error:
        return task.row | {"error": " ".join(str(error).split())}
    if found.interrupted:
        raise KeyboardInterrupt
    write_solution(task.solution, problem, found, solver=task.config["solver"], seed=config.seed)
    answer = Answer.of(problem, found)
    hard = {"hard_unsatisfied": str(answer.score.hard_unsatisfied)} if "hard_clauses" in problem.sizes else {}
    return task.row | {
        **{kind: str(number) for kind, number in problem.sizes.items()},
        **hard,
        "objective": problem.objective.name,
        "direction": problem.objective.direction,
        "value": in_full(answer.score.value),
        "energy": in_full(answer.energy),
        "status": found.conclusion.name,
        "restarts": str(answer.n_run),
        "reached": str(answer.n_reached),
        "wall_time_s": f"{found.wall_time_s:.4g}",
    }


def best_known(problems: Sequence[Path], given: Path | None) -> dict[Path, str]:
    """Values by file: from the file that is given, or from ``best_known.csv`` beside each problem."""
    read: Callable[[Path], dict[str, str]] = cache(read_best_known)
    known: dict[Path, str] = {}
    for file in problems:
        beside = given or file.parent / "best_known.csv"
        values = read(beside) if given is not None or beside.exists() else {}
        if (name := stem(file).stem) in values:
            known[file] = values[name]
    return known
