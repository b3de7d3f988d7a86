"""Values of units in the words of their data, as pictures show them."""

import numpy as np
import pytest
import torch

from memcomp_lightning import rng
from memcomp_lightning.data import PixelLayout, TableSchema
from memcomp_lightning.data.schema import ImageSchema
from memcomp_lightning.data.sequences import SequenceSchema
from memcomp_lightning.data.shown import Shown
from memcomp_lightning.data.tables.columns import Binary, Category, Real, SpinColumn
from memcomp_lightning.models.units import Bernoulli, Categorical, Gaussian, Mixed, Spin

pytest.importorskip("pyarrow")

SCHEMA = TableSchema(
    (
        Real("age", 40.0, 10.0),
        Binary("sex", ("f", "m")),
        Category("colour", ("blue", "green", "red")),
        SpinColumn("spin"),
    )
)
KEPT = torch.tensor([[1.0, -1, 2, 0.5], [0, 1, 0, -1]])
OBSERVED = torch.tensor([[True, True, True, False], [True, True, False, True]])


def test_a_table_is_shown_in_its_words() -> None:
    units = SCHEMA.units()
    shown = Shown(units, units.encode(KEPT), units.over_sites(OBSERVED), schema=SCHEMA)
    columns = shown.columns
    assert list(columns) == ["age", "sex", "colour", "spin"]
    np.testing.assert_array_equal(columns["age"], [np.nan, 30])
    assert [columns[name].tolist() for name in ("sex", "colour", "spin")] == [["m", "f"], ["red", None], [-1, 1]]
    assert shown.entry_names == ["sex", "spin", "colour=blue", "colour=green", "colour=red", "age"]
    entries = shown.entries
    np.testing.assert_array_equal(entries[0], [1, -1, 0, 0, 1, np.nan])
    np.testing.assert_array_equal(entries[1], [0, 1, np.nan, np.nan, np.nan, -1])
    weighted = Shown(units, shown.v, torch.tensor([[True] * 6, [False] * 6]), torch.tensor([2.0, 3.0]))
    assert weighted.complete.v.equal(shown.v[:1])
    assert weighted.complete.weights == [2.0]


def test_units_of_which_nothing_is_known_keep_their_numbers() -> None:
    units = Mixed(Spin(1), Categorical([2, 11]))
    shown = Shown(units, units.encode(torch.tensor([[-1.0, 1, 10], [1, 0, 2]])))
    columns = {name: cells.tolist() for name, cells in shown.columns.items()}
    assert columns == {"unit 0": [-1, 1], "unit 1": ["1", "0"], "unit 2": ["10", "02"]}
    assert shown.entry_names[-1] == "unit 13"
    pixels = ImageSchema(PixelLayout(1, 2), 0)
    assert list(Shown(Bernoulli(2), torch.zeros(3, 2), schema=pixels).columns) == ["pixel 0,0", "pixel 0,1"]
    of_two_each = Shown(Categorical(2, q=2), torch.zeros(3, 4), schema=pixels)
    assert of_two_each.entry_names == ["unit 0", "unit 1", "unit 2", "unit 3"]


def test_sequences_have_a_column_for_each_site() -> None:
    schema = SequenceSchema(3, "rna")
    units = schema.units()
    observed = units.over_sites(torch.tensor([[True, True, False], [True, True, True]]))
    shown = Shown(units, units.encode(torch.tensor([[0, 1, 0], [4, 4, 1]])), observed, schema=schema)
    columns = {name: cells.tolist() for name, cells in shown.columns.items()}
    assert columns == {"site 1": ["A", "-"], "site 2": ["C", "-"], "site 3": [None, "C"]}


def test_means_are_drawn_as_values() -> None:
    units = Mixed(Bernoulli(1), Categorical([2]), Gaussian(1))
    grey = torch.tensor([[0.3, 0.2, 0.8, 0.7]]).expand(4000, -1)
    drawn = Shown(units, grey).drawn(rng.stream(0, "shown")).entries
    assert set(drawn[:, :3].flatten()) == {0.0, 1.0}
    np.testing.assert_allclose(drawn.mean(0), [0.3, 0.2, 0.8, 0.7], atol=0.04)
    assert (drawn[:, 1] + drawn[:, 2] == 1).all()
