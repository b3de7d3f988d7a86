"""Models of all kinds of units: the same numbers on another device, and no wait for it in an update."""

import pytest
import stand_in
import torch

from memcomp_lightning import rng
from memcomp_lightning.likelihood import (
    Ais,
    exact_samples,
    log_likelihood,
    log_partition_function,
    log_pseudo_likelihood,
)
from memcomp_lightning.models import RBM, start_at_means
from memcomp_lightning.objective import Centring, contrast
from memcomp_lightning.samplers import ClampedGibbs, ExactPosterior, MeanField
from memcomp_lightning.testing import small_machines, small_rbms

MODELS = small_rbms() | small_machines()
LAYERS = [
    "bits x spins",
    "spins x ReLU",
    "ragged categories x categories",
    "categories x bits",
    "real x bits",
    "mixed x spins",
    "bits x real",
]
MACHINES = ["spins, all pairs", "mixed", "categories alone", "DBM of mixed units"]


def numbers(name, device):
    """What a model on this device says, by names."""
    model = MODELS[name](replicas=(2,)).double().to(device)
    generator = rng.stream(0, "device")
    field = rng.uniform((2, 5, model.n_visible), generator=generator, like=model.b) - 0.5
    v = model.visible.sample(field, generator=generator)
    start_at_means(model, v)
    found = {"v": v, "b": model.b, "free energy": model.free_energy(v)}
    found["log Z"] = log_partition_function(model)
    found["log p"] = log_likelihood(model, v, found["log Z"])
    found["pseudo"] = log_pseudo_likelihood(model, v)
    negative = model.all_configurations()
    positive = negative._replace(v=v, h=model.hidden_mean(v).detach(), weight=None)
    for offsets in (None, Centring().follow(None, positive)):
        loss = contrast(model, positive, negative, offsets)
        gradients = torch.autograd.grad(loss.sum(), list(model.parameters()))
        found |= {f"gradient {number} {offsets is None}": one for number, one in enumerate(gradients)}
    known = torch.ones_like(v, dtype=torch.bool)
    last = model.visible.site_of() == model.visible.n_sites - 1
    known[..., 1:3, last.to(device)] = False
    samplers = [ClampedGibbs(k=2), MeanField()]
    pairs = model.quadratic_form().pairs
    apart = pairs is None or not bool((pairs < model.n_visible).all(-1).any())
    if apart and not model.hidden.real:
        samplers.append(ExactPosterior())
        found["log p of observed"] = log_likelihood(model, v, found["log Z"], observed=known)
    if model.hidden.real:
        samplers.pop()
    for sampler in samplers:
        phase = sampler.sample(model, v, observed=known, generator=generator).configurations
        found[f"{type(sampler).__name__} v"], found[f"{type(sampler).__name__} h"] = phase.v, phase.h
    chains = model.chains()
    x = chains.random(5, generator=generator)
    found["sweep"] = chains.sweep(x, beta=0.7, generator=generator)
    if isinstance(model, RBM):
        found["samples"] = exact_samples(model, 7, generator=generator)
        found["annealing"] = Ais(n_chains=5, n_betas=5).estimate(model, generator=generator).log_z
    model.project()
    return found


@pytest.mark.parametrize("name", [*LAYERS, *MACHINES])
def test_models_say_the_same_on_both_devices(name, device: str) -> None:
    here, there = numbers(name, "cpu"), numbers(name, device)
    for key, value in here.items():
        assert there[key].device.type == device, key
        torch.testing.assert_close(
            there[key].detach().cpu(), value.detach(), msg=lambda text, key=key: f"{key}: {text}"
        )


@pytest.mark.parametrize("name", LAYERS)
def test_the_host_waits_for_no_update_of_any_kind(name, device: str) -> None:
    if device != stand_in.NAME:
        pytest.skip("CUDA does not count for what the host waits")
    model = MODELS[name]().to(device)
    generator = rng.stream(0, "device", device=device)
    v = model.visible.sample(model.b.expand(5, -1), generator=generator)
    before = list(stand_in.waits)
    h = model.draw_hidden(v, generator=generator)
    positive = model.all_configurations()._replace(v=v, h=model.hidden_mean(v).detach(), weight=None)
    negative = positive._replace(v=model.draw_visible(h, generator=generator), h=h)
    for offsets in (None, Centring().follow(None, positive)):
        contrast(model, positive, negative, offsets).backward()
    model.project()
    assert stand_in.waits == before
