"""``memcomp-score``: how likely the rows of a table are, and which class they have."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from memcomp_lightning.cli.output import say
from memcomp_lightning.cli.products import OfRun, Usage, carry_out, existing
from memcomp_lightning.data.rows import Rows
from memcomp_lightning.data.schema import Columns, Schema
from memcomp_lightning.data.written import TABLES, check_output, write_columns
from memcomp_lightning.errors import UserError
from memcomp_lightning.plotting.written import check_figures, write_figures
from memcomp_lightning.trained.beside import beside, left_out, without_values
from memcomp_lightning.trained.figures import figure_of_scores
from memcomp_lightning.trained.partition import Annealing
from memcomp_lightning.trained.run import Run
from memcomp_lightning.trained.scoring import Scores, score


@dataclass(frozen=True)
class Settings(OfRun):
    """Settings of ``memcomp-score``.

    Attributes:
        output: File for the scores: .csv, .tsv, .parquet or .npz. Names of sequences and columns that the model
            does not have come first.
        pseudo: Whether pseudo-likelihoods are computed; of many real columns they take longest.
        chains: Chains of AIS, which estimates log Z where it cannot be enumerated.
        betas: Its steps at most.
        figures: Folder, .png or .pdf for histograms of the log-likelihoods: those of the rows, of the data of the
            run, where they can still be read, and of samples of the model.
        seed: Of what is drawn.
        overwrite: Whether a file that is there is replaced.
    """

    output: str = "scores.csv"
    pseudo: bool = True
    chains: int = 100
    betas: int = 16_000
    figures: str | None = None
    seed: int = 0
    overwrite: bool = False


USAGE = Usage(
    "memcomp-score",
    "write the log-likelihood of each row of a table, and its class.",
    ("RUN", "TABLE"),
    Settings,
    [
        ("memcomp-score runs/people people.csv", "log-likelihoods and class probabilities, in scores.csv"),
        ("memcomp-score runs/people 'parts/*.parquet'", "of the rows of all files, one file after the other"),
    ],
)


def act(places: Sequence[str], settings: Settings) -> None:
    """Score a file."""
    output = Path(settings.output)
    check_output(output, overwrite=settings.overwrite, endings=TABLES)
    if settings.figures is not None:
        check_figures(Path(settings.figures), overwrite=settings.overwrite)
    annealing = Annealing(
        n_chains=settings.chains, n_betas=min(Annealing().n_betas, settings.betas), most_betas=settings.betas
    )
    run = settings.load(places[0])
    tables = _files(places[1], run.needed_schema)
    if len(tables) > 1:
        if settings.figures is not None:
            raise UserError(f"figures={settings.figures}: {places[1]} is several files. Leave it out.")
        _of_parts(run, tables, output, settings, annealing)
        return
    (table,) = tables
    rows = run.needed_schema.read(table, complete=False)
    found = score(run, rows, pseudo=settings.pseudo, annealing=annealing, seed=settings.seed)
    if settings.figures is not None and "log_likelihood" not in found.columns:
        raise UserError(f"figures={settings.figures}: this run gives no log-likelihoods to draw. Leave it out.")
    figures, doubts = {}, list[str]()
    if settings.figures is not None and found.log_z is not None:
        likelihoods = found.columns["log_likelihood"]
        drawn, doubts = figure_of_scores(
            run, rows, likelihoods, found.log_z, name=f"rows of {table.name}", seed=settings.seed
        )
        figures["likelihoods"] = drawn
    columns, hidden = beside(run.needed_schema, table, rows, found.columns)
    write_columns(columns, output, overwrite=settings.overwrite)
    if settings.figures is not None:
        write_figures(figures, Path(settings.figures), overwrite=settings.overwrite)
    empty = without_values(_empty(rows, run.needed_schema))
    say("\n".join([_summary(found, settings), *empty, *doubts, *left_out(hidden)]))
    say(f"written: {output}")


def _files(place: str, schema: Schema) -> list[Path]:
    """The file that was typed; of a table also a folder or a pattern of files."""
    if Path(place).is_file() or schema.as_json()["data"] != "table":
        return [existing(place)]
    from memcomp_lightning.data.tables.parts import files_of  # Arrow is read where a table is

    return files_of(place)


def _of_parts(run: Run, tables: Sequence[Path], output: Path, settings: Settings, annealing: Annealing) -> None:
    """Score the files of a table one after the other: no more than one of them is held."""
    schema, parts, all_found, empty = run.needed_schema, list[Columns](), list[Scores](), list[set[str]]()
    hidden: list[str] = []
    for table in tables:
        log_z = all_found[0].log_z if all_found else None
        rows = schema.read(table, complete=False)
        own = score(run, rows, pseudo=settings.pseudo, annealing=annealing, log_z=log_z, seed=settings.seed)
        columns, hidden = beside(schema, table, rows, own.columns)
        columns["row"] = columns["row"] + sum(len(part["row"]) for part in parts)
        parts.append(columns)
        all_found.append(replace(own, notes=[f"{table}: {note}" for note in own.notes]))
        empty.append(set(_empty(rows, schema)))
    columns, first = _one_after_the_other(parts), all_found[0]
    write_columns(columns, output, overwrite=settings.overwrite)
    n = sum(found.n_judged for found in all_found)
    right = sum((found.accuracy or 0.0) * found.n_judged for found in all_found)
    notes = [note for found in all_found for note in found.notes]
    of_all = Scores(columns, first.log_z, first.seconds, right / n if n else None, notes, n)
    nowhere = without_values([name for name in schema.site_names if all(name in some for some in empty)])
    say("\n".join([_summary(of_all, settings), *nowhere, *left_out(hidden)]))
    say(f"written: {output}")


def _one_after_the_other(parts: Sequence[Columns]) -> Columns:
    """Columns of all parts; an error that a part did not need is 0, what it has no number of is empty."""
    joined: Columns = {}
    for name in dict.fromkeys(name for part in parts for name in part):
        absent = 0.0 if name == "log_likelihood_error" else np.nan
        joined[name] = np.concatenate([part.get(name, np.full(len(part["row"]), absent)) for part in parts])
    return joined


def main(arguments: Sequence[str] | None = None) -> None:
    """Entry point."""
    carry_out(USAGE, act, arguments)


def _empty(rows: Rows, schema: Schema) -> list[str]:
    """Columns of the model that no row has a value of."""
    if rows.observed is None:
        return []
    known = rows.observed.any(0).tolist()
    return [name for name, has_some in zip(schema.site_names, known, strict=True) if not has_some]


def _summary(found: Scores, settings: Settings) -> str:
    """What was found, and how far it can be trusted."""
    n = len(found.columns["row"])
    lines = [f"{n:,} rows"]
    if found.log_z is not None:
        of_rows = found.columns["log_likelihood"]
        of_rows = of_rows[~np.isnan(of_rows)]
        if len(of_rows) > 1:
            error = of_rows.std(ddof=1) / len(of_rows) ** 0.5
            lines[0] += f", mean log-likelihood {of_rows.mean():.4f} ± {error:.2g} nats (standard error over rows)"
        lines.append(f"{found.log_z}, {found.seconds:.1f} s")
        if not found.log_z.trusted:
            lines.append(
                f"log Z is not settled, its error is larger than it says: type betas={4 * settings.betas}; "
                "rows can still be compared with each other"
            )
    if found.accuracy is not None:
        lines.append(f"accuracy on labelled rows: {found.accuracy:.4f}")
    return "\n".join([*lines, *found.notes])
