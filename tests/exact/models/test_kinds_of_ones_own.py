"""Kinds of units that are not ours: with settings, with a measure, with values beyond one."""

import pytest
import torch

from memcomp_lightning import rng
from memcomp_lightning.likelihood import log_likelihood, log_partition_function, log_pseudo_likelihood
from memcomp_lightning.models import RBM, BoltzmannMachine, Normal
from memcomp_lightning.models.units import Bernoulli, Bits, Gaussian, Mixed, Spin, Units, all_states


class Count(Units):
    """How many of ``most`` bits of one field are 1: the measure is the number of ways."""

    linear = False

    def __init__(self, n, *, most):
        super().__init__(n)
        self.most = most
        self.register_buffer("scale", torch.ones(n))

    def mean(self, field):
        return self.most * field.sigmoid()

    def sample(self, field, *, generator):
        u = rng.uniform((*field.shape, self.most), generator=generator, like=field)
        return (u < field.sigmoid().unsqueeze(-1)).sum(-1).to(field.dtype)

    def mode(self, field):
        values = torch.arange(self.most + 1).to(field)
        return values[(field.unsqueeze(-1) * values - self._minus_log_ways(values)).argmax(-1)]

    def cumulant(self, field):
        return self.most * torch.nn.functional.softplus(field)

    def site_energies(self, x):
        return self._minus_log_ways(x)

    def bias_of(self, total, n):
        share = (total + 1) / (self.most * n + 2)
        return share.logit()

    @property
    def n_states(self):
        return (self.most + 1) ** self.n

    def states(self, numbers, *, like):
        place = (self.most + 1) ** torch.arange(self.n - 1, -1, -1)
        return (numbers.unsqueeze(-1) // place % (self.most + 1)).to(like)

    def _minus_log_ways(self, x):
        of = torch.lgamma
        return of(x + 1) + of(self.most - x + 1) - of(torch.full_like(x, self.most + 1))


class Wide(Spin):
    """Spins of size three."""

    def mean(self, field):
        return 3 * super().mean(3 * field)

    def sample(self, field, *, generator):
        return 3 * super().sample(3 * field, generator=generator)

    def cumulant(self, field):
        return super().cumulant(3 * field)

    def states(self, numbers, *, like):
        return 3 * super().states(numbers, like=like)

    def bits(self):
        form = super().bits()
        return Bits(form.at, 3 * form.low, 3 * form.width)


def machine(visible, **settings):
    generator = rng.stream(0, "test model")
    made = BoltzmannMachine(visible=visible, hidden=Bernoulli(0), weight_init=Normal(std=0.5), **settings).double()
    with torch.no_grad():
        made.b.normal_(0.0, 1.0, generator=generator)
    return made


def test_selected_units_keep_their_settings():
    """A part of one kind, whose size is an argument of its own as well as a number of entries."""
    units = Count(4, most=5)
    units.scale.copy_(torch.arange(4.0))
    part = units.select(torch.tensor([1, 3]))
    assert (part.n, part.n_sites, part.most, part.scale.tolist()) == (2, 2, 5, [1.0, 3.0])
    assert units.n == 4
    real = Gaussian(3, variance=torch.tensor([1.0, 2.0, 4.0])).for_replicas((2,)).select(torch.tensor([0, 2]))
    assert real.precision.tolist() == [[1.0, 0.25], [1.0, 0.25]]
    assert not real.precision.requires_grad


@pytest.mark.parametrize("visible", [Count(3, most=2), Mixed(Spin(1), Count(2, most=3))], ids=["alone", "mixed"])
def test_pseudo_likelihood_has_the_measure_of_visible_units_alone(visible):
    model = machine(visible)
    v = all_states(model.visible, model.b)
    found = log_pseudo_likelihood(model, v)
    log_p = log_likelihood(model, v, log_partition_function(model))
    for site in range(3):
        others = torch.ones(3, dtype=torch.bool)
        others[site] = False
        alike = (v[:, None, others] == v[None, :, others]).all(-1)
        expected = log_p - torch.where(alike, log_p, -torch.inf).logsumexp(-1)
        torch.testing.assert_close(found[:, site], expected)


def test_pseudo_likelihood_of_real_units_reaches_as_far_as_the_values_of_the_others():
    generator = rng.stream(0, "test model")
    model = RBM(visible=Gaussian(2), hidden=Wide(3), weight_init=Normal(std=3.0), generator=generator).double()
    v = model.draw_visible(all_states(model.hidden, model.b), generator=generator)
    found = log_pseudo_likelihood(model, v)
    nodes = torch.linspace(-60.0, 60.0, 5001, dtype=torch.float64)
    for entry in range(2):
        moved = v.unsqueeze(-2).repeat(1, len(nodes), 1)
        moved[..., entry] = nodes
        total = (-model.free_energy(moved.flatten(0, 1))).view(len(v), -1).logsumexp(-1) + (
            nodes[1] - nodes[0]
        ).log()
        torch.testing.assert_close(found[:, entry], -model.free_energy(v) - total)
