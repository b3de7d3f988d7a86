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
# # 7. Aligned sequences
#
# An alignment is a table of letters. This one is made up: a family of RNA hairpins whose two arms pair. An RBM with categorical units
# learns which letters go together, and draws new members.

# %%
# %matplotlib inline
from functools import partial
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
from torch.optim import SGD

from memcomp_lightning.data import Sequences, TableDataModule
from memcomp_lightning.models import RBM, start_at_means
from memcomp_lightning.models.couplings import contact_scores, couplings
from memcomp_lightning.objective import Centring
from memcomp_lightning.plotting import plot_logo
from memcomp_lightning.samplers import PCD
from memcomp_lightning.trained import Run, sample
from memcomp_lightning.training import Greedy, pretrain

draw = np.random.default_rng(0)
PAIR = dict(zip("ACGU", "UGCA", strict=True))
lines = []
for number in range(2000):
    arm = "".join(draw.choice(list("ACGU"), 5, p=[0.2, 0.3, 0.3, 0.2]))
    back = "".join(PAIR[x] if draw.random() < 0.9 else draw.choice(list("ACGU")) for x in reversed(arm))
    lines.append(f">hairpin {number}\n{arm}GAAA{back}\n")
Path("hairpins.fasta").write_text("".join(lines))
family = Sequences(path="hairpins.fasta").load()
print(family.described())

# %% [markdown]
# ## Train

# %%
data = TableDataModule(family, batch_size=100)
rbm = RBM(visible=data.units, n_hidden=30)
start_at_means(rbm, data.train[0])
training = pretrain(
    Greedy(rbm),
    data.train_dataloader(),
    PCD(n_chains=100),
    iterations=60,
    optimizer=partial(SGD, lr=0.1),
    centring=Centring(),
)
for _ in training:
    pass

# %% [markdown]
# ## New members, and who pairs with whom

# %%
run = Run(Path("hairpins"), rbm, schema=data.schema)
members = data.schema.decode(sample(run, 500).v)["sequence"]
paired = np.mean([[PAIR.get(s[k]) == s[-1 - k] for k in range(5)] for s in members])
print(members[:3], f"paired: {paired:.2f} of the samples, .93 of the family")
scores = contact_scores(couplings(rbm)).numpy()
plt.imshow(scores)
plt.title("contact scores: the arms pair")
plt.colorbar()
plt.show()
letters = np.array([list(s) for s in members])
frequency = np.stack([(letters == x).mean(0) for x in "-ACGU"], axis=-1)
plot_logo({"samples": frequency}, alphabet="-ACGU")
plt.show()
