"""What products in bfloat16 do to a model: exact log-likelihoods of test images, beside float32 of the same seeds.

    python experiments/throughput/bfloat16.py

With units in {0, 1}, the products that `pretrain.products=bf16` makes are those of rounded weights, summed in
float32. So any processor makes the same ones with weights that are rounded beforehand, and these are trained here;
where the processor multiplies in bfloat16 by itself, that is trained as well, and timed.
"""

import argparse
import copy
import time
from dataclasses import dataclass
from functools import partial
from typing import Any, ClassVar

import numpy as np
import torch
from scipy.stats import t
from torch import Generator

from memcomp_lightning.data import Batches, Digits
from memcomp_lightning.likelihood import log_likelihood, log_partition_function
from memcomp_lightning.models import DBN, EnergyModel
from memcomp_lightning.samplers import CD, PCD, InBfloat16
from memcomp_lightning.samplers.bfloat16 import multiplies_in_bfloat16
from memcomp_lightning.training import Greedy, pretrain
from memcomp_lightning.types import Configurations, NegativePhase

N_HIDDEN, BATCH, LEARNING_RATE = 16, 20, 0.1


@dataclass(frozen=True)
class RoundedBeforehand:
    """A sampler that sees weights rounded to bfloat16."""

    inner: CD | PCD
    uses_data: ClassVar[bool] = True
    shared: ClassVar[bool] = False

    def init(self, model: EnergyModel, n_chains: int, *, generator: Generator) -> Any:
        return self.inner.init(model, n_chains, generator=generator)

    def sample(
        self, model: EnergyModel, state: Any, positive: Configurations, *, generator: Generator
    ) -> NegativePhase[Any]:
        rounded: Any = copy.deepcopy(model)
        with torch.no_grad():
            rounded.weight.copy_(rounded.weight.bfloat16())
        return self.inner.sample(rounded, state, positive, generator=generator)


def trained(sampler: Any, seed: int, passes: int) -> tuple[float, float]:
    """Mean log-likelihood of a held-out row in nats, exact, and seconds of the processor."""
    digits = Digits().load()
    train_v, test_v = ((v > 0.5).float() for v in (digits.train_v, digits.test_v))
    network = DBN(train_v.shape[-1], [N_HIDDEN], generator=torch.Generator().manual_seed(seed))
    batches = Batches(train_v, digits.train_label, BATCH, BATCH, True, seed)
    optimizer = partial(torch.optim.SGD, lr=LEARNING_RATE)
    begin = time.process_time()
    for _ in pretrain(Greedy(network), batches, sampler, iterations=passes, optimizer=optimizer, seed=seed):
        pass
    seconds = time.process_time() - begin
    return float(log_likelihood(network[0], test_v, log_partition_function(network[0])).mean()), seconds


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=10, help="pairs of trainings, two or more")
    parser.add_argument("--passes", type=int, default=50, help="over the 1,437 training images")
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    for name, sampler in (("CD-1", CD()), ("PCD-1", PCD())):
        ways: dict[str, Any] = {"rounded weights": RoundedBeforehand(sampler)}
        if multiplies_in_bfloat16():
            ways["products in bfloat16"] = InBfloat16(sampler=sampler)
        plain = [trained(sampler, seed, arguments.passes) for seed in range(arguments.seeds)]
        print(f"{name}, float32: {np.mean([nats for nats, _ in plain]):.3f} nats")
        for way, other in ways.items():
            found = [trained(other, seed, arguments.passes) for seed in range(arguments.seeds)]
            seconds = sum(b[1] for b in found) / sum(a[1] for a in plain)
            gain = np.array([b[0] - a[0] for a, b in zip(plain, found, strict=True)])
            half = t.ppf(0.975, len(gain) - 1) * gain.std(ddof=1) / len(gain) ** 0.5
            interval = f"[{gain.mean() - half:+.3f}, {gain.mean() + half:+.3f}]"
            took = f", {seconds:.2f} of the seconds" if isinstance(other, InBfloat16) else ""
            print(f"  {way}: {gain.mean():+.3f} nats {interval}{took}")


if __name__ == "__main__":
    main()
