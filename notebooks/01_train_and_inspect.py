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
# # 1. Train a deep belief network and look inside
#
# A deep belief network is pretrained layer by layer, without labels, each layer as a restricted Boltzmann machine (RBM).
# Then it is fine-tuned with labels as an ordinary network. Here the data are the digits that ship with scikit-learn, reduced to
# 32 inputs as in the paper, and the negative phase is contrastive divergence.

# %%
# %matplotlib inline
import csv
import logging
from pathlib import Path

import lightning.pytorch as pl
import matplotlib.pyplot as plt

from memcomp_lightning import rng
from memcomp_lightning.callbacks import LogLikelihood, ReconstructionError, SaturationGuard
from memcomp_lightning.data import Digits, ImageDataModule
from memcomp_lightning.models import DBN
from memcomp_lightning.modules import DBNClassifier, EnergyPretraining
from memcomp_lightning.plotting import picture_grid
from memcomp_lightning.samplers import CD
from memcomp_lightning.training import Greedy, MomentumSchedule, evaluate

logging.getLogger("lightning.pytorch").setLevel(logging.WARNING)  # fewer greetings
images = Digits().load()
layout = images.layout
print(images.name, tuple(images.train_v.shape), "training images and labels,", len(images.test_v), "for testing")
plt.imshow(picture_grid(layout.to_picture(images.train_v[:24]).numpy()), cmap="gray")
plt.axis("off")
plt.title("images as the network sees them")
plt.show()

# %% [markdown]
# ## Pretraining
#
# `EnergyPretraining` is a LightningModule, `CD` the sampler that supplies its negative phase. Any other sampler takes its place; nothing
# else changes. Callbacks log to whatever logger the trainer has.

# %%
dbn = DBN(32, [32, 32], generator=rng.stream(0, "weights"))
module = EnergyPretraining(Greedy(dbn), CD(k=1), iterations=20, schedules=[MomentumSchedule()])
data = ImageDataModule(images, batch_size=50, validation_fraction=0.1)
log = pl.loggers.CSVLogger("logs", name="pretraining")


def trainer(epochs, callbacks=()):
    return pl.Trainer(
        max_epochs=epochs,
        callbacks=list(callbacks),
        logger=log if callbacks else False,
        log_every_n_steps=1,
        enable_checkpointing=False,
        enable_progress_bar=False,
        enable_model_summary=False,
    )


looking = [ReconstructionError(), LogLikelihood(every=5), SaturationGuard()]
trainer(module.n_epochs, looking).fit(module, datamodule=data)

# %% [markdown]
# The reconstruction error falls, which says little. The log-likelihood says what was learned of the distribution.

# %%
with Path(log.log_dir, "metrics.csv").open() as file:
    rows = list(csv.DictReader(file))
tags = [tag for tag in rows[0] if tag.endswith(("reconstruction_error", "log_likelihood_train"))]
figure, axes = plt.subplots(1, len(tags), figsize=(3.2 * len(tags), 2.6), layout="constrained")
for tag, ax in zip(tags, axes, strict=True):
    points = [(int(row["epoch"]), float(row[tag])) for row in rows if row[tag]]
    ax.plot(*zip(*points, strict=True), marker="o", markersize=3)
    ax.set_title(tag, fontsize="small")
    ax.set_xlabel("pass")
plt.show()

# %% [markdown]
# ## Inside
#
# Receptive fields of the first layer's hidden units, and images that Gibbs chains draw from it.

# %%
rbm = dbn[0]
fields = rbm.weight.detach()
chains = rbm.chains()
generator = rng.stream(0, "fantasies")
v = chains.random(24, generator=generator)
for _ in range(200):
    v = chains.sweep(v, generator=generator)
mean = rbm.visible_mean(rbm.hidden_mean(v)).detach()

figure, axes = plt.subplots(1, 2, figsize=(9, 3.2), layout="constrained")
axes[0].imshow(
    picture_grid(layout.to_picture((fields - fields.min()) / (fields.max() - fields.min())).numpy()), cmap="gray"
)
axes[0].set_title("receptive fields")
axes[1].imshow(picture_grid(layout.to_picture(mean).numpy()), cmap="gray")
axes[1].set_title("samples of the model")
for ax in axes:
    ax.axis("off")
plt.show()

# %% [markdown]
# ## Fine-tuning
#
# The same weights with an output layer, trained with labels. One *iteration* is one pass over the training set.

# %%
accuracy = {}
for name, network in {
    "pretrained": dbn,
    "not pretrained": DBN(32, [32, 32], generator=rng.stream(0, "weights")),
}.items():
    classifier = DBNClassifier(network, iterations=60, generator=rng.stream(0, "output"))
    trainer(classifier.n_epochs).fit(classifier, datamodule=data)
    accuracy[name] = float(evaluate(classifier.network, data.test_dataloader()).accuracy)
accuracy

# %% [markdown]
# The weights N(0, 0.01²) of the network that was not pretrained learn late. Whether that is a merit of pretraining or of the size of
# the weights, notebook 4 asks.
