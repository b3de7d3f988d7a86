"""Does the DMM with its default constants reach the optimum on small random and trained RBMs?

    python experiments/dmm_small/run.py

For each family of RBMs: the share of restarts that reach the lowest energy known, of the DMM and of
alternating descent, and whether one call of 28 restarts reaches it. The lowest energy known is certified by
enumeration up to 22 units in the smaller layer, otherwise the best of 20,000 descents and 280 restarts of
the DMM.
"""

import logging
from functools import partial

import lightning.pytorch as pl
import torch

from memcomp_lightning import rng
from memcomp_lightning.data import Digits, ImageDataModule
from memcomp_lightning.dmm import DmmSolver
from memcomp_lightning.models import DBN, RBM, Gaussian
from memcomp_lightning.modules import DBNPretraining
from memcomp_lightning.qubo import AlternatingDescent, BruteForce, Qubo, from_model
from memcomp_lightning.samplers import CD, PCD

N_INSTANCES = 5


def random_rbms(n: int, std: float, bias_std: float = 0.5, *, cancel_mean: bool = False) -> RBM:
    """Independent random RBMs as replicas; ``cancel_mean`` sets b_j = -sum_i w_ij / 2 and c likewise."""
    generator = rng.stream(101, f"instances {n} {std} {bias_std} {cancel_mean}")
    rbm = RBM(n, n, replicas=(N_INSTANCES,), weight_init=Gaussian(std=std), generator=generator)
    with torch.no_grad():
        if cancel_mean:
            rbm.b.copy_(-rbm.weight.sum(-2) / 2)
            rbm.c.copy_(-rbm.weight.sum(-1) / 2)
        else:
            rbm.b.normal_(0, bias_std, generator=generator)
            rbm.c.normal_(0, bias_std, generator=generator)
    return rbm


def trained_rbms(sampler: CD | PCD, n_epochs: int) -> RBM:
    """RBMs trained on five partitions of the digits in mini-batches of 20."""
    dbn = DBN(32, [32], replicas=(N_INSTANCES,), generator=rng.stream(102, "weights"))
    optimizer = partial(torch.optim.SGD, lr=0.1)
    trainer = pl.Trainer(
        max_epochs=n_epochs,
        accelerator="cpu",
        logger=False,
        enable_checkpointing=False,
        enable_progress_bar=False,
        enable_model_summary=False,
        limit_val_batches=0,
    )
    data = ImageDataModule(Digits().load(), batch_size=20, partitions=N_INSTANCES)
    trainer.fit(DBNPretraining(dbn, sampler, iterations=n_epochs, optimizer=optimizer, seed=103), datamodule=data)
    return dbn[0]


def lowest_energy(qubo: Qubo) -> tuple[torch.Tensor, str]:
    """Lowest energy known, and how it is known."""
    generator = rng.stream(104, "reference")
    if qubo.n <= 44:
        return BruteForce().minimise(qubo, generator=generator).best_energy, "exact"
    descents = AlternatingDescent(n_restarts=20_000).minimise(qubo, generator=generator).best_energy
    machine = DmmSolver(n_restarts=280, max_steps=1000).minimise(qubo, generator=generator).best_energy
    return torch.minimum(descents, machine), "best known"


def main() -> None:
    logging.getLogger("lightning.pytorch").setLevel(logging.WARNING)
    families = {
        "16x16, std 0.1": random_rbms(16, 0.1),
        "16x16, std 1": random_rbms(16, 1.0),
        "16x16, std 1, mean-cancelled": random_rbms(16, 1.0, cancel_mean=True),
        "32x32, std 0.01, first updates": random_rbms(32, 0.01, 0.03),
        "32x32, std 0.1": random_rbms(32, 0.1),
        "32x32, std 0.5": random_rbms(32, 0.5),
        "32x32, std 1": random_rbms(32, 1.0),
        "32x32, std 1, mean-cancelled": random_rbms(32, 1.0, cancel_mean=True),
        "32x32, digits, CD-1, 50 epochs": trained_rbms(CD(k=1), 50),
        "32x32, digits, CD-1, 500 epochs": trained_rbms(CD(k=1), 500),
        "32x32, digits, PCD-5, 500 epochs": trained_rbms(PCD(k=5, n_chains=100), 500),
    }
    columns = ("family of five RBMs", "DMM restarts at optimum", "descents", "calls", "s a call")
    print("{:34s} {:>34s} {:>8s} {:>6s} {:>9s}".format(*columns))
    for name, rbm in families.items():
        qubo = from_model(rbm)
        best, how = lowest_energy(qubo)
        limit = (best + 1e-6 * best.abs()).unsqueeze(-1)
        solution = DmmSolver().minimise(qubo, generator=rng.stream(105, "measured"))
        descent = AlternatingDescent(n_restarts=20_000).minimise(qubo, generator=rng.stream(106, "measured"))
        shares = (solution.energies <= limit).double().mean(-1)
        reached = int((shares > 0).sum())
        print(
            f"{name:34s} {' '.join(f'{share:.2f}' for share in shares):>34s} "
            f"{float((descent.energies <= limit).double().mean()):8.3f} {reached:2d} / {N_INSTANCES} "
            f"{solution.wall_time_s / N_INSTANCES:7.2f}   ({how})",
            flush=True,
        )


if __name__ == "__main__":
    main()
