"""The same numbers on another device, and no update for which the host waits."""

import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial

import lightning.pytorch as pl
import numpy as np
import pytest
import stand_in
import torch

from memcomp_lightning import rng
from memcomp_lightning.data import Digits, ImageDataModule
from memcomp_lightning.enumeration import binary_states
from memcomp_lightning.likelihood import (
    Ais,
    ReverseAis,
    base_of,
    exact_samples,
    kl_divergence,
    log_partition_function,
    log_pseudo_likelihood,
)
from memcomp_lightning.models import DBN
from memcomp_lightning.modules import DBNClassifier, EnergyPretraining
from memcomp_lightning.objective import contrast
from memcomp_lightning.problems import Qubo, WeightedMaxSat, from_model
from memcomp_lightning.samplers import CD, PCD, Exact, GroundState, MeanField, Quench, positive_phase
from memcomp_lightning.solvers import AlternatingDescent, BruteForce
from memcomp_lightning.solvers.dmm import BondField, ClauseField, DmmSolver, Recording, WarmRestart
from memcomp_lightning.testing import small_dbm, small_machine, small_rbm
from memcomp_lightning.training import Greedy, evaluate, finetune, pretrain


@pytest.mark.parametrize(
    "sampler",
    [CD(k=3), PCD(k=2, n_chains=11), Exact(), Quench(n_chains=11), GroundState(solver=BruteForce())],
    ids=lambda sampler: type(sampler).__name__,
)
def test_samplers_draw_the_same_on_both_devices(sampler, device: str) -> None:
    answers = []
    for name in ("cpu", device):
        rbm = small_rbm(replicas=(3,)).double().to(name)
        v = rng.uniform((3, 11, 7), generator=rng.stream(1, "data"), like=rbm.b)
        generator = rng.stream(2, "negative_phase")
        state = sampler.init(rbm, 11, generator=generator)
        configurations = sampler.sample(rbm, state, positive_phase(rbm, v), generator=generator).configurations
        assert configurations.v.device.type == name
        answers.append([part.cpu() for part in configurations if part is not None])
    for cpu, cuda in zip(*answers, strict=True):
        torch.testing.assert_close(cuda, cpu)


@pytest.mark.parametrize(
    "solver",
    [
        AlternatingDescent(),
        DmmSolver(n_restarts=8, patience=7, max_steps=31, record=Recording()),
        DmmSolver(patience=7, max_steps=101, quench_every=0, warm=WarmRestart()),
        DmmSolver(field=BondField(), max_steps=101),
    ],
    ids=["descent", "records", "warm restarts", "bonds"],
)
def test_solvers_find_the_optimum_on_the_device(solver, device: str) -> None:
    matrix = torch.empty(2, 7, 7).normal_(generator=rng.stream(3, "matrix"))
    for qubo in (from_model(small_rbm(replicas=(3,)).to(device)), Qubo.from_matrix(matrix.to(device))):
        exact = BruteForce().minimise(qubo, generator=rng.stream(0, "unused")).best_energy
        solution = solver.minimise(qubo, generator=rng.stream(4, "solver"))
        assert solution.best.device.type == device
        torch.testing.assert_close(solution.best_energy, exact, rtol=1e-6, atol=1e-9)


@pytest.mark.parametrize(("field", "n_steps"), [(ClauseField(), 50), (ClauseField(), 150), (BondField(), 50)])
def test_the_host_runs_ahead_of_the_solver(field, n_steps: int, device: str) -> None:
    """Steps are never waited for: a quench is, once, and each eighth time whether all restarts are done."""
    if device != stand_in.NAME:
        pytest.skip("CUDA does not count for what the host waits")
    qubo = from_model(small_rbm(replicas=(3,)).to(device))
    solver = DmmSolver(field=field, n_restarts=5, max_steps=n_steps, quench_every=10, stall=None)
    solver.minimise(qubo, generator=rng.stream(4, "solver"))
    assert n_steps / 10 <= len(stand_in.waits) <= 1.1 * n_steps / 10 + 20


def test_clauses_of_any_length_are_solved_on_the_device(device: str) -> None:
    cpu = WeightedMaxSat.from_clauses(
        7,
        [[1, 2, 3], [-1, 4, -5], [2, -3, 6, 7], [-2, -4], [5, -6], [-7], [3, 5]],
        [1.0, 2.0, 1.5, 0.7, 0.4, 0.3, 1.0],
    )
    problem = cpu.alike(torch.zeros((), device=device))
    solution = DmmSolver(max_steps=101).minimise(problem, generator=rng.stream(4, "solver"))
    assert solution.best.device.type == device
    exact = cpu.energy(binary_states(7, like=cpu.unit)).min()
    np.testing.assert_allclose(solution.best_energy.cpu(), exact)


def test_training_runs_on_the_device(device: str) -> None:
    if device == stand_in.NAME:
        pytest.skip("Lightning knows no accelerator of this name")
    data = ImageDataModule(Digits().load(), batch_size=100, partitions=2)
    dbn = DBN(32, [7, 5], replicas=(2,))
    for module in (
        EnergyPretraining(Greedy(dbn), PCD(n_chains=11), iterations=2),
        DBNClassifier(dbn, iterations=2),
    ):
        trainer = pl.Trainer(
            max_epochs=module.n_epochs,
            accelerator=device,
            devices=1,
            logger=False,
            enable_checkpointing=False,
            enable_progress_bar=False,
        )
        trainer.fit(module, datamodule=data)
    assert evaluate(module.network, data.test_dataloader()).accuracy.shape == (2,)


def test_likelihoods_are_the_same_on_both_devices(device: str) -> None:
    answers = []
    for name in ("cpu", device):
        rbm = small_rbm(11, 13, replicas=(3,)).double().to(name)
        generator = rng.stream(2, "annealing")
        v = exact_samples(rbm, 31, generator=generator)
        up = Ais(n_chains=31, n_betas=53).estimate(rbm, generator=generator, base=base_of(v))
        down = ReverseAis(n_betas=53).estimate(rbm, v, generator=generator)
        exact = (log_partition_function(rbm), kl_divergence(rbm, v), log_pseudo_likelihood(rbm, v))
        assert all(part.device.type == name for part in (v, *up, *down, *exact))
        answers.append([part.cpu() for part in (v, *up, *down, *exact)])
    for cpu, cuda in zip(*answers, strict=True):
        torch.testing.assert_close(cuda, cpu)


@contextmanager
def _no_waiting(device: str) -> Iterator[None]:
    """Every synchronisation of host and device is an error."""
    if device == stand_in.NAME:
        before = list(stand_in.waits)
        yield
        assert stand_in.waits == before
        return
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message="Synchronization debug mode")  # a prototype, torch says
        torch.cuda.set_sync_debug_mode("error")
    try:
        yield
    finally:
        torch.cuda.set_sync_debug_mode("default")


@pytest.mark.parametrize("sampler", [CD(k=2), PCD(n_chains=11)], ids=["CD", "PCD"])
def test_the_host_waits_for_no_update(sampler, device: str) -> None:
    """A pass of many updates; the copy of its order joins the device's queue."""
    data = ImageDataModule(Digits().load(), batch_size=100, partitions=2)
    dbn = DBN(32, [7, 5], replicas=(2,)).to(device)
    network = DBNClassifier(dbn).network.to(device)
    batches = data.train_batches(0, 1).to(device)
    optimizer = partial(torch.optim.SGD, lr=0.1)
    passes = pretrain(Greedy(dbn), batches, sampler, iterations=2, optimizer=optimizer)
    for training in (passes, finetune(network, batches, iterations=2, optimizer=optimizer)):
        next(training)  # kernels are loaded
        with _no_waiting(device):
            next(training)


@pytest.mark.parametrize("make", [small_dbm, small_machine])
@pytest.mark.parametrize(
    "sampler",
    [CD(k=3), PCD(k=2, n_chains=11), Exact(), GroundState(solver=BruteForce())],
    ids=lambda sampler: type(sampler).__name__,
)
def test_machines_of_any_connectivity_draw_the_same_on_both_devices(sampler, make, device: str) -> None:
    answers = []
    for name in ("cpu", device):
        model = make(replicas=(3,)).double().to(name)
        v = rng.uniform((3, 11, model.n_visible), generator=rng.stream(1, "data"), like=model.b)
        generator = rng.stream(2, "negative_phase")
        positive = MeanField().sample(model, v, generator=generator).configurations
        state = sampler.init(model, 11, generator=generator)
        negative = sampler.sample(model, state, positive, generator=generator).configurations
        loss = contrast(model, positive, negative)
        parts = (*positive, *negative, loss.detach(), log_partition_function(model))
        assert all(part is None or part.device.type == name for part in parts)
        answers.append([part.cpu() for part in parts if part is not None])
    for cpu, cuda in zip(*answers, strict=True):
        torch.testing.assert_close(cuda, cpu)
