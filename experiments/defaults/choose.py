"""Fine-tuning settings by accuracy on held-out training images; test images have no say.

python experiments/defaults/choose.py         # about half an hour on one core
"""

import statistics

import torch
from hydra import compose, initialize_config_module
from omegaconf import OmegaConf

from memcomp_lightning.cli.hydra_versions import INITIALIZE
from memcomp_lightning.cli.overrides import CONFIG_MODULE
from memcomp_lightning.cli.units import Member, Unit, run_unit

SPLITS = (100, 101, 102)
"""Seeds of runs and of splits into training and test images, others than those of the table that is reported."""

PASSES = (20, 50, 100)
SAMPLERS = ("cd", "pcd", "dmm_qubo", "quench")
RATES = {
    "rate 1": ["finetune.optimizer.lr=1.0", "finetune.optimizer.momentum=0.0"],
    "rate .1, momentum .9": ["finetune.optimizer.lr=0.1", "finetune.optimizer.momentum=0.9"],
}


def accuracies(overrides: list[str]) -> list[list[float]]:
    """Held-out accuracy after the passes asked for, a row a split."""
    rows = []
    for seed in SPLITS:
        held_out = [f"data.source.split_seed={seed}", "data.validation_fraction=0.2"]
        config = OmegaConf.to_container(compose("config", [*overrides, *held_out]), resolve=False)
        member = Member("choose", config, config["pretrain"]["iterations"], seed, None, choosing=False)
        (record,) = run_unit(Unit((member,), PASSES, 0), lambda what, n_updates: None)
        rows.append([of_pass[0] for of_pass in record.scores["validation_accuracy"]])
    return rows


def main() -> None:
    """Print the table."""
    torch.set_num_threads(1)
    print(f"| sampler | fine-tuning | {' | '.join(f'{n} passes' for n in PASSES)} |")
    print("| --- | --- |" + " --- |" * len(PASSES))
    with initialize_config_module(CONFIG_MODULE, **INITIALIZE):
        for sampler in SAMPLERS:
            for name, overrides in RATES.items():
                of_passes = zip(*accuracies([f"sampler={sampler}", *overrides]), strict=True)
                means = [f"{statistics.mean(values):.3f}" for values in of_passes]
                print(f"| {sampler} | {name} | {' | '.join(means)} |", flush=True)


if __name__ == "__main__":
    main()
