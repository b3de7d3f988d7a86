"""What the tables cannot tell: single calls with defaults beside the clock, batches, cost against couplings."""

import multiprocessing
import resource
import statistics
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import torch
from families import Family
from instances import Instance, random_graph_of, random_rbm
from opponents import SimulatedAnnealing, energies
from sweep import Row, Store, version

from memcomp_lightning import rng
from memcomp_lightning.problems import Qubo
from memcomp_lightning.solvers import Portfolio, QuboSolver
from memcomp_lightning.solvers.dmm import DmmSolver

N_CALLS = 10
SOLVERS = {"DMM": DmmSolver(), "best": Portfolio(), "best, four times the effort": Portfolio(effort=4.0)}
"""What is called as it is: the DMM on 32x32, the portfolio on files, beside SA's 28 reads of 1,000 sweeps."""

COUPLINGS = (10_000, 30_000, 100_000, 300_000, 1_000_000)


def reference_solver() -> DmmSolver:
    """The DMM on the reference kernel."""
    return DmmSolver(kernel="reference")


def calls(store: Store, family: Family, limit: int | None) -> Iterator[Row]:
    """Warm calls on each reported instance: of the DMM on 32x32 and planted 200x200, of the portfolio on files.

    Those on files are made in turns with SA, 28 reads of 1,000 sweeps with its own temperatures.
    """
    is_file = family.group in ("G-set", "Beasley")
    if not is_file and family.size not in ("32x32", "200x200"):
        return
    for instance in family.instances("report", limit):
        for name, solver in SOLVERS.items():
            if name.startswith("best") != is_file:
                continue
            settings = {
                "purpose": "calls",
                "family": family.name,
                "instance": instance.name,
                "digest": instance.digest,
                "solver": name,
                "version": version(name.split(",")[0]),
            }
            yield store.get(settings, lambda instance=instance, solver=solver: _calls(instance, solver, is_file))


def _calls(instance: Instance, solver: QuboSolver, beside_sa: bool) -> Row:
    problem, n_calls = instance.problem, 3 if beside_sa else N_CALLS
    generator = rng.stream(7, f"calls {instance.name}")
    solver.minimise(problem, generator=generator)
    seconds, best, others, other_best = [], [], [], []
    for seed in range(n_calls):
        begin = time.perf_counter()
        solution = solver.minimise(problem, generator=generator)
        seconds.append(time.perf_counter() - begin)
        best.append(float(energies(problem, solution.assignments).min()))
        if beside_sa:
            reads = SimulatedAnnealing().run(problem, n_reads=28, budget=1000, seed=seed)
            others.append(reads.seconds)
            other_best.append(float(reads.energies.min()))
    row: Row = {"energies": best, "call_seconds": seconds}
    return row | ({"opponent_seconds": others, "opponent_energies": other_best} if beside_sa else {})


def throughput(store: Store, n_problems: int) -> Row:
    """Many 32x32 problems in one call against one call each on the reference kernel (20 of them are timed)."""

    def run() -> Row:
        generator = rng.stream(7, "throughput")
        draw = {"cancelled": 1.0, "bias_std": 0.5, "generator": generator}
        singles = [random_rbm(32, 32, 1.0, **draw) for _ in range(n_problems)]
        batch = Qubo(singles[0].graph, *(torch.stack([getattr(q, name) for q in singles]) for name in _TENSORS))
        together = _seconds(lambda: DmmSolver().minimise(batch, generator=generator))
        timed = singles[: min(20, n_problems)]
        one = statistics.mean(
            _seconds(lambda q=q: reference_solver().minimise(q, generator=generator)) for q in timed
        )
        return {"batch_seconds": together, "single_seconds": one * n_problems}

    return store.get({"purpose": "throughput", "n_problems": n_problems, "version": version("DMM")}, run)


_TENSORS = ("coupling", "linear", "offset")


def _seconds(call: Callable[[], object]) -> float:
    """Time of a call, after one that warms up."""
    call()
    begin = time.perf_counter()
    call()
    return time.perf_counter() - begin


def linear_cost(store: Store, n_couplings: int) -> Row:
    """Seconds a step and memory of sparse random problems, each size in a process of its own."""

    def run() -> Row:
        with multiprocessing.get_context("spawn").Pool(1) as pool:
            return pool.apply(_cost, (n_couplings,))

    return store.get({"purpose": "linear cost", "n_couplings": n_couplings, "version": version("DMM")}, run)


def _cost(n_couplings: int) -> Row:
    torch.set_num_threads(1)
    generator = rng.stream(7, f"linear {n_couplings}")
    small, problem = (random_graph_of(m // 5, m, generator=generator) for m in (100, n_couplings))
    replace(DmmSolver(), n_restarts=4, max_steps=10).minimise(small, generator=generator)  # compiles
    before, seconds = _peak_bytes(reset=True), {}
    for n_steps in (10, 60):  # the difference leaves out what a call costs once
        solver = replace(DmmSolver(), n_restarts=4, max_steps=n_steps)
        seconds[n_steps] = _seconds(lambda solver=solver: solver.minimise(problem, generator=generator))
    return {"step_seconds": (seconds[60] - seconds[10]) / 50 / 4, "bytes": _peak_bytes() - before}


def _peak_bytes(*, reset: bool = False) -> int:
    """Largest memory of this process since the last reset (Linux; elsewhere since its start)."""
    clear, status = Path("/proc/self/clear_refs"), Path("/proc/self/status")
    if not status.exists():
        return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024
    if reset:
        clear.write_text("5")
    return (
        int(next(line for line in status.read_text().splitlines() if line.startswith("VmHWM")).split()[1]) * 1024
    )
