"""Estimate log Z of models too large to be enumerated, by annealed importance sampling, from below and above."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import NamedTuple

import torch
from torch import Generator, Tensor
from tqdm.auto import tqdm

from memcomp_lightning.errors import require, require_count
from memcomp_lightning.likelihood.boltzmann import base_on_first_class
from memcomp_lightning.likelihood.machine_ais import MachinePath
from memcomp_lightning.models.base import EnergyModel, Visible
from memcomp_lightning.models.init import independent_bias
from memcomp_lightning.models.rbm import RBM
from memcomp_lightning.products import quick_products

Schedule = Sequence[float] | Tensor

STEP = 10**5
"""Products in the time that one class of a machine takes to be drawn, however few units it has."""

base_of = independent_bias
"""Visible bias of independent units with the data's means, a base for AIS: ``base_of(v, model.visible)``."""


class AisEstimate(NamedTuple):
    """An estimate of log Z with what it takes to judge it; ``str`` gives a line a replica.

    Attributes:
        log_z: ``(*replicas,)`` float64.
        standard_error: Of log Z, by the delta method: standard error of the mean weight over the mean weight. It
            knows the weights that were drawn: with few effective samples it is too small.
        effective_sample_size: (sum w)^2 / sum w^2, 1 to n_chains.
        log_weights: Log importance weight of each chain, without log Z of the base, ``(*replicas, n_chains)``.
    """

    log_z: Tensor
    standard_error: Tensor
    effective_sample_size: Tensor
    log_weights: Tensor

    def __str__(self) -> str:
        n_chains = self.log_weights.shape[-1]
        columns = (column.reshape(-1).tolist() for column in self[:3])
        return "\n".join(
            f"log Z = {log_z:.4f} +- {error:.2g} ({size:.1f} effective of {n_chains} chains)"
            for log_z, error, size in zip(*columns, strict=True)
        )


@dataclass(frozen=True, kw_only=True, slots=True)
class _Annealing:
    """Settings of both directions."""

    n_betas: int = 1000
    betas: Schedule | None = None
    k: int = 1

    def __post_init__(self) -> None:
        require_count("n_betas", self.n_betas)
        require_count("k", self.k)
        if self.betas is None:
            return
        betas = tuple(float(beta) for beta in self.betas)
        rises = betas[:1] == (0.0,) and betas[-1] == 1.0 and all(low < high for low, high in pairwise(betas))
        require(rises, "betas", self.betas, "numbers that increase from 0 to 1, both among them")
        object.__setattr__(self, "betas", betas)

    def _schedule(self) -> list[float]:
        if self.betas is None:
            return [step / self.n_betas for step in range(self.n_betas + 1)]
        return [float(beta) for beta in self.betas]


@dataclass(frozen=True, kw_only=True, slots=True)
class Ais(_Annealing):
    r"""Estimates log Z of models too large to be enumerated; the estimate is too low on average.

    Annealed importance sampling from an RBM without couplings (Neal 2001; Salakhutdinov & Murray 2008):

    .. math:: p_\beta(v) \propto \mu(v) exp((1 - \beta) b_0.v + \beta b.v + \sum_i A(\beta (W v + c)_i))

    with the measure and the cumulant A of the units, log(1 + exp(f)) for those in {0, 1}. Real units keep their
    precision along the way. A Boltzmann machine of two classes of units is such an RBM; of any other one the path
    is that of :class:`~memcomp_lightning.likelihood.machine_ais.MachinePath`.

    A chain starts at an independent draw at beta = 0 and makes k Gibbs sweeps at each beta in between. The mean
    weight is Z / Z_0 without bias; log Z is therefore too low on average, and log p(v) too high.

    How many steps suffice is seen in the effective sample size: raise ``n_betas`` until it is a third of the
    chains and log Z has stopped rising; below, the standard error is too small. For a 784x20 RBM after four epochs
    of PCD-1 on binary MNIST, with ``base_of`` the images and 100 chains: 300, 1,000, 10,000 steps are 0.39, 0.08,
    0.05 nats off with 25, 47, 87 effective chains; from a base of zeros it takes ten times as many. For 784x500,
    trained alike, 60,000 do not suffice: 7 effective chains, log Z 421, 425, 427 after 1,000, 10,000, 60,000.
    Semi-restricted machines of 112x100 and 500x100 units take 1.5 and 8 s for 1,000 steps of 100 chains.

    Weights are summed in float64. In a float32 model each step's gain is computed as log1p of a small number, not
    as a difference of softplus sums: 3,000 steps of 784x500 are off by at most 3e-6 nats a chain instead of 3e-3.

    Attributes:
        n_chains: Chains a replica, >= 2.
        n_betas: Steps of the linear schedule, >= 1.
        betas: The schedule itself, increasing from 0 to 1, in place of ``n_betas``; None is linear.
        k: Gibbs sweeps at each beta, >= 1.
    """

    n_chains: int = 100

    def __post_init__(self) -> None:
        require_count("n_chains", self.n_chains, 2)
        _Annealing.__post_init__(self)

    def estimate(
        self, model: EnergyModel, *, generator: Generator, base: Tensor | None = None, progress: bool = False
    ) -> AisEstimate:
        """Estimate log Z.

        Args:
            model: An RBM or a Boltzmann machine of any connectivity, on any device.
            generator: Random stream.
            base: Visible bias b_0 at beta = 0, ``(n_visible,)`` or ``(*replicas, n_visible)``, see
                :func:`base_of`; None is zeros.
            progress: Show a bar.

        Raises:
            SettingError: base has the wrong shape.
        """
        base, two_layers = _base(model, base), model.two_layers()
        if two_layers is None:
            path = MachinePath(model, base)
            x = path.start(self.n_chains, generator=generator)
            log_w = path.anneal(x, self._schedule(), self.k, generator=generator, progress=progress)
            return _summary(path.log_z_of_base(), log_w, 1)
        rbm, base = two_layers.rbm, base_on_first_class(model, base)
        start = base.unsqueeze(-2).expand(*rbm.replicas, self.n_chains, rbm.n_visible)
        v = rbm.visible.sample(start, generator=generator)
        log_w = _anneal(rbm, v, base, self._schedule(), self.k, generator, progress)
        return _summary(_log_z_of_base(rbm, base), log_w, 1)


@dataclass(frozen=True, kw_only=True, slots=True)
class ReverseAis(_Annealing):
    r"""Estimates log Z from above, to see how far :class:`Ais` is off: the same path, from samples of the model.

    The mean weight is Z_0 / Z without bias; log Z is therefore too high on average. With ``Ais`` it brackets log Z
    (Burda et al. 2015; Grosse et al. 2015) - but only if the samples are the model's own: exact ones
    (``exact_samples``), where the smaller layer can be enumerated. From Markov chains, which never mix to the end,
    the estimate is no bound any more. ``n_betas``, ``betas`` and ``k`` are as those of ``Ais``.
    """

    def estimate(
        self,
        model: EnergyModel,
        v: Visible,
        *,
        generator: Generator,
        base: Tensor | None = None,
        progress: bool = False,
    ) -> AisEstimate:
        """Estimate log Z; ``log_weights`` are those of Z_0 / Z.

        Args:
            model: As that of ``Ais.estimate``.
            v: Samples of the model, two or more a replica; each starts a chain. Of an RBM the visible units, of a
                machine all units, visible ones first: states of ``model.chains()``.
            generator: Random stream.
            base: As that of ``Ais.estimate``.
            progress: Show a bar.

        Raises:
            SettingError: v or base has the wrong shape.
        """
        two_layers = model.two_layers()
        is_rbm = two_layers is not None and two_layers.units is None
        width = model.n_visible if is_rbm else model.n_units
        fits = v.ndim >= 2 and v.shape[:-2] == model.replicas and v.shape[-1] == width
        allowed = f"{(*model.replicas, 'n', width)} with n >= 2"
        require(fits and v.shape[-2] >= 2, "shape of v", tuple(v.shape), allowed)
        base, v, betas = _base(model, base), v.to(model.b), self._schedule()[::-1]
        if two_layers is None:
            path = MachinePath(model, base)
            log_w = path.anneal(v, betas, self.k, generator=generator, progress=progress)
            return _summary(path.log_z_of_base(), log_w, -1)
        rbm, base = two_layers.rbm, base_on_first_class(model, base)
        log_w = _anneal(rbm, two_layers.first(v), base, betas, self.k, generator, progress)
        return _summary(_log_z_of_base(rbm, base), log_w, -1)


def annealing_products(model: EnergyModel, n_chains: int, n_betas: int) -> float:
    """Products of a unit and a weight in all chains and steps of AIS, about 10^10 a second and CPU thread.

    Machines of many classes take most of their time for the classes one by one, which counts as products.
    """
    n_steps, n_replicas = n_chains * n_betas, math.prod(model.replicas)
    pairs = model.quadratic_form().pairs
    if pairs is None or len(model.classes) == 2:
        return n_steps * model.n_visible * model.n_hidden * n_replicas
    return 3 * n_steps * len(pairs) * n_replicas + STEP * n_betas * len(model.classes)


@torch.no_grad()
def _anneal(
    model: RBM, v: Tensor, base: Tensor, betas: Sequence[float], k: int, generator: Generator, progress: bool
) -> Tensor:
    """Log weights of chains that start at v, in equilibrium at the first beta, ``(*replicas, n_chains)``."""
    log_w = torch.zeros(v.shape[:-1], dtype=torch.float64, device=v.device)
    bias_gain = (model.b - base).unsqueeze(-1)
    base = base.unsqueeze(-2)
    with quick_products(v.shape[-2] * model.n_visible * model.n_hidden):
        field = model.hidden_field(v)
        for beta, target in tqdm(list(pairwise(betas)), desc="annealing", disable=not progress):
            log_w += (target - beta) * (v @ bias_gain).squeeze(-1).double()
            log_w += model.hidden.cumulant_gain(field, beta, target)
            if target != betas[-1]:
                for _ in range(k):
                    h = model.hidden.sample(field.mul_(target), generator=generator)
                    towards = model.visible_field(h).mul_(target).add_(base, alpha=1 - target)
                    v = model.visible.sample(towards, generator=generator)
                    field = model.hidden_field(v)
    return log_w


def _summary(log_z_of_base: Tensor, log_w: Tensor, sign: int) -> AisEstimate:
    """Estimate from weights whose mean is (Z / Z_0)^sign."""
    n = log_w.shape[-1]
    w = torch.exp(log_w - log_w.amax(-1, keepdim=True))
    log_mean = w.mean(-1).log() + log_w.amax(-1)
    error = w.std(-1) / (w.mean(-1) * n**0.5)
    return AisEstimate(log_z_of_base + sign * log_mean, error, w.sum(-1).square() / w.square().sum(-1), log_w)


@torch.no_grad()
def _log_z_of_base(model: RBM, base: Tensor) -> Tensor:
    """Log of Z_0 = prod_i exp(A(0)) prod_j exp(A(b_0j)), ``(*replicas,)`` float64."""
    free = model.c.new_zeros(*model.replicas, 1, model.n_hidden, dtype=torch.float64)
    of_hidden = model.hidden.cumulant(free).sum(-1)
    return (of_hidden + model.visible.cumulant(base.double().unsqueeze(-2)).sum(-1)).squeeze(-1)


def _base(model: EnergyModel, base: Tensor | None) -> Tensor:
    """The base's bias for each replica."""
    shape = model.b.shape
    if base is None:
        return torch.zeros_like(model.b, requires_grad=False)
    fits = base.shape in (shape, shape[-1:])
    require(fits, "shape of base", tuple(base.shape), f"{tuple(shape[-1:])} or {tuple(shape)}")
    return base.detach().to(model.b).expand(shape)
