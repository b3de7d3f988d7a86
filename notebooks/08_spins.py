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
# # 8. Spins on a lattice
#
# Spins of a known Ising model, and the couplings that training finds in them: by pseudo-likelihood, which needs no chains, on the bonds of
# the lattice. Then the ground state, and the magnetisation at other temperatures.

# %%
# %matplotlib inline
from functools import partial

import matplotlib.pyplot as plt
import torch
from torch.optim import SGD

import memcomp_lightning
from memcomp_lightning.data import TableDataModule
from memcomp_lightning.models import BoltzmannMachine, start_at_means
from memcomp_lightning.models.connectivity import grid
from memcomp_lightning.models.couplings import couplings
from memcomp_lightning.models.units import Spin
from memcomp_lightning.samplers import PseudoLikelihood
from memcomp_lightning.trained import sample
from memcomp_lightning.training import Boltzmann, pretrain

side = 6
truth = BoltzmannMachine(None, 0, grid(side, side), visible=Spin(side**2))
with torch.no_grad():
    truth.coupling.fill_(0.35)
spins = sample(truth, 2000, seed=1).v
data = TableDataModule.from_array(spins, batch_size=200)
print(data.described)

# %% [markdown]
# ## Train, and compare the couplings

# %%
machine = BoltzmannMachine(None, 0, grid(side, side), visible=data.units)
start_at_means(machine, data.train[0])
rows = data.train_dataloader()
for _ in pretrain(Boltzmann(machine), rows, PseudoLikelihood(), iterations=40, optimizer=partial(SGD, lr=0.05)):
    pass
found = couplings(machine)
J = found.J[tuple(machine.pairs.T)]
print(f"J: {J.mean():.3f} on the average, {J.std():.3f} apart; h: {found.h.abs().max():.3f} at most")
plt.hist(J.numpy(), bins=20)
plt.axvline(0.35, color="k")
plt.xlabel("couplings found; the line is the true one")
plt.show()

# %% [markdown]
# ## Ground state, and other temperatures

# %%
print(memcomp_lightning.solve(machine, seed=0))
temperatures = [0.5, 1.0, 1.5, 2.0, 3.0, 5.0]
order = [sample(machine, 500, temperature=t).v.mean(-1).abs().mean().item() for t in temperatures]
plt.plot(temperatures, order, "o-")
plt.xlabel("temperature")
plt.ylabel("mean of |magnetisation|")
plt.show()
