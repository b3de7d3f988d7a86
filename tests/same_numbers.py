"""Compare the numbers of two checkouts on this machine, bit for bit: run by hand when code moves.

    python tests/same_numbers.py OLD NEW [NAME...]

OLD and NEW are folders with a checkout each (``git worktree add``); names choose some of the commands below. Each
command runs with either checkout on the path. What it leaves is compared: weights, results, records, solutions.
Ends with 1 if something differs.
"""

import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import torch

SMALL = [
    "callbacks=minimal",
    "logger=none",
    "pretrain.iterations=2",
    "finetune.iterations=2",
    "solver.max_steps=60",
]
FIGURE = ["data=digits", "data.partitions=2", "figure.passes=[1,2]", "figure.iterations=[2]", "figure.workers=1"]
FIGURE += ["figure.controls_at=[2]", "solver.max_steps=40", "solver.n_restarts=4"]
WORTH = [
    "worth.data_sets.shifting_bars.passes=60",
    "worth.replicas=2",
    "worth.choosing=1",
    "worth.points=3",
    "worth.rates=[0.3]",
    "worth.workers=1",
]
EXACT = ["data=shifting_bars", "model.hidden_sizes=[7]", "finetune.batch_size=9"]
SAMPLERS = (
    "cd",
    "pcd",
    "parallel_tempering",
    "quench",
    "dmm_qubo",
    "dmm_time_average",
    "annealer",
)

COMMANDS = {
    **{name: ["train", f"sampler={name}", *SMALL] for name in SAMPLERS},
    "mode_assisted_pcd": ["train", "sampler=mode_assisted_pcd", "solver=dmm", *SMALL],
    "exact": ["train", "sampler=exact", *EXACT, *SMALL],
    "paper": ["train", "preset=paper", *SMALL],
    "centred_momentum": ["train", "sampler=pcd", "pretrain=centred", "preset=paper", *SMALL],
    "joint": ["train", "sampler=pcd", "pretrain=joint", *SMALL],
    "machine": ["train", "sampler=pcd", "model=boltzmann", "pretrain=boltzmann", *SMALL, "finetune.iterations=0"],
    "graph": ["train", "experiment=annealer_graph", "data=digits", "model.connectivity.size=1", *SMALL[:3]],
    "baseline": ["train", "model=baseline_bn_relu", *SMALL],
    "likelihood": ["train", "sampler=cd", "model.hidden_sizes=[12]", *SMALL[1:], "finetune.iterations=0"],
    "figure4": ["train", "experiment=figure4", *FIGURE],
    "figure_joint": ["train", "experiment=joint", *FIGURE],
    "worth": ["train", "experiment=sampler_worth", "worth.only=[shifting_bars]", *WORTH],
    "joint_likelihood": ["train", "experiment=joint_likelihood", "worth.only=[shifting_bars]", *WORTH],
    **{
        f"solve_{name}": ["solve", "problem=problem.txt", f"solver={name}"]
        for name in ("dmm", "dmm_bond", "annealing", "alternating_descent", "brute_force")
    },
}
NOT_COMPARED = ("_target_", "seconds", "time", "memcomp_lightning", "source", "file", "path", "version")


def problem() -> str:
    """A random graph of 18 vertices, in the format of G-set."""
    edges = [(i, j) for i in range(1, 19) for j in range(i + 1, 19) if (i * 7 + j * 13) % 5 < 2]
    return "\n".join([f"18 {len(edges)}", *(f"{i} {j} {(i * j) % 7 - 3}" for i, j in edges)]) + "\n"


def run(checkout: Path, folder: Path, command: list[str]) -> None:
    folder.mkdir(parents=True)
    (folder / "problem.txt").write_text(problem())
    name, *arguments = command
    done = subprocess.run(
        [sys.executable, "-m", f"memcomp_lightning.cli.{name}", *arguments, "hydra.run.dir=run"],
        cwd=folder,
        env={**os.environ, "PYTHONPATH": str(checkout.resolve()), "OMP_NUM_THREADS": "1"},
        capture_output=True,
        text=True,
        check=False,
    )
    if done.returncode:
        sys.exit(f"{checkout}: memcomp-{name} {' '.join(arguments)}\n{done.stderr[-2000:]}")


def numbers(value: object, name: str = "") -> Iterator[tuple[str, object]]:
    """All that is compared in a parsed JSON value, with its place."""
    if isinstance(value, dict):
        for key, inner in value.items():
            if not key.endswith("_s") and not any(word in key for word in NOT_COMPARED):
                yield from numbers(inner, f"{name}.{key}")
    elif isinstance(value, list):
        for number, inner in enumerate(value):
            yield from numbers(inner, f"{name}[{number}]")
    else:
        yield name, value


def left(folder: Path) -> dict[str, object]:
    """What a command left, by place."""
    found: dict[str, object] = {}
    for path in sorted(folder.rglob("*")):
        place = str(path.relative_to(folder))
        if path.suffix == ".pt":
            found |= {f"{place} {k}": v for k, v in torch.load(path, weights_only=True).items()}
        elif path.name in ("result.json", "solution.json"):
            found |= {f"{place} {k}": v for k, v in numbers(json.loads(path.read_text()))}
        elif path.name in ("records.jsonl", "courses.jsonl"):
            for record in map(by_present_names, map(json.loads, path.read_text().splitlines())):
                key = tuple(
                    record.get(name) for name in ("data_set", "method", "value", "iterations", "seed", "choosing")
                )
                found |= {f"record {key} {k}": v for k, v in numbers({n: record[n] for n in ("at", "measures")})}
    return found


def by_present_names(record: dict[str, Any]) -> dict[str, Any]:
    """A record as it is written now, from one of version 0.2.0 or before."""
    if "curve" in record:
        old = ("curve", "choice", "passes", "scores")
    elif "rate" in record:
        old = ("method", "rate", "updates", "measures")
        names = {"scores": "score", "reverse": "reverse", "cosines": "cosine", "errors": "relative_error"}
        measures = {name: record[before] for before, name in names.items() if record[before]}
        record = {**record, "measures": measures, "iterations": None, "seed": None, "choosing": False}
    else:
        return {**record, "data_set": record["data_set"] or None}
    return {
        **record,
        **{now: record[name] for name, now in zip(old, ("method", "value", "at", "measures"), strict=True)},
    }


def same(one: object, other: object) -> bool:
    if isinstance(one, torch.Tensor):
        return isinstance(other, torch.Tensor) and one.dtype == other.dtype and one.equal(other)
    return one == other or (one != one and other != other)


def main(old: str, new: str, *names: str) -> None:
    failed = False
    for name in names or COMMANDS:
        with tempfile.TemporaryDirectory() as place:
            for side, checkout in (("old", old), ("new", new)):
                run(Path(checkout), Path(place) / side, COMMANDS[name])
            before, after = (left(Path(place) / side / "run") for side in ("old", "new"))
        differ = [key for key in before.keys() | after.keys() if not same(before.get(key), after.get(key))]
        failed |= bool(differ) or not before
        print(f"{name}: {len(before)} values, {len(differ)} differ", *sorted(differ)[:5], sep="\n  ", flush=True)
    sys.exit(failed)


if __name__ == "__main__":
    main(*sys.argv[1:])
