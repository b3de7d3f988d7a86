"""What the generative model of a run is like: a bound of log p of test images, errors of its labels, samples.

    memcomp-train experiment=full_size updown=contrastive hydra.run.dir=RUN
    python experiments/full_size/generative.py RUN

Grey images become binary ones, each pixel drawn once with its grey value, as a likelihood asks for values.
"""

import argparse
from pathlib import Path
from typing import cast

import torch
from matplotlib.image import imsave
from omegaconf import DictConfig, OmegaConf
from torch import Tensor

from memcomp_lightning import rng
from memcomp_lightning.configuration.rows import rows_of
from memcomp_lightning.likelihood import Ais, base_of, recognition_bound
from memcomp_lightning.models import GenerativeDBN
from memcomp_lightning.plotting import picture_grid
from memcomp_lightning.trained import load_generative

SEED = 0


def bound_of(model: GenerativeDBN, train: Tensor, test: Tensor, ais: Ais) -> str:
    """The bound of log p of test images, in nats an image, and how sure log Z of the top RBM is."""
    below = model.up(train, generator=rng.stream(SEED, "base"))[-1]
    units = model.top.visible.select(torch.arange(model.n_below))
    base = torch.cat((base_of(below, units), model.top.b.new_zeros(model.n_classes)))  # labels are alike in it
    found = ais.estimate(model.top, base=base, generator=rng.stream(SEED, "ais"))
    bound = recognition_bound(model, test, found.log_z, generator=rng.stream(SEED, "bound"))
    error = bound.value.std() / len(test) ** 0.5
    return f"log p >= {bound.value.mean():.2f} ± {error:.2f} (over images); {found}"


def main() -> None:
    """Measure, print, and write the picture."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run", type=Path, help="run folder of memcomp-train with updown=contrastive")
    parser.add_argument("--pretrained", type=Path, help="run folder of its pretraining, if it took model.weights")
    parser.add_argument("--images", type=int, default=1000, help="test images, the first ones")
    parser.add_argument("--betas", type=int, default=10_000, help="steps of annealed importance sampling")
    parser.add_argument("--chains", type=int, default=100)
    parser.add_argument("--sweeps", type=int, default=1000, help="Gibbs sweeps before a sample")
    parser.add_argument("--picture", type=Path, help="file.png; samples.png in the run folder by default")
    given = parser.parse_args()
    model, before = load_generative(given.run), load_generative(given.pretrained or given.run, pretrained=True)
    rows = rows_of(cast(DictConfig, OmegaConf.load(given.run / "settings.yaml")))
    values = rng.stream(SEED, "values")
    some = (rows.train[0][:5000], rows.test[0][: given.images])
    train, test = (model.visible.values_of(v, generator=values) for v in some)
    ais = Ais(n_betas=given.betas, n_chains=given.chains)
    print("before up-down training:", bound_of(before, train, test, ais))
    print("after it:               ", bound_of(model, train, test, ais))
    if not model.n_classes:
        return
    v, label = rows.test
    errors = (model.logits(v).argmax(-1) != label).float().mean()
    print(f"test images whose label it gets wrong: {100 * errors:.2f} %")
    labels = torch.arange(model.n_classes).repeat_interleave(model.n_classes)
    samples = model.samples(len(labels), sweeps=given.sweeps, label=labels, generator=rng.stream(SEED, "samples"))
    picture = given.picture or given.run / "samples.png"
    layout = rows.pixel_layout
    assert layout is not None, "the data are no pictures"
    imsave(picture, picture_grid(layout.to_picture(samples).numpy()), cmap="gray", vmin=0, vmax=1)
    print(f"samples, a class a row: {picture}")


if __name__ == "__main__":
    main()
