"""What the caller has switched on elsewhere changes no result."""

import contextlib
import warnings
from collections.abc import Callable, Iterator
from functools import partial
from typing import Any

import lightning.pytorch as pl
import numpy as np
import pytest
import torch

from memcomp_lightning import rng
from memcomp_lightning.data import BarsAndStripes, ImageDataModule
from memcomp_lightning.likelihood import (
    Ais,
    log_likelihood_or_bound,
    log_partition_function,
    log_pseudo_likelihood,
)
from memcomp_lightning.models import DBM, DBN, RBM, BatchNormReluNetwork, BoltzmannMachine, Normal
from memcomp_lightning.models.connectivity import grid
from memcomp_lightning.modules import BaselineClassifier, Classifier, DBNClassifier, EnergyPretraining, StageModule
from memcomp_lightning.objective import Centring, contrast
from memcomp_lightning.problems import from_model
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
    positive_phase,
)
from memcomp_lightning.solvers import AlternatingDescent, BruteForce, GibbsAnnealing
from memcomp_lightning.solvers.dmm import DmmSolver
from memcomp_lightning.training import Boltzmann, Greedy, Joint, evaluate


@contextlib.contextmanager
def default_dtype() -> Iterator[None]:
    before = torch.get_default_dtype()
    torch.set_default_dtype(torch.float64)
    try:
        yield
    finally:
        torch.set_default_dtype(before)


@contextlib.contextmanager
def deterministic() -> Iterator[None]:
    torch.use_deterministic_algorithms(True)
    try:
        yield
    finally:
        torch.use_deterministic_algorithms(False)


@contextlib.contextmanager
def warnings_are_errors() -> Iterator[None]:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        warnings.filterwarnings("ignore", ".*LeafSpec.*", FutureWarning)  # of Lightning's own
        yield


AMBIENT: dict[str, Callable[[], contextlib.AbstractContextManager[Any]]] = {
    "double precision by default": default_dtype,
    "no gradients": torch.no_grad,
    "inference mode": torch.inference_mode,
    "autocast": lambda: torch.autocast("cpu", torch.bfloat16),
    "deterministic algorithms": deterministic,
    "errors of numpy": lambda: np.errstate(all="raise"),
    "warnings are errors": warnings_are_errors,
    "another device by default": lambda: torch.device("meta"),
}


def sampled() -> list[torch.Tensor]:
    """Every sampler, on a model of each kind."""
    ground = GroundState(solver=BruteForce())
    samplers = [
        CD(k=2),
        PCD(n_chains=5),
        ParallelTempering(n_chains=5, n_temperatures=3),
        Exact(),
        Quench(n_chains=5),
        ground,
        GroundState(solver=DmmSolver(n_restarts=3, max_steps=20)),
        GroundState(solver=AlternatingDescent(n_restarts=3)),
        GroundState(solver=GibbsAnnealing(n_restarts=3, n_sweeps=5)),
        ModeAssisted(inner=PCD(n_chains=5), mode=ground, schedule=ModeSchedule(n_updates=1, p_max=0.5, delay=-99)),
    ]
    found = []
    for model in models():
        v = rng.uniform((*model.replicas, 7, model.n_visible), generator=rng.stream(0, "data"))
        positive = positive_phase(model, v)
        for sampler in samplers:
            generator = rng.stream(1, "negative_phase")
            state = sampler.init(model, 7, generator=generator)
            answer = sampler.sample(model, state, positive, generator=generator)
            found += [answer.configurations.v, answer.configurations.h]
            found.append(contrast(model, positive, answer.configurations).detach())
        if isinstance(model, BoltzmannMachine):
            for kind in (MeanField(), ClampedGibbs(k=2), ExactPosterior()):
                found.append(kind.sample(model, v, generator=rng.stream(2, "positive_phase")).configurations.h)
    return found


def models() -> list[Any]:
    settings: dict[str, Any] = {"weight_init": Normal(std=0.5)}
    return [
        RBM(5, 4, replicas=(2,), **settings),
        DBM(5, [3, 2], **settings),
        BoltzmannMachine(5, 3, **settings),
        BoltzmannMachine(6, 0, grid(2, 3), **settings),
    ]


def judged() -> list[torch.Tensor]:
    """Likelihoods, energies, free energies, ground states."""
    found = []
    for model in models():
        v = rng.bernoulli(
            torch.full((7, model.n_visible), 0.5, dtype=torch.float32, device="cpu"), generator=rng.stream(0, "v")
        )
        log_z = log_partition_function(model)
        found += [log_z, log_likelihood_or_bound(model, v, log_z), log_pseudo_likelihood(model, v)]
        found.append(model.free_energy(v.expand(*model.replicas, 7, -1)).detach())
        found.append(BruteForce().minimise(from_model(model), generator=rng.stream(0, "solver")).best_energy)
    found.append(Ais(n_chains=5, n_betas=7).estimate(models()[0], generator=rng.stream(0, "ais")).log_z)
    return found


def trained() -> list[torch.Tensor]:
    """Every stage under a trainer."""
    found: list[torch.Tensor] = []
    optimizer = partial(torch.optim.SGD, lr=0.5, momentum=0.5)
    settings: dict[str, Any] = {"iterations": 2, "optimizer": optimizer}
    dbn = DBN(9, [5, 4], weight_init=Normal(std=0.5))
    machine = BoltzmannMachine(9, 2, weight_init=Normal(std=0.5))
    modules: list[StageModule] = [
        EnergyPretraining(Greedy(dbn), PCD(n_chains=7), centring=Centring(rate=0.1), **settings),
        EnergyPretraining(Joint(dbn), CD(), **settings),
        DBNClassifier(dbn, n_classes=2, **settings),
        DBNClassifier(dbn, n_classes=2, units="batch_norm_relu", **settings),
        EnergyPretraining(Boltzmann(machine), CD(), **settings),
        BaselineClassifier(9, [5], n_classes=2, **settings),
        Classifier(BatchNormReluNetwork(9, [5], 2), loss="squared_error", **settings),
    ]
    for module in modules:
        data = ImageDataModule(BarsAndStripes().load(), batch_size=None)
        trainer = pl.Trainer(
            max_epochs=module.n_epochs,
            accelerator="cpu",
            logger=False,
            enable_checkpointing=False,
            enable_progress_bar=False,
            enable_model_summary=False,
            num_sanity_val_steps=0,
        )
        trainer.fit(module, datamodule=data)
        found += [parameter.detach() for parameter in module.parameters()]
        if isinstance(module, Classifier):
            found.append(evaluate(module.network, data.test_dataloader(), module.loss).accuracy)
    return found


WORK = [sampled, judged, trained]


@pytest.mark.parametrize("work", WORK)
@pytest.mark.parametrize("name", AMBIENT)
def test_changes_no_result(name: str, work: Callable[[], list[torch.Tensor]]) -> None:
    plain = work()
    with AMBIENT[name]():
        found = work()
    assert [x.dtype for x in found] == [x.dtype for x in plain]
    for one, other in zip(found, plain, strict=True):
        torch.testing.assert_close(one.cpu(), other, rtol=0, atol=0)


@pytest.mark.parametrize("work", WORK)
def test_nor_does_the_number_of_threads(work: Callable[[], list[torch.Tensor]], threads: Any) -> None:
    plain = work()
    with threads(2):
        found = work()
    for one, other in zip(found, plain, strict=True):
        torch.testing.assert_close(one, other)
