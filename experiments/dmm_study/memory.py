"""When does memory pay? The DMM with its memories, with one of them frozen, and annealing, on five sizes.

python experiments/dmm_study/memory.py                     # a quarter of an hour on one core
"""

import argparse
import sys
import time
from dataclasses import replace
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1] / "solver_benchmark"))

import measure
import numpy as np
import torch
from instances import random_rbm

from memcomp_lightning import rng
from memcomp_lightning.problems import Qubo
from memcomp_lightning.solvers import GibbsAnnealing, QuboSolver
from memcomp_lightning.solvers.dmm import ClauseField, DmmSolver

SIZES = ((32, 32), (64, 64), (100, 100), (160, 130), (250, 200))
STEPS = (100, 300, 1000, 3000, 10_000)
SWEEPS = (30, 100, 300, 1000, 3000)
STILL = 1e-6
"""Rate of a memory that stays where it begins."""

MACHINES = {
    "both memories": ClauseField(),
    "long-term memory frozen": replace(ClauseField(), long_term_max=1.0),
    "short-term memory frozen": replace(ClauseField(), beta=STILL),
    "both frozen": replace(ClauseField(), long_term_max=1.0, beta=STILL),
}


def candidates() -> dict[str, list[QuboSolver]]:
    """Each method at its budgets; restarts of the machines run for all their steps."""
    machines: dict[str, list[QuboSolver]] = {
        name: [DmmSolver(field=field, max_steps=steps, stall=None) for steps in STEPS]
        for name, field in MACHINES.items()
    }
    return {**machines, "annealing": [GibbsAnnealing(n_sweeps=sweeps) for sweeps in SWEEPS]}


def reads(problem: Qubo, solver: QuboSolver, seconds: float) -> tuple[np.ndarray, float]:
    """Energies of restarts, and what the processor took, in calls of 28 for about so many seconds."""
    generator, found, spent = rng.numpy_stream(1, "memory"), [], 0.0
    while spent < seconds:
        begin = time.process_time()
        found.append(solver.minimise(problem, generator=generator).energies)
        spent += time.process_time() - begin
    return np.concatenate(found), spent


def drawn(purpose: str, size: tuple[int, int], index: int) -> Qubo:
    """A mean-cancelled RBM."""
    generator = rng.stream(2027, f"memory {purpose} {size}", index)
    return random_rbm(*size, 1.0, cancelled=1.0, bias_std=0.0, generator=generator).alike(np.zeros(0))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--instances", type=int, default=10)
    parser.add_argument("--seconds", type=float, default=2.0, help="of a method on a reported instance")
    given = parser.parse_args()
    torch.set_num_threads(1)
    methods = candidates()
    for solvers in methods.values():
        solvers[0].minimise(drawn("warm", SIZES[0], 0), generator=rng.numpy_stream(0, "warm"))
    print("| size | " + " | ".join(methods) + " | both memories over annealing |")
    print("| --- |" + " --- |" * (len(methods) + 1))
    for size in SIZES:
        tuning = [drawn("tuning", size, k) for k in range(2)]
        chosen = {}
        for name, solvers in methods.items():
            runs = [[reads(problem, solver, given.seconds / 10) for problem in tuning] for solver in solvers]
            chosen[name] = runs
        lowest = [min(run[k][0].min() for runs in chosen.values() for run in runs) for k in range(2)]
        best = {}
        for name, runs in chosen.items():
            merits = [measure.ranking([measure.tally(*run[k], lowest[k]) for k in range(2)]) for run in runs]
            best[name] = methods[name][int(np.argmin(merits))]
        found = {name: [] for name in methods}
        for k in range(given.instances):
            problem = drawn("report", size, k)
            runs = {name: reads(problem, solver, given.seconds) for name, solver in best.items()}
            lowest_here = min(run[0].min() for run in runs.values())
            for name, run in runs.items():
                found[name].append(measure.tally(*run, lowest_here))
        cells = [
            _cell(measure.family_tts(tallies), 1e3) + f" ({_budget(best[name])})"
            for name, tallies in found.items()
        ]
        ratio = measure.family_ratio(found["both memories"], found["annealing"])
        print(f"| {size[0]}x{size[1]} | {' | '.join(cells)} | {_cell(ratio, 1.0)} |", flush=True)


def _budget(solver: QuboSolver) -> int:
    return solver.max_steps if isinstance(solver, DmmSolver) else solver.n_sweeps


def _cell(value: measure.Interval, scale: float) -> str:
    low, high = value.low * scale, value.high * scale
    return f"{value.mark}{value.value * scale:.2g}" + ("" if value.mark else f" [{low:.2g}, {high:.2g}]")


if __name__ == "__main__":
    main()
