"""How likely observed values are, where many hidden units and many missing values leave no sum to be taken."""

from dataclasses import dataclass
from itertools import pairwise
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Generator, Tensor

from memcomp_lightning.errors import require_count
from memcomp_lightning.likelihood.layers import NUMBERS
from memcomp_lightning.models.mean_field import mean_field
from memcomp_lightning.models.rbm import RBM


class ObservedEstimate(NamedTuple):
    """Log of the sum of exp(-E) over the hidden units and the missing values of each row.

    Attributes:
        log_weight: ``(n,)`` float64; less log Z it is log p(observed).
        standard_error: 0 where it is exact.
    """

    log_weight: Tensor
    standard_error: Tensor


@dataclass(frozen=True, kw_only=True, slots=True)
class ObservedAis:
    r"""Annealed importance sampling of what is missing, for each row by itself, in an RBM.

    .. math:: f_\beta(m) = \mu(m) \exp(((1 - \beta) g + \beta b) \cdot m + \sum_i A(\beta (W v + c)_i))

    over the missing values m of the row v, from independent ones at beta = 0. Their fields g are those in the mean
    field given what is observed, which is close to the end; few steps suffice. The estimate is too low on average.

    Attributes:
        n_chains: Of each row, >= 2.
        n_betas: Steps, >= 1.
    """

    n_chains: int = 32
    n_betas: int = 100

    def __post_init__(self) -> None:
        require_count("n_chains", self.n_chains, 2)
        require_count("n_betas", self.n_betas)

    @torch.no_grad()
    def estimate(
        self,
        rbm: RBM,
        v: Float[Tensor, "n n_visible"],
        observed: Bool[Tensor, "n n_visible"],
        *,
        generator: Generator,
    ) -> ObservedEstimate:
        """Estimate the sum of each row.

        Args:
            rbm: Without replica axes.
            v: Values of the visible units; where they are missing they are not read.
            observed: Where they are known.
            generator: Random stream.
        """
        rows = max(1, NUMBERS // (self.n_chains * 3 * rbm.n_units))
        parts = [
            self._of(rbm, *some, generator)
            for some in zip(v.to(rbm.b).split(rows), observed.split(rows), strict=True)
        ]
        return ObservedEstimate(*(torch.cat(column) for column in zip(*parts, strict=True)))

    def _of(self, rbm: RBM, v: Tensor, observed: Tensor, generator: Generator) -> ObservedEstimate:
        units, n, known = rbm.visible, self.n_chains, torch.where(observed, v, 0.0)
        base = rbm.visible_field(mean_field(rbm, v, observed=observed).h)
        absent = units.site_sums(observed.to(v.dtype)) == 0
        start = (units.cumulant(base.double()) * absent).sum(-1)
        start = start + rbm.hidden.cumulant(base.new_zeros(1, rbm.n_hidden, dtype=torch.float64)).sum(-1)
        seen = (known @ rbm.b).double() - units.energy(known).double()

        def wide(x: Tensor) -> Tensor:
            return x.repeat_interleave(n, dim=0)

        fixed, values, fields = wide(observed), wide(known), wide(base)
        x = torch.where(fixed, values, units.sample(fields, generator=generator))
        gain, log_w = (
            torch.where(fixed, 0.0, rbm.b - fields),
            torch.zeros(len(x), dtype=torch.float64, device=x.device),
        )
        field = rbm.hidden_field(x)
        betas = [step / self.n_betas for step in range(self.n_betas + 1)]
        for beta, target in pairwise(betas):
            log_w += (target - beta) * (x * gain).sum(-1).double()
            log_w += rbm.hidden.cumulant_gain(field, beta, target)
            if target < 1:
                h = rbm.hidden.sample(field * target, generator=generator)
                towards = target * rbm.visible_field(h) + (1 - target) * fields
                x = torch.where(fixed, values, units.sample(towards, generator=generator))
                field = rbm.hidden_field(x)
        log_w = log_w.view(-1, n)
        top = log_w.amax(-1, keepdim=True)
        w = (log_w - top).exp()
        mean = w.mean(-1)
        return ObservedEstimate(start + seen + top.squeeze(-1) + mean.log(), w.std(-1) / (mean * n**0.5))
