"""Whether rows that judge a run have been trained on by the one that it goes on from."""

from pathlib import Path

import pytest
import torch

from memcomp_lightning.data import TableDataModule
from memcomp_lightning.data.rows import Rows
from memcomp_lightning.data.tables import data_of
from memcomp_lightning.errors import UserError
from memcomp_lightning.files import write_json
from memcomp_lightning.runs.folder import RunFolder
from memcomp_lightning.runs.history import seen_before

ROWS = {"train": "a", "test": "b", "held-out": "c"}


@pytest.mark.parametrize(
    ("changed", "said"),
    [
        ({}, ""),
        ({"test": "x"}, ""),
        ({"train": "x"}, ""),
        ({"train": "x", "test": "y"}, "The test rows may"),
        ({"train": "x", "held-out": "y"}, "The held-out rows may"),
        ({"train": "x", "test": "y", "held-out": "y"}, "The test and held-out rows may"),
    ],
)
def test_rows_are_safe_where_they_were_split_so_before(tmp_path: Path, changed: dict[str, str], said: str) -> None:
    folder = RunFolder(tmp_path)
    folder.keep_rows(ROWS)
    found = seen_before(folder, ROWS | changed)
    assert found.startswith(said)
    assert bool(found) == bool(said)


def test_what_was_seen_by_a_run_before_stays_seen(tmp_path: Path) -> None:
    folder = RunFolder(tmp_path)
    assert "The test and held-out rows may" in seen_before(folder, ROWS)  # an older run, which kept no rows
    folder.keep_rows(ROWS)
    write_json(tmp_path / "result.json", {"seen_before": "these rows"})
    assert seen_before(folder, ROWS) == "these rows"


def test_a_run_goes_on_with_its_own_rows(tmp_path: Path) -> None:
    folder = RunFolder(tmp_path)
    folder.keep_rows(ROWS)
    folder.keep_rows(dict(ROWS))
    with pytest.raises(UserError, match="have changed since its training began"):
        folder.keep_rows(ROWS | {"test": "x"})


def test_fingerprints_are_those_of_all_numbers() -> None:
    v, label = torch.zeros(40_000, 2), torch.zeros(40_000, dtype=torch.long)
    rows = Rows(v, label)
    changed = v.clone()
    changed[39_999, 1] = 1
    others = [Rows(changed, label), Rows(v, label + 1), Rows(v, label, v < 1), Rows(v[:-1], label[:-1])]
    assert len({one.fingerprint for one in [rows, *others]}) == 5
    assert Rows(v.T.contiguous().T, label).fingerprint == rows.fingerprint


def test_held_out_rows_are_a_part_of_the_training_rows() -> None:
    data = data_of(torch.arange(60.0).view(20, 3) / 7)
    plain, held_out = TableDataModule(data), TableDataModule(data, validation_fraction=0.2)
    assert set(plain.fingerprints) == {"train", "test"}
    assert held_out.fingerprints == plain.fingerprints | {"held-out": plain.fingerprints["train"]}
