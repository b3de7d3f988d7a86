"""Pictures: which passes are looked at, and what the chains' pictures show."""

from pathlib import Path

import pytest
import torch
from foreign import PREFIX, TheirRBM, events_in, fit, tensorboard

from memcomp_lightning.callbacks import ChainPictures, ModelSamples
from memcomp_lightning.models import DBN
from memcomp_lightning.modules import EnergyPretraining
from memcomp_lightning.samplers import CD
from memcomp_lightning.training import Greedy
from memcomp_lightning.types import Configurations


@pytest.mark.filterwarnings("ignore:.*does not have many workers.*")
@pytest.mark.usefixtures("allow_global_rng")  # torch's DataLoader draws a base seed
@pytest.mark.parametrize(("every", "expected"), [(1, 5), (2, 3), (3, 3), (10, 2)])
def test_first_and_last_pass_have_a_picture(tmp_path: Path, every: int, expected: int) -> None:
    callbacks = [ChainPictures(every=every, n_chains=2), ModelSamples(every=every, n_samples=2, n_sweeps=1)]
    fit(tmp_path, callbacks, tensorboard(tmp_path), TheirRBM(), n_passes=5)
    for tag in ("chains", "samples"):
        assert len(events_in(tmp_path).Images(f"{PREFIX}/{tag}")) == expected


def test_chains_are_the_negative_phase_the_heaviest_first() -> None:
    v = torch.eye(6)[:4]
    callback = ChainPictures(n_chains=3)
    outputs = {"negative": Configurations(v, torch.zeros(4, 5))}
    assert callback.tiles(TheirRBM(), outputs).equal(v)
    outputs = {"negative": Configurations(v, torch.zeros(4, 5), torch.tensor([0.1, 0.0, 0.7, 0.2]))}
    assert callback.tiles(TheirRBM(), outputs).equal(v[[2, 3, 0]])


def test_chains_of_an_upper_layer_are_projected_to_the_inputs() -> None:
    class SecondLayer(EnergyPretraining):
        layer = 1

    module = SecondLayer(Greedy(DBN(6, [4, 3])), CD(), iterations=1)
    v = torch.eye(4)[:2]
    tiles = ChainPictures().tiles(module, {"negative": Configurations(v, torch.zeros(2, 3))})
    assert tiles.equal(module.network[0].visible_mean(v).detach())
