"""Pictures of categories show the letters of the data's alphabet, unless they are told others."""

from functools import partial
from pathlib import Path
from typing import Any

import lightning.pytorch as pl
import pytest
import torch
from foreign import tensorboard
from matplotlib.figure import Figure

from memcomp_lightning.callbacks import (
    Logos,
    StateFrequencies,
    StateWeights,
    against_samples,
    logos,
    state_weights,
)
from memcomp_lightning.data import Sequences, TableDataModule
from memcomp_lightning.models import DBN
from memcomp_lightning.models.units import Categorical
from memcomp_lightning.modules import EnergyPretraining
from memcomp_lightning.plotting.rendering import rendered
from memcomp_lightning.samplers import CD
from memcomp_lightning.training import Greedy

pytest.importorskip("Bio")


@pytest.fixture
def data(tmp_path: Path) -> TableDataModule:
    path = tmp_path / "family.fasta"
    path.write_text(">a\nACGU-\n>b\nACGUU\n>c\nAC-NU\n")
    return TableDataModule(Sequences(path=str(path), test=str(path)).load(), batch_size=None)


def pictures(
    folder: Path, data: TableDataModule, callbacks: list[pl.Callback], monkeypatch: pytest.MonkeyPatch
) -> list[Figure]:
    """Train a network of two layers; the figures as they are rendered."""
    found: list[Figure] = []

    def kept(figure: Figure) -> Any:
        found.append(figure)
        return rendered(figure)

    for module in (against_samples, state_weights):
        monkeypatch.setattr(module, "rendered", kept)
    dbn = DBN(visible=data.units, hidden_sizes=[2, 2])
    module = EnergyPretraining(Greedy(dbn), CD(), iterations=1, optimizer=partial(torch.optim.SGD, lr=0.1))
    trainer = pl.Trainer(
        max_epochs=module.n_epochs,
        accelerator="cpu",
        logger=tensorboard(folder),
        callbacks=callbacks,
        enable_checkpointing=False,
        enable_progress_bar=False,
        enable_model_summary=False,
        num_sanity_val_steps=0,
        log_every_n_steps=1,
    )
    trainer.fit(module, datamodule=data)
    return found


def letters(figure: Figure) -> str:
    """At the vertical axis of the first panel."""
    return "".join(label.get_text() for label in figure.axes[0].get_yticklabels())


@pytest.mark.parametrize(("alphabet", "shown"), [(None, "ACGU-"), ("vwxyz", "vwxyz")])
def test_pictures_have_the_letters_of_the_data(
    tmp_path: Path,
    data: TableDataModule,
    monkeypatch: pytest.MonkeyPatch,
    alphabet: str | None,
    shown: str,
) -> None:
    drawn: list[str | None] = []
    plot = logos.plot_logo

    def kept(tables: Any, *, alphabet: str | None) -> Figure:
        drawn.append(alphabet)
        return plot(tables, alphabet=alphabet)

    monkeypatch.setattr(logos, "plot_logo", kept)
    small: dict[str, Any] = {"every": 1, "n_samples": 4, "n_sweeps": 2, "alphabet": alphabet}
    callbacks = [StateFrequencies(**small), StateWeights(every=1, alphabet=alphabet), Logos(**small)]
    frequencies, weights, _ = pictures(tmp_path, data, callbacks, monkeypatch)
    assert letters(frequencies) == letters(weights) == shown
    assert drawn == [shown]


def test_upper_layers_have_no_letters(data: TableDataModule) -> None:
    class Trainer:
        datamodule = data

    class Module:
        layer = 0

    trainer, module = Trainer(), Module()
    assert against_samples.schema_of_model(trainer, module) is not None  # type: ignore[arg-type]
    module.layer = 1
    assert against_samples.schema_of_model(trainer, module) is None  # type: ignore[arg-type]
    assert against_samples.letters_in(None) is None
    assert isinstance(data.units, Categorical)
