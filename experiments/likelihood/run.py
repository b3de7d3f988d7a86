"""Log-likelihoods of RBMs on binarised MNIST beside published ones: exact, by AIS, and by reverse AIS.

Weights, biases and the order of the mini-batches begin as in PyDeep's examples RBM_MNIST_small and RBM_MNIST_big.

python experiments/likelihood/run.py                      # 784 x 16, 50 passes, centred and plain
python experiments/likelihood/run.py --hidden 500 --only centred --fantasy-sweeps 1000    # 200 passes
"""

import argparse
import json
import time
from functools import partial
from pathlib import Path
from typing import NamedTuple

import torch
from torch.optim import SGD

from memcomp_lightning import rng
from memcomp_lightning.data import Batches, ImageData, Mnist
from memcomp_lightning.likelihood import (
    Ais,
    ReverseAis,
    base_of,
    exact_samples,
    log_likelihood,
    log_partition_function,
)
from memcomp_lightning.models import DBN, RBM, Initialiser, Normal, Xavier
from memcomp_lightning.models.chains import sweep
from memcomp_lightning.objective import Centring
from memcomp_lightning.samplers import PCD
from memcomp_lightning.training import Greedy, pretrain

CASES = {"centred": Centring(rate=0.01), "plain": None}


class Published(NamedTuple):
    """What an example of PyDeep begins with."""

    passes: int
    weights: Initialiser
    shuffled: bool


PUBLISHED = {
    16: Published(50, Xavier(gain=4.0), shuffled=False),
    500: Published(200, Normal(std=0.01), shuffled=True),
}


@torch.no_grad()
def start(rbm: RBM, images: ImageData, given: argparse.Namespace, *, centred: bool) -> None:
    """Visible biases by the means of the pixels; of centred units with offsets of these means and 1/2."""
    mean = images.train_v.mean(0)
    if given.visible_bias == "data":
        rbm.b.copy_(mean.clamp(0.001, 0.999).logit())
    if centred:
        rbm.b.sub_(rbm.weight.sum(0) / 2)
        rbm.c.sub_(rbm.weight @ mean)


def trained(images: ImageData, given: argparse.Namespace, centring: Centring | None) -> tuple[RBM, float]:
    """An RBM after all passes of PCD-1, and the seconds."""
    published = PUBLISHED[given.hidden]
    weights = published.weights if given.weight_std is None else Normal(std=given.weight_std)
    dbn = DBN(784, [given.hidden], weight_init=weights, generator=rng.stream(given.seed, "weights"))
    start(dbn[0], images, given, centred=centring is not None)
    batches = Batches(
        images.train_v,
        images.train_label,
        batch_size=100,
        chunk_size=100,
        shuffle=published.shuffled,
        seed=given.seed,
    )
    passes = pretrain(
        Greedy(dbn),
        batches,
        PCD(k=1, n_chains=100),
        iterations=given.passes or published.passes,
        optimizer=partial(SGD, lr=given.rate),
        centring=centring,
        seed=given.seed,
    )
    begin = time.perf_counter()
    for done in passes:
        print(f"pass {done.number}, {time.perf_counter() - begin:.0f} s", end="\r", flush=True)
    return dbn[0], time.perf_counter() - begin


def model_samples(rbm: RBM, n: int, n_sweeps: int, start: torch.Tensor) -> torch.Tensor:
    """Exact samples where the hidden layer can be enumerated, otherwise chains that start at images."""
    generator = rng.stream(0, "model samples")
    if rbm.n_hidden <= 25:
        return exact_samples(rbm, n, generator=generator)
    v = start[:n]
    for _ in range(n_sweeps):
        v = sweep(rbm, v, generator=generator)
    return v


def measured(rbm: RBM, images: ImageData, given: argparse.Namespace) -> dict[str, float]:
    """Nats an image, and log Z three ways."""
    train, test = images.train_v, images.test_v
    base = base_of(train)
    ais = Ais(n_chains=given.chains, n_betas=given.betas)
    up = ais.estimate(rbm, generator=rng.stream(0, "ais"), base=base)
    samples = model_samples(rbm, given.chains, given.fantasy_sweeps, train)
    down = ReverseAis(n_betas=given.betas).estimate(
        rbm, samples, generator=rng.stream(0, "reverse ais"), base=base
    )
    estimates = {"ais": up.log_z, "reverse_ais": down.log_z}
    if given.hidden <= 25:
        estimates = {"exact": log_partition_function(rbm), **estimates}
    found = {f"log_z_{name}": float(log_z) for name, log_z in estimates.items()}
    # PyDeep counts energies of centred units from the state of all offsets, the means of the units.
    offsets = train.mean(0, keepdim=True), rbm.hidden_mean(train).mean(0, keepdim=True)
    found["log_z_from_offsets"] = next(iter(found.values())) + float(rbm.energy(*offsets))
    for name, log_z in estimates.items():
        found[f"test_{name}"] = float(log_likelihood(rbm, test, log_z).mean())
    for name, estimate in (("ais", up), ("reverse_ais", down)):
        found[f"{name}_standard_error"] = float(estimate.standard_error)
        found[f"{name}_effective_sample_size"] = float(estimate.effective_sample_size)
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--hidden", type=int, choices=tuple(PUBLISHED), default=16)
    parser.add_argument("--passes", type=int, help="other than published: 50 of 784 x 16, 200 of 784 x 500")
    parser.add_argument("--rate", type=float, default=0.01)
    parser.add_argument(
        "--visible-bias", choices=("data", "zero"), default="data", help="first: log odds of the data, or 0"
    )
    parser.add_argument("--weight-std", type=float, help="first weights N(0, std^2), not the published ones")
    parser.add_argument("--only", choices=tuple(CASES))
    parser.add_argument("--chains", type=int, default=100, help="of AIS")
    parser.add_argument("--betas", type=int, default=10_000, help="of AIS")
    parser.add_argument(
        "--fantasy-sweeps", type=int, default=1000, help="Gibbs sweeps before reverse AIS, above 25 units"
    )
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--output", type=Path, help="JSON lines")
    given = parser.parse_args()
    images = Mnist(pixels="threshold").load()
    for name, centring in CASES.items():
        if given.only in (None, name):
            rbm, seconds = trained(images, given, centring)
            settings = {
                "case": name,
                **{k: getattr(given, k) for k in ("hidden", "passes", "weight_std", "visible_bias", "seed")},
            }
            found = {**settings, "seconds": round(seconds, 1)}
            line = json.dumps({**found, **measured(rbm, images, given)})
            print(line.ljust(60))
            if given.output:
                with given.output.open("a") as file:
                    file.write(line + "\n")


if __name__ == "__main__":
    main()
