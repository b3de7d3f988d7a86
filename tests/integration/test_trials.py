"""The loops without a trainer train what a run trains, bit for bit: a trial is the run that it decides."""

from collections.abc import Callable
from pathlib import Path

import pytest
import torch
from hydra import compose
from running import QUIET, Outcome

from memcomp_lightning.configuration.composition import composing
from memcomp_lightning.configuration.plans import build
from memcomp_lightning.modules import Classifier
from memcomp_lightning.studies.accuracy import pretrained
from memcomp_lightning.studies.plan import finetuning_without_trainer

Run = Callable[..., Outcome]
ROOT = Path(__file__).parents[2]

SMALL = [
    *(*QUIET, "data=shifting_bars", "model.hidden_sizes=[5,4]", "choose=null", "seed=3"),
    *("pretrain.iterations=3", "pretrain.batch_size=7", "finetune.iterations=3", "finetune.batch_size=5"),
]
DMM = ["solver.max_steps=20", "solver.n_restarts=5"]
NOT_HERE = {
    "dwave_qpu": "asks a machine",
    "annealer": "draws from a random stream of its own",
}


def options(group: str) -> list[str]:
    return sorted(path.stem for path in (ROOT / "conf" / group).glob("*.yaml"))


def schedule(name: str, stage: str) -> str:
    kinds = {"momentum": "MomentumSchedule,switch_at:2", "decay": "LearningRateDecay,n_passes:3"}
    return f"{stage}.schedules.{name}={{_target_:memcomp_lightning.training.{kinds[name]}}}"


SCHEDULES = [schedule(name, stage) for name in ("momentum", "decay") for stage in ("pretrain", "finetune")]
PENALTIES = [
    f"pretrain.penalties.{name}={{_target_:memcomp_lightning.training.{kind},strength:0.01}}"
    for name, kind in (("l1", "L1"), ("l2", "L2"), ("groups", "GroupSparsity"))
]
PATIENT = ["data.validation_fraction=0.2", "finetune.patience=1"]
CASES = [
    *([f"sampler={sampler}", *SCHEDULES] for sampler in options("sampler") if sampler not in NOT_HERE),
    *([f"control={control}"] for control in options("control")),
    ["sampler=pcd", "pretrain=greedy", SCHEDULES[0]],
    [
        "sampler=pseudo_likelihood",
        "sampler.max_units=9",
        "pretrain=joint",
        "data.partitions=2",
        "data.chunk_size=3",
        *PENALTIES,
    ],
    ["sampler=mode_assisted_pcd", "pretrain=joint", *SCHEDULES],
    ["control=bn_relu", "finetune.keep_best=true", "data.validation_fraction=0.2", SCHEDULES[3]],
    ["sampler=cd", "finetune.loss=squared_error", "finetune.units=batch_norm_relu", "data.partitions=2"],
    [
        *("control=bn_relu", "finetune.dropout=0.4", "finetune.class_weights=balanced", "finetune.labels=20"),
        *("data.source.copies=5", "data.validation_fraction=0.3", "finetune.patience=1", "finetune.best_by=loss"),
    ],
    ["sampler=cd", "finetune.dropout=0.2", "finetune.optimizer.lr=1e-9", *PATIENT],
]


@pytest.mark.parametrize("case", CASES, ids=lambda case: " ".join(case)[:60])
def test_a_loop_without_a_trainer_ends_with_the_weights_of_the_run(memcomp_train: Run, case: list[str]) -> None:
    uses_dmm = not any(
        part in " ".join(case) for part in ("annealing", "descent", "exact", "boltzmann", "mode_assisted")
    )
    # The case comes last but for what keeps it small: controls may choose.
    overrides = [*SMALL, *(DMM if uses_dmm else []), *case]
    if case[0].startswith("sampler=exact"):
        overrides.append("model.hidden_sizes=[5]")
    outcome = memcomp_train(*overrides, "hydra.run.dir=run")
    assert outcome.status == 0, outcome.err
    expected = torch.load("run/weights/finetune.pt", weights_only=True)
    with composing():
        config = compose("config", overrides)
        plan = pretrained(build(config), config.seed, torch.device("cpu"))
    assert plan.finetuning is not None
    module, data = plan.finetuning.module, plan.finetuning.data
    assert isinstance(module, Classifier)
    passes = finetuning_without_trainer(
        plan.finetuning,
        module.network,
        data.train_batches(0, 1),
        iterations=module.iterations,
        seeds=[config.seed],
        held_out=next(iter(data.val_dataloader())),
    )
    assert len(list(passes)) == 3
    found = module.network.state_dict()
    assert found.keys() == expected.keys()
    assert [name for name, tensor in expected.items() if not tensor.equal(found[name])] == []
