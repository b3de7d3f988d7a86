"""For what the host waits in the work that experiments/accelerator times: counted, line by line."""

import sys
from functools import partial
from pathlib import Path

import pytest
import stand_in
import torch
from torch.optim import SGD

from memcomp_lightning import rng
from memcomp_lightning.data import Batches
from memcomp_lightning.models import DBN
from memcomp_lightning.objective import Centring
from memcomp_lightning.samplers import PCD, Exact, ParallelTempering, PseudoLikelihood, Quench
from memcomp_lightning.training import GroupSparsity, MomentumSchedule, PhaseTraining
from memcomp_lightning.training.stages import Greedy

sys.path.append(str(Path(__file__).parents[2] / "experiments" / "accelerator"))
import waits
from work import QUICK, WORKS

# A solve: whether there are zeros among the couplings, the polarities' way to the device and, where an axis of
# problems is added, whether all is finite; then at each reading whether its descent is done.
OF_SOLVES = {"dmm_many": 2 + QUICK.steps + 1, "dmm_large": 3 + QUICK.steps + 1}


@pytest.mark.parametrize("name", [name for name in WORKS if not name.endswith("_kernel")])
def test_the_host_waits_for_nothing_but_the_ends_of_descents(name, device):
    piece = WORKS[name].start(device, QUICK)
    piece()
    found = waits.counted(piece, device)
    if device == stand_in.NAME:
        assert sum(found.values()) == OF_SOLVES.get(name, 0), found
    elif not name.endswith("host_draws"):  # a copy from pageable memory may wait, which is CUDA's own business
        assert sum(found.values()) <= OF_SOLVES.get(name, 0), found


@pytest.mark.parametrize(
    "settings",
    [
        {"sampler": ParallelTempering(n_chains=5, n_temperatures=3)},
        {"sampler": Exact()},
        {"sampler": Quench(n_chains=5)},
        {"sampler": PseudoLikelihood()},
        {"sampler": PCD(n_chains=5), "centring": Centring(), "schedules": [MomentumSchedule()]},
        {"sampler": PCD(n_chains=5), "penalties": [GroupSparsity(0.1)]},
        {"sampler": PCD(n_chains=5), "weight": torch.arange(1.0, 31)},
    ],
    ids=["tempering", "exact", "quench", "pseudo-likelihood", "centred", "penalty", "weights"],
)
def test_the_host_waits_for_no_pass(settings, device):
    """Not even for its order, nor where random numbers come from the host, as they do under Lightning."""
    settings = {"centring": None, "weight": None} | settings
    weight = settings.pop("weight")
    v = rng.bernoulli(torch.full((30, 8), 0.5), generator=rng.stream(0, "images"))
    label, plan = (
        torch.zeros(30, dtype=torch.long),
        {"batch_size": 10, "chunk_size": 10, "shuffle": True, "seed": 0},
    )
    batches = Batches(v, label, weight=weight, **plan).to(device)
    phase, streams = Greedy(DBN(8, [6]).to(device)).phases[0], rng.streams(0, ("negative_phase", "positive_phase"))
    loop = PhaseTraining(phase, optimizer=partial(SGD, lr=0.1), streams=streams, **settings)
    loop.run_pass(batches)
    found = waits.counted(lambda: loop.run_pass(batches), device)
    if device == stand_in.NAME:
        assert not found


def test_a_wait_is_counted_with_its_line(device):
    x = torch.full((3,), 2.0, device=device)
    found = waits.counted(lambda: [float(x.sum()) for _ in range(4)], device)
    assert sum(found.values()) == 4
    assert Path(__file__).name in str(found)
