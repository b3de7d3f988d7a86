"""How often AGREED is wrong, on problems whose minima are known.

python experiments/agreement/run.py               # 10,002 problems, ten minutes on one core
python experiments/agreement/run.py --problems 50 # of each family, to try it
"""

import argparse
import csv
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
from numba import njit
from numpy.typing import NDArray

from memcomp_lightning import rng
from memcomp_lightning.problems import Bipartite, Qubo
from memcomp_lightning.solvers import (
    AlternatingDescent,
    BranchAndBound,
    GibbsAnnealing,
    Portfolio,
    Search,
    Status,
    TabuSearch,
)
from memcomp_lightning.solvers.dmm import DmmSolver

Matrix = NDArray[np.float64]
SOLVERS = {
    "best": Portfolio(),
    "dmm": DmmSolver(),
    "annealing, 10 sweeps": GibbsAnnealing(n_sweeps=10),
    "tabu, 20 flips": TabuSearch(n_steps=20),
    "descent": AlternatingDescent(),
}


@njit(cache=True)
def lowest(couplings: Matrix, linear: Matrix) -> float:
    """Minimum over all states of ``linear . x + sum_{i < j} couplings x_i x_j``, one flip after another."""
    n = len(linear)
    field, x = linear.copy(), np.zeros(n)
    energy = best = 0.0
    for state in range(1, 2**n):
        i = 0
        while not state >> i & 1:  # Gray code
            i += 1
        sign = 1 - 2 * x[i]
        energy += sign * field[i]
        x[i] += sign
        for j in range(n):
            field[j] += sign * couplings[i, j]
        best = min(best, energy)
    return best


SIDE = 12
"""Of the grid."""


def dense(generator: np.random.Generator) -> tuple[Qubo, float]:
    """x'Qx with Gaussian numbers."""
    return enumerated(generator.normal(size=(20, 20)))


def spins(generator: np.random.Generator) -> tuple[Qubo, float]:
    """Gaussian couplings of spins without fields: Sherrington and Kirkpatrick's glass."""
    return enumerated(over_bits(np.triu(generator.normal(size=(20, 20)), 1)))


def regular(generator: np.random.Generator) -> tuple[Qubo, float]:
    """Couplings -1 and 1 of spins that have three neighbours each, or two where a pair was drawn twice."""
    ends = np.concatenate([generator.permutation(22) for _ in range(3)]).reshape(-1, 2)
    bonds = np.zeros((22, 22))
    for i, j in ends[ends[:, 0] != ends[:, 1]]:
        bonds[min(i, j), max(i, j)] = generator.choice([-1, 1])
    return enumerated(over_bits(bonds))


def grid(generator: np.random.Generator) -> tuple[Qubo, float]:
    """Couplings -1 and 1 on a square grid; a row of spins after another leaves the minimum."""
    right, down = generator.choice([-1, 1], (SIDE, SIDE - 1)), generator.choice([-1, 1], (SIDE - 1, SIDE))
    bonds, site = np.zeros((SIDE**2, SIDE**2)), np.arange(SIDE**2).reshape(SIDE, SIDE)
    bonds[site[:, :-1], site[:, 1:]], bonds[site[:-1], site[1:]] = right, down
    spin, energy = np.array([-1, 1]), np.zeros(2**SIDE)  # of the last row's spins
    for row in range(SIDE):
        for column in range(SIDE):
            if row:
                energy = energy.reshape(2**column, 2, -1)
                bond = down[row - 1, column] * np.multiply.outer(spin, spin)
                energy = (energy[:, :, None] + bond[None, :, :, None]).min(1)
            if column:
                bond = right[row, column - 1] * np.multiply.outer(spin, spin)
                energy = energy.reshape(2 ** (column - 1), 2, 2, -1) + bond[None, :, :, None]
    return Qubo.from_matrix(over_bits(bonds)), float(energy.min() - bonds.sum())


def layers(n: int, cancelled: float) -> Callable[[np.random.Generator], tuple[Qubo, float]]:
    """Two layers with Gaussian couplings, whose biases cancel a share of the mean field."""

    def draw(generator: np.random.Generator) -> tuple[Qubo, float]:
        weight = generator.normal(size=(n, n))
        bias = -cancelled * np.concatenate((weight.sum(0), weight.sum(1))) / 2
        bias += (1 - cancelled) * generator.normal(size=2 * n) / 2
        qubo = Qubo(Bipartite(n, n), -weight, -bias, np.array(0.0))
        proof = BranchAndBound().minimise(qubo, generator=generator)
        assert proof.status.tolist() == [Status.OPTIMAL]
        return qubo, float(proof.best_energy)

    return draw


def over_bits(bonds: Matrix) -> Matrix:
    """The matrix Q of ``sum_{i < j} bonds s_i s_j`` over bits, without its constant."""
    return 4 * bonds - 2 * np.diag((bonds + bonds.T).sum(0))


def enumerated(matrix: Matrix) -> tuple[Qubo, float]:
    """x'Qx and its minimum."""
    off = matrix - np.diag(matrix.diagonal())
    return Qubo.from_matrix(matrix), lowest(off + off.T, matrix.diagonal().copy())


FAMILIES = {
    "dense QUBO, 20": dense,
    "dense spin glass, 20": spins,
    "three neighbours, 22": regular,
    "grid, 12x12": grid,
    "two layers, 20x20": layers(20, 0.0),
    "two layers, mean-cancelled, 20x20": layers(20, 1.0),
}


def measure(n_problems: int, families: list[str]) -> list[dict[str, object]]:
    """A row for each family and solver."""
    rows = []
    for family in families:
        draw, counts = FAMILIES[family], {name: [0, 0, 0, 0.0] for name in SOLVERS}
        for k in range(n_problems):
            qubo, minimum = draw(rng.numpy_stream(k, family))
            for name, solver in SOLVERS.items():
                found = Search().run(qubo, solver, seed=k)
                wrong = found.states[0].energy > minimum + 1e-9
                proven = found.conclusion is Status.OPTIMAL
                assert not (proven and wrong)
                # Of descents, too, whose status is never AGREED: this is why.
                agreed = not proven and replace(found, status=[Status.STEP_BUDGET] * len(found.status)).agree
                for column, value in enumerate((wrong, agreed, agreed and wrong, found.wall_time_s)):
                    counts[name][column] += value
        for name, (wrong, agreed, both, seconds) in counts.items():
            columns = {"problems": n_problems, "wrong": wrong, "agreed": agreed, "agreed_and_wrong": both}
            rows.append({"family": family, "solver": name, **columns, "ms": round(1e3 * seconds / n_problems, 2)})
            print(rows[-1], flush=True)
    return rows


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--problems", type=int, default=1667, help="of each family")
    parser.add_argument("--families", nargs="+", choices=FAMILIES, default=[*FAMILIES], metavar="FAMILY")
    parser.add_argument("--out", type=Path, default=Path(__file__).with_name("results.csv"))
    given = parser.parse_args()
    begin = time.perf_counter()
    rows = measure(given.problems, given.families)
    with given.out.open("w", newline="") as file:
        writer = csv.DictWriter(file, rows[0].keys())
        writer.writeheader()
        writer.writerows(rows)
    print(f"{(time.perf_counter() - begin) / 60:.1f} minutes")
