"""A table of a million rows from the command line: what reading, training and drawing take."""

import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
from commands import Used, command
from numpy.typing import NDArray
from pyarrow import csv

from memcomp_lightning import rng

N_REAL = N_CATEGORY = 50
N_FACTORS, AT_ONCE = 5, 50_000
WORDS = np.array(list("abcdefgh"))


def write(path: Path, n: int, *, n_real: int = N_REAL, n_category: int = N_CATEGORY) -> None:
    """Numbers that are sums of a few factors and noise, and categories of 2 to 8 words that follow them, too."""
    generator = rng.numpy_stream(0, "large table")
    loading = generator.normal(size=(N_FACTORS, n_real)) / N_FACTORS**0.5
    sizes = [2 + k % 7 for k in range(n_category)]
    fields = [generator.normal(size=(N_FACTORS, size)) for size in sizes]
    names = [*(f"real {k}" for k in range(n_real)), *(f"word {k}" for k in range(n_category))]
    schema = pa.schema([(name, pa.float64() if name.startswith("real") else pa.string()) for name in names])
    with csv.CSVWriter(path, schema) as file:
        for begin in range(0, n, AT_ONCE):
            rows = min(AT_ONCE, n - begin)
            factors = generator.normal(size=(rows, N_FACTORS))
            real = (factors @ loading + 0.5 * generator.normal(size=(rows, n_real))).round(4)
            words = [_drawn(factors @ field, generator) for field in fields]
            file.write_batch(pa.record_batch([*(pa.array(column) for column in real.T), *words], schema=schema))


def _drawn(field: NDArray[np.float64], generator: np.random.Generator) -> Any:
    return pa.array(WORDS[(field + generator.gumbel(size=field.shape)).argmax(-1)])


def row(what: str, used: Used, **more: Any) -> dict[str, Any]:
    numbers = {"seconds": used.seconds, "core seconds": used.core_seconds, "GiB": used.gibibytes}
    return {"what": what, **{name: f"{number:.3g}" for name, number in numbers.items()}, **more}


def measure(*, quick: bool) -> Iterator[dict[str, Any]]:
    """A row for each command."""
    n, drawn = (400, 20) if quick else (1_000_000, 10_000)
    shape = {"n_real": 3, "n_category": 3} if quick else {}
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        write(folder / "rows.csv", n, **shape)
        size = f"{(folder / 'rows.csv').stat().st_size / 1e6:.0f} MB"
        settings = ["pretrain.iterations=1", "pretrain.batch_size=1000", "hydra.run.dir=run"]
        used = command("train", "data=table", "data.path=rows.csv", *settings, folder=folder)
        yield row(f"read {n:,} rows of {sum(shape.values()) or 100} columns, train on them once", used, file=size)
        used = command("sample", "run", f"n={drawn}", "output=drawn.csv", folder=folder)
        method = next(line for line in used.out.splitlines() if "method" in line).split(maxsplit=1)[1]
        yield row(f"draw {drawn:,} rows", used, method=method)
