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
# # 3. Swap the negative phase, and measure it
#
# The gradient of an RBM's log-likelihood has a positive phase, an average over the data, and a negative phase, an average over the model.
# A *sampler* supplies the negative phase. On nine bits everything can be enumerated, so that each sampler can be held against the
# exact gradient and each trained RBM against the data's distribution.

# %%
# %matplotlib inline
import copy
from functools import partial

import matplotlib.pyplot as plt
import torch

from memcomp_lightning import rng
from memcomp_lightning.data import BarsAndStripes, ImageDataModule
from memcomp_lightning.likelihood import kl_divergence
from memcomp_lightning.models import DBN
from memcomp_lightning.objective import contrast
from memcomp_lightning.samplers import CD, PCD, Exact, GroundState, ModeAssisted, ModeSchedule, positive_phase
from memcomp_lightning.solvers.dmm import DmmSolver
from memcomp_lightning.training import Greedy, LearningRateDecay, pretrain

N_SEEDS, N_UPDATES = 10, 2000
images = BarsAndStripes(side=3).load()
v = images.train_v.expand(N_SEEDS, -1, -1)
ground_state = GroundState(solver=DmmSolver(n_restarts=8))
samplers = {
    "CD-1": CD(k=1),
    "CD-10": CD(k=10),
    "PCD-1": PCD(n_chains=100),
    "exact gradient": Exact(),
    "mode-assisted CD-1": ModeAssisted(
        inner=CD(k=1), mode=ground_state, schedule=ModeSchedule(n_updates=N_UPDATES)
    ),
    "ground states alone": ground_state,
}

# %% [markdown]
# ## Train each of them
#
# Ten seeds side by side on the replica axis: one tensor program. `pretrain` is the loop of `EnergyPretraining` without the trainer.
# `experiment=sampler_worth` does this on six data sets with the best learning rate of each sampler, and with its time.

# %%
data = ImageDataModule(images, batch_size=None)
learning_rate = {"PCD-1": 0.3}  # about its best for so many updates, as 1 is about that of the others
kl, machines = {}, {}
for name, sampler in samplers.items():
    iterations = N_UPDATES // 10 if name == "ground states alone" else N_UPDATES
    dbn = DBN(9, [18], replicas=(N_SEEDS,), generator=rng.stream(0, "weights"))
    optimizer = partial(torch.optim.SGD, lr=learning_rate.get(name, 1.0))
    decay = LearningRateDecay(iterations)  # falls to a hundredth
    batches = data.train_batches(0, 1).repeated([0] * N_SEEDS)
    training = pretrain(
        Greedy(dbn), batches, sampler, iterations=iterations, optimizer=optimizer, schedules=[decay]
    )
    kl[name], machines[name] = [], {}
    for done in training:
        if done.number in {10, 30, 100, 300, 1000, 2000}:
            kl[name].append((done.number, kl_divergence(dbn[0], v).detach()))
            machines[name][done.number] = copy.deepcopy(dbn[0])

for name, points in kl.items():
    updates, values = zip(*points, strict=True)
    values = torch.stack(values)
    (line,) = plt.loglog(updates, values.median(1).values, marker="o", label=name)
    plt.fill_between(updates, values.min(1).values, values.max(1).values, color=line.get_color(), alpha=0.12)
plt.xlabel("updates")
plt.ylabel("KL divergence of the data (nats)")
plt.legend(fontsize="small")
plt.title("bars and stripes, 3x3: median and range of ten seeds")
plt.show()

# %% [markdown]
# ## How close is each gradient to the exact one?
#
# The mean of many draws, at the same RBM for all: the one that the exact gradient had reached after a number of updates. Close to 1 is
# unbiased; "close to the true gradient" is the paper's claim for ground states.


# %%
def gradient(rbm, sampler, n_draws):
    generator, positive = rng.stream(1, "negative_phase"), positive_phase(rbm, v)
    state, total = sampler.init(rbm, v.shape[-2], generator=generator), 0.0
    for _ in range(n_draws):
        negative = sampler.sample(rbm, state, positive, generator=generator)
        state = negative.state
        total = total + contrast(rbm, positive, negative.configurations)
    parts = torch.autograd.grad(total.sum() / n_draws, list(rbm.parameters()))
    return torch.cat([part.flatten(1) for part in parts], dim=1)


shown = {"CD-1": samplers["CD-1"], "CD-10": samplers["CD-10"], "ground states alone": ground_state}
for name, sampler in shown.items():
    cosine = {
        number: torch.cosine_similarity(gradient(rbm, sampler, 100), gradient(rbm, Exact(), 1), dim=1).median()
        for number, rbm in machines["exact gradient"].items()
    }
    plt.semilogx(list(cosine), list(cosine.values()), marker="o", label=name)
plt.axhline(0, color="0.8", linewidth=0.8)
plt.xlabel("updates of the RBM that is looked at")
plt.ylabel("cosine with the exact gradient")
plt.legend(fontsize="small")
plt.show()

# %%
{name: round(float(points[-1][1].median()), 3) for name, points in kl.items()}
