"""Models of aligned sequences: an RBM of categorical units and a Potts model, beside other packages' on one split.

    RUN="python experiments/units/sequences.py"
    $RUN split --family kunitz --out F
    $RUN train --model rbm --train F/train.npz --seconds 120 --out F/rbm.npz
    PEERS/bin/python experiments/units/peers.py --peer rbms --train F/train.npz --seconds 120 --out F/rbms.npz
    $RUN judge F --samples F/rbm.npz F/rbms.npz
    $RUN likelihood F --models F/rbm.pt
    $RUN modes F --models F/rbm.pt

`split` reads `$MEMCOMP_DATA_DIR/sequences/FAMILY.fasta.gz`, drops rows that stand twice, and divides clusters of
rows, not rows: neighbours of 80 % identity, and theirs, stay together, so that no held-out row has a near copy
among the training rows. A fifth of the rows is held out (test.npz); a tenth of the others chooses the settings
(validation.npz), the rest is fit.npz. train.npz is fit and validation together.

`train` writes what peers.py writes, in the same format, and the weights (.pt). Seconds are those of the processor.
Samples are chains that begin in uniformly random states.
"""

import argparse
import gzip
import json
import os
import time
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Any

import ground_states
import numpy as np
import torch
from site_statistics import ALPHABET, N_STATES, RNA, compare, one_site
from torch import Tensor
from torch.optim import SGD

from memcomp_lightning import rng
from memcomp_lightning.data import Batches
from memcomp_lightning.likelihood import Ais, ReverseAis, base_of, log_likelihood, log_pseudo_likelihood
from memcomp_lightning.models import RBM, BoltzmannMachine, start_at_means
from memcomp_lightning.models.units import Bernoulli, Categorical, ReLU
from memcomp_lightning.objective import Centring
from memcomp_lightning.samplers import (
    PCD,
    BlockAnnealing,
    GroundState,
    ModeAssisted,
    ModeSchedule,
    PseudoLikelihood,
)
from memcomp_lightning.solvers import GibbsAnnealing
from memcomp_lightning.training import L2, Boltzmann, Greedy, Phase, PhaseTraining

FAMILIES = {"kunitz": ALPHABET, "RF00379": RNA}
IDENTITY = 0.8
HELD_OUT, VALIDATION = 0.2, 0.1

# ---------------------------------------------------------------------------------------------------- the rows


def read_fasta(path: Path, alphabet: str) -> np.ndarray:
    """(n, L) numbers of letters; headers begin with one ">" or two."""
    rows: list[str] = []
    with gzip.open(path, "rt") as file:
        for line in file:
            if line.startswith(">"):
                rows.append("")
            else:
                rows[-1] += line.strip()
    state_of = {letter: state for state, letter in enumerate(alphabet)}
    return np.array([[state_of[letter] for letter in row] for row in rows])


def clusters(rows: np.ndarray, n_states: int, identity: float = IDENTITY) -> np.ndarray:
    """(n,) number of the cluster of each row: rows that share so many of their sites are together."""
    units = np.zeros((*rows.shape, n_states), np.float32)
    np.put_along_axis(units, rows[..., None], 1.0, axis=-1)
    units = units.reshape(len(rows), -1)
    found = np.full(len(rows), -1)
    for first in range(len(rows)):
        if found[first] >= 0:
            continue
        edge, found[first] = np.array([first]), first
        while len(edge):
            near = (units[edge] @ units.T >= identity * rows.shape[1] - 1e-3).any(0) & (found < 0)
            edge = np.flatnonzero(near)
            found[edge] = first
    return found


def parts(rows: np.ndarray, n_states: int, seed: int = 0) -> dict[str, np.ndarray]:
    """The rows of each part, each once; a cluster is in one part."""
    rows = np.unique(rows, axis=0)
    cluster = clusters(rows, n_states)
    order = rng.numpy_stream(seed, "split").permutation(np.unique(cluster))
    sizes = np.array([(cluster == number).sum() for number in order])
    before = (np.cumsum(sizes) - sizes) / len(rows)
    held_out = before < HELD_OUT
    validation = ~held_out & (before < HELD_OUT + (1 - HELD_OUT) * VALIDATION)
    found = {}
    for name, numbers in (
        ("test", order[held_out]),
        ("validation", order[validation]),
        ("fit", order[~held_out & ~validation]),
        ("train", order[~held_out]),
    ):
        found[name] = rows[np.isin(cluster, numbers)]
    return found


def split(given: argparse.Namespace) -> None:
    alphabet = FAMILIES[given.family]
    path = Path(os.environ["MEMCOMP_DATA_DIR"]) / "sequences" / f"{given.family}.fasta.gz"
    rows = read_fasta(path, alphabet)
    given.out.mkdir(parents=True, exist_ok=True)
    found = parts(rows, len(alphabet), given.seed)
    for name, some in found.items():
        np.savez_compressed(given.out / f"{name}.npz", indices=some, alphabet=np.array(alphabet))
    print(json.dumps({"rows": len(rows)} | {name: len(some) for name, some in found.items()}))


def load(path: Path) -> tuple[np.ndarray, str]:
    with np.load(path) as file:
        return file["indices"], str(file["alphabet"]) if "alphabet" in file else ALPHABET


# -------------------------------------------------------------------------------------------------- training


@dataclass(frozen=True, kw_only=True)
class Settings:
    """Of one training."""

    n_hidden: int = 100
    hidden: str = "bernoulli"
    sampler: str = "pcd"
    rate: float = 0.05
    last_rate: float = 1.0  # as a share of the rate, which falls exponentially over the seconds
    batch_size: int = 500
    n_chains: int = 500
    k: int = 1
    l2: float = 0.0
    centring: float | None = 0.01
    p_max: float = 0.0  # largest share of updates with the mode
    n_updates: int = 2000  # of the schedule of the mode


class Clock:
    """Seconds of the processor, and on the wall, since it was made."""

    def __init__(self) -> None:
        self.begun, self.begun_at_work = time.perf_counter(), time.process_time()

    @property
    def seconds(self) -> float:
        return time.process_time() - self.begun_at_work

    def report(self, what: str) -> dict[str, float]:
        return {f"seconds_{what}": time.perf_counter() - self.begun, f"cpu_seconds_{what}": self.seconds}


def sampler_of(settings: Settings) -> Any:
    if settings.sampler == "pseudo":
        return PseudoLikelihood()
    pcd = PCD(k=settings.k, n_chains=settings.n_chains)
    if not settings.p_max:
        return pcd
    mode = GroundState(solver=GibbsAnnealing())
    schedule = ModeSchedule(n_updates=settings.n_updates, p_max=settings.p_max)
    return ModeAssisted(inner=pcd, mode=mode, schedule=schedule)


def phase_of(kind: str, units: Categorical, settings: Settings) -> Phase:
    """The model, and how it is trained."""
    if kind == "potts":
        return Boltzmann(BoltzmannMachine(visible=units, n_hidden=0)).phases[0]
    hidden = {"bernoulli": Bernoulli, "relu": ReLU}[settings.hidden](settings.n_hidden)
    return Greedy(RBM(visible=units, hidden=hidden)).phases[0]


def trained(
    kind: str,
    rows: np.ndarray,
    n_states: int,
    settings: Settings,
    *,
    seconds: float = float("inf"),
    updates: int | None = None,
    seed: int = 0,
) -> tuple[Any, Tensor | None, dict[str, Any]]:
    """A model of the rows, its persistent chains, and what the training took."""
    clock = Clock()
    units = Categorical(rows.shape[1], q=n_states)
    v = units.encode(torch.as_tensor(rows))
    phase = phase_of(kind, units, settings)
    model = phase.model
    start_at_means(model, v)
    batches = Batches(
        v, torch.zeros(len(v), dtype=torch.long), settings.batch_size, len(v), shuffle=True, seed=seed
    )
    training = PhaseTraining(
        phase,
        sampler_of(settings),
        optimizer=partial(SGD, lr=settings.rate),
        penalties=[L2(settings.l2)] if settings.l2 else [],
        centring=None if settings.centring is None else Centring(rate=settings.centring),
        streams=rng.streams(seed, ("negative_phase", "positive_phase")),
    )
    n_updates, done = 0, None
    while clock.seconds < seconds and (updates is None or n_updates < updates):
        share = max(clock.seconds / seconds, n_updates / updates if updates else 0.0)
        for group in training.optimizer.param_groups:
            group["lr"] = settings.rate * settings.last_rate**share
        batches.set_epoch(training.passes_done)
        done = training.run_pass(batches)
        n_updates += len(batches)
    report = clock.report("training")
    chains = getattr(getattr(done.state, "inner", done.state), "x", None) if done else None
    return model, chains, report | {"updates": n_updates, "settings": asdict(settings) | {"seed": seed}}


@torch.no_grad()
def sampled(model: Any, n: int, n_sweeps: int, *, seed: int = 0, at_once: int = 1000) -> Tensor:
    """(n, L) states of chains that begin in uniformly random ones."""
    generator, found = rng.stream(seed, "samples"), []
    for begin in range(0, n, at_once):
        chains = model.chains()
        x = chains.random(min(at_once, n - begin), generator=generator)
        for _ in range(n_sweeps):
            x = chains.sweep(x, generator=generator)
        found.append(x[..., : model.n_visible])
    return torch.cat(found)


def train(given: argparse.Namespace) -> None:
    rows, alphabet = load(given.train)
    settings = Settings(**given.settings)
    model, chains, report = trained(
        given.model,
        rows,
        len(alphabet),
        settings,
        seconds=given.seconds or float("inf"),
        updates=given.updates,
        seed=given.seed,
    )
    torch.save(
        {"kind": given.model, "settings": asdict(settings), "weights": model.state_dict()},
        given.out.with_suffix(".pt"),
    )
    clock = Clock()
    v = sampled(model, given.samples, given.sweeps, seed=given.seed)
    report |= clock.report("sampling")
    units = model.visible
    report |= {"rows": len(rows), "samples": len(v), "sweeps": given.sweeps, "valid": valid(units, v)}
    arrays = {"indices": units.decode(v).numpy()}
    if chains is not None:
        arrays["chains"] = units.decode(chains).numpy()
    np.savez_compressed(given.out, **arrays)
    given.out.with_suffix(".json").write_text(json.dumps(report, indent=2) + "\n")
    print(json.dumps(report))


def valid(units: Categorical, v: Tensor) -> float:
    """Share of the rows that are sequences: they are what decoding and encoding gives back."""
    return float((units.encode(units.decode(v)) == v).all(-1).double().mean())


# -------------------------------------------------------------------------------------------------- judging


def independent(rows: np.ndarray, n_states: int, n: int, seed: int = 0) -> np.ndarray:
    """(n, L) rows of independent sites with the frequencies of these rows."""
    below = one_site(rows, n_states).cumsum(-1)
    u = rng.numpy_stream(seed, "independent").random((n, rows.shape[1], 1))
    return (below <= u * below[:, -1:]).sum(-1)


MEASURES = ("one_site_pearson", "one_site_rms", "two_site_pearson", "two_site_slope", "two_site_rms")


def row_of(name: str, found: dict[str, float], prefix: str = "") -> dict[str, Any]:
    """A row of the table of statistics."""
    return {"samples": name} | {measure: f"{found[prefix + measure]:.4f}" for measure in MEASURES}


def bounds(rows: np.ndarray, held_out: np.ndarray, n_states: int) -> list[dict[str, Any]]:
    """What training rows themselves reach, and what models without couplings do."""
    floor = compare(independent(rows, n_states, 10_000), held_out, rows, n_states)
    return [row_of("training rows (ceiling)", floor, "ceiling_"), row_of("independent sites (floor)", floor)]


def spent(report: dict[str, Any]) -> dict[str, Any]:
    """What a training and its samples took, as columns of a table."""
    seconds = {what: round(report[f"cpu_seconds_{what}"]) for what in ("training", "sampling")}
    return {
        "updates": report["updates"],
        "s of training": seconds["training"],
        "s of sampling": seconds["sampling"],
    }


def judge(given: argparse.Namespace) -> None:
    train_name, test_name = ("fit", "validation") if given.validation else ("train", "test")
    rows, alphabet = load(given.folder / f"{train_name}.npz")
    held_out, _ = load(given.folder / f"{test_name}.npz")
    q = len(alphabet)
    table = bounds(rows, held_out, q)
    for path in (path for path in given.samples if path.with_suffix(".json").exists()):  # the split has none
        with np.load(path) as file:
            report = json.loads(path.with_suffix(".json").read_text())
            kinds = ("indices", "chains") if given.chains and "chains" in file else ("indices",)
            for kind in kinds:
                name = path.stem if kind == "indices" else f"{path.stem}, training's chains"
                found = row_of(name, compare(file[kind], held_out, rows, q))
                table.append(found | {"distinct": len(np.unique(file[kind], axis=0))} | spent(report))
    columns = list(dict.fromkeys(column for row in table for column in row))
    print("| " + " | ".join(columns) + " |")
    print("|" + " --- |" * len(columns))
    for row in table:
        print("| " + " | ".join(str(row.get(column, "")) for column in columns) + " |")


def measure(*, quick: bool = False) -> Iterator[dict[str, Any]]:
    """Our rows of the table of the page, for run.py: statistics of 10,000 samples, and nats a held-out row."""
    path = Path(os.environ["MEMCOMP_DATA_DIR"]) / "sequences" / "kunitz.fasta.gz"
    rows = read_fasta(path, ALPHABET)
    found = parts(rows[:300] if quick else rows, N_STATES)
    fit, held_out = found["train"], found["test"]
    yield from bounds(fit, held_out, N_STATES)
    ends = {"updates": 2} if quick else {"seconds": 60.0}
    for name, (kind, settings) in MODELS.items():
        model, _, report = trained(kind, fit, N_STATES, settings, **ends)
        clock = Clock()
        v = sampled(model, 20 if quick else 10_000, 2 if quick else 50)
        report |= clock.report("sampling")
        samples = model.visible.decode(v).numpy()
        row = row_of(name, compare(samples, held_out, fit, N_STATES))
        row |= {"distinct": len(np.unique(samples, axis=0))} | spent(report) | {"valid": valid(model.visible, v)}
        nats = nats_of(
            model,
            fit,
            held_out[:20] if quick else held_out,
            n_chains=10 if quick else 100,
            n_betas=20 if quick else 1000,
        )
        yield row | {
            name: value for name, value in nats.items() if name in ("pseudo, held out", "log p, held out")
        }


MODELS = {
    "RBM, PCD": ("rbm", Settings(rate=0.1)),
    "RBM, PCD, L2 and a falling rate": ("rbm", Settings(rate=0.1, last_rate=0.1, l2=0.003)),
    "Potts, PCD": ("potts", Settings(rate=0.1)),
    "Potts, pseudo-likelihood": ("potts", Settings(rate=0.1, sampler="pseudo", centring=None, l2=0.01)),
}


def model_of(path: Path, n_sites: int, n_states: int) -> Any:
    kept = torch.load(path, weights_only=True)
    model = phase_of(kept["kind"], Categorical(n_sites, q=n_states), Settings(**kept["settings"])).model
    model.load_state_dict(kept["weights"])
    return model


def nats_of(model: Any, rows: np.ndarray, held_out: np.ndarray, *, n_chains: int, n_betas: int) -> dict[str, Any]:
    """Mean nats a row: the pseudo-likelihood, and for RBMs the likelihood, log Z by annealing."""
    units = model.visible
    v, test = units.encode(torch.as_tensor(rows)), units.encode(torch.as_tensor(held_out))
    some = {"held out": test, "training": v[:: max(1, len(v) // 1000)]}
    found: dict[str, Any] = {
        f"pseudo, {name}": round(float(log_pseudo_likelihood(model, rows).sum(-1).mean()), 2)
        for name, rows in some.items()
    }
    if isinstance(model, RBM):
        generator, base = rng.stream(0, "ais"), base_of(v, units)
        log_z = Ais(n_chains=n_chains, n_betas=n_betas).estimate(model, generator=generator, base=base)
        found["log Z"] = str(log_z)
        # Chains need not be in equilibrium: what they give need not be above log Z.
        drawn = sampled(model, n_chains, n_betas, seed=1)
        reverse = ReverseAis(n_betas=n_betas).estimate(model, drawn, generator=generator, base=base)
        found["log Z, reverse"] = str(reverse)
        for name, rows in some.items():
            found[f"log p, {name}"] = round(float(log_likelihood(model, rows, log_z.log_z).mean()), 2)
    return found


def likelihoods(given: argparse.Namespace) -> None:
    rows, alphabet = load(given.folder / "train.npz")
    held_out, _ = load(given.folder / "test.npz")
    units = Categorical(rows.shape[1], q=len(alphabet))
    field = base_of(units.encode(torch.as_tensor(rows)), units).double()
    alone = (units.encode(torch.as_tensor(held_out)).double() @ field).mean() - units.cumulant(field).sum()
    print(json.dumps({"model": "independent sites", "log p, held out": round(float(alone), 2)}))
    for path in given.models:
        model, clock = model_of(path, rows.shape[1], len(alphabet)), Clock()
        found = nats_of(model, rows, held_out, n_chains=given.chains, n_betas=given.betas)
        print(json.dumps({"model": path.stem} | found | clock.report("judging")), flush=True)


def modes(given: argparse.Namespace) -> None:
    """Ground states of trained models: how far each sampler is from the lowest of all, and processor seconds."""
    rows, alphabet = load(given.folder / "train.npz")
    samplers = {**ground_states.SAMPLERS, "long block annealing": BlockAnnealing(n_chains=128, n_sweeps=1000)}
    for path in given.models:
        model = model_of(path, rows.shape[1], len(alphabet)).requires_grad_(False)
        found = {name: ground_states.found_by(model, sampler, 0) for name, sampler in samplers.items()}
        lowest = min(one.energy for one in found.values())
        for name, (energy, seconds, kept) in found.items():
            gap = 100 * (energy - lowest) / abs(lowest)
            print(f"| {path.stem} | {name} | {gap:.3f} | {seconds:.2f} | {100 * kept:.1f} |", flush=True)


def arguments(given: Sequence[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    commands = parser.add_subparsers(required=True)
    one = commands.add_parser("split", help="write the parts of an alignment")
    one.add_argument("--family", choices=FAMILIES, default="kunitz")
    one.add_argument("--seed", type=int, default=0)
    one.add_argument("--out", type=Path, required=True)
    one.set_defaults(run=split)
    one = commands.add_parser("train", help="train a model, and draw samples of it")
    one.add_argument("--model", choices=("rbm", "potts"), required=True)
    one.add_argument("--train", type=Path, required=True)
    one.add_argument("--out", type=Path, required=True)
    one.add_argument("--seconds", type=float)
    one.add_argument("--updates", type=int)
    one.add_argument("--seed", type=int, default=0)
    one.add_argument("--samples", type=int, default=10_000)
    one.add_argument("--sweeps", type=int, default=100)
    one.add_argument("--settings", type=json.loads, default={})
    one.set_defaults(run=train)
    one = commands.add_parser("judge", help="a table of statistics of held-out rows")
    one.add_argument("folder", type=Path)
    one.add_argument("--samples", type=Path, nargs="*", default=[])
    one.add_argument("--validation", action="store_true", help="of validation.npz beside fit.npz")
    one.add_argument("--chains", action="store_true", help="the persistent chains at the end of training, too")
    one.set_defaults(run=judge)
    one = commands.add_parser("likelihood", help="nats a held-out row")
    one.add_argument("folder", type=Path)
    one.add_argument("--models", type=Path, nargs="+", required=True)
    one.add_argument("--chains", type=int, default=100)
    one.add_argument("--betas", type=int, default=1000)
    one.set_defaults(run=likelihoods)
    one = commands.add_parser("modes", help="ground states of trained RBMs by several solvers")
    one.add_argument("folder", type=Path)
    one.add_argument("--models", type=Path, nargs="+", required=True)
    one.set_defaults(run=modes)
    return parser.parse_args(given)


def main(given: Sequence[str] | None = None) -> None:
    torch.set_num_threads(1)
    chosen = arguments(given)
    chosen.run(chosen)


if __name__ == "__main__":
    main()
