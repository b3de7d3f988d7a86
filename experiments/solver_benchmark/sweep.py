"""Measuring: a file of results that grows line by line, the sweep that tunes, the runs that are reported."""

import dataclasses
import functools
import hashlib
import importlib.metadata
import json
import math
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import measure
from exact import branch_and_bound, highs
from families import Family, Purpose
from instances import Instance
from opponents import Opponent, Reads
from side_by_side import OF_THE_PACKAGE, SOLVERS

import memcomp_lightning
from memcomp_lightning.errors import SettingError
from memcomp_lightning.problems import Bipartite, Qubo, WeightedMaxSat, to_qubo

Row = dict[str, Any]
N_FINALISTS = 3
PACKAGES = ("dwave-samplers", "dimod", "simulated-bifurcation", "torch", "numpy", "numba", "scipy")


class Effort(NamedTuple):
    """How long and how often at most a setting is measured on an instance."""

    seconds: float
    max_reads: int


class Setting(NamedTuple):
    """A solver with what it may spend."""

    solver: Opponent
    budget: int

    @property
    def label(self) -> str:
        """For tables."""
        options = [(field.default, getattr(self.solver, field.name)) for field in dataclasses.fields(self.solver)]
        changed = [str(value) for default, value in options if value != default]
        return " ".join([str(self.budget), *changed]) if self.budget else "defaults"


class Store:
    """Measurements by their settings, in a file of JSON lines that is only ever appended to."""

    def __init__(self, path: Path) -> None:
        self.path, self.rows = path, {}
        path.parent.mkdir(parents=True, exist_ok=True)
        lines = path.read_text().splitlines() if path.exists() else []
        for line in lines:
            try:
                row = json.loads(line)
            except json.JSONDecodeError:  # cut off when the run was stopped
                continue
            self.rows[row["key"]] = row
        if lines and not path.read_bytes().endswith(b"\n"):
            with path.open("a") as file:
                file.write("\n")

    def get(self, settings: Row, run: Callable[[], Row]) -> Row:
        """Return the row of these settings, measured now unless it is there."""
        key = hashlib.sha256(json.dumps(settings, sort_keys=True).encode()).hexdigest()[:16]
        if key not in self.rows:
            self.rows[key] = {"key": key, **settings, **run()}
            with self.path.open("a") as file:
                file.write(json.dumps(self.rows[key]) + "\n")
        return self.rows[key]

    def lowest(self, digest: str, known: float | None = None) -> float:
        """Lowest energy of all runs of an instance, whenever they were, and of what is known."""
        rows = (row for row in self.rows.values() if row.get("digest") == digest)
        found = [min(row["energies"]) for row in rows if row.get("energies")]
        return min([*found, math.inf if known is None else known])


@functools.cache
def version(solver: str) -> str:
    """Changes when the numbers may: of the package's solvers their source, of others the packages' versions."""
    if solver in OF_THE_PACKAGE:
        folder = Path(memcomp_lightning.__file__).parent / "solvers"
        files = (folder / "dmm").rglob("*.py") if solver.startswith("DMM") else _SOURCES[solver]
        paths = sorted(path if isinstance(path, Path) else folder / path for path in files)
        source = b"".join(path.read_bytes() for path in paths)
        return hashlib.sha256(source).hexdigest()[:12]
    return " ".join(importlib.metadata.version(package) for package in PACKAGES[:3])


_ANNEALING = ("annealing.py", "kernels/annealing.py")
_TABU = ("tabu.py", "kernels/tabu.py")
_CROSSOVER = ("crossover.py", "kernels/crossover.py", *_ANNEALING)
_SOURCES: dict[str, tuple[str, ...]] = {
    "annealing": _ANNEALING,
    "tabu": _TABU,
    "crossover": _CROSSOVER,
    "best": ("best.py", *_TABU, *_CROSSOVER),
}


def measured(store: Store, setting: Setting, instance: Instance, purpose: Purpose, effort: Effort) -> Row:
    """Measure one setting on one instance; the pilot runs warm the solver up and are not counted."""

    def run() -> Row:
        n_reads, seed = 4, 1
        try:
            reads, busy = _watched(setting, instance, n_reads, seed)
            while True:
                affordable = int(effort.seconds * n_reads / max(reads.seconds, 1e-9))
                wanted = min(affordable, effort.max_reads, 16 * n_reads)
                if wanted <= 1.5 * n_reads:
                    break
                n_reads, seed = wanted, seed + 1
                reads, busy = _watched(setting, instance, n_reads, seed)
        except (SettingError, TypeError, AttributeError) as error:
            return {"error": f"{type(error).__name__}: {error}"}
        energies = [round(float(energy), 9) for energy in reads.energies]
        return {"energies": energies, "seconds": reads.seconds, "build_seconds": reads.build_seconds, "busy": busy}

    settings = {
        "purpose": purpose,
        "family": instance.family,
        "instance": instance.name,
        "digest": instance.digest,
        "solver": setting.solver.name,
        "variant": dataclasses.asdict(setting.solver),
        "budget": setting.budget,
        "label": setting.label,
        "effort": list(effort),
        "version": version(setting.solver.name),
    }
    return store.get(settings, run)


def _watched(setting: Setting, instance: Instance, n_reads: int, seed: int) -> tuple[Reads, float]:
    """Run once; also the share of the wall time that this process computed: below .9 others took the core."""
    wall, cpu = time.perf_counter(), time.process_time()
    reads = setting.solver.run(instance.problem, n_reads=n_reads, budget=setting.budget, seed=seed)
    return reads, (time.process_time() - cpu) / (time.perf_counter() - wall)


def tune(store: Store, family: Family, effort: Effort, limit: int | None) -> Iterator[Row]:
    """Sweep every solver over budgets and variants on the family's instances for tuning."""
    for instance in family.instances("tuning", limit):
        for kind in SOLVERS:
            for variant in kind.variants:
                for budget in kind.budgets:
                    row = measured(store, Setting(kind(**variant), budget), instance, "tuning", effort)
                    yield row
                    if "error" in row or row["seconds"] / len(row["energies"]) > effort.seconds:
                        break  # a larger budget takes longer still


def tuned_for(family: Family, everything: list[Family]) -> list[Family]:
    """The families whose tuning a family uses: itself, or the two nearest sizes of its group."""
    if family.n_tuning:
        return [family]
    others = [other for other in everything if other.group == family.group and other.n_tuning]
    return sorted(others, key=lambda other: abs(math.log(other.n / family.n)))[:2]


def finalists(
    store: Store, tuned: dict[str, list[Row]], family: Family, everything: list[Family], kind: type[Opponent]
) -> list[Setting]:
    """The best settings of a solver on the family's instances for tuning, best first.

    By TTS99, or by the gap at the family's horizon. A size that was not tuned on takes the best settings of the
    two nearest sizes of its group that were, and the nearest one's with the next larger budgets.
    """
    if not family.n_tuning:
        columns = [finalists(store, tuned, other, everything, kind) for other in tuned_for(family, everything)]
        found = [column[0] for column in columns if column]
        larger = [found[0]._replace(budget=b) for b in kind.budgets if b > found[0].budget] if found else []
        return list(dict.fromkeys([*found, *larger]))[:N_FINALISTS]
    rows: dict[Setting, list[Row]] = {}
    for row in tuned[family.name]:
        if row["solver"] == kind.name and "error" not in row:
            options = {name: tuple(v) if isinstance(v, list) else v for name, v in row["variant"].items()}
            rows.setdefault(Setting(kind(**options), row["budget"]), []).append(row)
    n_instances = max((len(group) for group in rows.values()), default=0)
    complete = [setting for setting, group in rows.items() if len(group) == n_instances]
    return sorted(complete, key=lambda setting: _merit(store, family, rows[setting]))[:N_FINALISTS]


def _merit(store: Store, family: Family, rows: list[Row]) -> float:
    results = [(row["energies"], row["seconds"], store.lowest(row["digest"])) for row in rows]
    if family.horizon is None:
        return measure.ranking([measure.tally(*result) for result in results])
    gaps = [measure.expected_gap(*result, family.horizon) for result in results]
    return math.inf if any(math.isnan(gap) for gap in gaps) else sum(gaps)


def report(
    store: Store,
    family: Family,
    chosen: dict[type[Opponent], list[Setting]],
    effort: Effort,
    limit: int | None,
    proof_seconds: float,
) -> Iterator[Row]:
    """Run the finalists of all solvers in turns on the family's instances for reporting, then try to prove."""
    effort = effort._replace(seconds=max(effort.seconds, 2 * (family.horizon or 0)))
    for instance in family.instances("report", limit):
        for settings in chosen.values():
            for setting in settings:
                yield measured(store, setting, instance, "report", effort)
        best = store.lowest(instance.digest, instance.best_known)
        settings = {
            "purpose": "proof",
            "family": family.name,
            "instance": instance.name,
            "digest": instance.digest,
            "n": instance.problem.n,
            "best_known": instance.best_known,
            "how": instance.how,
            "best": best,
            "seconds_limit": proof_seconds,
        }
        yield store.get(settings, lambda instance=instance, best=best: _proof(instance, best, proof_seconds))


def _proof(instance: Instance, best: float, seconds: float) -> Row:
    """Branch and bound of an RBM, HiGHS of a small sparse problem; nothing else is worth the try."""
    problem = instance.problem
    if isinstance(problem, WeightedMaxSat) and not problem.longer:
        problem = to_qubo(problem)
    if isinstance(problem, Qubo) and isinstance(problem.graph, Bipartite):
        smaller, larger = sorted((problem.graph.n_first, problem.graph.n_second))
        hope = 1.0 if smaller <= 40 else 0.1  # beyond, no attempt has succeeded yet
        max_nodes = int(3e9 * seconds * hope / (smaller * larger))
        prover, proof = "branch and bound", branch_and_bound(problem, incumbent=best, max_nodes=max_nodes)
    elif isinstance(problem, Qubo) and len(problem.graph.edges()) <= 1000:
        prover, proof = "HiGHS", highs(problem, time_limit=seconds)
    else:
        return {}
    return {"prover": prover, "proven": proof.proven, "energy": proof.energy, "proof_seconds": proof.seconds}
