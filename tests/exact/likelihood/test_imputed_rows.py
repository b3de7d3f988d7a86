"""What is filled into rows, in numbers and in words: tables, pictures, letters."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from memcomp_lightning import rng
from memcomp_lightning.data.images import PixelLayout
from memcomp_lightning.data.rows import Rows
from memcomp_lightning.data.schema import ImageSchema, Schema
from memcomp_lightning.data.tables import TableSchema
from memcomp_lightning.data.tables.columns import Binary, Category, Probability, Real, SpinColumn
from memcomp_lightning.errors import SettingError, UserError
from memcomp_lightning.models import DBN
from memcomp_lightning.models.units import Bernoulli, Categorical, Gaussian, Spin, Units
from memcomp_lightning.testing import enumerated, small_rbm
from memcomp_lightning.trained import Run, imputation
from memcomp_lightning.trained.imputation import completed_columns, gap_columns, impute

# Sites: b, p, s, c, x.
SCHEMA = TableSchema(
    (
        Real("x", 100.0, 10.0, True),
        Category("c", ("a", "b", "c")),
        SpinColumn("s"),
        Binary("b", (3, 7)),
        Probability("p"),
    )
)


def run_of(schema: Schema, units: Units) -> Run:
    return Run(Path("run"), small_rbm(visible=units, hidden=Bernoulli(3)), None, schema)


def gappy(v: Tensor, share: float = 0.4) -> Rows:
    observed = rng.uniform(v.shape, generator=rng.stream(0, "mask")) > share
    observed[0], observed[1] = False, True
    return Rows(torch.where(observed, v, 0.0), torch.full((len(v),), -1), observed)


def table_rows(n: int = 12) -> Rows:
    generator = rng.stream(0, "rows")
    whole = [rng.bernoulli(torch.full((n, 2), 0.5), generator=generator), torch.ones(n, 1), torch.ones(n, 1)]
    return gappy(torch.cat([*whole, rng.uniform((n, 1), generator=generator)], dim=-1))


def test_each_gap_has_the_probabilities_of_its_own_row(monkeypatch: pytest.MonkeyPatch) -> None:
    """Whatever else is missing there, and whichever rows are found together."""
    run, rows = run_of(SCHEMA, SCHEMA.units()), table_rows()
    found = impute(run, rows)
    monkeypatch.setattr(imputation, "MOST_ROWS", 1)
    alone = impute(run, rows)
    units, model = run.model.visible, run.model
    v, masks = units.encode(rows.v), units.over_sites(rows.observed)  # type: ignore[arg-type]
    assert [gaps.site for gaps in found.gaps] == [0, 1, 2, 3, 4]
    assert found.n_gaps == int((~rows.observed).sum())  # type: ignore[operator]
    for gaps, same in zip(found.gaps, alone.gaps, strict=True):
        assert gaps.row.tolist() == (~rows.observed)[:, gaps.site].nonzero().flatten().tolist()  # type: ignore[operator]
        assert gaps.value.allclose(same.value)
        for k, row in enumerate(gaps.row.tolist()):
            exact = enumerated(model, v[row], masks[row])
            mean = (exact.probability @ exact.x.double())[: units.n]
            at = (units.site_of() == gaps.site).nonzero().flatten()
            if gaps.states is None:
                assert gaps.value[k] == pytest.approx(float(mean[at]), abs=1e-5)
            elif len(at) > 1:
                assert gaps.probability[k].allclose(mean[at].float(), atol=1e-5)  # type: ignore[index]
                assert gaps.value[k] == mean[at].argmax()
                assert gaps.of_value[k] == pytest.approx(float(mean[at].max()), abs=1e-5)
            else:
                assert float(gaps.probability[k] @ gaps.states) == pytest.approx(float(mean[at]), abs=1e-5)  # type: ignore[index]
    assert bool(found.r_hat.isnan().all())
    completed = found.completed()
    assert completed[rows.observed].equal(rows.v[rows.observed])
    assert completed[1].equal(rows.v[1])


def test_gaps_are_told_in_the_words_of_the_table() -> None:
    run, rows = run_of(SCHEMA, SCHEMA.units()), table_rows()
    found = impute(run, rows, m=3)
    told, columns = gap_columns(SCHEMA, found), SCHEMA.decode(found.completed())
    assert told["row"].tolist() == sorted(told["row"].tolist())
    for row, column, value in zip(told["row"], told["column"], told["value"], strict=True):
        cell = columns[column][row - 1]
        assert value == (f"{cell:.7g}" if isinstance(cell, float | np.floating) else str(cell))
    of_real, of_grey = told["column"] == "x", told["column"] == "p"
    assert np.isnan(told["probability"]).tolist() == (of_real | of_grey).tolist()
    assert np.isnan(told["low"]).tolist() == (~of_real).tolist()
    middle = np.array([float(x) for x in told["value"][of_real]])
    assert (told["low"][of_real] < middle).all()
    assert (middle < told["high"][of_real]).all()
    x = found.gaps[-1]
    assert told["deviation"][of_real] == pytest.approx(10 * x.deviation.numpy())  # type: ignore[union-attr]
    assert (told["low"] == told["low"].round())[of_real].all()  # whole numbers, as the column has them
    assert set(told["value"][told["column"] == "b"]) <= {"3", "7"}
    p = found.gaps[1]
    assert bool(((p.value > 0) & (p.value < 1)).all())  # a mean is what a probability is
    assert set(p.draws.flatten().tolist()) <= {0.0, 1.0}


@pytest.mark.parametrize(
    ("units", "states"),
    [
        (Bernoulli(6), [0, 1]),
        (Spin(6), [0, 1]),
        (Categorical(6, q=3), [0, 0.5, 1]),
        (Gaussian(6, variance=0.1), None),
    ],
    ids=["bits", "spins", "levels", "real"],
)
def test_pictures_are_filled_with_grey_values(tmp_path: Path, units: Units, states: list[float] | None) -> None:
    schema = ImageSchema(PixelLayout(2, 3), 0)
    run = run_of(schema, units)
    grey = np.round(rng.uniform((8, 6), generator=rng.stream(0, "grey")).numpy())
    grey[0], grey[1:, 2] = np.nan, np.nan
    np.save(tmp_path / "holes.npy", grey.reshape(8, 2, 3))
    rows = schema.read(tmp_path / "holes.npy", complete=False)
    found = impute(run, rows, m=2)
    v, masks = units.encode(units.from_intensity(rows.v)), units.over_sites(rows.observed)  # type: ignore[arg-type]
    exact = enumerated(run.model, v[3], masks[3])
    mean = units.to_intensity((exact.probability @ exact.x.double())[: units.n].float())
    completed = found.completed()
    assert completed[3, 2] == pytest.approx(float(mean[2]), abs=1e-5)
    if states is not None:
        assert found.gaps[2].states.tolist() == states  # type: ignore[union-attr]
        assert set(found.completed(1)[0].tolist()) <= set(states)
    columns = completed_columns(schema, tmp_path / "holes.npy", completed)
    assert columns["0,2"].tolist() == completed[:, 2].tolist()
    told = gap_columns(schema, found)
    assert float(told["value"][told["row"] == 4][0]) == pytest.approx(float(completed[3, 2]))


class Letters(ImageSchema):
    """One text a row, as sequences have."""

    @property
    def site_names(self) -> list[str]:
        return ["1", "2", "3"]

    @property
    def entry_names(self) -> list[str]:
        return [f"{site}={letter}" for site in self.site_names for letter in "ACGU-"]

    def units(self) -> Any:
        return Categorical(3, q=5)

    def decode(self, v: Tensor) -> dict[str, Any]:
        return {"sequence": np.array(["".join("ACGU-"[int(k)] for k in row) for row in v.tolist()], dtype=object)}


def test_letters_are_told_by_their_names() -> None:
    schema = Letters(PixelLayout(1, 3), 0)
    found = impute(run_of(schema, schema.units()), gappy(torch.ones(6, 3)))
    told, sequences = gap_columns(schema, found), schema.decode(found.completed())["sequence"]
    assert len(told["row"]) == found.n_gaps
    for row, site, letter in zip(told["row"], told["column"], told["value"], strict=True):
        assert sequences[row - 1][int(site) - 1] == letter


def test_rows_without_gaps_stay_as_they_are() -> None:
    rows = table_rows()
    run, whole = run_of(SCHEMA, SCHEMA.units()), rows._replace(observed=None)
    found = impute(run, whole, m=2)
    assert found.completed(1).equal(rows.v)
    assert found.n_gaps == 0
    assert len(gap_columns(SCHEMA, found)["row"]) == 0


def test_what_cannot_be_filled_is_refused() -> None:
    rows = table_rows()
    with pytest.raises(SettingError, match=r"m = 0 is not allowed: expected an integer >= 1\."):
        impute(run_of(SCHEMA, SCHEMA.units()), rows, m=0)
    stack = Run(Path("run"), DBN(None, [3, 2], visible=SCHEMA.units()), None, SCHEMA)
    with pytest.raises(UserError, match="run is a deep belief network of 2 layers"):
        impute(stack, rows)
    wrong = rows._replace(v=rows.v.masked_fill(rows.observed, 0.5))  # type: ignore[arg-type]
    wrong.v[1, 2] = 3.0
    with pytest.raises(SettingError, match=r"row 1 = 3\.0 is not allowed"):
        impute(run_of(SCHEMA, SCHEMA.units()), wrong)
