"""``memcomp-impute``: what is missing of a table, filled in."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from memcomp_lightning.cli.output import say
from memcomp_lightning.cli.products import OfRun, Usage, carry_out, existing
from memcomp_lightning.data.written import ENDINGS, TABLES, check_kind, check_output, in_one_array, write_columns
from memcomp_lightning.errors import UserError, require, require_count
from memcomp_lightning.likelihood.missing import MissingChains
from memcomp_lightning.plotting.written import check_figures, write_figures
from memcomp_lightning.trained.beside import without_values
from memcomp_lightning.trained.imputation import Imputation, completed_columns, gap_columns, impute
from memcomp_lightning.trained.masking import figure_of_imputation, masked

HIDDEN = 0.1
"""Share of the known cells that is hidden for figures."""

MOST_FILES = 1_000
"""Draws, each of which is a file."""


@dataclass(frozen=True)
class Settings(OfRun):
    """Settings of ``memcomp-impute``.

    Attributes:
        output: File for the completed table, with all columns of TABLE: .csv, .tsv, .parquet, .npz or .fasta.
        m: Completed tables to draw, as filled-1.csv, filled-2.csv, ...; null is one with the likeliest values of
            discrete columns and the means of real ones.
        probabilities: File with a row for each gap: row, column, value, probability, deviation, low, high; null
            is none.
        figures: Folder, .png or .pdf: a tenth of the known cells is hidden, and what is filled in is drawn beside
            what was there.
        seed: Of chains and draws.
        chains: Gibbs chains of each row, where there are too many hidden units for exact sums.
        sweeps: Sweeps of the last round of these chains at most.
        overwrite: Whether files that are there are replaced.
    """

    output: str = "filled.csv"
    m: int | None = None
    probabilities: str | None = None
    figures: str | None = None
    seed: int = 0
    chains: int = 8
    sweeps: int = 1600
    overwrite: bool = False


USAGE = Usage(
    "memcomp-impute",
    "fill the gaps of a table by what a trained model knows of its rows.",
    ("RUN", "TABLE"),
    Settings,
    [
        ("memcomp-impute runs/people people.csv", "the likeliest values and means, in filled.csv"),
        ("memcomp-impute runs/people people.csv m=5", "five tables, drawn: filled-1.csv to filled-5.csv"),
        ("memcomp-impute runs/people people.csv probabilities=gaps.csv", "how sure each value is, too"),
    ],
)


def act(places: Sequence[str], settings: Settings) -> None:
    """Complete a file."""
    if settings.m is not None:
        require_count("m", settings.m)
        require(settings.m <= MOST_FILES, "m", settings.m, f"at most {MOST_FILES:,}: each draw is a file")
    outputs = _outputs(Path(settings.output), settings.m)
    gaps = None if settings.probabilities is None else Path(settings.probabilities)
    for path in outputs:
        check_output(path, overwrite=settings.overwrite)
    if gaps is not None:
        check_output(gaps, overwrite=settings.overwrite, endings=TABLES, setting="probabilities")
    if gaps in outputs:
        raise UserError(f"probabilities={gaps}: the completed table goes there. Choose another file.")
    if settings.figures is not None:
        check_figures(Path(settings.figures), overwrite=settings.overwrite)
    run, table = settings.load(places[0]), existing(places[1])
    check_kind(outputs[0], run.needed_schema)
    chains = MissingChains(n_chains=settings.chains, most_sweeps=settings.sweeps)
    rows = run.needed_schema.read(table, complete=False)
    found = impute(run, rows, m=settings.m, seed=settings.seed, chains=chains)
    for draw, path in enumerate(outputs):
        v = found.completed(None if settings.m is None else draw)
        columns = in_one_array(completed_columns(run.needed_schema, table, v), run.needed_schema, path)
        write_columns(columns, path, overwrite=settings.overwrite)
    if gaps is not None:
        write_columns(gap_columns(run.needed_schema, found), gaps, overwrite=settings.overwrite)
    if settings.figures is not None:
        hidden = impute(run, masked(rows, HIDDEN, seed=settings.seed), seed=settings.seed, chains=chains)
        figures = {"imputation": figure_of_imputation(run.needed_schema, rows, hidden.gaps)}
        write_figures(figures, Path(settings.figures), overwrite=settings.overwrite)
    say(_summary(found, chains, run.needed_schema.site_names))
    say(f"written: {', '.join(map(str, [*outputs, *([] if gaps is None else [gaps])]))}")


def main(arguments: Sequence[str] | None = None) -> None:
    """Entry point."""
    carry_out(USAGE, act, arguments)


def _outputs(output: Path, m: int | None) -> list[Path]:
    """The file, or one for each draw."""
    if m is None:
        return [output]
    ending = next((ending for ending in ENDINGS if output.name.lower().endswith(ending)), output.suffix)
    stem = output.name[: len(output.name) - len(ending)]
    return [output.with_name(f"{stem}-{draw + 1}{output.name[len(stem) :]}") for draw in range(m)]


def _summary(found: Imputation, chains: MissingChains, site_names: Sequence[str]) -> str:
    """What was done, and how far it can be trusted."""
    n_rows = int((~found.rows.observed).any(-1).sum()) if found.rows.observed is not None else 0
    lines = [f"{found.n_gaps:,} gaps in {n_rows:,} of {found.rows.n:,} rows filled"]
    if found.mean_probability == found.mean_probability:
        lines[0] += f"; discrete values are right with a mean probability of {found.mean_probability:.3f}"
    lines += without_values([site_names[gaps.site] for gaps in found.gaps if len(gaps.row) == found.rows.n])
    r_hat = found.r_hat[~found.r_hat.isnan()]
    if not len(r_hat):
        return "\n".join([*lines, "by exact sums" if found.n_gaps else "nothing was missing"])
    apart = int((r_hat > chains.r_hat).sum())
    exact = n_rows - len(r_hat)
    lines.append(
        f"{len(r_hat):,} rows by Gibbs chains (R-hat at most {float(r_hat.max()):.3f}), {exact:,} by exact sums"
    )
    if apart:
        lines.append(
            f"the chains of {apart:,} rows do not agree yet (R-hat above {chains.r_hat}): what is filled in there "
            f"may be off; type sweeps={2 * chains.most_sweeps} or more"
        )
    return "\n".join(lines)
