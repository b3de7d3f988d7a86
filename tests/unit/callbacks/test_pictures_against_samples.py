"""Pictures of samples against data in training: whose rows they show, and in which words."""

from pathlib import Path
from typing import Any

import lightning.pytorch as pl
import numpy as np
import pytest
import torch
from foreign import blank, tensorboard
from matplotlib.figure import Figure

from memcomp_lightning import rng
from memcomp_lightning.callbacks import FreeEnergyHistograms, SamplesAgainstData, StateFrequencies, against_samples
from memcomp_lightning.callbacks.against_samples import Seen, frequencies
from memcomp_lightning.data import ImageDataModule, ShiftingBars, TableDataModule
from memcomp_lightning.models import DBN, RBM
from memcomp_lightning.models.units import Categorical
from memcomp_lightning.modules import EnergyPretraining
from memcomp_lightning.samplers import CD
from memcomp_lightning.training import Greedy

pd = pytest.importorskip("pandas")

CHAINS: dict[str, Any] = {"every": 1, "n_samples": 9, "n_sweeps": 2}


@pytest.fixture
def drawn(monkeypatch: pytest.MonkeyPatch) -> list[Figure]:
    """The figures, as they are written to TensorBoard."""
    found: list[Figure] = []

    def keep(figure: Figure) -> Any:
        found.append(figure)
        return blank(figure)

    monkeypatch.setattr(against_samples, "rendered", keep)
    return found


class Spy(SamplesAgainstData):
    """Keeps what it is shown."""

    def figures(self, seen: Seen) -> dict[str, Figure]:
        self.seen = seen
        return {}


def people(n: int = 60, *, gaps: bool = True) -> Any:
    r = rng.numpy_stream(0, "people")
    table = pd.DataFrame(
        {"age": r.normal(40, 9, n), "sex": ["f", "m"] * (n // 2), "colour": ["red", "green", "blue"] * (n // 3)}
    )
    if gaps:
        table.loc[::2, "age"] = np.nan
    return table


def fit(folder: Path, data: Any, callback: pl.Callback, network: Any = None, n_passes: int = 1) -> None:
    network = RBM(visible=data.units, n_hidden=3, replicas=data.replicas) if network is None else network
    module = EnergyPretraining(Greedy(network), CD(), iterations=n_passes)
    trainer = pl.Trainer(
        max_epochs=n_passes * module.n_models,
        accelerator="cpu",
        logger=tensorboard(folder),
        callbacks=[callback],
        enable_checkpointing=False,
        enable_progress_bar=False,
        enable_model_summary=False,
        num_sanity_val_steps=0,
        log_every_n_steps=1,
    )
    trainer.fit(module, datamodule=data)


def titles(figure: Figure) -> list[str]:
    return [axes.get_title(loc="left") for axes in figure.axes if axes.get_title(loc="left")]


def test_a_table_is_drawn_in_its_columns_and_words(tmp_path: Path, drawn: list[Figure]) -> None:
    fit(tmp_path, TableDataModule.from_frame(people(), validation_fraction=0.2), SamplesAgainstData(**CHAINS))
    marginals, correlations, plane = drawn
    assert {title.split(" ")[0] for title in titles(marginals)} == {"age", "sex", "colour"}
    words = {label.get_text() for axes in marginals.axes for label in axes.get_xticklabels()}
    assert {"f", "m", "red", "green", "blue"} <= words
    named = correlations.axes[0].texts[0].get_text().split("\n")[1:]
    assert set(named) <= {"age", "sex", "colour=blue", "colour=green", "colour=red"}
    assert titles(plane) == ["data", "samples", "held-out data"]


def test_gaps_weights_and_held_out_rows_are_passed_on(tmp_path: Path) -> None:
    table = people().assign(w=np.arange(1.0, 61.0))
    data = TableDataModule.from_frame(table, columns={"weight": "w"}, validation_fraction=0.2, batch_size=20)
    fit(tmp_path, data, spy := Spy(**CHAINS))
    seen, heldout = spy.seen, spy.seen.heldout
    assert heldout is not None
    assert len(seen.samples.v) == 9
    for rows, kept, mask in (
        (seen.data, data.train[0], data.train_observed),
        (heldout, data.heldout[0], data.heldout_observed),
    ):
        assert rows.observed is not None
        assert mask is not None
        assert sorted(rows.v.tolist()) == sorted(kept.tolist())
        assert int(rows.observed.sum()) == int(mask.sum())
        assert rows.weight is not None
    assert data._train.weight is not None
    assert seen.data.weight is not None
    assert sorted(seen.data.weight.tolist()) == sorted(data._train.weight.tolist())


@pytest.mark.parametrize("kind", [SamplesAgainstData, FreeEnergyHistograms])
def test_of_several_replicas_the_first_is_drawn(tmp_path: Path, drawn: list[Figure], kind: Any) -> None:
    data = ImageDataModule(ShiftingBars(copies=2).load(), partitions=2)
    network = RBM(visible=data.units, n_hidden=3, replicas=(2,))
    with torch.no_grad():
        network.c[1] += 1e3  # of the second one the free energies are 3,000 nats away
    fit(tmp_path, data, kind(**CHAINS), network)
    if kind is FreeEnergyHistograms:
        (figure,) = drawn
        names = [text.get_text().partition(", mean ") for text in figure.axes[0].get_legend().get_texts()]
        assert [name for name, _, _ in names] == ["data", "samples", "held-out data"]
        assert all(abs(float(mean)) < 100 for _, _, mean in names)
    else:
        assert all(title.startswith("pixel ") for title in titles(drawn[0]))


def test_free_energies_are_those_of_complete_rows(tmp_path: Path, drawn: list[Figure], caplog: Any) -> None:
    data = TableDataModule.from_frame(people())
    fit(tmp_path, data, FreeEnergyHistograms(**CHAINS))
    assert len(drawn) == 1
    table = people()
    table.loc[1::2, "colour"] = None
    with caplog.at_level("INFO", logger="memcomp_lightning"):
        fit(tmp_path, TableDataModule.from_frame(table), FreeEnergyHistograms(**CHAINS))
    assert len(drawn) == 1
    assert "none is complete" in caplog.text


def test_upper_layers_have_no_columns(tmp_path: Path, drawn: list[Figure]) -> None:
    data = TableDataModule.from_frame(people(gaps=False))
    dbn = DBN(visible=data.units, hidden_sizes=[3, 2])  # as many units in the second layer as there are columns
    fit(tmp_path, data, SamplesAgainstData(**CHAINS), dbn)
    first, second = titles(drawn[0]), titles(drawn[3])
    assert {title.split(" ")[0] for title in first} == {"age", "sex", "colour"}
    assert {" ".join(title.split(" ")[:2]) for title in second} == {"unit 0", "unit 1", "unit 2"}
    assert {label.get_text() for axes in drawn[3].axes for label in axes.get_xticklabels()} <= {"0", "1", ""}


def test_chains_that_run_away_are_said_to(
    tmp_path: Path, drawn: list[Figure], monkeypatch: Any, caplog: Any
) -> None:
    monkeypatch.setattr(against_samples, "fresh_chains", lambda model, n, *_: torch.full((n, 12), torch.inf))
    with caplog.at_level("INFO", logger="memcomp_lightning"):
        fit(tmp_path, ImageDataModule(ShiftingBars(copies=1).load()), SamplesAgainstData(**CHAINS))
    assert not drawn
    assert "SamplesAgainstData is left out: the chains ran away to infinity" in caplog.text


def test_rows_count_by_weight() -> None:
    units = Categorical([2])
    v = units.encode(torch.tensor([[0], [1], [1]]))
    weight = torch.tensor([3.0, 1.0, 1.0])
    assert frequencies(units, v, None, weight)[0].tolist() == pytest.approx([0.6, 0.4])
    observed = torch.tensor([[True, True], [True, True], [False, False]])
    assert frequencies(units, v, observed, weight)[0].tolist() == pytest.approx([0.75, 0.25])
    assert StateFrequencies(every=3).every == 3
