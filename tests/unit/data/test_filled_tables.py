"""A table with its empty cells filled is the same table: columns, order, texts and types."""

import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pytest
import torch
from pyarrow import parquet

from memcomp_lightning import rng
from memcomp_lightning.data import PixelLayout, Table, TableDataModule
from memcomp_lightning.data.schema import ImageSchema
from memcomp_lightning.data.tables import TableSchema
from memcomp_lightning.data.tables.cells import Cells
from memcomp_lightning.data.tables.columns import Binary, Category, Real
from memcomp_lightning.data.tables.filled import filled
from memcomp_lightning.data.written import in_one_array, write_columns
from memcomp_lightning.errors import UserError
from memcomp_lightning.trained.beside import others_of

SCHEMA = TableSchema(
    (
        Real("age", 30.0, 10.0, True),
        Category("colour", ("blue", "red")),
        Real("height", 170.0, 10.0),
        Binary("on", ("false", "true")),
    )
)
# Sites: on, colour, age, height.
V = torch.tensor([[1.0, 0.0, 0.5, 1.25], [0.0, 1.0, -1.04, 0.125], [1.0, 1.0, 0.0, 0.0]])


def test_texts_stay_to_the_letter(tmp_path: Path) -> None:
    table = tmp_path / "people.csv"
    table.write_text(
        'id,height,age,note,colour,on\n007,1.7e2,,"a, b",red,true\n008,,41.0,NA, blue ,\n009,180.50,NA,, ,false\n'
    )
    write_columns(filled(table, SCHEMA, V), tmp_path / "out.csv")
    assert (tmp_path / "out.csv").read_text().splitlines() == [
        "id,height,age,note,colour,on",
        '007,1.7e2,35,"a, b",red,true',
        "008,171.25,41.0,NA, blue ,false",
        "009,180.50,30,,red,false",
    ]


def test_a_column_that_is_not_there_follows_the_others(tmp_path: Path) -> None:
    (tmp_path / "short.csv").write_text("colour,age\nred,20\n,21\nblue,\n")
    found = filled(tmp_path / "short.csv", SCHEMA, V)
    assert list(found) == ["colour", "age", "height", "on"]
    assert found["height"].tolist() == [182.5, 171.25, 170.0]
    assert found["on"].tolist() == ["true", "false", "true"]


@pytest.mark.parametrize(
    ("cells", "expected"),
    [
        ({"age": pa.array([None, 41, None])}, [35, 41, 30]),
        ({"age": pa.array([None, 41.5, None])}, [35.0, 41.5, 30.0]),
        ({"on": pa.array([True, None, None])}, [True, False, True]),
        ({"colour": pa.array(["red", None, None]).dictionary_encode()}, ["red", "red", "red"]),
        ({"height": pa.array([1.5, None, None], pa.float32())}, [1.5, 171.25, 170.0]),
        ({"other": pa.array([12345678901, None, 3])}, [12345678901, None, 3]),
    ],
    ids=["whole", "real", "truth values", "dictionary", "single precision", "numbers of another column"],
)
def test_types_stay(tmp_path: Path, cells: dict[str, Any], expected: list[Any]) -> None:
    parquet.write_table(pa.table(cells), tmp_path / "in.parquet")
    found = filled(tmp_path / "in.parquet", SCHEMA, V)
    write_columns(found, tmp_path / "out.parquet")
    written = parquet.read_table(tmp_path / "out.parquet").column(next(iter(cells))).to_pylist()
    assert written == expected
    assert [type(cell) for cell in written] == [type(cell) for cell in expected]


def test_numbers_and_times_of_other_columns_keep_their_digits(tmp_path: Path) -> None:
    """What is found has the seven digits of single precision; what was there has all of its own."""
    cells = {
        "id": pa.array([123456789.5, 0.1, 52.520006612]),
        "seen": pa.array([1577836800_000000000, None, 1577836800_123456789], pa.timestamp("ns")),
        "height": pa.array([1.23456789012, None, None]),
    }
    parquet.write_table(pa.table(cells), tmp_path / "in.parquet")
    write_columns(filled(tmp_path / "in.parquet", SCHEMA, V[:, :4] + 0.0123456789), tmp_path / "out.csv")
    assert (tmp_path / "out.csv").read_text().splitlines()[1:] == [
        "123456789.5,2020-01-01T00:00:00.000000000,1.23456789012,35,blue,true",
        "0.1,,171.3735,20,red,false",
        "52.520006612,2020-01-01T00:00:00.123456789,170.1235,30,red,true",
    ]


@pytest.mark.parametrize("x", [0.1, -1e-12, 123456.78, 1e20, 9.99999999, 0.0, math.nan, -math.inf, 3e-20])
def test_real_cells_have_seven_digits(x: float) -> None:
    (written,) = Real("x", 0.0, 1.0).write(np.array([x])).tolist()
    assert written == pytest.approx(float(f"{x:.7g}"), rel=1e-15 if 0 < abs(x) < 1e-9 else 0, abs=0, nan_ok=True)


def test_a_part_without_rows_is_no_end(tmp_path: Path) -> None:
    table = pa.table({"x": [0.5, 1.5, 2.5, 4.0] * 5, "y": ["a", "b", "a", "b"] * 5})
    parts = pa.Table.from_batches(
        [pa.RecordBatch.from_pylist([], schema=table.schema), *table.to_batches()], schema=table.schema
    )
    assert TableDataModule.from_frame(parts).n_train > 0


def test_truth_values_are_one_word_in_any_case(tmp_path: Path) -> None:
    """As pandas writes them, as Arrow does, and as booleans; what is filled in is spelt as the others."""
    for spelt in ("True", "TRUE", "true"):
        (tmp_path / "b.csv").write_text(f"on,age\n{spelt},20\n,21\n{spelt},22\n")
        found = filled(tmp_path / "b.csv", SCHEMA, V)
        assert found["on"].tolist() == [spelt, {"True": "False", "TRUE": "FALSE", "true": "false"}[spelt], spelt]
        assert SCHEMA.read(tmp_path / "b.csv", complete=False).v[[0, 2], 0].tolist() == [1.0, 1.0]
    capital = Binary("on", ("False", "True"))
    assert capital.read(Cells(pa.array([True, False]))).tolist() == [1.0, 0.0]


def test_a_key_with_holes_is_left_out() -> None:
    """Rows of a larger table: their numbers rise, and say nothing; numbers that do not rise do."""
    n = 40
    key = np.cumsum(rng.numpy_stream(0, "steps").integers(1, 9, n))
    columns = {"key": key, "other": key[::-1].copy(), "x": np.sin(key)}
    data = TableDataModule.from_frame(pa.table(columns))
    assert data.schema.site_names == ["other", "x"]
    assert "its whole numbers rise from row to row" in data.described


def test_what_is_beside_a_table_is_read_alone(tmp_path: Path) -> None:
    table = tmp_path / "people.csv"
    table.write_text("id,age,colour,note\n007,41,red,x\n008,,,y\n")
    assert {name: column.tolist() for name, column in SCHEMA.others(table).items()} == {
        "id": ["007", "008"],
        "note": ["x", "y"],
    }
    assert list(others_of(SCHEMA, table, 2)) == ["id", "note"]
    with pytest.raises(UserError, match="has changed while it was worked on: it had 3 rows"):
        others_of(SCHEMA, table, 3)


def test_arrays_and_pictures_come_back_from_the_file_that_is_written(tmp_path: Path) -> None:
    pixels = rng.numpy_stream(0, "pixels").random((20, 2, 3)).round(3)
    np.savez(tmp_path / "in.npz", other=np.zeros(3), rows=pixels)
    schema = Table(path=str(tmp_path / "in.npz"), columns="probability", key="rows").load().schema
    schema = TableSchema.from_json(json.loads(json.dumps(schema.as_json())))  # as a run keeps it
    pictures = ImageSchema(PixelLayout(2, 3), 0)
    some = pixels.copy()
    some[3, 1, 1] = np.nan
    np.savez(tmp_path / "gaps.npz", other=np.zeros(3), rows=some, x=some)
    v = torch.tensor(pixels.reshape(20, 6), dtype=torch.float32)
    for own, columns in (
        (schema, schema.filled(tmp_path / "gaps.npz", v)),
        (pictures, pictures.decode(v)),
        (ImageSchema(PixelLayout(3, 3, (0, 1, 2, 3, 5, 8)), 0), pictures.decode(v)),
    ):
        write_columns(in_one_array(columns, own, tmp_path / "out.npz"), tmp_path / "out.npz", overwrite=True)
        torch.testing.assert_close(own.read(tmp_path / "out.npz").v, v)
        again = Table(path=str(tmp_path / "out.npz"), columns="probability").load()  # as data=arrays reads them
        assert not again.schema.named
        assert again.train.n + again.test.n == 20


def test_an_npz_of_columns_is_a_table(tmp_path: Path) -> None:
    columns = {
        "age": np.array([30, 41, 22]),
        "colour": np.array(["red", None, "blue"], dtype=object),
        "height": np.array([170.0, np.nan, 180.0]),
    }
    write_columns(columns, tmp_path / "out.npz")
    rows = SCHEMA.read(tmp_path / "out.npz", complete=False)
    known = rows.v.masked_fill(~rows.observed, torch.nan)  # type: ignore[operator]
    expected = [[torch.nan, 1, 0, 0], [torch.nan, torch.nan, 1.1, torch.nan], [torch.nan, 0, -0.8, 1]]
    torch.testing.assert_close(known, torch.tensor(expected), equal_nan=True)
    np.savez(tmp_path / "odd.npz", a=np.zeros(3), b=np.zeros(4))
    with pytest.raises(UserError, match="holds the arrays a, b: call the one that is meant x, or choose"):
        SCHEMA.read(tmp_path / "odd.npz")


def test_a_file_that_has_changed_is_refused(tmp_path: Path) -> None:
    (tmp_path / "grown.csv").write_text("age\n1\n2\n3\n4\n")
    with pytest.raises(UserError, match=r"grown\.csv has changed while it was worked on: it had 3 rows\."):
        filled(tmp_path / "grown.csv", SCHEMA, V)


def test_a_table_of_other_columns_is_refused(tmp_path: Path) -> None:
    (tmp_path / "other.csv").write_text("Age,Colour\n1,red\n")
    with pytest.raises(
        UserError,
        match="none of the columns of the model, which are 'on', 'colour', 'age', 'height'; it has 'Age'",
    ):
        SCHEMA.read(tmp_path / "other.csv", complete=False)
