"""What the pictures of chains show."""

import torch
from foreign import TheirRBM

from memcomp_lightning.callbacks import ChainPictures
from memcomp_lightning.models import DBN
from memcomp_lightning.modules import EnergyPretraining
from memcomp_lightning.samplers import CD
from memcomp_lightning.training import Greedy
from memcomp_lightning.types import Configurations


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
