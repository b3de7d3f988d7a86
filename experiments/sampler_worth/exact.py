"""Exact log-likelihoods of the final RBMs of a run of experiment=sampler_worth, beside those by AIS.

python experiments/sampler_worth/exact.py RUN_FOLDER --data-set reduced_mnist --replicas 3
"""

import argparse
import time
from pathlib import Path

import torch

from memcomp_lightning.data import ImageData, ReducedMnist
from memcomp_lightning.likelihood import log_likelihood, log_partition_function
from memcomp_lightning.models import RBM
from memcomp_lightning.studies.likelihood import weights_path
from memcomp_lightning.studies.worth import read_worth

IMAGES = {"reduced_mnist": lambda: ReducedMnist(pixels="threshold").load()}


def model_of(path: Path, n_replicas: int) -> RBM:
    """The first replicas of saved weights, those that are reported."""
    state = {name: tensor[:n_replicas] for name, tensor in torch.load(path, weights_only=True).items()}
    _, n_hidden, n_visible = state["weight"].shape
    rbm = RBM(n_visible, n_hidden, replicas=(n_replicas,))
    rbm.load_state_dict(state)
    return rbm


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run", type=Path)
    parser.add_argument("--data-set", choices=tuple(IMAGES), default="reduced_mnist")
    parser.add_argument("--replicas", type=int, default=3)
    given = parser.parse_args()
    worth, images = read_worth(given.run), IMAGES[given.data_set]()
    assert isinstance(images, ImageData)
    print("| method | exact: median, worst | AIS: median, worst | largest difference | seconds |")
    print("| --- | --- | --- | --- | --- |")
    for method in worth.methods(given.data_set):
        record = worth.best(given.data_set, method)
        rbm, begin = model_of(weights_path(given.run, record), given.replicas), time.perf_counter()
        log_z = log_partition_function(rbm, max_units=32)
        exact = -log_likelihood(rbm, images.test_v, log_z).mean(-1)
        by_ais = torch.tensor(record.measures["score"][-1][: given.replicas], dtype=torch.float64)
        cells = [
            *(f"{float(x.median()):.3f}, {float(x.max()):.3f}" for x in (exact, by_ais)),
            f"{float((exact - by_ais).abs().max()):.3f}",
            f"{time.perf_counter() - begin:.0f}",
        ]
        print(f"| {worth.plan.methods[method].label} | {' | '.join(cells)} |", flush=True)


if __name__ == "__main__":
    main()
