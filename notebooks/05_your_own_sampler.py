# ---
# jupyter:
#   jupytext:
#     formats: ipynb,py:percent
#     text_representation:
#       extension: .py
#       format_name: percent
#   kernelspec:
#     display_name: Python 3
#     language: python
#     name: python3
# ---

# %% [markdown]
# # 5. Write your own sampler
#
# A sampler is an object with two methods, `init` and `sample`, and two facts about itself. As an example: CD with *tempered* data chains,
# which start at the images like CD-1, but make their sweep at a higher temperature first, to leave the images' surroundings.

# %%
# %matplotlib inline
from dataclasses import dataclass
from functools import partial

import matplotlib.pyplot as plt
import torch

from memcomp_lightning import rng
from memcomp_lightning.data import BarsAndStripes, ImageDataModule
from memcomp_lightning.errors import require
from memcomp_lightning.likelihood import kl_divergence
from memcomp_lightning.models import DBN
from memcomp_lightning.samplers import CD
from memcomp_lightning.testing import check_sampler
from memcomp_lightning.training import Greedy, LearningRateDecay, pretrain
from memcomp_lightning.types import Configurations, NegativePhase, NoState


@dataclass(frozen=True, kw_only=True)
class WarmCD:
    """CD whose first sweep is at inverse temperature ``beta``, in (0, 1]."""

    uses_data = True  # a new answer for each batch
    shared = False  # with several processes, each one draws for its own images
    beta: float = 0.5

    def __post_init__(self):
        require(0 < self.beta <= 1, "beta", self.beta, "a number in (0, 1]")

    def init(self, model, n_chains, *, generator):
        return NoState()

    @torch.no_grad()
    def sample(self, model, state, positive, *, generator):
        v = model.visible_mean(rng.bernoulli(positive.h, generator=generator), beta=self.beta)
        v = rng.bernoulli(v, generator=generator)
        v = model.visible_mean(rng.bernoulli(model.hidden_mean(v), generator=generator))
        return NegativePhase(Configurations(v, model.hidden_mean(v)), state, {})


# %% [markdown]
# ## Is it a sampler?
#
# The conformance kit tries shapes, replicas, random streams and what the gradient needs. It says what is wrong; here a sampler that
# draws from torch's global random stream:

# %%
check_sampler(WarmCD())


class Forgetful(WarmCD):
    @torch.no_grad()
    def sample(self, model, state, positive, *, generator):
        v = torch.bernoulli(model.visible_mean(positive.h))  # noqa: TID251
        return NegativePhase(Configurations(v, model.hidden_mean(v)), state, {})


try:
    check_sampler(Forgetful())
except AssertionError as error:
    print(error)

# %% [markdown]
# ## Is it any good?

# %%
images = BarsAndStripes(side=3).load()
v, n_seeds, n_updates = images.train_v.expand(10, -1, -1), 10, 3000
data = ImageDataModule(images, batch_size=None)
optimizer, decay = partial(torch.optim.SGD, lr=0.5), LearningRateDecay(n_updates)  # falls to a hundredth
for name, sampler in {"CD-1": CD(k=1), "CD-2": CD(k=2), "warm CD": WarmCD(beta=0.5)}.items():
    dbn = DBN(9, [18], replicas=(n_seeds,), generator=rng.stream(0, "weights"))
    batches = data.train_batches(0, 1).repeated([0] * n_seeds)
    training = pretrain(
        Greedy(dbn), batches, sampler, iterations=n_updates, optimizer=optimizer, schedules=[decay]
    )
    course = [
        (done.number, float(kl_divergence(dbn[0], v).median())) for done in training if done.number % 100 == 0
    ]
    plt.semilogy(*zip(*course, strict=True), label=name)
plt.xlabel("updates")
plt.ylabel("KL divergence of the data (nats)")
plt.legend()
plt.show()

# %% [markdown]
# ## From the command line
#
# With `confs/sampler/warm_cd.yaml`, two lines,
#
#     _target_: your_package.WarmCD
#     beta: 0.5
#
# and your package on the path:
#
#     memcomp-train --config-dir confs sampler=warm_cd
#     memcomp-train --config-dir confs -m sampler=cd,warm_cd sampler.beta=0.3,0.5,0.8
#
# Solvers for `GroundState` and vector fields for the DMM plug in the same way: [docs/extending.md](../docs/extending.md).
