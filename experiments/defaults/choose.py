"""Fine-tuning settings by accuracy on held-out training images; test images have no say.

python experiments/defaults/choose.py         # about half an hour on one core
"""

import statistics

import torch
from hydra import compose

from memcomp_lightning.configuration.choice import trial_of
from memcomp_lightning.configuration.composition import composing
from memcomp_lightning.studies import SideBySide

SPLITS = (100, 101, 102)
"""Seeds of runs and of splits into training and test images, others than those of the table that is reported."""

PASSES = (20, 30, 50, 100)
RATES = {
    "rate 1": ["finetune.optimizer.lr=1.0", "finetune.optimizer.momentum=0.0"],
    "rate .1, momentum .9": ["finetune.optimizer.lr=0.1", "finetune.optimizer.momentum=0.9"],
    "rate .2, momentum .9": ["finetune.optimizer.lr=0.2", "finetune.optimizer.momentum=0.9"],
    "rate .3, momentum .9": ["finetune.optimizer.lr=0.3", "finetune.optimizer.momentum=0.9"],
    "rate 1, momentum .9": ["finetune.optimizer.lr=1.0", "finetune.optimizer.momentum=0.9"],
}
RUNS = {sampler: [f"sampler={sampler}"] for sampler in ("cd", "pcd", "dmm_qubo", "quench")}
"""All rates are tried for these."""

FURTHER_RUNS = {
    "dmm_time_average, 4 restarts": ["sampler=dmm_time_average", "solver.n_restarts=4"],
    "dmm_time_average, 8 restarts": ["sampler=dmm_time_average", "solver.n_restarts=8"],
    "dmm_time_average, 28 restarts": ["sampler=dmm_time_average", "solver.n_restarts=28"],
    "exact, 12 and 12 hidden units": ["sampler=exact", "model.hidden_sizes=[12,12]"],
    "exact, 12 and 32 hidden units": ["sampler=exact", "model.hidden_sizes=[12,32]"],
    "exact, 12 and 64 hidden units": ["sampler=exact", "model.hidden_sizes=[12,64]"],
    "parallel_tempering": ["sampler=parallel_tempering"],
    "mode_assisted_cd": ["sampler=mode_assisted_cd"],
    "mode_assisted_pcd": ["sampler=mode_assisted_pcd"],
    "annealer": ["sampler=annealer"],
    "batch norm + ReLU": ["control=bn_relu"],
}
"""The chosen rate alone."""


def accuracies(overrides: list[str]) -> list[list[float]]:
    """Held-out accuracy after the passes asked for, a row a split."""
    rows = []
    for seed in SPLITS:
        held_out = [f"data.source.split_seed={seed}", "data.validation_fraction=0.2"]
        trial = trial_of(compose("config", [*overrides, *held_out, f"seed={seed}"]), "choose")
        (record,) = SideBySide((trial,), PASSES, 0).run(lambda what, n_updates: None)
        rows.append([of_pass[0] for of_pass in record.measures["validation_accuracy"]])
    return rows


def main() -> None:
    """Print the table."""
    torch.set_num_threads(1)
    tried = [(name, rate) for name in RUNS for rate in RATES]
    tried += [(name, "rate .2, momentum .9") for name in FURTHER_RUNS]
    print(f"| run | fine-tuning | {' | '.join(f'{n} passes' for n in PASSES)} |")
    print("| --- | --- |" + " --- |" * len(PASSES))
    with composing():
        for name, rate in tried:
            overrides = (RUNS | FURTHER_RUNS)[name] + RATES[rate]
            of_passes = zip(*accuracies(overrides), strict=True)
            means = [f"{statistics.mean(values):.3f}" for values in of_passes]
            print(f"| {name} | {rate} | {' | '.join(means)} |", flush=True)


if __name__ == "__main__":
    main()
