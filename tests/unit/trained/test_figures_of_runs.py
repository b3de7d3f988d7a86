"""Figures of a trained run: the run's own words, weights, gaps, and what was filled in."""

from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
import torch
from torch import Tensor

from memcomp_lightning import rng
from memcomp_lightning.data import TableSchema
from memcomp_lightning.data.rows import Rows
from memcomp_lightning.data.sequences import SequenceSchema
from memcomp_lightning.data.tables.columns import Binary, Category, Real
from memcomp_lightning.errors import SettingError
from memcomp_lightning.models import DBN, RBM
from memcomp_lightning.trained import Run, masking
from memcomp_lightning.trained import figures as figures_module
from memcomp_lightning.trained.figures import figures_of
from memcomp_lightning.trained.masking import figure_of_imputation, masked

pytest.importorskip("pyarrow")

SCHEMA = TableSchema(
    (Real("age", 40.0, 10.0), Binary("sex", ("f", "m")), Category("colour", ("blue", "green", "red")))
)


def rows(n: int, *, gaps: bool = False) -> Rows:
    r = rng.numpy_stream(0, f"rows {n}")
    v = np.stack((r.integers(0, 2, n), r.integers(0, 3, n), r.standard_normal(n)), axis=1)
    label = torch.full((n,), -1)
    observed = torch.from_numpy(r.random((n, 3)) > 0.3) if gaps else None
    kept = torch.from_numpy(v).float()
    return Rows(kept if observed is None else kept.where(observed, torch.zeros(())), label, observed)


def run_of(network: Any) -> Run:
    return Run(Path("run"), network, schema=SCHEMA)


def titles(figure: Any) -> list[str]:
    return [axes.get_title(loc="left") for axes in figure.axes if axes.get_title(loc="left")]


def test_a_run_is_shown_beside_data_and_held_out_data(monkeypatch: pytest.MonkeyPatch) -> None:
    given: dict[str, Any] = {}

    def keep(values: Any, **settings: Any) -> str:
        given.update(values=values, **settings)
        return "free energies"

    monkeypatch.setattr(figures_module, "plot_likelihoods", keep)
    rbm = RBM(visible=SCHEMA.units(), n_hidden=2)
    data = rows(50, gaps=True)._replace(weight=torch.arange(1.0, 51.0))
    found = figures_of(run_of(rbm), data, rows(30).v, heldout=rows(40))
    assert set(found) == {"marginals", "correlations", "plane", "free_energies"}
    assert {title.split(" ")[0] for title in titles(found["marginals"])} == {"age", "sex", "colour"}
    assert titles(found["plane"]) == ["data", "samples", "held-out data"]
    assert data.observed is not None
    whole = data.observed.all(-1)
    v = rbm.visible.encode(data.v[whole])
    np.testing.assert_allclose(given["values"]["data"], -rbm.free_energy(v).detach(), rtol=1e-6)
    assert given["weights"]["data"].tolist() == (whole.nonzero().flatten() + 1.0).tolist()
    assert len(given["values"]["samples"]) == 30
    assert len(given["values"]["held-out data"]) == 40


def test_a_stack_without_an_energy_has_no_free_energies() -> None:
    dbn = DBN(visible=SCHEMA.units(), hidden_sizes=[3, 2])
    assert set(figures_of(run_of(dbn), rows(20), rows(20).v)) == {"marginals", "correlations", "plane"}


def test_sequences_have_logos_with_the_letters_of_the_data(monkeypatch: pytest.MonkeyPatch) -> None:
    drawn: dict[str, Any] = {}

    def keep(tables: Any, *, alphabet: str) -> str:
        drawn.update(tables, alphabet=alphabet)
        return "logos"

    monkeypatch.setattr(figures_module, "plot_logo", keep)
    schema = SequenceSchema(4, "rna")
    run = Run(Path("run"), RBM(visible=schema.units(), n_hidden=2), schema=schema)
    v = torch.tensor([[0.0, 1, 2, 3], [0, 1, 2, 4]])
    data = Rows(v, torch.full((2,), -1), weight=torch.tensor([3.0, 1.0]))
    found = figures_of(run, data, v[:1])
    assert set(found) == {"marginals", "correlations", "plane", "free_energies", "logos", "state_frequencies"}
    assert drawn["alphabet"] == schema.letters
    assert drawn["data"][3].tolist() == [0, 0, 0, 0.75, 0.25]
    assert drawn["samples"][3].tolist() == [0, 0, 0, 1, 0]
    assert {title.split(" (")[0] for title in titles(found["marginals"])} == {f"site {k}" for k in (1, 2, 3, 4)}


def test_known_values_are_hidden_at_random() -> None:
    data = rows(2000, gaps=True)
    hidden = masked(data, 0.25, seed=1)
    assert data.observed is not None
    assert hidden.observed is not None
    assert not bool((hidden.observed & ~data.observed).any())
    share = 1 - hidden.observed.sum() / data.observed.sum()
    assert float(share) == pytest.approx(0.25, abs=0.03)
    assert not bool(hidden.v[~hidden.observed].any())
    assert masked(rows(9), seed=2).v.equal(masked(rows(9), seed=2).v)
    with pytest.raises(SettingError, match=r"expected a number in \(0, 1\)"):
        masked(data, 1.0)


class Found(NamedTuple):
    site: int
    row: Tensor
    value: Tensor
    states: Tensor | None = None
    probability: Tensor | None = None
    low: Tensor | None = None
    high: Tensor | None = None


def test_what_was_found_is_held_against_what_was_there(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(masking, "plot_imputation", lambda real, discrete: (real, discrete))
    v = torch.tensor([[1.0, 2, 0.5], [0, 1, -1], [0.25, 0, 0]])
    known = torch.tensor([[True, True, True], [True, True, True], [True, False, True]])
    truth = Rows(v, torch.full((3,), -1), known)
    number = torch.tensor
    gaps = [
        Found(0, number([0, 2]), number([0, 0]), number([0.0, 1]), number([[0.7, 0.3], [0.8, 0.2]])),
        Found(1, number([1, 2]), number([1, 1]), number([0.0, 1, 2]), number([[0.2, 0.5, 0.3], [0.0, 0.0, 1.0]])),
        Found(2, number([0, 1]), number([0.0, 1]), low=number([-1.0, 0]), high=number([1.0, 2])),
    ]
    figure: Any = figure_of_imputation(SCHEMA, truth, gaps)
    real, discrete = figure
    assert list(real) == ["age"]
    assert [cells.tolist() for cells in real["age"]] == [[45, 30], [40, 50], [30, 40], [50, 60]]
    # Of two states one counts; a grey value is partly both; nobody knows what was in a gap of the data.
    np.testing.assert_allclose(discrete.probability, [0.3, 0.2, 0.2, 0.5, 0.3], rtol=1e-6)
    assert discrete.outcome.tolist() == [1, 0.25, 0, 1, 0]
