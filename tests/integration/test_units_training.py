"""Units of every kind from the command line: all ways of pretraining, samplers, fine-tuning, callbacks."""

import json
from collections.abc import Callable
from pathlib import Path

import pytest
import torch
from running import Outcome

Run = Callable[..., Outcome]

UNITS = ["spin", "categorical", "gaussian"]
SAMPLERS = ["cd", "pcd", "parallel_tempering", "exact", "dmm_qubo", "mode_assisted_cd"]
SMALL = {
    "parallel_tempering": ["sampler.n_chains=3", "sampler.n_temperatures=3"],
    "dmm_qubo": ["solver.max_steps=20", "solver.n_restarts=3"],
    "mode_assisted_cd": ["solver.n_restarts=3", "sampler.schedule.p_max=1.0"],
}
QUICK = ["callbacks=minimal", "logger=none", "pretrain.iterations=2", "pretrain.batch_size=5", "hydra.run.dir=run"]
WAYS = {
    "greedy": ["model.hidden_sizes=[4,3]", "pretrain=centred", "finetune.iterations=1"],
    "joint": ["model.hidden_sizes=[4,3]", "pretrain=joint", "finetune.iterations=1"],
    "boltzmann": ["model=boltzmann", "model.n_hidden=3", "pretrain=boltzmann", "finetune.iterations=0"],
}


def settings(units: str, *others: str) -> list[str]:
    """Settings of a small run."""
    q = ["units.q=3"] if units == "categorical" else []
    return ["data=shifting_bars", f"units={units}", *q, *QUICK, *others]


CASES = [
    (units, way, sampler)
    for first, units in enumerate(UNITS)
    for number, sampler in enumerate(SAMPLERS)
    for way in [list(WAYS)[(first + number) % (2 if units == "gaussian" else 3)]]  # real units are not coupled
    if (first + number) % 2 == 0
]
"""Each kind in each of its ways, with half of the samplers: the others are tested on the models themselves."""


@pytest.mark.parametrize(("units", "way", "sampler"), CASES, ids=lambda value: value)
def test_every_sampler_and_way_of_pretraining(memcomp_train: Run, units: str, way: str, sampler: str) -> None:
    outcome = memcomp_train(*settings(units, *WAYS[way], f"sampler={sampler}", *SMALL.get(sampler, [])))
    assert outcome.status == 0, outcome.err + outcome.out
    weights = torch.load("run/weights/pretrain.pt", weights_only=True)
    assert all(bool(tensor.isfinite().all()) for tensor in weights.values() if tensor.is_floating_point())
    first = next(tensor for name, tensor in weights.items() if name.split(".")[-1] == "b")
    assert first.shape[-1] == 9 * (3 if units == "categorical" else 1)
    result = json.loads(Path("run/result.json").read_text())
    assert ("test_accuracy" in result) == (way != "boltzmann")


@pytest.mark.parametrize(
    "own",
    [
        ["model=rbm", "units=gaussian"],
        ["model=rbm", "units=categorical", "units.q=3", "units@model.hidden=spin"],
        ["model=ising"],
        ["model=ising", "model.connectivity=null"],
        ["model=potts", "units.q=2"],
    ],
    ids=" ".join,
)
def test_models_in_one_word(memcomp_train: Run, own: list[str]) -> None:
    outcome = memcomp_train(*own, "data=shifting_bars", *QUICK, "sampler=pcd", "finetune.iterations=0")
    assert outcome.status == 0, outcome.err + outcome.out


def test_neighbours_in_a_picture_without_corners(memcomp_train: Run) -> None:
    run = ["model=ising", *QUICK, "sampler=cd", "finetune.iterations=0", "pretrain.batch_size=500"]
    assert memcomp_train(*run).status == 0
    pairs = torch.load("run/weights/pretrain.pt", weights_only=True)["pairs"].tolist()
    assert len(pairs) == 2 * 6 * 5 - 8  # of a grid of six by six, less two at each corner
    assert [0, 1] in pairs
    assert [0, 5] in pairs  # the first row has four pixels, the second six: below its first is its second
    assert [0, 4] not in pairs


@pytest.mark.parametrize(
    ("own", "message"),
    [
        (
            ["units=gaussian", "units.variance=0"],
            "variance of column 0 = 0.0 is not allowed: expected a number > 0",
        ),
        (["units=gaussian", "model=boltzmann", "pretrain=boltzmann"], "expected no couplings between real units"),
        (["units=categorical", "units.q=0"], "q = 0 is not allowed"),
        (["units=categorical", "units.q=x"], "units.q = 'x' is not allowed: expected an integer"),
        (["units=spin", "+units.q=3"], "unexpected keyword argument 'q'"),
        (["model=rbm", "units@model.hidden=gaussian", "units=gaussian"], "real units in one layer at most"),
    ],
    ids=lambda value: " ".join(value) if isinstance(value, list) else "",
)
def test_what_does_not_fit_is_refused_in_a_line(memcomp_train: Run, own: list[str], message: str) -> None:
    outcome = memcomp_train(*own, "data=shifting_bars", *QUICK, "sampler=cd", "finetune.iterations=0")
    assert outcome.status == 2
    assert message in outcome.err


@pytest.mark.parametrize("units", UNITS)
def test_baseline_replicas_and_held_out_images(memcomp_train: Run, units: str) -> None:
    """A network without energies, and the replica axis, see the same values."""
    few = ["data.source.copies=4", "data.partitions=2", "data.validation_fraction=0.2", "sampler=cd"]
    for own in (["model=baseline_bn_relu"], ["model.hidden_sizes=[4]", "callbacks=default"]):
        folder = f"hydra.run.dir=run/{len(own)}"
        outcome = memcomp_train(*settings(units, *own, *few, "finetune.iterations=1", folder))
        assert outcome.status == 0, outcome.err + outcome.out
