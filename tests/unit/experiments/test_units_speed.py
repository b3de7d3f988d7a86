"""The loops by hand do the updates that they are timed for."""

import sys
from pathlib import Path

import pytest
import torch

sys.path.insert(0, str(Path(__file__).parents[3] / "experiments" / "units"))
import speed


@pytest.mark.parametrize("sampler", speed.SAMPLERS)
@pytest.mark.parametrize("name", speed.CASES)
def test_the_loop_by_hand_ends_at_our_weights(name, sampler):
    units = speed.CASES[name][True]()
    v = speed.data_of(units, 300)
    rbm = speed.ours(units, 20, sampler, v)[1][0]
    model = speed.theirs(units, 20, sampler, v, speed.inversion)[1]
    for ours, theirs in ((rbm.weight, model.weight), (rbm.b, model.b), (rbm.c, model.c)):
        torch.testing.assert_close(ours.detach(), theirs, rtol=0, atol=1e-5)
    if name == "Gaussian":
        torch.testing.assert_close(rbm.visible.precision.detach(), model.precision, rtol=0, atol=1e-5)
    other = "PCD-1" if sampler == "CD-1" else "CD-1"
    different = speed.theirs(units, 20, other, v, speed.inversion)[1]
    assert (rbm.weight.detach() - different.weight).abs().max() > 1e-4


@pytest.mark.parametrize("draw", speed.DRAWS)
def test_states_are_drawn_by_their_probabilities(draw):
    field = torch.tensor([0.0, 1.0, -1.0]).expand(200, 100, 3).contiguous()
    state = speed.DRAWS[draw](field, torch.Generator().manual_seed(1))
    share = torch.bincount(state.flatten(), minlength=3) / state.numel()
    torch.testing.assert_close(share, field[0, 0].softmax(-1), rtol=0, atol=5 * 0.5 / 20000**0.5)
