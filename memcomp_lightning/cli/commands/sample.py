"""``memcomp-sample``: rows drawn from a trained model."""

import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from torch import Tensor

from memcomp_lightning.cli.output import say
from memcomp_lightning.cli.products import OfRun, Usage, carry_out, existing
from memcomp_lightning.data.rows import Rows
from memcomp_lightning.data.schema import Columns, ImageSchema, Schema
from memcomp_lightning.data.written import check_kind, check_output, in_one_array, write_columns
from memcomp_lightning.errors import UserError
from memcomp_lightning.files import written_whole
from memcomp_lightning.trained.beside import others_of
from memcomp_lightning.trained.given import given_row, unlike_training
from memcomp_lightning.trained.imputation import completed_columns
from memcomp_lightning.trained.sampling import sample

N_ROWS = 1000
"""Rows, where ``n`` does not say how many."""

N_PICTURES = 100
"""Pictures of a figure at most."""


@dataclass(frozen=True)
class Settings(OfRun):
    """Settings of ``memcomp-sample``.

    Attributes:
        n: Rows; of each row of given=FILE. null is 1,000, or 1 with given=FILE.
        output: File for the rows: .csv, .tsv, .parquet, .npz, .fasta; of pictures .npz has them as x.
        given: Known values, '{age: 30, sex: f}', or a table with gaps, each row of which is completed.
        temperature: Below 1 the likely becomes more likely; real columns keep their spread given the others.
        method: auto, exact (layers of up to 16 bits), gibbs, or tempering.
        most_sweeps: Sweeps by which chains are judged at most; more of them where they do not mix.
        seed: Of all draws.
        overwrite: Whether files that are there are replaced.
        figure: A .png of the first 100, where rows are pictures.
        figures: Folder, .png or .pdf for figures of the rows beside those of data=TABLE.
        data: The table that figures compare with, say the one that was trained on.
    """

    n: int | None = None
    output: str = "rows.csv"
    given: dict[str, object] | str | None = None
    temperature: float = 1.0
    method: str = "auto"
    most_sweeps: int = 4096
    seed: int = 0
    overwrite: bool = False
    figure: str | None = None
    figures: str | None = None
    data: str | None = None


USAGE = Usage(
    "memcomp-sample",
    "draw rows from a trained model, by chains whose mixing is measured.",
    ("RUN",),
    Settings,
    [
        (
            "memcomp-sample runs/people n=1000 output=rows.csv",
            "a table like the one that the model was trained on",
        ),
        ("memcomp-sample runs/people given='{age: 30, sex: f}'", "other columns of rows with these values"),
        ("memcomp-sample runs/people given=gaps.csv output=whole.csv", "a table with its gaps filled by draws"),
        (
            "memcomp-sample runs/people data=people.csv figures=looks",
            "marginals, correlations and principal components beside the data's",
        ),
        ("memcomp-sample runs/digits output=digits.npz figure=digits.png", "pictures"),
    ],
)


def act(places: Sequence[str], settings: Settings) -> None:
    """Draw rows, and write them."""
    output = Path(settings.output)
    check_output(output, overwrite=settings.overwrite)
    run = settings.load(places[0])
    schema = run.needed_schema
    check_kind(output, schema)
    figure = None if settings.figure is None else _checked_figure(settings, schema)
    beside = _beside(settings, schema)
    given = _given(settings, schema)
    of_file = isinstance(settings.given, str)
    begin = time.perf_counter()
    v, mixing = sample(
        run,
        (1 if of_file else N_ROWS) if settings.n is None else settings.n,
        given=given,
        temperature=settings.temperature,
        method=settings.method,
        most_sweeps=settings.most_sweeps,
        seed=settings.seed,
    )
    seconds = time.perf_counter() - begin
    columns = in_one_array(_columns(settings, schema, given, v), schema, output)
    write_columns(columns, output, overwrite=settings.overwrite)
    if beside is not None:
        from memcomp_lightning.plotting.written import write_figures
        from memcomp_lightning.trained.figures import figures_of

        figures = figures_of(run, beside, v, seed=settings.seed)
        write_figures(figures, Path(str(settings.figures)), overwrite=settings.overwrite)
    if figure is not None and isinstance(schema, ImageSchema):
        _draw(v, schema, figure)
    say(f"{len(v):,} rows in {seconds:.1f} s: {output}")
    for line in mixing.lines():
        say(f"  {line}")
    for text in [] if given is None else unlike_training(schema, given):
        say(f"memcomp-sample: warning: {text}", error=True)
    if mixing.warning is not None:
        say(f"memcomp-sample: warning: {mixing.warning}", error=True)


def _given(settings: Settings, schema: Schema) -> Rows | None:
    if settings.given is None:
        return None
    if isinstance(settings.given, str):
        file = Path(settings.given)
        if not file.is_file():
            raise UserError(
                f"given={file}: there is no such file. Known values are typed given='{{COLUMN: VALUE}}'."
            )
        return schema.read(file, complete=False)
    return given_row(schema, settings.given)


def _columns(settings: Settings, schema: Schema, given: Rows | None, v: Tensor) -> Columns:
    """Rows in the user's columns; those of a file keep its other columns, each row as often as it was drawn."""
    if given is None or not isinstance(settings.given, str):
        return schema.decode(v)
    if len(v) == given.n:
        return completed_columns(schema, Path(settings.given), v)
    others = others_of(schema, Path(settings.given), given.n)
    return {name: np.repeat(column, len(v) // given.n) for name, column in others.items()} | schema.decode(v)


def _beside(settings: Settings, schema: Schema) -> Rows | None:
    """The rows that figures compare with; None without figures."""
    if settings.figures is None:
        return None
    if settings.data is None:
        raise UserError(f"figures={settings.figures} needs a table to compare with: type data=TABLE.")
    from memcomp_lightning.plotting.written import check_figures

    check_figures(Path(settings.figures), overwrite=settings.overwrite)
    return schema.read(existing(settings.data), complete=False)


def _checked_figure(settings: Settings, schema: Schema) -> Path:
    figure = Path(str(settings.figure))
    if not isinstance(schema, ImageSchema):
        raise UserError(f"figure={figure}: the rows of this run are no pictures. Leave it out.")
    if figure.suffix.lower() != ".png" or not figure.parent.is_dir():
        raise UserError(f"figure={figure}: expected a file that ends in .png, in a folder that is there.")
    if settings.figures is not None and Path(settings.figures) == figure:
        raise UserError(f"figure={figure}: figures go there, too. Choose another file.")
    if figure.exists() and not settings.overwrite:
        raise UserError(f"figure={figure}: the file is there already. Choose another, or type overwrite=true.")
    return figure


def _draw(v: Tensor, schema: ImageSchema, figure: Path) -> None:
    from matplotlib.image import imsave

    from memcomp_lightning.plotting.grid import picture_grid

    grid = picture_grid(schema.layout.to_picture(v[:N_PICTURES].cpu()).numpy())
    with written_whole(figure) as partial:
        imsave(partial, grid, cmap="gray", vmin=0, vmax=1, format="png")


def main(arguments: Sequence[str] | None = None) -> None:
    """Entry point."""
    carry_out(USAGE, act, arguments)
