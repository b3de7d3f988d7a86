"""Other packages' models of aligned sequences: trains one and draws samples from it.

    PEERS/bin/python experiments/units/peers.py --peer adabmDCA --train train.npz --out adabmDCA.npz --seconds 120
    PEERS/bin/python experiments/units/peers.py --peer rbms     --train train.npz --out rbms.npz     --seconds 120

PEERS is an environment of its own, without memcomp_lightning:

    python -m venv PEERS
    PEERS/bin/pip install torch==2.13.0 numpy scipy h5py pandas biopython matplotlib seaborn tqdm
    PEERS/bin/pip install --no-deps adabmDCA==1.0.0 rbms==0.5.0

`train.npz` holds `indices`, (n, L) numbers of letters, perhaps `alphabet`, these letters, if they are not those of
`site_statistics.ALPHABET`, and perhaps `weights`, (n,).

    adabmDCA   a Potts model of all pairs of sites (bmDCA), persistent chains, Metropolis
    rbms       an RBM of Potts visible and Bernoulli hidden units (PBRBM), persistent chains, block Gibbs

Each peer has its own defaults but for what `--settings` changes. The rows are trained on as they are, with the
weights of `train.npz` or equal ones: left to themselves both peers drop rows that stand twice, and adabmDCA weighs
each row by its number of neighbours. Samples are chains that begin in uniformly random states.

`--seconds` are those of the processor, which do not count where it works for somebody else; with more than one
thread those of all add up. `--out` gets `indices`, (n_samples, L), and `chains`, the persistent chains at the end
of training. Beside it lies a .json with the seconds of training and of sampling, what ended training, and the
settings.
"""

import argparse
import contextlib
import importlib.util
import json
import resource
import sys
import time
import types
from dataclasses import asdict, dataclass, field, fields
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
from site_statistics import ALPHABET, RNA


@dataclass(frozen=True)
class Limits:
    """When training ends, whichever comes first; None is no limit."""

    seconds: float | None
    updates: int | None


@dataclass
class Clock:
    """Seconds since it was made, and whether a number of them has passed on the processors."""

    limit: float | None = None
    begun: float = field(default_factory=time.perf_counter)
    begun_at_work: float = field(default_factory=time.process_time)

    def over(self) -> bool:
        return self.limit is not None and time.process_time() - self.begun_at_work >= self.limit

    def report(self, what: str) -> dict[str, float]:
        """Seconds on the wall, and of processors: they differ where others have work for the same ones."""
        return {
            f"seconds_{what}": time.perf_counter() - self.begun,
            f"cpu_seconds_{what}": time.process_time() - self.begun_at_work,
        }


@dataclass(frozen=True)
class Outcome:
    """What a peer gave: samples, persistent chains, and what the .json tells of them."""

    indices: np.ndarray
    chains: np.ndarray
    report: dict[str, Any]


class Latest:
    """A checkpoint of adabmDCA in memory, so that chains survive the end of the time."""

    def __init__(self, chains):
        self.chains = chains

    def log(self, record):
        pass

    def check(self, updates):
        return True

    def save(self, *, chains, **_):
        self.chains = chains


def adabmdca(rows, alphabet, weights, limits, settings, seed, n_samples, n_sweeps):
    """Trains adabmDCA's Potts model as its `train_model` does, but with an end after some seconds.

    `train_model` loses the model when it is cancelled, so its steps stand here; each is a function of the package.
    Seconds of training include what its loop does at each update beside the update: Pearson's correlation of its
    chains with the training rows, and estimates of log-likelihood and entropy.
    """
    # adabmDCA imports wandb for a log that is off here; it need not be installed.
    if importlib.util.find_spec("wandb") is None:
        sys.modules["wandb"] = types.ModuleType("wandb")
    import torch
    from adabmDCA.alignment import Alignment
    from adabmDCA.api.model import DCAModel
    from adabmDCA.api.runtime import resolve_runtime
    from adabmDCA.api.sampling import sample_sequences
    from adabmDCA.dataset import DatasetDCA
    from adabmDCA.input_loading import AlignmentLoadConfig
    from adabmDCA.sampling import prepare_training_sampler
    from adabmDCA.training import train_graph
    from adabmDCA.training_config import TrainingConfig
    from adabmDCA.training_control import TrainingCancelled, TrainingController
    from adabmDCA.utils import init_chains, init_parameters

    not_here = {"model_type", "alphabet", "seed", "device", "max_epochs", "max_gradient_steps"}
    refuse_unknown(settings, {each.name for each in fields(TrainingConfig)} - not_here)
    ends = {} if limits.updates is None else {"max_epochs": limits.updates}
    config = TrainingConfig(**{"device": "cpu", "seed": seed} | settings | ends)
    device, dtype = resolve_runtime(config.device, config.dtype)

    kind = {ALPHABET: "protein", RNA: "rna"}[alphabet]
    clock = Clock(limits.seconds)
    sequences = tuple("".join(alphabet[state] for state in row) for row in rows)
    dataset = DatasetDCA.from_alignment(
        Alignment(names=tuple(map(str, range(len(rows)))), sequences=sequences),
        weights=weights,
        load_config=AlignmentLoadConfig(alphabet=kind, invalid_sequences="error", remove_duplicates=False),
        no_reweighting=weights is None,
        device=device,
        dtype=dtype,
    )
    pseudocount = config.resolve_pseudocount(dataset.get_effective_size())
    single, double = dataset.get_frequencies(pseudocount=pseudocount)
    length, states = single.shape
    parameters = init_parameters(fi=single)
    mask = torch.ones(double.shape, dtype=torch.bool, device=device)
    mask[torch.arange(length), :, torch.arange(length), :] = False
    latest = Latest(
        init_chains(num_chains=config.n_chains, L=length, q=states, fi=single, device=device, dtype=dtype)
    )
    controller = TrainingController(limits=config.limits, checkpoint=latest, is_cancelled=clock.over)
    with contextlib.suppress(TrainingCancelled):
        train_graph(
            sampler=prepare_training_sampler(config.sampler, device, config.dtype),
            chains=latest.chains,
            mask=mask,
            fi_target=single,
            fij_target=double,
            params=parameters,  # changed in place, so that they are there after a cancellation
            nsweeps=config.n_sweeps,
            lr=config.learning_rate,
            max_epochs=config.limits.max_gradient_steps,
            target_pearson=config.target_pearson,
            l2_reg=config.l2_regularization,
            controller=controller,
            slope_tolerance=config.slope_tolerance,
        )
    training = clock.report("training")

    clock = Clock()
    sampled = sample_sequences(
        model=DCAModel(parameters, alphabet=kind),
        n_sequences=n_samples,
        n_sweeps=n_sweeps,
        sampler=config.sampler,
        seed=seed + 1,
    )
    state_of = {letter: state for state, letter in enumerate(alphabet)}
    indices = np.array([[state_of[letter] for letter in sequence] for sequence in sampled.sequences])
    reason = controller.stop_reason.value
    ended = {"cancelled": "seconds", "max_gradient_steps": "updates"}.get(reason, reason)
    history = controller.history
    return Outcome(
        indices,
        latest.chains.argmax(-1).numpy(),
        {
            **training,
            **clock.report("sampling"),
            "ended_by": ended,
            "updates": controller.counters.gradient_steps,
            "effective_rows": dataset.get_effective_size(),
            "pseudocount": pseudocount,
            "settings": asdict(config),
            # Pearson and slope are those of the chains' two-site correlations against the training rows'.
            "trace": {name: thinned(history[name]) for name in ("Epochs", "Time", "Pearson", "Slope")},
        },
    )


def rbms(rows, alphabet, weights, limits, settings, seed, n_samples, n_sweeps):
    """Trains rbms' Potts-Bernoulli RBM as its `train` does, but with an end after some seconds, and no files.

    `train` writes the model at some updates and learning rates at each one; the seconds here are without that.
    Its gradient of the couplings takes no weights of rows, so weighted rows are drawn into the batches by weight.
    """
    import torch
    from rbms.dataset.dataset_class import RBMDataset
    from rbms.parser import default_args
    from rbms.potts_bernoulli.classes import PBRBM
    from rbms.potts_bernoulli.utils import ensure_zero_sum_gauge
    from rbms.training.pcd import fit_batch_pcd

    names = {
        "num_hiddens",
        "batch_size",
        "gibbs_steps",
        "learning_rate",
        "num_chains",
        "beta",
        "no_center",
        "L1",
        "L2",
    }
    refuse_unknown(settings, names)
    used = {name: default_args[name] for name in sorted(names)} | settings
    n_updates = default_args["num_updates"] if limits.updates is None else limits.updates

    clock = Clock(limits.seconds)
    data = RBMDataset(
        data=rows,
        labels=-np.ones(len(rows)),
        weights=np.ones(len(rows)),
        names=np.arange(len(rows)),
        dataset_name="train",
        is_binary=False,
        device="cpu",
    )
    if data.get_num_states() != len(alphabet):
        raise SystemExit(f"rbms counts states by the largest one; state {len(alphabet) - 1} is in no training row")
    shares = None if weights is None else torch.as_tensor(weights)
    updates = 0
    with torch.no_grad():
        model = PBRBM.init_parameters(used["num_hiddens"], data, torch.device("cpu"), torch.float32)
        ensure_zero_sum_gauge(model)
        chains = model.sample_state(model.init_chains(used["num_chains"]), n_steps=used["gibbs_steps"])
        model.init_grad()
        optimizer = torch.optim.SGD(model.parameters(), lr=used["learning_rate"], maximize=True)
        while updates < n_updates and not clock.over():
            if shares is None:
                chosen = torch.randperm(len(data))[: used["batch_size"]]
            else:
                chosen = torch.multinomial(shares, used["batch_size"], replacement=True)
            optimizer.zero_grad(set_to_none=False)
            chains, _ = fit_batch_pcd(
                batch=(data.data[chosen], data.weights[chosen]),
                parallel_chains=chains,
                params=model,
                gibbs_steps=used["gibbs_steps"],
                beta=used["beta"],
                centered=not used["no_center"],
                lambda_l1=used["L1"],
                lambda_l2=used["L2"],
            )
            optimizer.step()
            ensure_zero_sum_gauge(model)
            updates += 1
        training = clock.report("training")

        clock = Clock()
        sampled = model.sample_state(model.init_chains(n_samples), n_steps=n_sweeps)
    return Outcome(
        sampled["visible"].long().numpy(),
        chains["visible"].long().numpy(),
        {
            **training,
            **clock.report("sampling"),
            "ended_by": "updates" if updates == n_updates else "seconds",
            "updates": updates,
            "settings": used | {"num_updates": n_updates, "seed": seed},
        },
    )


PEERS = {"adabmDCA": adabmdca, "rbms": rbms}


def refuse_unknown(settings, known):
    unknown = sorted(set(settings) - known)
    if unknown:
        raise SystemExit(f"--settings has {', '.join(unknown)}: expected some of {', '.join(sorted(known))}")


def thinned(values, n_kept=100):
    """Some of the values at equal steps, the last one among them."""
    step = -(-len(values) // n_kept) or 1
    return [float(value) for value in values[::-1][::step][::-1]]


def read(path):
    """Rows, their letters and weights of a file, refused where they are not what the module's text says."""
    with np.load(path) as file:
        rows, weights = file["indices"].astype(np.int64), file.get("weights")
        alphabet = str(file["alphabet"]) if "alphabet" in file else ALPHABET
    if rows.ndim != 2 or rows.min() < 0 or rows.max() >= len(alphabet):
        raise SystemExit(f"{path}: indices of shape {rows.shape}: expected (n, L) integers below {len(alphabet)}")
    if weights is not None and weights.shape != (len(rows),):
        raise SystemExit(f"{path}: weights of shape {weights.shape}: expected ({len(rows)},)")
    return rows, alphabet, weights


def arguments():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--peer", choices=PEERS, required=True)
    parser.add_argument("--train", type=Path, required=True, help="an .npz with indices and perhaps weights")
    parser.add_argument("--out", type=Path, required=True, help="an .npz for the samples; a .json goes beside it")
    parser.add_argument("--seconds", type=float, help="of a processor: training ends after so many")
    parser.add_argument(
        "--updates", "--epochs", type=int, help="... or after so many gradients; the peer's default"
    )
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--samples", type=int, default=10_000)
    parser.add_argument("--sweeps", type=int, default=1000, help="of each sample's chain; both peers' default")
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--settings", type=json.loads, default={}, help='as JSON: {"n_chains": 1000}')
    return parser.parse_args()


def main():
    given = arguments()
    rows, alphabet, weights = read(given.train)
    import torch

    torch.set_num_threads(given.threads)
    torch.manual_seed(given.seed)  # noqa: TID251 - the peers draw from the global generator
    limits = Limits(given.seconds, given.updates)
    train = PEERS[given.peer]
    outcome = train(rows, alphabet, weights, limits, given.settings, given.seed, given.samples, given.sweeps)
    report = {
        "peer": given.peer,
        "version": version(given.peer),
        "torch": torch.__version__,
        "threads": given.threads,
        "rows": len(rows),
        "weighted": weights is not None,
        "samples": len(outcome.indices),
        "sweeps": given.sweeps,
        "peak_mib": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024,  # on Linux
        **outcome.report,
    }
    np.savez_compressed(given.out, indices=outcome.indices, chains=outcome.chains)
    given.out.with_suffix(".json").write_text(json.dumps(report, indent=2) + "\n")
    print(json.dumps({name: value for name, value in report.items() if not name.startswith("trace")}))


if __name__ == "__main__":
    main()
