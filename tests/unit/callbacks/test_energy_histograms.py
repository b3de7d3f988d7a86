"""Histograms of energies: common bins, weights, and the picture."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from foreign import TheirRBM, events_in, fit, tensorboard

from memcomp_lightning.callbacks import EnergyHistograms
from memcomp_lightning.errors import SettingError
from memcomp_lightning.plotting import plot_histograms, rendered
from memcomp_lightning.samplers import Exact
from memcomp_lightning.types import NoState

pytestmark = [
    pytest.mark.filterwarnings("ignore:.*does not have many workers.*"),
    pytest.mark.usefixtures("allow_global_rng"),  # torch's DataLoader draws a base seed
]


class Weighted(TheirRBM):
    """Its negative phase, as the callbacks see it, is every state by its probability."""

    def training_step(self, batch: list[torch.Tensor], batch_idx: int) -> dict[str, Any]:
        outputs = super().training_step(batch, batch_idx)
        exact = Exact().sample(self.model, NoState(), outputs["positive"], generator=self.their_generator)
        self.outputs = {**outputs, "negative": exact.configurations}
        return self.outputs


def test_both_histograms_share_their_bins_and_configurations_count_by_weight(tmp_path: Path) -> None:
    module, _ = fit(tmp_path, [EnergyHistograms(every=2, n_bins=7)], tensorboard(tmp_path), Weighted())
    events = events_in(tmp_path)
    assert len(events.Histograms("Weighted/energies_data")) == 2  # passes 1 and 3
    data, model = (
        events.Histograms(f"Weighted/energies_{name}")[-1].histogram_value for name in ("data", "model")
    )
    positive, negative = module.outputs["positive"], module.outputs["negative"]
    with torch.no_grad():
        of_data = module.model.energy(positive.v, positive.h).double().numpy()
        of_model = module.model.energy(negative.v, negative.h).double().numpy()
    edges = np.linspace(*np.sort(np.concatenate((of_data, of_model)))[[0, -1]], 8)
    assert data.bucket_limit == model.bucket_limit
    np.testing.assert_allclose(data.bucket_limit[-7:], edges[1:])
    weights = negative.weight.double().numpy()
    np.testing.assert_allclose(data.bucket[-7:], np.histogram(of_data, edges)[0])
    np.testing.assert_allclose(
        model.bucket[-7:], 32 * np.histogram(of_model, edges, weights=weights)[0], rtol=1e-5
    )
    assert model.sum == pytest.approx(32 * (weights * of_model).sum(), rel=1e-5)
    assert len(events.Images("Weighted/energies")) == 2


def test_figure_shows_shares() -> None:
    figure = plot_histograms(np.arange(4.0), {"data": np.array([1, 2, 1]), "model": np.array([0, 0, 5])})
    heights = {patch.get_label(): patch.get_data().values.tolist() for patch in figure.axes[0].patches[1::2]}
    assert heights == {"data": [0.25, 0.5, 0.25], "model": [0, 0, 1]}
    pixels = rendered(figure)
    assert pixels.shape[-1] == 3
    assert pixels.std() > 0
    with pytest.raises(SettingError, match="counts = "):
        plot_histograms(np.arange(4.0), {})
