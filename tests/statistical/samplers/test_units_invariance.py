"""Chains that begin in the exact distribution of a model stay there, whatever its units. It needs no mixing."""

import pytest
import torch

from memcomp_lightning import rng
from memcomp_lightning.models import RBM
from memcomp_lightning.models.units import Gaussian, Spin
from memcomp_lightning.testing import enumerated, most_errors_off, small_machines, small_rbms

MODELS = {name: make for name, make in {**small_rbms(), **small_machines()}.items() if not make().hidden.real}
N, SWEEPS, MOST_ERRORS = 6000, 4, 6.5


@torch.no_grad()
def after_sweeps(model):
    """How far the moments of all units are from the exact ones, in standard errors."""
    exact, generator = enumerated(model), rng.stream(3, "invariance")
    at = torch.multinomial(exact.probability, N, replacement=True, generator=generator)
    noise = torch.empty(N, model.n_units).normal_(generator=generator)
    x = exact.x[at] + exact.variance.sqrt() * noise
    chains = model.chains()
    if isinstance(model, RBM):
        x = x[:, : model.n_visible]
    for _ in range(SWEEPS):
        x = chains.sweep(x, generator=generator)
    if isinstance(model, RBM):
        x = torch.cat((x, model.draw_hidden(x, generator=generator)), dim=-1)
    return most_errors_off(x, exact)


@pytest.mark.parametrize("name", MODELS)
def test_sweeps_leave_the_exact_distribution(name):
    assert after_sweeps(MODELS[name]()) < MOST_ERRORS


def test_spins_drawn_at_half_their_field_are_seen(monkeypatch):
    draw = Spin.sample
    monkeypatch.setattr(
        Spin, "sample", lambda self, field, *, generator: draw(self, field / 2, generator=generator)
    )
    assert after_sweeps(MODELS["spins x bits"]()) > MOST_ERRORS


def test_real_units_of_another_variance_are_seen(monkeypatch):
    draw = Gaussian.sample

    def wider(self, field, *, generator):
        mean = self.mean(field)
        return mean + 1.2 * (draw(self, field, generator=generator) - mean)

    monkeypatch.setattr(Gaussian, "sample", wider)
    assert after_sweeps(MODELS["real x bits"]()) > MOST_ERRORS
