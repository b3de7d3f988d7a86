"""What the Lightning side costs: one CD-1 epoch beside a hand-written loop and scikit-learn, replica steps.

    python experiments/throughput/run.py

Every measurement is repeated, the repetitions of all candidates take turns, and medians are printed.
"""

import argparse
import logging
import statistics
import tempfile
from collections.abc import Callable
from functools import partial

import lightning.pytorch as pl
import torch
import torch.nn.functional as F
from common import N_VISIBLE, Seconds, random_images
from lightning.pytorch.loggers import TensorBoardLogger
from sklearn.neural_network import BernoulliRBM
from torch import Tensor

from memcomp_lightning import rng
from memcomp_lightning.callbacks import NegativePhaseEnergies, OptimizerMonitor, ReconstructionError
from memcomp_lightning.data import Batches, Digits, ImageData, ImageDataModule
from memcomp_lightning.models import DBN
from memcomp_lightning.modules import DBNClassifier, EnergyPretraining
from memcomp_lightning.products import multiplies_in_bfloat16, quick_products
from memcomp_lightning.samplers import CD, InBfloat16
from memcomp_lightning.training import Greedy, pretrain
from memcomp_lightning.training.given import Given

N_HIDDEN, BATCH, LEARNING_RATE, MOMENTUM = 500, 100, 0.1, 0.5


class Clock(pl.Callback):
    """Measures training, without what the trainer sets up before."""

    def on_train_start(self, *_: object) -> None:
        self.begin = Seconds.now()

    def on_train_end(self, *_: object) -> None:
        self.spent = Seconds.now().since(self.begin)


class OneStep(EnergyPretraining):
    """Works in its first step alone and repeats what that returned: what is left is Lightning's loop."""

    def training_step(self, batch: Given, batch_idx: int) -> dict[str, object]:
        if batch_idx == 0:
            self._returned = super().training_step(batch, batch_idx)
        return self._returned


def lightning_epoch(
    images: ImageData, kind: type[EnergyPretraining] = EnergyPretraining
) -> tuple[Seconds, Tensor]:
    """One epoch through EnergyPretraining, with callbacks and TensorBoard; seconds of training, final weights."""
    clock = Clock()
    dbn = DBN(N_VISIBLE, [N_HIDDEN])
    optimizer = partial(torch.optim.SGD, lr=LEARNING_RATE, momentum=MOMENTUM)
    module = kind(Greedy(dbn), CD(k=1), iterations=1, optimizer=optimizer, centring=None)
    with tempfile.TemporaryDirectory() as folder:
        trainer = pl.Trainer(
            max_epochs=1,
            accelerator="cpu",
            logger=TensorBoardLogger(folder, name="", version="", default_hp_metric=False),
            callbacks=[ReconstructionError(), NegativePhaseEnergies(), OptimizerMonitor(), clock],
            enable_checkpointing=False,
            enable_progress_bar=False,
            enable_model_summary=False,
            limit_val_batches=0,
            log_every_n_steps=1,
        )
        trainer.fit(module, datamodule=ImageDataModule(images, batch_size=BATCH))
    return clock.spent, dbn[0].weight.detach()


def bare_epoch(images: ImageData, sampler: CD | InBfloat16) -> Seconds:
    """The same updates by the package's loop without a trainer."""
    dbn = DBN(N_VISIBLE, [N_HIDDEN])
    batches = Batches(images.train_v, images.train_label, BATCH, len(images.train_v), True, 0)
    optimizer = partial(torch.optim.SGD, lr=LEARNING_RATE, momentum=MOMENTUM)
    begin = Seconds.now()
    for _ in pretrain(Greedy(dbn), batches, sampler, iterations=1, optimizer=optimizer):
        pass
    return Seconds.now().since(begin)


@torch.no_grad()
def hand_written_epoch(images: ImageData) -> tuple[Seconds, Tensor]:
    """The same updates in a bare loop: same order of images, same draws, gradients by hand."""
    weight = DBN(N_VISIBLE, [N_HIDDEN])[0].weight.detach()
    b, c = torch.zeros(N_VISIBLE), torch.zeros(N_HIDDEN)
    velocity = [torch.zeros_like(parameter) for parameter in (weight, b, c)]
    generator = rng.stream(0, "negative_phase")
    order = Batches(images.train_v, images.train_label, BATCH, len(images.train_v), True, 0)
    begin = Seconds.now()
    for batch in order:
        v, n = batch.v, len(batch.v)
        hidden = F.linear(v, weight, c).sigmoid_()
        h = torch.empty(n, N_HIDDEN).uniform_(generator=generator).lt_(hidden)
        visible = torch.addmm(b, h, weight).sigmoid_()
        v_model = torch.empty(n, N_VISIBLE).uniform_(generator=generator).lt_(visible)
        hidden_model = F.linear(v_model, weight, c).sigmoid_()
        gradients = (
            torch.mm(hidden_model.T, v_model).addmm_(hidden.T, v, alpha=-1 / n, beta=1 / n),
            v_model.mean(0) - v.mean(0),
            hidden_model.mean(0) - hidden.mean(0),
        )
        for parameter, speed, gradient in zip((weight, b, c), velocity, gradients, strict=True):
            speed.mul_(MOMENTUM).add_(gradient)
            parameter.sub_(speed, alpha=LEARNING_RATE)
    return Seconds.now().since(begin), weight


def with_our_products(images: ImageData) -> tuple[Seconds, Tensor]:
    """The hand-written loop with the library of torch's that the package takes on this processor."""
    with quick_products(BATCH * N_VISIBLE * N_HIDDEN):
        return hand_written_epoch(images)


def sklearn_epoch(images: ImageData, dtype: str) -> Seconds:
    """One epoch of BernoulliRBM: persistent chains, so the updates differ; the work is alike."""
    data = images.train_v.numpy().astype(dtype)
    rbm = BernoulliRBM(n_components=N_HIDDEN, batch_size=BATCH, n_iter=1, learning_rate=0.1, random_state=0)
    begin = Seconds.now()
    rbm.fit(data)
    return Seconds.now().since(begin)


def finetuning_step_us(n_replicas: int, n_steps: int) -> float:
    """Microseconds of one fine-tuning step of the 32-32-32-10 network, all replicas together."""
    digits = Digits().load()
    v = digits.train_v[:1400].repeat(n_replicas, 1, 1) if n_replicas > 1 else digits.train_v[:1400]
    label = digits.train_label[:1400].repeat(n_replicas, 1) if n_replicas > 1 else digits.train_label[:1400]
    replicas = (n_replicas,) if n_replicas > 1 else ()
    n_epochs = max(n_steps // 14, 1)
    module = DBNClassifier(DBN(32, [32, 32], replicas=replicas), iterations=n_epochs)
    trainer = pl.Trainer(
        max_epochs=n_epochs,
        accelerator="cpu",
        logger=False,
        enable_checkpointing=False,
        enable_progress_bar=False,
        enable_model_summary=False,
    )
    trainer.fit(module, train_dataloaders=Batches(v, label, BATCH, 10_000, True, 0))
    return module.wall_time_s / (n_epochs * 14) * 1e6


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--images", type=int, default=60_000, help="images of the CD-1 epoch")
    parser.add_argument("--repeats", type=int, default=3, help="repetitions; the median is printed")
    parser.add_argument("--steps", type=int, default=1400, help="fine-tuning steps")
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    logging.getLogger("lightning.pytorch").setLevel(logging.WARNING)
    images = random_images(arguments.images)
    candidates: dict[str, Callable[[], Seconds]] = {
        "EnergyPretraining, logging on": lambda: lightning_epoch(images)[0],
        "Lightning without work in its steps": lambda: lightning_epoch(images, OneStep)[0],
        "training.pretrain, without a trainer": lambda: bare_epoch(images, CD(k=1)),
        "hand-written torch loop": lambda: hand_written_epoch(images)[0],
        "the same loop, products as ours": lambda: with_our_products(images)[0],
        "scikit-learn BernoulliRBM, float32": lambda: sklearn_epoch(images, "float32"),
        "scikit-learn BernoulliRBM, float64": lambda: sklearn_epoch(images, "float64"),
    }
    if multiplies_in_bfloat16():
        sampler = InBfloat16(sampler=CD(k=1))
        candidates["the same, products=bf16"] = lambda: bare_epoch(images, sampler)
    difference = (lightning_epoch(images)[1] - with_our_products(images)[1]).abs().max()  # warms up, too
    seconds: dict[str, list[Seconds]] = {name: [] for name in candidates}
    for _ in range(arguments.repeats):
        for name, measure in candidates.items():
            seconds[name].append(measure())
    print(f"\nOne CD-1 epoch, {arguments.images} x {N_VISIBLE}, {N_HIDDEN} hidden, batch {BATCH}, one thread")
    for name, values in seconds.items():
        wall, cpu = (statistics.median(part) for part in zip(*values, strict=True))
        turns = zip(values, seconds["hand-written torch loop"], strict=True)
        ratios = [ours.cpu / by_hand.cpu for ours, by_hand in turns]
        spread = f"{min(ratios):.2f} to {max(ratios):.2f}"
        line = f"  {name:36s} {wall:6.2f} s, of the processor {cpu:6.2f} s, {statistics.median(ratios):5.2f}"
        print(f"{line} ({spread}) x the hand-written loop's", flush=True)
    print(f"  largest difference of a weight, module and loop with its products: {float(difference):.1e}")
    print("\nOne fine-tuning step, 32-32-32-10, batch 100, through DBNClassifier, one thread")
    for n_replicas in (1, 10, 50):
        step = statistics.median(finetuning_step_us(n_replicas, arguments.steps) for _ in range(arguments.repeats))
        print(f"  {n_replicas:2d} replicas {step:8.0f} us a step {step / n_replicas:8.0f} us a network")


if __name__ == "__main__":
    main()
