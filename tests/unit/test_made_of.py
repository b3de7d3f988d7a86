"""Dataclasses from the plain values of files: what a stranger wrote has the types that it must have."""

import json

import pytest

from memcomp_lightning.data import PixelLayout
from memcomp_lightning.data.schema import ImageSchema, schema_of
from memcomp_lightning.data.sequences import SequenceSchema
from memcomp_lightning.errors import SettingError, UserError, printable
from memcomp_lightning.files import made_of, read_json
from memcomp_lightning.studies.records import Record, Records
from memcomp_lightning.trained.alone import schema_in

pytest.importorskip("pyarrow")

RECORD = {"method": "cd", "at": [1, 2], "seconds": [0.5, 1], "measures": {"x": [[1.0], [2]]}, "seed": 0}
COLUMN = {"name": "a", "kind": "real", "mean": 0.0, "scale": 1.0}
TABLE = {"data": "table", "named": True, "label": None, "weight": None, "columns": [COLUMN]}
IMAGES = ImageSchema(PixelLayout(2, 2), 0).as_json()
SEQUENCES = SequenceSchema(3, "dna").as_json()


@pytest.mark.parametrize("schema", [TABLE, IMAGES, SEQUENCES])
def test_schemas_come_back(schema):
    again = schema_of(json.loads(json.dumps(schema_of(schema).as_json())))
    assert again.as_json() == schema_of(schema).as_json()


@pytest.mark.parametrize(
    "schema",
    [
        TABLE | {"columns": []},
        TABLE | {"columns": [COLUMN, COLUMN]},
        TABLE | {"columns": [COLUMN | {"name": [1]}]},
        TABLE | {"columns": [COLUMN | {"mean": "x"}]},
        TABLE | {"columns": [COLUMN | {"mean": float("nan")}]},
        TABLE | {"columns": [COLUMN | {"scale": 0}]},
        TABLE | {"columns": [{"name": "a", "kind": "binary", "words": []}]},
        TABLE | {"columns": [{"name": "a", "kind": "category", "words": ["x", 1]}]},
        TABLE | {"columns": [{"name": "a", "kind": ["real"]}]},
        TABLE | {"columns": "abc"},
        TABLE | {"label": COLUMN},
        TABLE | {"weight": 3},
        IMAGES | {"height": 10**9},
        IMAGES | {"n_classes": 1e9},
        IMAGES | {"n_classes": 10**9},
        IMAGES | {"pixels": ["a"]},
        SEQUENCES | {"n_sites": 10**9},
        SEQUENCES | {"alphabet": ["dna"]},
        SEQUENCES | {"insertions": "x"},
        {"data": ["table"]},
    ],
)
def test_schemas_of_other_values_are_refused(tmp_path, schema):
    (tmp_path / "schema.json").write_text(json.dumps(schema))
    with pytest.raises(UserError, match="no schema of a run"):
        schema_in(tmp_path / "schema.json")


def test_records_come_back():
    assert made_of(Record, json.loads(json.dumps(RECORD))) == Record(**RECORD)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"at": "12"}, "at is '12'"),
        ({"seconds": [0.5, None]}, "seconds is"),
        ({"measures": {"x": [["a"]]}}, "measures is"),
        ({"choosing": 1}, "expected bool"),
        ({"method": None}, "method is None"),
        ({"other": 1}, "'other' is not known"),
    ],
)
def test_records_of_other_values_are_refused_by_line(tmp_path, change, said):
    lines = [RECORD | change, RECORD]
    (tmp_path / "records.jsonl").write_text("".join(json.dumps(line) + "\n" for line in lines))
    with pytest.raises(SettingError, match=rf"records\.jsonl, line 1 .*{said}"):
        Records(tmp_path)


def test_a_value_is_missing():
    with pytest.raises(ValueError, match="seconds is missing"):
        made_of(Record, {name: value for name, value in RECORD.items() if name != "seconds"})
    with pytest.raises(ValueError, match="an object with named values"):
        made_of(Record, [1])


@pytest.mark.parametrize("content", [b"\xff\xfe", b"[" * 100_000])
def test_json_that_is_no_text_or_too_deep(tmp_path, content):
    (tmp_path / "a.json").write_bytes(content)
    with pytest.raises(ValueError, match=r"no text in UTF-8|nested too deeply"):
        read_json(tmp_path / "a.json")


def test_records_that_are_no_text_are_refused_by_line(tmp_path):
    (tmp_path / "records.jsonl").write_bytes(b"\xff\n" + json.dumps(RECORD).encode() + b"\n")
    with pytest.raises(SettingError, match="line 1"):
        Records(tmp_path)


def test_messages_have_no_signs_that_move_the_cursor():
    assert str(UserError("a\x1b[2Jb\x00")) == r"a\x1b[2Jb\x00"
    assert printable("two\nlines é") == "two\nlines é"


def test_long_messages_keep_beginning_and_end():
    text = str(UserError(f"FILE: {'x' * 10**6}. Do this."))
    assert len(text) <= 2000
    assert (text[:6], text[-8:]) == ("FILE: ", "Do this.")
