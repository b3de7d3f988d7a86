"""Ten thousand visible sites: numbers stay finite and right in single precision."""

import copy

import pytest
import torch
from torch.utils._python_dispatch import TorchDispatchMode

from memcomp_lightning import rng
from memcomp_lightning.likelihood import log_likelihood, log_partition_function
from memcomp_lightning.models import RBM, Normal, start_at_means
from memcomp_lightning.models.units import Categorical, Gaussian, Mixed, ReLU, Spin
from memcomp_lightning.objective import contrast
from memcomp_lightning.samplers import CD, positive_phase

N = 10_000
LAYERS = {
    "categories of 21": (Categorical(N, q=21), Spin(5)),
    "categories and ReLU": (Categorical(N, q=21), ReLU(5)),
    "spins": (Spin(N), Spin(5)),
    "real": (Gaussian(N), Spin(5)),
    "mixed": (Mixed(Categorical(N // 2, q=21), Gaussian(N // 2)), Spin(5)),
}


@pytest.mark.parametrize(("visible", "hidden"), LAYERS.values(), ids=LAYERS)
def test_ten_thousand_sites(visible, hidden):
    generator = rng.stream(0, "test model")
    model = RBM(visible=visible, hidden=hidden, weight_init=Normal(std=0.05), generator=generator)
    with torch.no_grad():
        model.b.normal_(0.0, 1.0, generator=generator)
    v = model.visible.sample(model.b.expand(6, -1) * 0.5, generator=generator)
    with torch.no_grad():  # as after training: fields of a hundred
        model.weight[0] += 0.01 * v[0]
    start_at_means(model, v)
    wide = copy.deepcopy(model).double()
    h = model.draw_hidden(v, generator=generator)
    for found, true in (
        (model.energy(v, h), wide.energy(v.double(), h.double())),
        (model.free_energy(v), wide.free_energy(v.double())),
        (model.hidden_free_energy(h), wide.hidden_free_energy(h.double())),
    ):
        assert bool(found.isfinite().all())
        torch.testing.assert_close(found.double(), true, rtol=1e-4, atol=0)
    if not hidden.real:
        log_z = log_partition_function(model)
        torch.testing.assert_close(log_z, log_partition_function(wide))
        assert bool((log_likelihood(model, v, log_z) < 0).all()) or visible.real
    positive = positive_phase(model, v)
    negative = CD().sample(model, CD().init(model, 6, generator=generator), positive, generator=generator)
    loss = contrast(model, positive, negative.configurations)
    loss.backward()
    with torch.no_grad():
        for parameter in model.parameters():
            assert bool(parameter.grad.isfinite().all())
            parameter -= 1e-3 * parameter.grad
    model.project()
    assert bool(model.free_energy(v).isfinite().all())


class Largest(TorchDispatchMode):
    """The most numbers that a tensor made in the meantime holds."""

    numel = 0

    def __torch_dispatch__(self, function, types, args=(), kwargs=None):
        made = function(*args, **(kwargs or {}))
        if isinstance(made, torch.Tensor):
            self.numel = max(self.numel, made.numel())
        return made


def test_the_form_in_bits_of_ten_thousand_real_units_needs_no_square_of_them():
    """What is left are the couplings of five spins: W diag(1 / precision) W'."""
    model = RBM(visible=Gaussian(N, variance=0.5), hidden=Spin(5), weight_init=Normal(std=0.05))
    with Largest() as largest:
        form = model.in_bits()
    assert largest.numel <= model.weight.numel()
    pairs, coupling, _ = form.form
    expected = 4 * 0.5 * (model.weight @ model.weight.mT)
    torch.testing.assert_close(coupling, expected[pairs[:, 0], pairs[:, 1]].detach())
