"""``memcomp-solve`` with many problems: a table that grows by a row with each answer, and goes on where it was."""

import re
import shlex
import sys
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from omegaconf import DictConfig

from memcomp_lightning.cli.arguments import CommandLine, expanded, parse
from memcomp_lightning.cli.output import NOT_FEASIBLE, say
from memcomp_lightning.cli.overrides import check_command_line
from memcomp_lightning.configuration.many_problems import Combination, answers, best_known, seen_from, tasks_of
from memcomp_lightning.configuration.problems import PROBLEM_MISSING
from memcomp_lightning.configuration.quoting import with_path
from memcomp_lightning.errors import LostError, UserError, lost, require, require_count
from memcomp_lightning.files import written_whole
from memcomp_lightning.problems import read_problem
from memcomp_lightning.runs import solve_table
from memcomp_lightning.runs.solve_table import Curve, Row
from memcomp_lightning.runs.table import short_path

OPTIONS = ("output", "figure", "best_known", "workers")
"""What is given for a table, as ``--NAME VALUE``, ``--NAME=VALUE`` or ``NAME=VALUE``."""

PICTURES = (".png", ".svg", ".pdf")

WAITS = 9
"""Times that the table took to be written, until it is written again: writing is a tenth of all, at any length."""


# --------------------------------------------------------------------------------------------------- what is asked


@dataclass(frozen=True, kw_only=True)
class Options:
    """What is asked of a table.

    Attributes:
        output: The table; None is ``results.csv`` in a folder named by the time.
        figure: A picture of gap against time; None is none.
        best_known: Values by name; None is ``best_known.csv`` in the folder of each problem, where it is.
        workers: Processes, >= 1.
    """

    output: Path | None = None
    figure: Path | None = None
    best_known: Path | None = None
    workers: int | None = None

    def __post_init__(self) -> None:
        for name, suffixes in (("output", (".csv",)), ("figure", PICTURES)):
            path = getattr(self, name)
            require(path is None or path.suffix in suffixes, name, str(path), f"a file *{' or *'.join(suffixes)}")
        require_count("workers", 1 if self.workers is None else self.workers)


def taken(arguments: Sequence[str]) -> tuple[Options, list[str]]:
    """The options of a table, and the other arguments.

    Raises:
        UserError, SettingError: An option has no value, or one that is not allowed.
    """
    given: dict[str, Any] = {}
    others: list[str] = []
    waiting = iter(arguments)
    for argument in waiting:
        name, equals, text = argument.partition("=")
        option = name.removeprefix("--").replace("-", "_")
        if option not in OPTIONS or (name == option and not equals):
            others.append(argument)
            continue
        text = text if equals else next(waiting, "")
        if not text or (not equals and text.startswith("--")):
            raise UserError(f"{name} has no value: write {name}{'=' if equals else ' '}VALUE.")
        number = option == "workers" and re.fullmatch(r"-?\d+", text)
        given[option] = int(text) if number else text if option == "workers" else Path(expanded(name, text))
    return Options(**given), others


def is_many(line: CommandLine, problems: Sequence[Path], options: Options) -> bool:
    """Whether a table is asked for: by an option, by several problems, or by several values of a setting."""
    if line.shows or line.multirun:
        if line.multirun and options != Options():
            raise UserError("-m gives each job a folder of its own: leave it away for one table.")
        return False
    several = any(parse(override).is_sweep_override() for override in line.overrides)
    return options != Options() or len(problems) > 1 or several


# -------------------------------------------------------------------------------------------------------- the rows


def solve_many(line: CommandLine, problems: Sequence[Path], options: Options, *, command: str) -> int:
    """Solve what has no row yet, write the table after each answer, and show the solvers side by side.

    Returns:
        The exit status: 1 where a problem was refused, ``NOT_FEASIBLE`` where an answer breaks a hard clause.

    Raises:
        UserError: Something is wrong with the settings, a file is missing, or the table cannot be written.
    """
    if not problems:
        raise UserError(PROBLEM_MISSING)
    for file in problems:
        if not file.exists():
            read_problem(file)  # says so
    known = best_known(problems, options.best_known)
    combinations, table, folder = _checked(line, options)
    named = [] if options.output else ["--output", str(short_path(table.absolute()))]
    again = shlex.join([command, *sys.argv[1:], *named])
    rows = {solve_table.key(row): row for row in solve_table.read_rows(table)}
    tasks = [task for file in problems for task in tasks_of(file, combinations, table, folder)]
    todo = [task for task in tasks if not task.is_done(rows)]
    if len(todo) < len(tasks):
        say(f"{len(tasks) - len(todo)} of {len(tasks)} answers are in {short_path(table.absolute())} already.")
    of_tasks = [task.row for task in tasks]
    label = dict(zip(map(solve_table.key, of_tasks), solve_table.labels(of_tasks), strict=True))
    order = list(dict.fromkeys([*label, *rows]))
    values = {seen_from(table, file): value for file, value in known.items()}

    def written() -> list[Row]:
        """The table as it is written, in the order of the tasks, whichever is done first."""
        found = solve_table.with_gaps([rows[key] for key in order if key in rows], values)
        solve_table.write_rows(table, found)
        return found

    try:
        folder.mkdir(parents=True, exist_ok=True)
        with answers(todo, options.workers or 1, lambda text: say(f"{command}: {text}", error=True)) as coming:
            try:
                due = 0.0
                for number, row in enumerate(coming, start=1):
                    rows[solve_table.key(row)] = row
                    if (began := time.monotonic()) >= due:
                        written()
                        due = time.monotonic() + WAITS * (time.monotonic() - began)
                    say(f"[{number}/{len(todo)}]  {_in_a_line(row, label[solve_table.key(row)])}")
            finally:
                # Also without new rows: other values may be known than when these were made.
                found = written() if rows else []
        say(f"\n{solve_table.summary(found)}\n\nTable:      {short_path(table.absolute())}")
        say(f"Solutions:  {short_path(folder.absolute())}")
        if options.figure is not None and any(map(solve_table.is_answer, found)):
            _draw(options.figure, solve_table.curves(found, values, table.parent))
    except KeyboardInterrupt as stop:
        raise KeyboardInterrupt(f"Finished rows are kept. Go on with: {again}") from stop
    except (OSError, MemoryError, RuntimeError, LostError) as error:
        if (said := lost(error)) is not None:
            raise UserError(f"{said} Finished rows are kept. Go on with: {again}") from error
        if not isinstance(error, OSError):
            raise
        place = f"{error.filename or table} cannot be written ({error.strerror})"
        rest = f"choose another file with --output FILE. Finished rows are kept. Go on with: {again}"
        raise UserError(f"{place}: {rest}") from error
    own = [rows[key] for key in label]
    return 1 if any(row["error"] for row in own) else 0 if all(map(solve_table.is_answer, own)) else NOT_FEASIBLE


def _checked(line: CommandLine, options: Options) -> tuple[list[Combination], Path, Path]:
    """Check every combination of settings; return them, the table's file and the folder of its solutions."""
    combinations = list[Combination]()

    def check(config: DictConfig, job: Sequence[str]) -> None:
        combinations.append(Combination.of(config, job))

    given, table = line.value("hydra.sweep.dir"), options.output
    own = [] if table is None else [with_path("hydra.sweep.dir", table.parent)]
    many = replace(line, multirun=True, overrides=(*line.overrides, *own))
    try:
        made = check_command_line(many, config_name="solve", check=check, folders=("solve", "solve")).claimed
    except UserError as error:
        raise UserError(str(error).replace("hydra.sweep.dir", "--output") if own else str(error)) from error
    table = table or (made or Path(given or "solve")) / "results.csv"
    return combinations, table, table.with_name(f"{table.stem}_solutions")


def _in_a_line(row: Row, label: str) -> str:
    """A row as it is told when it comes."""
    who = f"{row['problem']}  {label}  seed={row['seed']}"
    if row["error"]:
        return f"{who}:  refused. {row['error']}"
    broken = "" if solve_table.is_answer(row) else f", {row['hard_unsatisfied']} hard clauses broken"
    return f"{who}:  {row['objective']} {row['value']}{broken}  ({float(row['wall_time_s']):.2f} s)"


def _draw(picture: Path, curves: Mapping[str, list[Curve]]) -> None:
    """Write the figure."""
    from memcomp_lightning.plotting import plot_gaps  # matplotlib, which few runs need

    picture.parent.mkdir(parents=True, exist_ok=True)
    with written_whole(picture) as partial:
        plot_gaps(curves).savefig(partial, format=picture.suffix[1:], dpi=200)
    say(f"Figure:     {short_path(picture.absolute())}")
