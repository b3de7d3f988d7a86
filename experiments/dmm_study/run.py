"""What each part of the DMM contributes: memories, noise, lag, quench, integrators, stalls, warm restarts.

    python experiments/dmm_study/run.py

Success per restart on random RBMs, with 95 % Wilson intervals over all restarts of a family. The lowest energy
known is the best of all runs of this study and of 200 restarts with ten times the steps. The instances come
from seeds that no constant was searched on.
"""

import argparse
import math
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import matplotlib
import torch

from memcomp_lightning import rng
from memcomp_lightning.models import RBM, Normal
from memcomp_lightning.problems import Qubo, from_model
from memcomp_lightning.solvers.dmm import (
    AdaptiveEuler,
    BondField,
    ClauseField,
    DmmSolver,
    Heun,
    Splitting,
    Strang,
    WarmRestart,
)

matplotlib.use("Agg")
from matplotlib import pyplot as plt

HERE = Path(__file__).parent
N_INSTANCES = 6
N_RESTARTS = 28


def random_rbms(n: int, *, cancel_mean: bool) -> Qubo:
    """Independent RBMs with N(0, 1) weights; ``cancel_mean`` sets b_j = -sum_i w_ij / 2 and c likewise."""
    generator = rng.stream(301, f"study {n} {cancel_mean}")
    rbm = RBM(n, n, replicas=(N_INSTANCES,), weight_init=Normal(std=1.0), generator=generator)
    with torch.no_grad():
        rbm.b.normal_(0, 0.5, generator=generator)
        rbm.c.normal_(0, 0.5, generator=generator)
        if cancel_mean:
            rbm.b.sub_(rbm.weight.sum(-2) / 2)
            rbm.c.sub_(rbm.weight.sum(-1) / 2)
    return from_model(rbm)


class Study:
    """Families of problems and the lowest energies known of them."""

    def __init__(self) -> None:
        self.families = {
            "32x32": random_rbms(32, cancel_mean=False),
            "32x32 mean-cancelled": random_rbms(32, cancel_mean=True),
            "100x100 mean-cancelled": random_rbms(100, cancel_mean=True),
        }
        self.runs: list[tuple[str, str, torch.Tensor, float]] = []
        self.lowest = {}
        for name, qubo in self.families.items():
            thorough = DmmSolver(n_restarts=200, max_steps=3000, stall=None)
            self.lowest[name] = thorough.minimise(qubo, generator=rng.stream(302, name)).best_energy

    def run(self, label: str, solver: DmmSolver, *, only: str = "") -> None:
        """Run a solver on the families whose names contain ``only``."""
        for name, qubo in self.families.items():
            if only in name:
                solution = solver.minimise(qubo, generator=rng.stream(303, name))
                self.lowest[name] = torch.minimum(self.lowest[name], solution.best_energy)
                self.runs.append((label, name, solution.energies, solution.wall_time_s))

    def success(self, label: str, family: str) -> tuple[float, float, float]:
        """Share of restarts at the lowest energy known, and its interval."""
        energies = next(e for row, name, e, _ in self.runs if (row, name) == (label, family))
        lowest = self.lowest[family].unsqueeze(-1)
        hits = energies <= lowest + 1e-6 * lowest.abs()
        return wilson(int(hits.sum()), int(energies.isfinite().sum()))

    def table(self, labels: list[str], families: list[str]) -> str:
        """Markdown, one row a label."""
        lines = [f"| | {' | '.join(families)} |", "| --- |" + " --- |" * len(families)]
        for label in labels:
            cells = ["{:.2f} ({:.2f}-{:.2f})".format(*self.success(label, family)) for family in families]
            lines.append(f"| {label} | {' | '.join(cells)} |")
        return "\n".join(lines)

    def seconds(self, label: str, family: str) -> float:
        """Until a success with a probability of .99, restarts one after the other."""
        energies, wall = next((e, t) for row, name, e, t in self.runs if (row, name) == (label, family))
        p = max(self.success(label, family)[0], 0.1 / energies.numel())
        return wall / energies.numel() * max(1.0, math.log(0.01) / math.log1p(-min(p, 0.999999)))


def wilson(hits: int, n: int, z: float = 1.96) -> tuple[float, float, float]:
    """Share and its 95 % interval."""
    p = hits / n
    centre = (p + z * z / (2 * n)) / (1 + z * z / n)
    half = z / (1 + z * z / n) * math.sqrt(p * (1 - p) / n + z * z / (4 * n * n))
    return p, centre - half, centre + half


def memories(study: Study) -> None:
    """Take the parts of both fields away, one at a time."""
    clause, bond = ClauseField(), BondField()
    # A rate of 1e-9 keeps the short-term memories where they start.
    published = ClauseField(
        alpha=5.0, beta=20.0, gamma=0.25, delta=0.05, epsilon=1e-3, zeta=0.1, long_term_max=1e7, spread=1.0
    )
    euler = AdaptiveEuler(change=1.0, dt_min=2**-7, dt_max=1e3)
    variants: dict[str, Callable[[], DmmSolver]] = {
        "clause dynamics": lambda: DmmSolver(field=clause),
        "- long-term memory frozen at 1": lambda: DmmSolver(field=replace(clause, long_term_max=1.0)),
        "- short-term memory frozen at x_s(0)": lambda: DmmSolver(field=replace(clause, beta=1e-9)),
        "- zeta = 0.1": lambda: DmmSolver(field=replace(clause, zeta=0.1)),
        "- with noise 0.3": lambda: DmmSolver(field=replace(clause, noise=0.3)),
        "- no lag": lambda: DmmSolver(field=clause, integrator=replace(clause.integrator, lag=0.0)),  # type: ignore
        "- voltages alone, no quench": lambda: DmmSolver(field=clause, quench_every=0),
        "- quench alone: machine stopped after one step": lambda: DmmSolver(field=clause, max_steps=1),
        "- constants and scheme published for 3-SAT": lambda: DmmSolver(field=published, integrator=euler),
        "bond dynamics": lambda: DmmSolver(field=bond),
        "- Y frozen at 1": lambda: DmmSolver(field=replace(bond, long_term_max=1.0)),
        **{
            f"- X frozen at {x}": lambda x=x: DmmSolver(
                field=replace(bond, gamma=1.0, kappa=0.0, long_term_max=1.0, short_term_start=x)
            )
            for x in (0.1, 0.2, 0.4)
        },
        "- bond without noise": lambda: DmmSolver(field=replace(bond, noise=0.0)),
        "- bond, voltages alone, no quench": lambda: DmmSolver(field=bond, quench_every=0),
    }
    for label, make in variants.items():
        study.run(label, replace(make(), stall=None))
    print("\n## Memories, noise, lag and quench\n")
    print(study.table(list(variants), list(study.families)))


def integrators(study: Study) -> None:
    """Success at equal numbers of evaluations of the vector field, for each scheme and step size."""
    family = "32x32 mean-cancelled"
    budget = 200
    changes = (0.125, 0.25, 0.5, 0.7, 1.0, 1.4, 2.0, 4.0)
    own: Any = ClauseField().integrator
    schemes: dict[str, tuple[Any, int]] = {
        f"Splitting, lag {own.lag:g}": (partial(Splitting, lag=own.lag), 1),
        "Splitting": (Splitting, 1),
        "AdaptiveEuler": (AdaptiveEuler, 1),
        "Strang": (Strang, 2),
        "Heun": (Heun, 2),
    }
    figure, axis = plt.subplots(figsize=(5, 3.4), layout="constrained")
    labels = []
    for name, (scheme, evaluations) in schemes.items():
        for change in changes:
            solver = DmmSolver(
                integrator=scheme(change=change, dt_min=own.dt_min, dt_max=own.dt_max),
                max_steps=budget // evaluations,
                n_restarts=N_RESTARTS,
                quench_every=1,
                stall=None,
                kernel="reference",
            )
            label = f"{name}, {change:g}"
            study.run(label, solver, only=family)
            labels.append(label)
    for name in schemes:
        points = [study.success(f"{name}, {change:g}", family) for change in changes]
        p, low, high = zip(*points, strict=True)
        axis.plot(changes, p, marker="o", markersize=4, label=name)
        axis.fill_between(changes, low, high, alpha=0.15)
    axis.set_xscale("log", base=2)
    axis.set_xlabel("root mean square change of the voltages in a step")
    axis.set_ylabel(f"success per restart, {budget} evaluations")
    axis.set_ylim(0, 1)
    axis.legend(frameon=False, fontsize=8)
    figure.savefig(HERE / "step_size.png", dpi=150)
    print(f"\n## Integrators: {family}, {budget} evaluations a restart, by `change`\n")
    print("| | " + " | ".join(f"{change:g}" for change in changes) + " |")
    print("| --- |" + " --- |" * len(changes))
    for name in schemes:
        cells = [f"{study.success(f'{name}, {change:g}', family)[0]:.2f}" for change in changes]
        print(f"| {name} | {' | '.join(cells)} |")


def stalls(study: Study) -> None:
    """What it saves to end restarts that find nothing better."""
    variants = {"no stall": DmmSolver(stall=None), **{f"stall {s:g}": DmmSolver(stall=s) for s in STALLS}}
    for label, solver in variants.items():
        study.run(label, solver)
    print("\n## Stalls: milliseconds until the optimum is found with a probability of .99\n")
    print(f"| | {' | '.join(study.families)} |\n| --- |" + " --- |" * len(study.families))
    for label in variants:
        cells = [f"{1e3 * study.seconds(label, family):.3g}" for family in study.families]
        print(f"| {label} | {' | '.join(cells)} |")


STALLS = (1.0, 2.0, 4.0, 8.0)


def restarts(study: Study) -> None:
    """Cold against warm restarts, four in a row."""
    variants = {
        "cold": DmmSolver(n_restarts=112, patience=28),
        **{
            f"keep {keep}, spread {spread}": DmmSolver(
                n_restarts=112, patience=28, warm=WarmRestart(keep=keep, spread=spread)
            )
            for keep in (0.0, 0.5, 1.0)
            for spread in (0.1, 0.5, 2.0)
        },
    }
    for label, solver in variants.items():
        # Every row of four restarts is run to its end.
        study.run(label, replace(solver, stall=None))
    print("\n## Restarts: rows of up to four restarts, cold or warm\n")
    print(study.table(list(variants), list(study.families)))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.parse_args()
    torch.set_num_threads(1)
    study = Study()
    memories(study)
    integrators(study)
    stalls(study)
    restarts(study)


if __name__ == "__main__":
    main()
