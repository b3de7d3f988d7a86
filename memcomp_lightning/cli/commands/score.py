"""``memcomp-score``: how likely the rows of a table are, and which class they have."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from memcomp_lightning.cli.output import say
from memcomp_lightning.cli.products import OfRun, Usage, carry_out, existing
from memcomp_lightning.data.rows import Rows
from memcomp_lightning.data.schema import Schema
from memcomp_lightning.data.written import TABLES, check_output, write_columns
from memcomp_lightning.errors import UserError
from memcomp_lightning.plotting.written import check_figures, write_figures
from memcomp_lightning.trained.beside import beside, left_out, without_values
from memcomp_lightning.trained.figures import figure_of_scores
from memcomp_lightning.trained.partition import Annealing
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
    [("memcomp-score runs/people people.csv", "log-likelihoods and class probabilities, in scores.csv")],
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
    run, table = settings.load(places[0]), existing(places[1])
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
