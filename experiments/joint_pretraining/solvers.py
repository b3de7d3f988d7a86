"""What one ground state of a machine costs: solver=best and the DMM beside dwave-samplers' annealing.

python experiments/joint_pretraining/solvers.py               # a DBM, a Zephyr graph, a full machine; minutes
"""

import argparse
import statistics
import time
from collections.abc import Callable

import torch
from dimod import BinaryQuadraticModel
from dwave.samplers import SimulatedAnnealingSampler

from memcomp_lightning import rng
from memcomp_lightning.interop import annealer_graph
from memcomp_lightning.models import DBM, BoltzmannMachine, Normal
from memcomp_lightning.problems import Qubo, from_model
from memcomp_lightning.samplers.ground_state import posed_as
from memcomp_lightning.solvers import Portfolio, QuboSolver
from memcomp_lightning.solvers.dmm import DmmSolver

STD = 0.3
"""Of couplings and biases: about where trained machines are."""

MACHINES: dict[str, Callable[[torch.Generator], BoltzmannMachine]] = {
    "DBM 32-32-32": lambda g: DBM(32, [32, 32], weight_init=Normal(std=STD), generator=g),
    "DBM 784-500-500": lambda g: DBM(784, [500, 500], weight_init=Normal(std=STD), generator=g),
    "Zephyr 3, 336 units": lambda g: BoltzmannMachine(
        32, None, annealer_graph("zephyr", 3, 32), weight_init=Normal(std=STD), generator=g
    ),
    "all pairs, 100 units": lambda g: BoltzmannMachine(50, 50, weight_init=Normal(std=STD), generator=g),
}


def annealed(qubo: Qubo, reads: int, sweeps: int, seed: int) -> tuple[float, float]:
    """Lowest energy by simulated annealing, and the seconds, those of building the model left out."""
    matrix = qubo.to_matrix()
    model = BinaryQuadraticModel(matrix.double().numpy(), "BINARY")
    begin = time.perf_counter()
    found = SimulatedAnnealingSampler().sample(model, num_reads=reads, num_sweeps=sweeps, seed=seed)
    return float(found.first.energy), time.perf_counter() - begin


def found_by(solver: QuboSolver, qubo: Qubo, seed: int) -> tuple[float, float]:
    """Lowest energy by a solver of the package, and the seconds."""
    begin = time.perf_counter()
    found = solver.minimise(qubo, generator=rng.stream(seed, "solver"))
    return float(found.best_energy), time.perf_counter() - begin


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--instances", type=int, default=5)
    parser.add_argument("--reads", type=int, default=28, help="of annealing, as many as the others have restarts")
    parser.add_argument("--sweeps", type=int, default=100, help="of annealing")
    given = parser.parse_args()
    torch.set_num_threads(1)
    print("| machine | couplings | best, ms | DMM, ms | SA, ms | gap of best | gap of the DMM | gap of SA |")
    print("| --- | --- | --- | --- | --- | --- | --- | --- |")
    for name, make in MACHINES.items():
        found: list[list[tuple[float, float]]] = []
        for instance in range(given.instances + 1):
            generator = rng.stream(instance, "machine")
            model = make(generator)
            with torch.no_grad():
                for bias in (model.b, model.c):
                    bias.normal_(0.0, STD, generator=generator)
            qubo = from_model(posed_as(model)[0])
            runs = [found_by(solver, qubo, instance) for solver in (Portfolio(), DmmSolver())]
            runs.append(annealed(qubo, given.reads, given.sweeps, instance))
            if instance:  # the first one loads what is compiled
                found.append(runs)
        lowest = [min(energy for energy, _ in runs) for runs in found]
        cells = [str(len(model.pairs))]
        cells += [f"{1e3 * statistics.median(runs[k][1] for runs in found):.1f}" for k in range(3)]
        for k in range(3):
            gaps = [(runs[k][0] - low) / abs(low) for runs, low in zip(found, lowest, strict=True)]
            cells.append(f"{statistics.median(gaps):.2%} (worst {max(gaps):.2%})")
        print(f"| {name} | {' | '.join(cells)} |", flush=True)


if __name__ == "__main__":
    main()
