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
# # 6. A table: sample it, fill its gaps, find its odd rows
#
# Any table becomes an energy model: two-valued columns are bits, others categories, numbers are real units. Here are the wines that
# ship with scikit-learn, with a tenth of the cells taken away. Missing values are never filled in secret: training follows the gradient of
# the probability of what is there.

# %%
# %matplotlib inline
from functools import partial
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
from sklearn.datasets import load_wine
from torch.optim import SGD

from memcomp_lightning.data import TableDataModule
from memcomp_lightning.models import RBM, start_at_means
from memcomp_lightning.objective import Centring
from memcomp_lightning.samplers import PCD
from memcomp_lightning.trained import Run, impute, sample, score
from memcomp_lightning.training import Greedy, pretrain

wine = load_wine(as_frame=True)
whole = wine.data.copy()
whole["strength"] = np.where(whole["alcohol"] > 13, "strong", "light")
gaps = np.random.default_rng(0).random(whole.shape) < 0.1
table = whole.mask(gaps)
data = TableDataModule.from_frame(table, batch_size=50)
print(data.described)

# %% [markdown]
# ## Train
#
# One restricted Boltzmann machine with 12 hidden units. So few can be summed exactly, which makes likelihoods exact, too.

# %%
rbm = RBM(visible=data.units, n_hidden=12)
start_at_means(rbm, data.train[0], data.train_observed)
training = pretrain(
    Greedy(rbm),
    data.train_dataloader(),
    PCD(n_chains=100),
    iterations=300,
    optimizer=partial(SGD, lr=0.02),
    centring=Centring(),
)
for _ in training:
    pass
run = Run(Path("wine"), rbm, schema=data.schema)

# %% [markdown]
# ## New rows, beside the real ones

# %%
rows = data.schema.decode(sample(run, 500).v)
plt.scatter(whole["alcohol"], whole["color_intensity"], label="data")
plt.scatter(rows["alcohol"], rows["color_intensity"], s=6, label="samples")
plt.xlabel("alcohol")
plt.ylabel("colour intensity")
plt.legend()
plt.show()

# %% [markdown]
# ## Gaps
#
# Each gap gets its most probable value, or the mean with its deviation. How far are they from what was taken away?

# %%
kept = data.table.train
filled = data.schema.decode(impute(run, kept).completed(None))
print({name: column[:3].tolist() for name, column in list(filled.items())[:4]})

# %% [markdown]
# ## Odd rows
#
# A row with a column from another wine has a low likelihood.

# %%
usual = score(run, data.table.test, pseudo=False).columns["log_likelihood"]
odd = data.table.test._replace(v=data.table.test.v.roll(5, dims=0).where(data.table.test.v > 0, data.table.test.v))
strange = score(run, odd, pseudo=False).columns["log_likelihood"]
plt.hist([usual, strange], label=["test rows", "mixed up"])
plt.xlabel("log-likelihood, nats")
plt.legend()
plt.show()
