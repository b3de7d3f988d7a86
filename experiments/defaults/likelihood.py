"""Settings of an RBM's training by exact log-likelihood of held-out training rows of the digits.

python experiments/defaults/likelihood.py     # about three minutes on one core
"""

import statistics
from functools import partial

import numpy as np
import torch
from sklearn.datasets import load_digits
from torch.optim import SGD

from memcomp_lightning import rng
from memcomp_lightning.data import Batches, independent_log_likelihood
from memcomp_lightning.likelihood import log_likelihood, log_partition_function
from memcomp_lightning.models import DBN, start_at_means
from memcomp_lightning.objective import Centring
from memcomp_lightning.samplers import CD, PCD
from memcomp_lightning.training import Greedy, MomentumSchedule, pretrain

PAPER = MomentumSchedule(0.1, 0.5, switch_at=5)
ROWS = {
    "the paper's: 50 full batches, rate .1, momentum": (50, None, 0.1, PAPER, False, False),
    "the same in batches of 20, 10 passes": (10, 20, 0.1, PAPER, False, False),
    "batches of 20, 10 passes, rate .05": (10, 20, 0.05, None, False, False),
    "... biases from the data": (10, 20, 0.05, None, False, True),
    "... centred": (10, 20, 0.05, None, True, False),
    "... centred, biases from the data (the defaults)": (10, 20, 0.05, None, True, True),
    "... at rate .1": (10, 20, 0.1, None, True, True),
    "... at rate .2": (10, 20, 0.2, None, True, True),
}
SEEDS = (0, 1, 2)


def digits() -> tuple[torch.Tensor, torch.Tensor]:
    """Training and held-out rows of binary 8x8 digits."""
    rows = torch.from_numpy((load_digits().data > 8).astype(np.float32))
    order = torch.randperm(len(rows), generator=rng.stream(0, "partition"))
    return rows[order[:1347]], rows[order[1347:]]


def main() -> None:
    """Print the table."""
    torch.set_num_threads(1)
    train, held = digits()
    print(f"independent units: {independent_log_likelihood(train, held):.2f}")
    print("| settings, 16 hidden units | PCD-1, 100 chains | CD-1 |\n| --- | --- | --- |")
    for name, (passes, batch_size, rate, momentum, centred, biases) in ROWS.items():
        cells = []
        for sampler in (PCD(n_chains=100), CD()):
            found = []
            for seed in SEEDS:
                dbn = DBN(64, [16], generator=rng.stream(seed, "weights"))
                if biases:
                    start_at_means(dbn[0], train)
                labels = torch.zeros(len(train), dtype=torch.long)
                batches = Batches(train, labels, batch_size, chunk_size=10_000, shuffle=True, seed=seed)
                training = pretrain(
                    Greedy(dbn),
                    batches,
                    sampler,
                    iterations=passes,
                    optimizer=partial(SGD, lr=rate),
                    schedules=[] if momentum is None else [momentum],
                    centring=Centring() if centred else None,
                    seed=seed,
                )
                for _ in training:
                    pass
                log_z = log_partition_function(dbn[0])
                found.append(float(log_likelihood(dbn[0], held, log_z).mean()))
            cells.append(f"{statistics.mean(found):.2f} ± {statistics.stdev(found) / len(found) ** 0.5:.2f}")
        print(f"| {name} | {' | '.join(cells)} |", flush=True)


if __name__ == "__main__":
    main()
