"""The reads of an annealer as the negative phase."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, ClassVar, Literal, NamedTuple

import torch
from jaxtyping import Float
from torch import Generator, Tensor

from memcomp_lightning.errors import require
from memcomp_lightning.models.base import EnergyModel
from memcomp_lightning.models.bit_form import read_bits
from memcomp_lightning.problems import Qubo
from memcomp_lightning.problems.from_model import from_bit_form
from memcomp_lightning.solvers.dimod import check_parameters, problem_at, reads_of, sample_set
from memcomp_lightning.types import Configurations, NegativePhase

SMALLEST_BETA = 0.01
"""Lower bound of an estimated beta: an annealer is given E / beta, which must stay finite."""

MAX_NEWTON_STEPS = 60
"""Most Newton steps of an estimate, which takes about six."""


class AnnealerState(NamedTuple):
    """Inverse temperature at which the annealer samples what it is given, ``(*replicas,)``."""

    beta: Tensor


@dataclass(frozen=True, kw_only=True, eq=False)
class AnnealerSamples:
    r"""Takes the states that a ``dimod.Sampler`` returns (its reads) as the negative phase.

    An annealer that is given energies H returns states with about ``exp(-beta H)``; to sample ``exp(-E)`` it is
    given ``E / beta`` (Adachi & Henderson 2015; Benedetti et al. 2016). ``beta`` is a number that is known, or
    "estimate": then it begins with 1 and follows, from update to update, the value under which the reads are
    likeliest, :func:`maximum_pseudo_likelihood_beta`.

    Attributes:
        sampler: The sampler.
        parameters: Keyword arguments of its ``sample``; the number of reads is among them (``num_reads``).
        beta: Inverse temperature, > 0, or "estimate".
        rate: Weight of the newest estimate, in (0, 1].
    """

    uses_data: ClassVar[bool] = False
    shared: ClassVar[bool] = True

    sampler: Any
    parameters: Mapping[str, Any] = field(default_factory=dict)
    beta: float | Literal["estimate"] = 1.0
    rate: float = 0.2

    def __post_init__(self) -> None:
        check_parameters(self.sampler, self.parameters)
        fits = self.beta == "estimate" or (not isinstance(self.beta, str) and self.beta > 0)
        require(fits, "beta", self.beta, "a number > 0, or 'estimate'")
        require(0 < self.rate <= 1, "rate", self.rate, "a number in (0, 1]")

    def init(self, model: EnergyModel, n_chains: int, *, generator: Generator) -> AnnealerState:
        """Begin with the given inverse temperature, or 1.

        Raises:
            SettingError: Categorical or real units, which an annealer does not sample.
        """
        allowed = "units of two values, {0, 1} or spins, for an annealer"
        for name, units in (("visible", model.visible), ("hidden", model.hidden)):
            two_valued = not units.real and not units.bits().groups
            require(two_valued, f"{name} units", type(units).__name__, allowed)
        beta = 1.0 if self.beta == "estimate" else float(self.beta)
        return AnnealerState(torch.full(model.replicas, beta, dtype=model.b.dtype, device=model.b.device))

    @torch.no_grad()
    def sample(
        self, model: EnergyModel, state: AnnealerState, positive: Configurations, *, generator: Generator
    ) -> NegativePhase[AnnealerState]:
        """Return one configuration a read."""
        form = model.in_bits()
        qubo = from_bit_form(form)
        scale = (1 / state.beta).reshape(*state.beta.shape, *[1] * len(qubo.graph.edge_shape))
        given = Qubo(qubo.graph, qubo.coupling * scale, qubo.linear / state.beta.unsqueeze(-1), qubo.offset)
        problems = [problem_at(given, index) for index in range(max(1, given.offset.numel()))]
        answers = [sample_set(self.sampler, one, self.parameters, generator) for one in problems]
        reads = [reads_of(answer, one) for answer, one in zip(answers, problems, strict=True)]
        n_reads = min(len(x) for x in reads)
        x = torch.stack([x[:n_reads] for x in reads]).view(*model.replicas, n_reads, qubo.n)
        beta = state.beta.clone()
        if self.beta == "estimate":
            found = maximum_pseudo_likelihood_beta(given.field(x), x)
            beta = beta.lerp(found.to(beta), self.rate).clamp(min=SMALLEST_BETA)
        info = {"beta_effective": beta.clone()}
        if all("chain_break_fraction" in answer.record.dtype.names for answer in answers):
            broken = [float(answer.record.chain_break_fraction.mean()) for answer in answers]
            info["chain_break_fraction"] = torch.tensor(broken).to(beta).view(model.replicas)
        return NegativePhase(read_bits(model, form, x), AnnealerState(beta), info)


def maximum_pseudo_likelihood_beta(
    field: Float[Tensor, "*problems n_states n"],
    x: Float[Tensor, "*problems n_states n"],
    *,
    largest: float = 100.0,
) -> Float[Tensor, "*problems"]:
    r"""The inverse temperature under which states are likeliest, unit by unit given the others.

    .. math:: \beta^* = \arg\max_\beta \sum_{k, i} \log \sigma(-\beta (2 x_{ki} - 1) f_{ki})

    (Besag 1975), a concave function of one number, found by Newton's method, with bisection where
    its steps leave the bracket or do not halve.

    ``x`` are states in {0, 1}; ``field`` is f, the energy of x_i = 1 less that of x_i = 0 given the other units.
    The value is between 0 and ``largest``, which states get that are all local minima.

    >>> field, x = torch.tensor([[1.0], [1.0], [1.0], [1.0]]), torch.tensor([[0.0], [0.0], [0.0], [1.0]])
    >>> round(float(maximum_pseudo_likelihood_beta(field, x)), 4)  # log 3
    1.0986
    """
    gain = (-(2 * x - 1) * field).double()
    low = torch.zeros(gain.shape[:-2], dtype=torch.float64, device=gain.device)
    high = torch.full_like(low, largest)
    at_low, at_high = (_slope_and_curvature(gain, end)[0] for end in (low, high))
    settled = (at_low <= 0) | (at_high >= 0)
    ends = torch.where(at_low <= 0, low, high)
    beta, step = torch.ones_like(low).clamp(max=largest), high
    for _ in range(MAX_NEWTON_STEPS):
        slope, curvature = _slope_and_curvature(gain, beta)
        low, high = torch.where(slope > 0, beta, low), torch.where(slope > 0, high, beta)
        newton = beta + slope / curvature
        trusted = (low <= newton) & (newton <= high) & ((newton - beta).abs() <= step / 2)
        newer = torch.where(trusted, newton, (low + high) / 2)
        step, beta = (newer - beta).abs(), newer
        if bool((settled | (step <= 1e-10 * largest)).all()):
            break
    return torch.where(settled, ends, beta)


def _slope_and_curvature(gain: Tensor, beta: Tensor) -> tuple[Tensor, Tensor]:
    """Of the log pseudo-likelihood: its derivative, and less its second one."""
    doubt = torch.sigmoid(-beta[..., None, None] * gain)
    slope = gain * doubt
    return slope.sum((-2, -1)), (slope * gain * (1 - doubt)).sum((-2, -1))
