"""The minima that ground states are compared with."""

import sys
from pathlib import Path

import pytest
import torch

sys.path.insert(0, str(Path(__file__).parents[3] / "experiments" / "units"))
import ground_states

from memcomp_lightning.models.units import Bernoulli, Categorical, Gaussian, Mixed, Spin, all_states

KINDS = {
    "Potts": (Categorical([2, 3]), Spin(3)),
    "mixed": (Mixed(Bernoulli(2), Categorical([3]), Gaussian(2)), Bernoulli(3)),
}


@pytest.mark.parametrize("kind", KINDS)
def test_the_minimum_is_that_of_all_states(kind):
    visible, hidden = KINDS[kind]
    rbm = ground_states.random_rbm(visible, hidden, 1.0, 0)
    discrete = all_states(Mixed(*visible.kinds[:2]) if kind == "mixed" else visible, rbm.b)
    energies = []
    for h in all_states(hidden, rbm.b):
        field = rbm.visible_field(h[None])
        v = discrete
        if kind == "mixed":
            real = (field[0, -2:] / rbm.visible.kinds[2].precision).expand(len(v), 2)
            v = torch.cat((v, real), dim=-1)
        energies.append(rbm.energy(v, h.expand(len(v), -1)))
    lowest = float(torch.stack(energies).min())
    assert ground_states.minimum(rbm) == pytest.approx(lowest, abs=1e-4)
    for label, sampler in ground_states.SAMPLERS.items():
        assert ground_states.found_by(rbm, sampler, 0).energy == pytest.approx(lowest, abs=1e-4), label
    assert ground_states.minimum(ground_states.random_rbm(visible, hidden, 1.0, 1)) != pytest.approx(
        lowest, abs=1e-2
    )
