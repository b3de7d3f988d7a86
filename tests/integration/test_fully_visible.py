"""Machines without hidden units, and other small ones: the simplest Boltzmann machines train like all others."""

import json
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import lightning.pytorch as pl
import pytest
import torch
from running import Outcome

from memcomp_lightning import rng
from memcomp_lightning.data import ImageData, ImageDataModule, PixelLayout, ShiftingBars
from memcomp_lightning.enumeration import binary_states
from memcomp_lightning.likelihood import (
    kl_divergence,
    log_likelihood,
    log_partition_function,
    log_pseudo_likelihood,
)
from memcomp_lightning.models import BoltzmannMachine, Normal
from memcomp_lightning.models.connectivity import grid
from memcomp_lightning.modules import EnergyPretraining
from memcomp_lightning.objective import Centring
from memcomp_lightning.samplers import (
    CD,
    PCD,
    ClampedGibbs,
    Exact,
    ExactPosterior,
    GroundState,
    MeanField,
    ModeAssisted,
    ModeSchedule,
    ParallelTempering,
    Quench,
)
from memcomp_lightning.solvers import AlternatingDescent, BruteForce
from memcomp_lightning.testing import check_sampler
from memcomp_lightning.training import Boltzmann, LearningRateDecay, pretrain

Run = Callable[..., Outcome]

GROUND = GroundState(solver=BruteForce())
SAMPLERS: dict[str, Any] = {
    "CD": CD(),
    "PCD": PCD(n_chains=9),
    "tempering": ParallelTempering(n_chains=3, n_temperatures=3),
    "exact": Exact(),
    "quench": Quench(n_chains=9),
    "ground state": GROUND,
    "ground state by descent": GroundState(solver=AlternatingDescent(n_restarts=5)),
    "mode-assisted": ModeAssisted(
        inner=PCD(n_chains=9), mode=GROUND, schedule=ModeSchedule(n_updates=9, p_max=1.0)
    ),
}
MACHINES: dict[str, Callable[..., BoltzmannMachine]] = {
    "fully visible": partial(BoltzmannMachine, 9, 0, weight_init=Normal(std=0.3)),
    "a grid": partial(BoltzmannMachine, 9, 0, grid(3, 3), weight_init=Normal(std=0.3)),
    "a hidden unit without pairs": partial(BoltzmannMachine, 9, 2, [(unit, 9) for unit in range(9)]),
    "one hidden unit": partial(BoltzmannMachine, 9, 1),
}
TINY: dict[str, Callable[..., BoltzmannMachine]] = {
    "one unit": partial(BoltzmannMachine, 1, 0),
    "one visible unit": partial(BoltzmannMachine, 1, 2),
    "two visible units": partial(BoltzmannMachine, 2, 0),
}


def fit(model: BoltzmannMachine, sampler: Any, data: ImageDataModule, **settings: Any) -> EnergyPretraining:
    optimizer = partial(torch.optim.SGD, lr=0.5)
    module = EnergyPretraining(Boltzmann(model), sampler, **{"iterations": 3, "optimizer": optimizer, **settings})
    trainer = pl.Trainer(
        max_epochs=module.n_epochs,
        accelerator="cpu",
        logger=False,
        enable_checkpointing=False,
        enable_progress_bar=False,
        enable_model_summary=False,
    )
    trainer.fit(module, datamodule=data)
    return module


def bars(**settings: Any) -> ImageDataModule:
    return ImageDataModule(ShiftingBars().load(), **{"batch_size": None, **settings})


@pytest.mark.parametrize("centring", [None, Centring(rate=0.1)], ids=["plain", "centred"])
@pytest.mark.parametrize("sampler", SAMPLERS.values(), ids=SAMPLERS)
@pytest.mark.parametrize("name", MACHINES)
def test_trains(name: str, sampler: Any, centring: Centring | None) -> None:
    model = MACHINES[name]()
    before = [parameter.detach().clone() for parameter in (model.coupling, model.b)]
    fit(model, sampler, bars(), centring=centring)
    for old, new in zip(before, (model.coupling, model.b), strict=True):
        assert bool(new.isfinite().all())
        assert not new.equal(old)


@pytest.mark.parametrize(
    "positive", [MeanField(), ClampedGibbs(), ExactPosterior()], ids=lambda p: type(p).__name__
)
def test_every_positive_phase_of_no_hidden_units_is_the_data(positive: Any) -> None:
    model, v = MACHINES["fully visible"](replicas=(2,)), rng.uniform((2, 5, 9), generator=rng.stream(0, "data"))
    found = positive.sample(model, v, generator=rng.stream(1, "positive")).configurations
    assert found.v.equal(v)
    assert found.h.shape == (2, 5, 0)


def test_learns_the_maximum_of_the_likelihood() -> None:
    """There pairs of units are on together as often as in the data (Ackley, Hinton & Sejnowski 1985)."""
    model, data = BoltzmannMachine(9, 0), bars()
    optimizer = partial(torch.optim.Adam, lr=0.1)
    stage, falls = Boltzmann(model), [LearningRateDecay(600)]  # Adam would go on to swing about the maximum
    batches = data.train_batches(0, 1)
    for _ in pretrain(stage, batches, Exact(), iterations=600, optimizer=optimizer, schedules=falls):
        pass
    v = data.images.train_v
    states = binary_states(9, like=v)
    p = log_likelihood(model, states, log_partition_function(model)).exp().float()
    assert float(p.sum()) == pytest.approx(1, abs=1e-5)
    torch.testing.assert_close((states.mT * p) @ states, v.mT @ v / len(v), rtol=0, atol=0.02)
    assert float(kl_divergence(model, v)) < 0.1


@pytest.mark.parametrize("name", [*MACHINES, "one unit", "one visible unit", "two visible units"])
def test_likelihood_and_pseudo_likelihood_are_those_of_enumeration(name: str) -> None:
    model = {**MACHINES, **TINY}[name](replicas=(2,))
    with torch.no_grad():
        for parameter in model.parameters():
            parameter.copy_(rng.uniform(parameter.shape, generator=rng.stream(0, "parameters")) - 0.5)
    v, h = binary_states(model.n_visible, like=model.b), binary_states(model.n_hidden, like=model.b)
    joint = torch.cat((v.repeat_interleave(len(h), 0), h.repeat(len(v), 1)), dim=-1).expand(2, -1, -1)
    minus_energy = -model.energy(*joint.split((model.n_visible, model.n_hidden), dim=-1)).double()
    log_p = torch.log_softmax(minus_energy, -1).unflatten(-1, (len(v), len(h))).logsumexp(-1)
    found = log_likelihood(model, v, log_partition_function(model))
    torch.testing.assert_close(found, log_p, rtol=1e-5, atol=1e-5)
    flips = 2 ** torch.arange(model.n_visible - 1, -1, -1)
    other = log_p[:, torch.arange(len(v)).unsqueeze(-1) ^ flips]
    expected = log_p.unsqueeze(-1) - torch.logaddexp(log_p.unsqueeze(-1), other)
    torch.testing.assert_close(log_pseudo_likelihood(model, v), expected, rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize("sampler", SAMPLERS.values(), ids=SAMPLERS)
@pytest.mark.parametrize("make", TINY.values(), ids=TINY)
def test_samplers_keep_their_contract_on_tiny_machines(make: Any, sampler: Any) -> None:
    check_sampler(sampler, make=make)


@pytest.mark.parametrize("sampler", [CD(), PCD(n_chains=3), Exact()], ids=["CD", "PCD", "exact"])
@pytest.mark.parametrize("name", TINY)
def test_one_image_is_enough(name: str, sampler: Any) -> None:
    model = TINY[name]()
    v = torch.ones(1, model.n_visible)
    images = ImageData(
        v, torch.zeros(1).long(), v, torch.zeros(1).long(), 2, PixelLayout(1, model.n_visible), "one"
    )
    fit(model, sampler, ImageDataModule(images, batch_size=None), centring=Centring())
    assert bool((model.b > 0).all()) or sampler.uses_data


def test_from_the_command_line_with_all_callbacks(memcomp_train: Run) -> None:
    outcome = memcomp_train(
        "model=boltzmann",
        "model.n_hidden=0",
        "pretrain=boltzmann",
        "finetune.iterations=0",
        "data=shifting_bars",
        "sampler=pcd",
        "pretrain.iterations=2",
        "callbacks=diagnostics_exact",
        "hydra.run.dir=run",
    )
    assert outcome.status == 0, outcome.err
    assert json.loads(Path("run/result.json").read_text())["stages"]["pretrain"]["passes"] == [2]
    again = BoltzmannMachine(9, 0)
    again.load_state_dict(torch.load("run/weights/pretrain.pt", weights_only=True))
