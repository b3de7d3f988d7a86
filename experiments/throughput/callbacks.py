"""What each callback costs at its default interval, as a share of a pass that nothing looks at.

    python experiments/throughput/callbacks.py

Random images, batch 100, one thread. The pass is CD-1's; the callbacks look at PCD-1, so that there are chains
whose mixing is measured. Lightning's profiler adds up the seconds of each callback's hooks in each pass; medians
over passes. A callback that looks every so many passes is measured in passes with a look and in passes without,
and the two are weighted by its interval. What Lightning's logging and TensorBoard's thread do later is not in it.
"""

import argparse
import logging
import statistics
import tempfile
import time
from collections.abc import Callable

import lightning.pytorch as pl
import torch
from common import N_VISIBLE, random_images
from lightning.pytorch.loggers import TensorBoardLogger
from lightning.pytorch.profilers import SimpleProfiler

from memcomp_lightning import callbacks as ours
from memcomp_lightning.data import ImageData, ImageDataModule
from memcomp_lightning.models import DBN
from memcomp_lightning.modules import EnergyPretraining
from memcomp_lightning.samplers import CD, PCD
from memcomp_lightning.training import Greedy

BATCH, NEVER = 100, 10**9
TARGET = 0.03
Make = Callable[[], pl.Callback]

ANY_SIZE: list[Make] = [
    ours.StageTimes,
    ours.ReconstructionError,
    ours.FreeEnergyGap,
    ours.NegativePhaseEnergies,
    ours.SamplerDiagnostics,
    ours.EnergyHistograms,
    ours.OptimizerMonitor,
    ours.ParameterHistograms,
    ours.ReceptiveFields,
    ours.ModelSamples,
    ours.ChainPictures,
    ours.SaturationGuard,
    ours.TrajectoryFigure,
    ours.LogLikelihood,
]
ENUMERATED: list[Make] = [ours.GradientBias]


class PassTimes(pl.Callback):
    """Seconds of each pass, its validation included."""

    def __init__(self) -> None:
        self.seconds: list[float] = []

    def on_train_epoch_start(self, *_: object) -> None:
        self.begin = time.perf_counter()

    def on_train_epoch_end(self, *_: object) -> None:
        self.seconds.append(time.perf_counter() - self.begin)


def fit(
    images: ImageData, n_hidden: int, sampler: CD | PCD, n_passes: int, callbacks: list[pl.Callback]
) -> dict[str, list[float]]:
    """Train; seconds of each action of the profiler, call by call."""
    module = EnergyPretraining(Greedy(DBN(N_VISIBLE, [n_hidden])), sampler, iterations=n_passes, centring=None)
    profiler = SimpleProfiler()
    with tempfile.TemporaryDirectory() as folder:
        trainer = pl.Trainer(
            max_epochs=n_passes,
            accelerator="cpu",
            logger=TensorBoardLogger(folder, name="", version="", default_hp_metric=False),
            callbacks=callbacks,
            profiler=profiler,
            enable_checkpointing=False,
            enable_progress_bar=False,
            enable_model_summary=False,
            num_sanity_val_steps=0,
            log_every_n_steps=1,
            default_root_dir=folder,
        )
        trainer.fit(module, datamodule=ImageDataModule(images, batch_size=BATCH))
    return dict(profiler.recorded_durations)


def seconds_by_pass(durations: dict[str, list[float]], name: str, n_passes: int) -> list[float]:
    """Seconds of all hooks of a callback in each pass."""
    total = [0.0] * n_passes
    for action, calls in durations.items():
        if action.startswith(f"[Callback]{name}.on_") and len(calls) % n_passes == 0:
            n_calls = len(calls) // n_passes
            for index in range(n_passes):
                total[index] += sum(calls[index * n_calls : (index + 1) * n_calls])
    return total


def measure(images: ImageData, n_hidden: int, make: list[Make], n_passes: int) -> None:
    """Print a table."""
    times = PassTimes()
    fit(images, n_hidden, CD(k=1), n_passes + 1, [times])
    a_pass = statistics.median(times.seconds[1:])
    with_look, without = [callback() for callback in make], [callback() for callback in make]
    every = {type(callback).__name__: getattr(callback, "every", 1) for callback in with_look}
    for callbacks, interval in ((with_look, 1), (without, NEVER)):
        for callback in callbacks:
            if hasattr(callback, "every"):
                callback.every = interval
    # The first pass warms up, and where nothing is looked at it and the last one are looked at all the same.
    looked = fit(images, n_hidden, PCD(k=1), n_passes + 1, with_look)
    idle = fit(images, n_hidden, PCD(k=1), n_passes + 2, without)
    n_images = len(images.train_v)
    print(f"\nOne pass, {n_images} x {N_VISIBLE}, {n_hidden} hidden, batch {BATCH}: {a_pass:.2f} s")
    print(f"  {'callback':24s} {'every':>5s} {'a look, ms':>11s} {'other pass, ms':>15s} {'share of a pass':>16s}")
    for name, interval in every.items():
        look = statistics.median(seconds_by_pass(looked, name, n_passes + 1)[1:])
        rest = statistics.median(seconds_by_pass(idle, name, n_passes + 2)[1:-1])
        share = (look + (interval - 1) * rest) / interval / a_pass
        mark = "" if share <= TARGET else f"  above {TARGET:.0%}"
        print(f"  {name:24s} {interval:5d} {1e3 * look:11.1f} {1e3 * rest:15.2f} {share:16.2%}{mark}")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--images", type=int, default=10_000, help="images of a pass")
    parser.add_argument("--hidden", type=int, default=500, help="hidden units")
    parser.add_argument("--enumerated", type=int, default=12, help="hidden units where they are enumerated")
    parser.add_argument("--repeats", type=int, default=3, help="passes of each kind; the median is printed")
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    logging.getLogger("lightning.pytorch").setLevel(logging.WARNING)
    images = random_images(arguments.images, arguments.images // 10)
    measure(images, arguments.hidden, ANY_SIZE, arguments.repeats)
    measure(images, arguments.enumerated, ENUMERATED, arguments.repeats)


if __name__ == "__main__":
    main()
