"""A table with its empty cells filled is the same table: columns, order, texts and types."""

from pathlib import Path
from typing import Any

import pyarrow as pa
import pytest
import torch
from pyarrow import parquet

from memcomp_lightning.data.tables import TableSchema
from memcomp_lightning.data.tables.columns import Binary, Category, Real
from memcomp_lightning.data.tables.filled import filled
from memcomp_lightning.data.written import write_columns
from memcomp_lightning.errors import UserError

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
