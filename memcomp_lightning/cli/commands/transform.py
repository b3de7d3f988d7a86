"""``memcomp-transform``: features of rows, the means of hidden units."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from memcomp_lightning.cli.output import say
from memcomp_lightning.cli.products import OfRun, Usage, carry_out, existing
from memcomp_lightning.data.written import TABLES, check_output, write_columns
from memcomp_lightning.trained.beside import beside, left_out
from memcomp_lightning.trained.features import transform


@dataclass(frozen=True)
class Settings(OfRun):
    """Settings of ``memcomp-transform``.

    Attributes:
        output: File for the features: .csv, .tsv, .parquet or .npz. Names of sequences and columns that the model
            does not have come first.
        overwrite: Whether a file that is there is replaced.
        layer: Hidden layer, from 1; null is the top one.
    """

    output: str = "features.csv"
    overwrite: bool = False
    layer: int | None = None


USAGE = Usage(
    "memcomp-transform",
    "write the means of the hidden units for each row of a table.",
    ("RUN", "TABLE"),
    Settings,
    [("memcomp-transform runs/people people.csv output=features.parquet", "features of the top layer")],
)


def act(places: Sequence[str], settings: Settings) -> None:
    """Transform a file."""
    output = Path(settings.output)
    check_output(output, overwrite=settings.overwrite, endings=TABLES)
    run = settings.load(places[0])
    table = existing(places[1])
    rows = run.needed_schema.read(table, complete=False)
    found = transform(run, rows, layer=settings.layer)
    columns, hidden = beside(run.needed_schema, table, rows, found)
    write_columns(columns, output, overwrite=settings.overwrite)
    say("\n".join([f"{rows.n:,} rows, {len(found)} features: {output}", *left_out(hidden)]))


def main(arguments: Sequence[str] | None = None) -> None:
    """Entry point."""
    carry_out(USAGE, act, arguments)
