"""How far above the true mode do solvers end? At the final RBMs of a run of experiment=sampler_worth.

python experiments/sampler_worth/modes.py RUN_FOLDER --data-set mnist_16       # enumerates the hidden layer
"""

import argparse
from pathlib import Path

import torch
from exact import model_of

from memcomp_lightning import rng
from memcomp_lightning.enumeration import binary_states
from memcomp_lightning.models import RBM
from memcomp_lightning.problems import from_model
from memcomp_lightning.solvers import GibbsAnnealing
from memcomp_lightning.solvers.dmm import DmmSolver
from memcomp_lightning.studies.likelihood import weights_path
from memcomp_lightning.studies.worth import read_worth


def lowest_energy(rbm: RBM) -> torch.Tensor:
    """Of all states, ``(n_replicas,)``: for each hidden state the visible units choose their best values."""
    h = binary_states(rbm.n_hidden, like=rbm.b).expand(*rbm.replicas, -1, -1)
    of_visible = (h @ rbm.weight + rbm.b.unsqueeze(-2)).clamp(min=0).sum(-1)
    return (-(h * rbm.c.unsqueeze(-2)).sum(-1) - of_visible).amin(-1)


@torch.no_grad()
def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run", type=Path)
    parser.add_argument("--data-set", default="mnist_16")
    parser.add_argument("--replicas", type=int, default=4)
    given = parser.parse_args()
    worth = read_worth(given.run)
    print("| RBM trained by | DMM above the mode, median and worst | annealing above the mode |")
    print("| --- | --- | --- |")
    for method in worth.methods(given.data_set):
        rbm = model_of(weights_path(given.run, worth.best(given.data_set, method)), given.replicas)
        mode, problem, cells = lowest_energy(rbm), from_model(rbm), []
        for solver in (DmmSolver(n_restarts=8), GibbsAnnealing(n_restarts=8)):
            found = solver.minimise(problem, generator=rng.stream(0, "solver")).best_energy
            gap = (found - mode).clamp(min=0)
            cells.append(f"{float(gap.median()):.2f}, {float(gap.max()):.2f}")
        print(f"| {worth.plan.methods[method].label} | {' | '.join(cells)} |", flush=True)


if __name__ == "__main__":
    main()
