"""The page of the tables says what their files say."""

import csv
import importlib.util
from pathlib import Path

import pytest

FOLDER = Path(__file__).parents[3] / "experiments" / "tables"


@pytest.mark.parametrize("path", sorted(FOLDER.glob("*.csv")), ids=lambda path: path.stem)
def test_the_page_has_each_table_as_it_was_measured(path):
    spec = importlib.util.spec_from_file_location("tables_run", FOLDER / "run.py")
    run = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(run)
    with path.open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert path.stem in run.PARTS
    assert run.parts.markdown(rows) in (FOLDER / "README.md").read_text()
