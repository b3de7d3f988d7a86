"""RBMs with the class as a visible unit: classification by free energy, trained by either likelihood, or both."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import torch
import torch.nn.functional as F
from torch import Generator, Tensor, nn

from memcomp_lightning import rng
from memcomp_lightning.ambient import with_gradient
from memcomp_lightning.defaults import FINETUNING_MOMENTUM
from memcomp_lightning.models import RBM, Normal
from memcomp_lightning.models.affine import affine
from memcomp_lightning.models.units import Bernoulli, Categorical, Mixed
from memcomp_lightning.objective import Centring
from memcomp_lightning.products import n_weights, quick_products
from memcomp_lightning.samplers import CD
from memcomp_lightning.studies.few_labels.data import Sets
from memcomp_lightning.studies.few_labels.learner import Context, Point, point_of
from memcomp_lightning.studies.search import Setting
from memcomp_lightning.training import ClassifierStep, EnergyStep, StepState
from memcomp_lightning.training.given import begin_epoch
from memcomp_lightning.types import Batch, Configurations

AT_ONCE = 500
"""Rows that are judged together: each takes a number a class and hidden unit."""


class FreeEnergyClassifier(nn.Module):
    r"""The classes' free energies of an RBM whose last visible unit is the class.

    .. math:: \log p(y | v) = -F(v, y) + \mathrm{const}, \qquad
        -F(v, y) = d_y + \sum_i \log(1 + e^{c_i + (W v)_i + U_{iy}}) + b v

    Args:
        rbm: Hidden units in {0, 1}; visible ones in {0, 1}, then one of categories.
        n_classes: States of that one.
    """

    def __init__(self, rbm: RBM, n_classes: int) -> None:
        super().__init__()
        self.rbm, self.n_classes = rbm, n_classes

    def forward(self, v: Tensor) -> Tensor:
        """Logits of the classes given the other units, ``(*replicas, n, n_classes)``: -F without ``b v``."""
        n_inputs = self.rbm.n_visible - self.n_classes
        weight, of_class = self.rbm.weight[..., :n_inputs], self.rbm.weight[..., n_inputs:]
        field = affine(v, weight, self.rbm.c).unsqueeze(-2) + of_class.mT.unsqueeze(-3)
        return F.softplus(field).sum(-1) + self.rbm.b[..., n_inputs:].unsqueeze(-2)


@dataclass(frozen=True, kw_only=True)
class LabelRbm:
    r"""Goes on from a pretrained RBM, to which the class is added as a visible unit.

    An update follows the gradients of :math:`\log p(y | v)` (discriminative), of :math:`\log p(v, y)` by centred
    CD-1 (generative), or of both (hybrid: Larochelle & Bengio 2008), over labelled rows. The generative part takes
    as many rows without label, whose class is drawn from :math:`p(y | v)`, so that it is summed over.

    Attributes:
        layer: Of its RBM: 0 sees the data, 1 the means of the first hidden layer.
        discriminative: Whether log p(y | v) is part of what is maximised.
        generative: Weight of log p(v, y), >= 0, unless a setting says it.
        unlabelled: Weight of a row without label, as against one with, in the generative part.
    """

    layer: int
    discriminative: bool
    generative: float
    unlabelled: float = 1.0

    def learn(self, context: Context, sets: Sets, setting: Setting, passes: Sequence[int] | None) -> list[Point]:
        """See :class:`Learner`."""
        dbn = context.dbn()
        with torch.no_grad():
            rows = context.kept(f"layer {self.layer}", lambda: dbn.visible_of(self.layer, sets.rows))
            judging = rows if sets.judging is sets.rows else dbn.visible_of(self.layer, sets.judging)
        sets = replace(sets, rows=rows, judging=judging)
        n = sets.at.shape[-1]
        points = context.lengths.points(n) if passes is None else tuple(passes)
        network = FreeEnergyClassifier(with_class(dbn[self.layer], sets, context.seed), sets.n_classes)
        weight, size = setting.get("generative", self.generative), context.lengths.batch_size(n)
        found = []
        for done in self._passes(network, sets, setting["rate"], weight, size, points[-1]):
            if done in points:
                found.append(point_of(done, network, sets, at_once=AT_ONCE))
        return found

    def _passes(
        self, network: FreeEnergyClassifier, sets: Sets, rate: float, generative: float, size: int, n_passes: int
    ) -> Iterator[int]:
        weights = network.rbm.parameters()
        optimizer = torch.optim.SGD(weights, lr=rate, momentum=FINETUNING_MOMENTUM, fused=True)
        energy, by_class = EnergyStep(sampler=CD(), centring=Centring(rate=0.01)), ClassifierStep(network)
        batches, state, generator = sets.batches(size), StepState(), rng.stream(sets.seed, "label RBM")
        for number in range(n_passes):
            begin_epoch(batches, number)
            with with_gradient(), quick_products(size * n_weights(network)):
                for batch in batches:
                    if self.discriminative:
                        by_class.add_gradient(batch)
                    if generative:
                        positive = self._positive(network, sets, batch, generator)
                        _, _, state = energy.add_gradient(
                            network.rbm, positive, state, share=generative, generator=generator, valued=False
                        )
                        state = state.after_update()
                    optimizer.step()
                    optimizer.zero_grad()
            yield number + 1

    @torch.no_grad()
    def _positive(
        self, network: FreeEnergyClassifier, sets: Sets, batch: Batch, generator: Generator
    ) -> Configurations:
        """Labelled rows with their classes, and as many others with classes that the model draws."""
        v, y = batch.v, F.one_hot(batch.label, sets.n_classes).to(batch.v)
        weight = v.new_ones(v.shape[:-1])
        if self.unlabelled:
            some = torch.randint(len(sets.rows), (v.shape[-2],), generator=generator, device="cpu")
            others = sets.rows[some].expand(sets.n_sets, -1, -1)
            classes = Categorical([sets.n_classes]).sample(network(others), generator=generator)
            v, y = torch.cat((v, others), dim=-2), torch.cat((y, classes), dim=-2)
            weight = torch.cat((weight, self.unlabelled * weight), dim=-1)
        v = torch.cat((v, y), dim=-1)
        return Configurations(v, network.rbm.hidden_mean(v), weight)


@torch.no_grad()
def with_class(rbm: RBM, sets: Sets, seed: int) -> RBM:
    """An RBM for each set with the parameters of another one, and the class as one more visible unit."""
    n_classes, n_inputs = sets.n_classes, rbm.n_visible
    units = Mixed(Bernoulli(n_inputs), Categorical([n_classes]))
    made = RBM(visible=units, n_hidden=rbm.n_hidden, replicas=(sets.n_sets,))
    drawn = Normal(std=0.01)((rbm.n_hidden, n_classes), generator=rng.stream(seed, "output weights"))
    made.weight.copy_(torch.cat((rbm.weight, drawn), dim=-1))
    made.b[..., :n_inputs] = rbm.b
    made.c.copy_(rbm.c)
    return made
