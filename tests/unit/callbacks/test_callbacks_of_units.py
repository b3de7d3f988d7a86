"""Every callback with units of every kind: what it shows, and what it leaves out."""

import logging
from functools import partial
from pathlib import Path
from typing import Any

import lightning.pytorch as pl
import numpy as np
import pytest
import torch
from foreign import blank, events_in, tensorboard

from memcomp_lightning import callbacks, rng
from memcomp_lightning.callbacks import against_samples
from memcomp_lightning.callbacks.against_samples import by_site, frequencies
from memcomp_lightning.callbacks.sampler_diagnostics import _changed
from memcomp_lightning.data import ImageDataModule, ShiftingBars
from memcomp_lightning.errors import SettingError
from memcomp_lightning.models import RBM
from memcomp_lightning.models.units import Bernoulli, Categorical, Gaussian, Mixed, Spin, Units
from memcomp_lightning.modules import EnergyPretraining
from memcomp_lightning.plotting import plot_densities, plot_logo, plot_state_frequencies, plot_state_weights
from memcomp_lightning.plotting.logo import letter_heights
from memcomp_lightning.samplers import PCD
from memcomp_lightning.training import DivergedError, Greedy

OF_ALL = {"energies", "marginals", "correlations", "plane", "free_energies"}
PICTURES = OF_ALL | {"receptive_fields", "samples", "chains"}
OF_CATEGORIES = {"state_frequencies", "state_weights", "logos"}
CASES: dict[str, tuple[Units, Units, set[str]]] = {
    "spins": (Spin(9), Spin(4), PICTURES | {"trajectory"}),
    "categories": (Categorical(9, q=2), Bernoulli(4), PICTURES | OF_CATEGORIES),
    "real": (Gaussian(9), Bernoulli(4), PICTURES | {"densities", "trajectory"}),
    "mixed": (
        Mixed(Bernoulli(3), Categorical([2, 2, 3]), Gaussian(3)),
        Spin(4),
        OF_ALL | {"densities"} | OF_CATEGORIES,
    ),
}


@pytest.fixture(autouse=True)
def _no_pixels(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(against_samples, "rendered", blank)


class Kept(Mixed):
    """Grey values as they are, in each of the parts."""

    def from_intensity(self, v: torch.Tensor) -> torch.Tensor:
        return v


def all_callbacks() -> list[pl.Callback]:
    return [
        callbacks.ReconstructionError(),
        callbacks.FreeEnergyGap(),
        callbacks.LogLikelihood(every=1),
        callbacks.NegativePhaseEnergies(),
        callbacks.SamplerDiagnostics(),
        callbacks.EnergyHistograms(every=1),
        callbacks.GradientBias(every=1),
        callbacks.ParameterHistograms(every=1),
        callbacks.ReceptiveFields(every=1),
        callbacks.ModelSamples(every=1, n_samples=4, n_sweeps=3),
        callbacks.ChainPictures(every=1, n_chains=4),
        callbacks.StateFrequencies(every=1, n_samples=9, n_sweeps=3),
        callbacks.StateWeights(every=1),
        callbacks.Logos(every=1, n_samples=9, n_sweeps=3),
        callbacks.Densities(every=1, n_samples=9, n_sweeps=3),
        callbacks.SamplesAgainstData(every=1, n_samples=9, n_sweeps=3, n_panels=2),
        callbacks.FreeEnergyHistograms(every=1, n_samples=9, n_sweeps=3),
        callbacks.TrajectoryFigure(every=1),
        callbacks.SaturationGuard(),
    ]


def fit(
    folder: Path, visible: Units, hidden: Units, own: list[pl.Callback], logger: Any = False
) -> EnergyPretraining:
    units = Kept(*visible.kinds) if isinstance(visible, Mixed) else visible
    data = ImageDataModule(ShiftingBars(copies=3).load(), batch_size=9, units=units)
    rbm = RBM(visible=units, hidden=hidden)
    optimizer = partial(torch.optim.SGD, lr=0.05)
    module = EnergyPretraining(Greedy(rbm), PCD(n_chains=5), iterations=2, optimizer=optimizer)
    trainer = pl.Trainer(
        max_epochs=2,
        accelerator="cpu",
        logger=logger,
        callbacks=own,
        enable_checkpointing=False,
        enable_progress_bar=False,
        enable_model_summary=False,
        default_root_dir=folder,
        num_sanity_val_steps=0,
        log_every_n_steps=1,
    )
    trainer.fit(module, datamodule=data)
    return module


@pytest.mark.parametrize("name", CASES)
def test_pictures_and_numbers_of_each_kind(tmp_path: Path, name: str, caplog: pytest.LogCaptureFixture) -> None:
    visible, hidden, pictures = CASES[name]
    with caplog.at_level(logging.INFO, logger="memcomp_lightning"):
        watched = fit(tmp_path, visible, hidden, all_callbacks(), tensorboard(tmp_path))
    tags = events_in(tmp_path).Tags()
    assert set(tags["images"]) == {f"pretrain/layer1/{tag}" for tag in pictures}
    changed = {"spins": "sites_changed", "categories": "sites_changed"}.get(name)
    scalars = {tag.removeprefix("pretrain/layer1/") for tag in tags["scalars"]}
    assert {"reconstruction_error", "log_likelihood_heldout", "free_energy_gap", "gradient_bias/cosine"} <= scalars
    assert {tag for tag in scalars if tag.endswith("_changed")} == (
        {f"negative_phase/{changed}"} if changed else set()
    )
    left_out = {
        record.getMessage().split(" ")[0] for record in caplog.records if "left out" in record.getMessage()
    }
    assert ("TrajectoryFigure" in left_out) == ("trajectory" not in pictures)
    assert ("ModelSamples" in left_out) == ("samples" not in pictures)
    assert sum("ModelSamples is left out" in text for text in caplog.messages) <= 1
    alone = fit(tmp_path, visible, hidden, [])
    assert all(a.equal(b) for a, b in zip(watched.parameters(), alone.parameters(), strict=True))


def test_spins_are_drawn_as_black_and_white(tmp_path: Path) -> None:
    """The chains of spins have the picture of the bits that they stand for."""
    v = torch.tensor([[0.0, 1.0]]).repeat(3, 1)
    assert Spin(2).to_intensity(Spin(2).from_intensity(v)).equal(v)
    assert not Spin(2).from_intensity(v).equal(v)


def test_frequencies_are_counts() -> None:
    units = Mixed(Bernoulli(1), Categorical([2, 3]))
    kind = Categorical([2, 3])
    states = torch.tensor([[0, 2], [1, 2], [1, 0], [1, 2]])
    v = torch.cat((torch.ones(4, 1), kind.encode(states)), dim=-1)
    found = frequencies(units, v)
    assert found[0, :2].tolist() == [0.25, 0.75]
    assert found[1].tolist() == [0.25, 0.0, 0.75]
    assert bool(found[0, 2].isnan())
    observed = units.over_sites(torch.tensor([[True, True, True], *[[True, False, True]] * 3]))
    assert frequencies(units, v, observed)[0, :2].tolist() == [1.0, 0.0]
    assert by_site(units, v).shape == (4, 2, 3)


def test_sites_that_changed() -> None:
    units = Categorical([2, 3])
    before, after = units.encode(torch.tensor([[0, 0], [1, 2]])), units.encode(torch.tensor([[0, 1], [1, 0]]))
    assert _changed(units, after, before)["sites_changed"].item() == 0.5
    assert _changed(Gaussian(5), after, before) == {}
    assert _changed(Bernoulli(5), after, before)["bits_changed"].item() == pytest.approx(0.4)


@pytest.mark.parametrize(("h", "stuck"), [(1.0, True), (-1.0, True), (0.0, False)])
def test_hidden_spins_are_stuck_at_both_ends(tmp_path: Path, h: float, stuck: bool) -> None:
    guard = callbacks.SaturationGuard(patience=1)
    monkey = pytest.MonkeyPatch()
    monkey.setattr(Spin, "mean", lambda self, field: torch.full_like(field, h))
    try:
        if stuck:
            with pytest.raises(DivergedError, match="within 1e-06 of an end"):
                fit(tmp_path, Bernoulli(9), Spin(4), [guard])
        else:
            fit(tmp_path, Bernoulli(9), Spin(4), [guard])
    finally:
        monkey.undo()


def test_letters_are_as_high_as_their_information() -> None:
    p = np.array([[1.0, 0.0, 0.0, 0.0], [0.25] * 4, [0.5, 0.5, np.nan, np.nan]])
    heights = letter_heights(p)
    np.testing.assert_allclose(heights[0], [2, 0, 0, 0], atol=1e-12)
    np.testing.assert_allclose(heights[1], 0, atol=1e-12)
    np.testing.assert_allclose(heights[2, :2], 0, atol=1e-12)  # of two states, one bit at most
    figure = plot_logo({"data": p, "samples": p}, alphabet="ACG-")
    assert len(figure.axes) == 2
    assert len(figure.axes[0].patches) == 1  # of the first site the one letter, of the others none
    with pytest.raises(SettingError, match="expected at least 4 letters"):
        plot_logo({"data": p}, alphabet="AC")


def test_figures_show_what_they_are_given() -> None:
    data = np.array([[0.2, 0.8], [0.5, 0.5]])
    figure = plot_state_frequencies(data, data[::-1], title="a title")
    shown = [axes.images[0].get_array() for axes in figure.axes if axes.images]
    np.testing.assert_allclose(shown[0], data.T)
    np.testing.assert_allclose(shown[2], (data[::-1] - data).T)
    assert len(plot_state_weights(np.ones((3, 2, 40)), ["a", "b", "c"]).axes) == 4
    values = rng.uniform((100, 2), generator=rng.stream(0, "values")).numpy()
    values[:50, 0] = np.nan
    panels = plot_densities(values, values, ["x", "y"], n_bins=5).axes
    for axes in panels:
        heights, edges, _ = axes.patches[0].get_data()
        assert 0.95 <= float((heights * np.diff(edges)).sum()) <= 1.0
