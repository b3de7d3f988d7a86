"""The deep belief network as a generative model: directed layers below an RBM, and a recognition model."""

from itertools import pairwise
from typing import cast

import torch
from jaxtyping import Float, Int
from torch import Generator, Tensor, nn

from memcomp_lightning.errors import require, require_count
from memcomp_lightning.models.base import PerState, Readout, Visible
from memcomp_lightning.models.chains import swept
from memcomp_lightning.models.conditional import Conditional
from memcomp_lightning.models.dbn import DBN
from memcomp_lightning.models.rbm import RBM
from memcomp_lightning.models.units import Categorical, Units, side_by_side


class GenerativeDBN(nn.Module):
    r"""A deep belief network as what it is a model of: the data, and their labels.

    .. math:: p(v, h_1, \ldots, h_L) = p(v | h_1) \, p(h_1 | h_2) \cdots p(h_{L-1}, h_L)

    The last factor is an RBM, in which labels may stand beside :math:`h_{L-1}`; the others are directed, and a
    recognition model :math:`q(h_1 | v) \, q(h_2 | h_1) \cdots q(h_{L-1} | h_{L-2})` has weights of its own
    (Hinton, Osindero & Teh 2006). It begins with the weights of a DBN, each of them in both directions.

    Args:
        dbn: Where the weights come from; not changed.
        n_classes: Classes of the labels, which are a categorical unit of the top RBM, with weights of zero at
            first; 0 leaves labels out.

    Attributes:
        generative: :math:`p(h_{l-1} | h_l)`, the lowest first; one fewer than hidden layers.
        recognition: :math:`q(h_l | h_{l-1})`, the lowest first.
        top: The RBM.
        n_classes: Classes of the labels.

    >>> model = GenerativeDBN(DBN(5, [4, 3]), n_classes=2)
    >>> model.top.n_visible, model.logits(torch.zeros(7, 5)).shape
    (6, torch.Size([7, 2]))
    """

    @torch.inference_mode(False)
    def __init__(self, dbn: DBN, *, n_classes: int = 0) -> None:
        super().__init__()
        require_count("n_classes", n_classes, minimum=0)
        self.n_classes = n_classes
        pairs = list(pairwise(dbn))
        self.generative = nn.ModuleList(Conditional(rbm.visible, rbm.weight.mT, rbm.b) for rbm, _ in pairs)
        self.recognition = nn.ModuleList(Conditional(rbm.hidden, rbm.weight, rbm.c) for rbm, _ in pairs)
        visible = dbn[-1].visible
        if n_classes:
            visible = side_by_side(visible, Categorical(1, n_classes))
        self.top = RBM(visible=visible, hidden=dbn[-1].hidden, replicas=dbn.replicas).to(dbn[-1].b)
        self.take(dbn)

    @torch.no_grad()
    def take(self, dbn: DBN) -> None:
        """Begin with the weights of a DBN of the same sizes, and without weights of the labels."""
        for rbm, down, up in zip(dbn, self.downward, self.upward, strict=False):
            down.weight.copy_(rbm.weight.mT)
            down.bias.copy_(rbm.b)
            down.units.load_state_dict(rbm.visible.state_dict())
            up.weight.copy_(rbm.weight)
            up.bias.copy_(rbm.c)
        last, n = dbn[-1], dbn[-1].n_visible
        self.top.weight.zero_()
        self.top.b.zero_()
        self.top.weight[..., :n] = last.weight
        self.top.b[..., :n] = last.b
        self.top.c.copy_(last.c)

    @property
    def downward(self) -> list[Conditional]:
        """The directed layers, p(h_{l-1} | h_l), the lowest first."""
        return cast(list[Conditional], list(self.generative))

    @property
    def upward(self) -> list[Conditional]:
        """The recognition model, q(h_l | h_{l-1}), the lowest first."""
        return cast(list[Conditional], list(self.recognition))

    @property
    def visible(self) -> Units:
        """The kind of the inputs, without labels."""
        if self.generative:
            return self.downward[0].units
        return self.top.visible.select(torch.arange(self.n_below, device=self.top.b.device))

    @property
    def replicas(self) -> tuple[int, ...]:
        """Leading axes of independent networks."""
        return self.top.replicas

    @property
    def n_below(self) -> int:
        """Visible units of the top RBM that are no labels."""
        return self.top.n_visible - self.n_classes

    # ------------------------------------------------------------------------------------------ both directions

    @torch.no_grad()
    def up(self, v: Visible, *, generator: Generator) -> list[Tensor]:
        """Draw the layers below the top one by the recognition model: v, h_1, ..., h_{L-1}."""
        states = [v]
        for layer in self.upward:
            states.append(layer.draw(states[-1], generator=generator))
        return states

    @torch.no_grad()
    def down(self, x: Tensor, *, visible: Readout = "mean", generator: Generator) -> list[Tensor]:
        """Draw the layers below visible states of the top RBM by the directed layers: v, h_1, ..., h_{L-1}.

        Labels of ``x`` are left out. With ``visible="mean"`` v are the means given h_1.
        """
        states = [x[..., : self.n_below]]
        for number, layer in reversed(list(enumerate(self.downward))):
            means = number == 0 and visible == "mean"
            below = layer.mean(states[0]) if means else layer.draw(states[0], generator=generator)
            states.insert(0, below)
        return states

    def with_label(self, x: Tensor, label: Int[Tensor, "*axes n"]) -> Tensor:
        """Visible states of the top RBM: x, and beside it what says the class, if the model has labels."""
        return self._beside(x, self._label_units(x, label)) if self.n_classes else x

    def _label_units(self, x: Tensor, label: Tensor) -> Tensor:
        """What says the class of each row of x, ``(*axes, n, n_classes)``."""
        wrong = (label < 0) | (label >= self.n_classes)
        found = int(label[wrong][0]) if bool(wrong.any()) else 0
        allowed = f"an integer from 0 to {self.n_classes - 1} of each row, as labels are units of the model"
        require(not bool(wrong.any()), "label", found, allowed)
        n = x.shape[-2]
        require(label.shape[-1] == n, "length of label", label.shape[-1], f"{n}, one of each row")
        return torch.nn.functional.one_hot(label, self.n_classes).to(x)

    def _beside(self, x: Tensor, label_units: Tensor) -> Tensor:
        return torch.cat((x, label_units.expand(*x.shape[:-1], self.n_classes)), dim=-1)

    # ---------------------------------------------------------------------------------------------- reading off

    @torch.no_grad()
    def samples(
        self,
        n: int,
        *,
        sweeps: int,
        label: Int[Tensor, " n"] | None = None,
        visible: Readout = "mean",
        generator: Generator,
    ) -> Visible:
        """Draw from the model: Gibbs sweeps of the top RBM from random states, then one pass down.

        Args:
            n: Samples a replica.
            sweeps: Of the top RBM, >= 1; hundreds to thousands, as its chains mix slowly.
            label: Classes to hold fixed, ``(n,)`` int64; None draws them too.
            visible: "mean" for the means given the lowest hidden layer, or "sample".
            generator: Random stream.
        """
        require_count("n", n)
        require_count("sweeps", sweeps)
        remedy = "This model has no labels."
        require(label is None or self.n_classes > 0, "label", "a tensor", "None", remedy)
        x = self.top.chains().random(n, generator=generator)
        held = None if label is None else self._label_units(x, label.to(x.device))
        h = None
        for _ in range(sweeps):
            x = x if held is None else self._beside(x[..., : self.n_below], held)
            x, h = swept(self.top, x, generator=generator)
        if visible == "mean" and not self.generative:
            assert h is not None
            return self.top.visible_mean(h)[..., : self.n_below]
        return self.down(x, visible=visible, generator=generator)[0]

    def log_weights_of_labels(self, x: Tensor) -> Float[Tensor, "*replicas n n_classes"]:
        """Log of the unnormalised probability of states below the top with each label, in the top RBM."""
        fixed = torch.cat((x, x.new_zeros(*x.shape[:-1], self.n_classes)), dim=-1)
        field = self.top.hidden_field(fixed)
        found = []
        for label in range(self.n_below, self.top.n_visible):
            of_label = field + self.top.weight[..., label].unsqueeze(-2)
            found.append(self.top.hidden.cumulant(of_label).sum(-1) + self.top.b[..., label].unsqueeze(-1))
        return torch.stack(found, dim=-1) - self._energy_below(x, fixed).unsqueeze(-1)

    def log_weight(self, x: Tensor) -> PerState:
        """Log of the unnormalised probability of states below the top, labels and top units summed out."""
        if self.n_classes:
            return self.log_weights_of_labels(x).logsumexp(-1)
        return -self.top.free_energy(x)

    def _energy_below(self, x: Tensor, fixed: Tensor) -> Tensor:
        """What states below the top cost by themselves; ``fixed`` are they with no label beside them."""
        energy = -(x * self.top.b[..., : self.n_below].unsqueeze(-2)).sum(-1)
        units = self.top.visible
        return energy if units.linear else energy + units.energy(fixed)

    @torch.no_grad()
    def logits(self, v: Visible) -> Float[Tensor, "*replicas n n_classes"]:
        """Log odds of the classes given v, up to a number a row: the top RBM's, at the mean activations below."""
        require(self.n_classes > 0, "n_classes", 0, "classes, which this model was made without")
        for layer in self.upward:
            v = layer.mean(v)
        return self.log_weights_of_labels(v)
