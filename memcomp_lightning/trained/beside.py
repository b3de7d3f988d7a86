"""What else a file says of its rows, beside what a model reads: names, numbers, classes."""

from collections.abc import Sequence
from pathlib import Path

from memcomp_lightning.data.rows import Rows
from memcomp_lightning.data.schema import Columns, Schema
from memcomp_lightning.errors import UserError


def others_of(schema: Schema, path: Path, n: int) -> Columns:
    """Columns of a file of n rows that the model does not have; of FASTA the names; none of pictures.

    Raises:
        UserError: The file has changed since it was read.
    """
    read = getattr(schema, "others", None)
    found: Columns = {} if read is None else read(path)
    if any(len(column) != n for column in found.values()):
        raise UserError(f"{path} has changed while it was worked on: it had {n} rows.")
    return found


def beside(schema: Schema, path: Path, rows: Rows, found: Columns) -> tuple[Columns, list[str]]:
    """Numbers of rows, columns of a file that the model does not have, and what was found for its rows.

    Args:
        schema: Of the run.
        path: The file: a table; of FASTA the names are a column ``name``.
        rows: That were read from it.
        found: A number or word for each row.

    Returns:
        The columns, and the names of those of the file that are left out because something found has their name.
    """
    others = others_of(schema, path, rows.n)
    hidden = [name for name in others if name in found]
    first = {name: found[name] for name in ("row",) if name in found}
    return first | {name: column for name, column in others.items() if name not in found} | found, hidden


def left_out(hidden: list[str]) -> list[str]:
    """A line on columns that are left out; none without any."""
    names = ", ".join(map(repr, hidden))
    return [f"left out of the table's columns, as what was found has this name: {names}"] if hidden else []


def without_values(names: Sequence[str]) -> list[str]:
    """A line on columns of the model that no row has a value of; none without any."""
    return [f"columns without any value, or not in the file: {', '.join(names)}"] if names else []
