"""RBMs from real training runs, kept in a cache folder: training takes longer than solving."""

import dataclasses
import os
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np
import torch
from torch import Generator, Tensor

from memcomp_lightning import rng
from memcomp_lightning.data import Batches, Digits, Mnist, ReducedMnist
from memcomp_lightning.models import RBM
from memcomp_lightning.objective import contrast
from memcomp_lightning.samplers import CD, PCD, GroundState, positive_phase
from memcomp_lightning.solvers.dmm import DmmSolver

SAMPLERS = {
    "CD-1": CD(k=1),
    "PCD-1": PCD(k=1, n_chains=100),
    "DMM": GroundState(solver=DmmSolver()),
    "DMM short": GroundState(solver=DmmSolver(n_restarts=4, max_steps=50)),
}


@dataclass(frozen=True, kw_only=True, slots=True)
class Training:
    """One training run: stochastic gradients, no momentum, no decay.

    Attributes:
        sampler: A key of ``SAMPLERS``.
        full_size: 784x500 on MNIST (grey) instead of 32x32 on reduced MNIST.
        n_images: Images, drawn from the training set for each run anew.
        batch_size: Images an update.
        n_updates: Updates.
        learning_rate: Of weights and biases alike.
    """

    sampler: str
    full_size: bool = False
    n_images: int = 1000
    batch_size: int = 20
    n_updates: int
    learning_rate: float = 0.1

    @property
    def label(self) -> str:
        """For tables."""
        return f"{self.sampler}, {self.n_updates:,} updates, rate {self.learning_rate:g}"

    def rbm(self, *, seed: int, purpose: str, index: int, cache_folder: Path) -> RBM:
        """Return the trained RBM, from the cache if it is there."""
        settings = "_".join(str(value) for value in dataclasses.astuple(self)).replace(" ", "-")
        path = cache_folder / f"{images(self.full_size)[1]}_{settings}_{purpose}_{seed}_{index}.npz"
        n_visible, n_hidden = (784, 500) if self.full_size else (32, 32)
        rbm = RBM(n_visible, n_hidden, generator=rng.stream(seed, f"trained weights {purpose}", index))
        if path.exists():
            with np.load(path) as saved:
                rbm.load_state_dict({name: torch.from_numpy(saved[name]) for name in ("weight", "b", "c")})
            return rbm
        self._train(rbm, seed, rng.stream(seed, f"trained images {purpose}", index))
        path.parent.mkdir(parents=True, exist_ok=True)
        partial = path.with_suffix(".partial.npz")
        np.savez(partial, **{name: value.numpy() for name, value in rbm.state_dict().items()})
        partial.replace(path)
        return rbm

    def _train(self, rbm: RBM, seed: int, generator: Generator) -> None:
        v = images(self.full_size)[0]
        v = v[torch.randperm(len(v), generator=generator)[: self.n_images]]
        optimizer = torch.optim.SGD(rbm.parameters(), lr=self.learning_rate)
        sampler = SAMPLERS[self.sampler]
        state = sampler.init(rbm, self.batch_size, generator=generator)
        batches = Batches(v, torch.zeros(len(v), dtype=torch.int64), self.batch_size, 10_000, True, seed)
        n_done = 0
        while n_done < self.n_updates:
            batches.set_epoch(n_done // len(batches))
            for batch in batches:
                positive = positive_phase(rbm, batch.v)
                negative = sampler.sample(rbm, state, positive, generator=generator)
                state = negative.state
                optimizer.zero_grad()
                contrast(rbm, positive, negative.configurations).backward()
                optimizer.step()
                n_done += 1
                if n_done == self.n_updates:
                    break


@cache
def images(full_size: bool) -> tuple[Tensor, str]:
    """The training images and the name of the data set; digits stand in for reduced MNIST where there is none."""
    if os.environ.get("MEMCOMP_DATA_DIR"):
        data = (Mnist(download=False) if full_size else ReducedMnist(download=False)).load()
    elif full_size:
        raise FileNotFoundError("784x500 needs MNIST: set MEMCOMP_DATA_DIR to the folder that holds MNIST/raw.")
    else:
        data = Digits().load()
    return data.train_v, data.name
