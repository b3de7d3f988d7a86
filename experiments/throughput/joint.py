"""A pass of joint training of a 784-500-500 DBM by PCD-1 and the mean field, beside a torch loop written by hand.

    python experiments/throughput/joint.py

The same updates: same order of images, same draws, same momentum. By hand there are layers, no classes of units;
the field of the data is computed once an update; gradients need no autograd. Repetitions take turns, one thread.
"""

import argparse
from collections.abc import Callable
from functools import partial
from statistics import median

import torch
from common import Seconds
from torch import Tensor
from torch.optim import SGD

from memcomp_lightning import rng
from memcomp_lightning.data import Batches
from memcomp_lightning.models import DBN
from memcomp_lightning.products import quick_products
from memcomp_lightning.samplers import PCD
from memcomp_lightning.training import Joint, PhaseTraining

SIZES, BATCH, RATE, MOMENTUM = (784, 500, 500), 100, 0.01, 0.5
MOST_ITERATIONS, TOLERANCE = 30, 1e-3


def batches_of(v: Tensor) -> Batches:
    return Batches(v, torch.zeros(len(v), dtype=torch.long), BATCH, len(v), shuffle=True, seed=0)


def ours() -> tuple[Callable[[Tensor], object], Callable[[], Tensor]]:
    """A pass, and the couplings after it."""
    stage = Joint(DBN(SIZES[0], SIZES[1:]))
    streams = {name: rng.stream(0, name) for name in ("negative_phase", "positive_phase")}
    training = PhaseTraining(
        stage.phases[0],
        PCD(k=1, n_chains=BATCH),
        optimizer=partial(SGD, lr=RATE, momentum=MOMENTUM),
        centring=None,
        streams=streams,
    )
    return lambda v: training.run_pass(batches_of(v)), lambda: stage.machine.coupling.detach()


class ByHand:
    """Weights upwards, ``(n_below, n_above)``, and biases of the layers; chains of all units."""

    def __init__(self) -> None:
        self.w1, self.w2 = (
            weight.mT.detach().clone() for weight in Joint(DBN(SIZES[0], SIZES[1:])).machine.weights()
        )
        self.b, self.c1, self.c2 = (torch.zeros(n) for n in SIZES)
        self.parameters = [self.w1, self.w2, self.b, self.c1, self.c2]
        self.velocity = [torch.zeros_like(parameter) for parameter in self.parameters]
        self.generator = rng.stream(0, "negative_phase")
        self.chains = self.draw(torch.full((BATCH, sum(SIZES)), 0.5)).split(SIZES, dim=-1)

    def draw(self, p: Tensor) -> Tensor:
        return torch.empty(p.shape).uniform_(generator=self.generator).lt_(p)

    def means(self, v: Tensor) -> tuple[Tensor, Tensor]:
        """Of the hidden layers, in the mean field."""
        from_data = torch.addmm(self.c1, v, self.w1)
        h1, h2 = (torch.full((len(v), n), 0.5) for n in SIZES[1:])
        # Layers in the order of the classes: the even ones, then the odd one.
        for _ in range(MOST_ITERATIONS):
            before = h1, h2
            h2 = torch.addmm(self.c2, h1, self.w2).sigmoid_()
            h1 = torch.addmm(from_data, h2, self.w2.mT).sigmoid_()
            if max(float((x - y).abs().max()) for x, y in zip((h1, h2), before, strict=True)) < TOLERANCE:
                break
        return h1, h2

    def sweep(self) -> tuple[Tensor, Tensor, Tensor]:
        """Of the chains; the odd layer is read by its means."""
        h1 = self.chains[1]
        even = torch.cat((torch.addmm(self.b, h1, self.w1.mT), torch.addmm(self.c2, h1, self.w2)), dim=-1)
        v, h2 = self.draw(even.sigmoid_()).split((SIZES[0], SIZES[2]), dim=-1)
        mean = torch.addmm(self.c1, v, self.w1).addmm_(h2, self.w2.mT).sigmoid_()
        self.chains = v, self.draw(mean), h2
        return v, mean, h2

    @torch.no_grad()
    def run_pass(self, images: Tensor) -> None:
        with quick_products(BATCH * SIZES[0] * sum(SIZES[1:])):  # as ours
            self._run_pass(images)

    def _run_pass(self, images: Tensor) -> None:
        for batch in batches_of(images):
            v, n = batch.v, len(batch.v)
            h1, h2 = self.means(v)
            v_model, h1_model, h2_model = self.sweep()
            gradients = [
                torch.mm(v_model.mT, h1_model).addmm_(v.mT, h1, alpha=-1 / n, beta=1 / BATCH),
                torch.mm(h1_model.mT, h2_model).addmm_(h1.mT, h2, alpha=-1 / n, beta=1 / BATCH),
                v_model.mean(0) - v.mean(0),
                h1_model.mean(0) - h1.mean(0),
                h2_model.mean(0) - h2.mean(0),
            ]
            for parameter, speed, gradient in zip(self.parameters, self.velocity, gradients, strict=True):
                speed.mul_(MOMENTUM).add_(gradient)
                parameter.sub_(speed, alpha=RATE)

    def coupling(self) -> Tensor:
        return torch.cat((self.w1.flatten(), self.w2.flatten()))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--images", type=int, default=2000, help="images of a pass")
    parser.add_argument("--repeats", type=int, default=7)
    given = parser.parse_args()
    torch.set_num_threads(1)
    v = rng.bernoulli(torch.full((given.images, SIZES[0]), 0.5), generator=rng.stream(0, "images"))
    by_hand, (run_pass, coupling) = ByHand(), ours()
    runs = {"pretrain": run_pass, "by hand": by_hand.run_pass}
    seconds = {name: list[Seconds]() for name in runs}
    for repeat in range(given.repeats + 1):
        for name, run in runs.items():
            begin = Seconds.now()
            run(v)
            spent = Seconds.now().since(begin)
            seconds[name] += [spent] if repeat else []  # the first pass warms up
        if not repeat:
            difference = float((coupling() - by_hand.coupling()).abs().max())
    print(f"{'-'.join(map(str, SIZES))}, batch {BATCH}, ms an update")
    n_updates = given.images / BATCH
    for name, spent in seconds.items():
        wall, cpu = (1e3 * median(x) / n_updates for x in zip(*spent, strict=True))
        print(f"  {name:10s} {wall:6.1f}, of the processor {cpu:6.1f}")
    ratios = [x[1] / y[1] for x, y in zip(*seconds.values(), strict=True)]
    print(f"  ratio of processor times {median(ratios):.2f} ({min(ratios):.2f} to {max(ratios):.2f})")
    print(f"  largest difference of a coupling after a pass: {difference:.1e}")


if __name__ == "__main__":
    main()
