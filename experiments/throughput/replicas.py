"""Cost of a fine-tuning update of a 32-32-32-10 network: in a stack of replicas, alone, alone under Lightning.

python experiments/throughput/replicas.py          # two minutes on one core
"""

import argparse
import logging
import statistics
import time
import warnings
from functools import partial

import lightning.pytorch as pl
import torch
from torch.optim import SGD

from memcomp_lightning.data import ImageData, ImageDataModule
from memcomp_lightning.data.reduce import SIX_BY_SIX_WITHOUT_CORNERS
from memcomp_lightning.models import DBN, Normal
from memcomp_lightning.modules import DBNClassifier
from memcomp_lightning.rng import stream, uniform
from memcomp_lightning.training import MomentumSchedule, finetune

N_IMAGES, BATCH_SIZE, N_PARTITIONS = 60_000, 100, 10
FIGURE_4 = 24_000_000
"""Updates of the networks of Fig. 4: 2 methods, 50 lengths, 10 partitions, 400 passes of 60 mini-batches."""


def images() -> ImageData:
    """As many as MNIST has, at the paper's size; the time does not depend on what they show."""
    v = uniform((N_IMAGES, 32), generator=stream(0, "images"))
    label = torch.arange(N_IMAGES) % 10
    return ImageData(v, label, v[:10], label[:10], 10, SIX_BY_SIX_WITHOUT_CORNERS, "noise")


def classifier(n_replicas: int, iterations: int) -> DBNClassifier:
    dbn = DBN(32, [32, 32], replicas=(n_replicas,), weight_init=Normal(std=0.1))
    return DBNClassifier(
        dbn, iterations=iterations, optimizer=partial(SGD, lr=0.1), schedules=[MomentumSchedule()]
    )


def stacked(data: ImageDataModule, n_replicas: int, n_passes: int) -> float:
    """Seconds an update of one network."""
    module = classifier(n_replicas, n_passes + 1)
    copies = max(1, n_replicas // data.replicas[0])
    batches = data.train_batches(0, 1).repeated([0] * copies)
    settings = {"optimizer": module.make_optimizer, "schedules": module.schedules}
    begin = time.perf_counter()
    for done in finetune(module.network, batches, iterations=n_passes + 1, **settings):
        if done == 1:  # the first pass warms up
            begin = time.perf_counter()
    return (time.perf_counter() - begin) / (n_passes * len(batches) * n_replicas)


def under_lightning(data: ImageDataModule, n_passes: int) -> float:
    """The same of one network, trained as ``memcomp-train`` trains it, without anything that looks at it."""
    module = classifier(1, n_passes)
    quiet = {"enable_progress_bar": False, "enable_model_summary": False, "enable_checkpointing": False}
    trainer = pl.Trainer(
        max_epochs=n_passes,
        accelerator="cpu",
        logger=False,
        limit_val_batches=0,
        **quiet,
    )
    begin = time.perf_counter()
    trainer.fit(module, datamodule=data)
    return (time.perf_counter() - begin) / (n_passes * len(data.train_batches(0, 1)))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--passes", type=int, default=5, help="passes of 60 mini-batches that are timed")
    parser.add_argument("--repeats", type=int, default=3)
    given = parser.parse_args()
    torch.set_num_threads(1)
    logging.getLogger("lightning.pytorch").setLevel(logging.ERROR)
    warnings.filterwarnings("ignore", message=".*LeafSpec.*", category=FutureWarning)
    everything = images()
    print(f"{'networks in a stack':>28}  {'us an update of one':>20}  {'Fig. 4 on two cores, min':>25}")
    for n_replicas in (1, 10, 20, 40, 100):
        first = min(n_replicas, N_PARTITIONS)
        data = ImageDataModule(everything, partitions=N_PARTITIONS, first_partitions=first, batch_size=BATCH_SIZE)
        seconds = statistics.median(stacked(data, n_replicas, given.passes) for _ in range(given.repeats))
        print(f"{n_replicas:>28}  {seconds * 1e6:>20.0f}  {seconds * FIGURE_4 / 2 / 60:>25.0f}", flush=True)
    data = ImageDataModule(everything, partitions=N_PARTITIONS, first_partitions=1, batch_size=BATCH_SIZE)
    seconds = statistics.median(under_lightning(data, given.passes) for _ in range(given.repeats))
    print(f"{'1, by Lightning':>28}  {seconds * 1e6:>20.0f}  {seconds * FIGURE_4 / 2 / 60:>25.0f}")


if __name__ == "__main__":
    main()
