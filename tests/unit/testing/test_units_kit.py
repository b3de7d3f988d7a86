"""Every kind of units passes the published kit; broken ones do not."""

import math

import pytest
import torch

from memcomp_lightning import rng
from memcomp_lightning.errors import SettingError
from memcomp_lightning.likelihood import log_partition_function
from memcomp_lightning.models import RBM
from memcomp_lightning.models.units import Bernoulli, Bits, Categorical, Gaussian, Mixed, ReLU, Spin, Units
from memcomp_lightning.testing import check_units, small_layers

LAYERS = small_layers() | {
    "one bit": Bernoulli(1),
    "one category of one state": Categorical([1]),
    "ReLU": ReLU(3),
    "parts within parts": Mixed(Mixed(Spin(1), Gaussian(1)), Bernoulli(2)),
    "real beside ReLU": Mixed(Gaussian(1), ReLU(1)),
}


@pytest.mark.parametrize("units", LAYERS.values(), ids=LAYERS)
def test_units_keep_the_contract(units):
    check_units(units)


class Three(Units):
    """A kind of one's own: -1, 0 or 1, with the measure 1, and neither bits nor an entropy."""

    def mean(self, field):
        return torch.softmax(self._weights(field), -1) @ self._values(field)

    def sample(self, field, *, generator):
        below = torch.softmax(self._weights(field), -1).cumsum(-1)
        u = rng.uniform(field.shape, generator=generator, like=field).unsqueeze(-1)
        return (below[..., :2] <= u).sum(-1).to(field.dtype) - 1

    def mode(self, field):
        return field.sign()

    def cumulant(self, field):
        return self._weights(field).logsumexp(-1)

    def check(self, v, observed=None, *, pure=False, column=0):
        right = (v.abs() <= 1) & (~torch.tensor(pure) | (v == v.round()))
        wrong = (~right if observed is None else ~right & observed).nonzero().tolist()
        if wrong:
            raise SettingError(f"v in column {column + wrong[0][-1]}, row {wrong[0][0]}")

    def bias_of(self, total, n):
        mean = (total / n).clamp(-0.999999, 0.999999)
        root = (mean + (4 - 3 * mean**2).sqrt()) / (2 * (1 - mean))
        return root.log()

    def states(self, numbers, *, like):
        digits = [numbers // 3**place % 3 - 1 for place in reversed(range(self.n))]
        return torch.stack([*digits, numbers][: self.n], -1).to(like.dtype) if self.n else like.new_zeros(1, 0)

    @property
    def n_states(self):
        return 3**self.n

    @staticmethod
    def _values(field):
        return torch.tensor([-1.0, 0.0, 1.0]).to(field)

    def _weights(self, field):
        return field.unsqueeze(-1) * self._values(field)


def test_a_kind_of_ones_own_keeps_the_contract_and_is_a_layer():
    check_units(Three(3))
    check_units(Mixed(Three(2), Gaussian(1)))
    rbm = RBM(visible=Three(4), hidden=Spin(2))
    with torch.no_grad():
        rbm.weight.zero_()
    # 3^4 2^2 states of energy zero, though the kind has no bits.
    torch.testing.assert_close(
        log_partition_function(rbm), torch.tensor(4 * math.log(3) + 2 * math.log(2)).double()
    )


# --- broken kinds -----------------------------------------------------------------------------------------


def broken(kind, **methods):
    """A subclass with other methods, which are given the right answer first."""

    def wrap(name, change):
        def method(self, *arguments, **settings):
            return change(getattr(kind, name)(self, *arguments, **settings), self, *arguments)

        return method

    return type(kind.__name__, (kind,), {name: wrap(name, change) for name, change in methods.items()})


def alone(kind, **members):
    return type(kind.__name__, (kind,), members)


def from_the_global_stream(right, units, field):
    torch.empty(3).normal_()
    return right


def rounded_bits(right, units):
    return right._replace(width=2 * right.width)


def tempered(self, field, *, generator):
    return Spin.sample(self, 1.1 * field, generator=generator)


@torch.no_grad()
def less_spread(self, field, *, generator):
    return 0.9 * (Gaussian.sample(self, field, generator=generator) - self.mean(field)) + self.mean(field)


def forgets_its_parameters(self, entries):
    return Gaussian(len(entries), learned=False)


def shares_its_parameters(self, entries):
    part = Gaussian(len(entries))
    part.precision = torch.nn.Parameter(self.precision.detach()[entries])
    return part


def wrong_for_replicas(self, field):
    return field / self.precision.unsqueeze(-2)


def takes_all(self, v, observed=None, *, pure=False, column=0):
    pass


def no_column(self, v, observed=None, *, pure=False, column=0):
    Bernoulli.check(self, v, observed, pure=pure)


def overflows(self, field):
    return torch.log(2 * torch.cosh(field))


def cancels(self, field, beta, target):
    of_target, of_beta = (self.cumulant(size * field + 3e4).sum(-1) for size in (target, beta))
    return (of_target - of_beta).double()


def lets_it_move(self, field, *, generator):
    with torch.no_grad():
        self.precision.mul_(1.1)
    return Gaussian.sample(self, field, generator=generator)


def with_gradient(self, field, *, generator):
    with torch.enable_grad():
        return self.mean(field) + 0 * self.precision


MUTANTS = {
    "mean of the other sign": (broken(Spin, mean=lambda x, *_: -x), Spin(3), "derivative of the cumulant"),
    "field counted twice": (
        alone(
            Spin, mean=lambda s, f: torch.tanh(2 * f), cumulant=lambda s, f: torch.log(2 * torch.cosh(2 * f)) / 2
        ),
        Spin(3),
        "log of the sum",
    ),
    "constant left out": (
        broken(Gaussian, cumulant=lambda x, *_: x - 0.5 * math.log(2 * math.pi)),
        Gaussian(3),
        "log of the integral",
    ),
    "measure left out": (broken(ReLU, energy=lambda x, *_: 0 * x), ReLU(2), "log of the integral"),
    "least likely state": (broken(Bernoulli, mode=lambda x, *_: 1 - x), Bernoulli(3), "not the likeliest state"),
    "mode of real units": (broken(ReLU, mode=lambda x, *_: x + 0.1), ReLU(3), "not the likeliest value"),
    "samples too cold": (alone(Spin, sample=tempered), Spin(3), "sample has not the distribution"),
    "samples of too little spread": (alone(Gaussian, sample=less_spread), Gaussian(2), "sample has not the dist"),
    "samples that are no states": (broken(Spin, sample=lambda x, *_: 0.5 * x), Spin(2), "draws values that check"),
    "sample_of_mean of other units": (
        broken(Spin, sample_of_mean=lambda x, *_: -x),
        Spin(2),
        "sample_of_mean has not the distribution",
    ),
    "global stream": (broken(Spin, sample=from_the_global_stream), Spin(2), "global random stream"),
    "changes itself": (alone(Gaussian, sample=lets_it_move), Gaussian(2), "other sample|changed its parameters"),
    "gradient": (alone(Gaussian, sample=with_gradient), Gaussian(2), "carries a gradient"),
    "points without spread": (
        alone(Gaussian, points=Units.points),
        Gaussian(2),
        "do not have the expected energy",
    ),
    "points beside the mean": (broken(Spin, points=lambda x, *_: [0.9 * x[0]]), Spin(2), "do not have the mean"),
    "entropy of the other sign": (broken(Spin, negative_entropy=lambda x, *_: -x), Spin(2), "negative_entropy"),
    "two numbers of one state": (
        broken(Bernoulli, states=lambda x, *_: x * (torch.arange(x.shape[-1]) > 0)),
        Bernoulli(3),
        "no state|likeliest|log of the sum|two numbers",
    ),
    "bits of another width": (broken(Bernoulli, bits=rounded_bits), Bernoulli(2), "bits that its groups allow"),
    "bits without groups": (
        broken(Categorical, bits=lambda x, *_: x._replace(groups=())),
        Categorical(2, q=3),
        "bits that its groups allow",
    ),
    "bits of missing low values": (
        broken(Spin, bits=lambda x, *_: Bits(x.at, 0 * x.low, x.width)),
        Spin(2),
        "bits that its groups allow",
    ),
    "sites in another order": (broken(Spin, site_of=lambda x, *_: x.flip(0)), Spin(3), "another site|site_of"),
    "sums of other sites": (
        broken(Categorical, site_sums=lambda x, *_: x.flip(-1)),
        Categorical([2, 3]),
        "site_sums and site_of",
    ),
    "over other sites": (
        broken(Categorical, over_sites=lambda x, *_: x.flip(-1)),
        Categorical([2, 3]),
        "over_sites and site_of",
    ),
    "not linear after all": (broken(Spin, energy=lambda x, *_: x + 1), Spin(2), "log of the sum"),
    "another total energy": (broken(Gaussian, total_energy=lambda x, *_: 2 * x), Gaussian(2), "total_energy"),
    "another curvature": (
        alone(Gaussian, curvature=property(lambda self: 2 * self.precision)),
        Gaussian(2),
        "half of curvature",
    ),
    "parts without parameters": (
        alone(Gaussian, select=forgets_its_parameters),
        Gaussian(3, variance=2.0),
        "the part of sites .* other",
    ),
    "parts that are trained apart": (
        alone(Gaussian, select=shares_its_parameters),
        Gaussian(3),
        "training would change",
    ),
    "layers in another order": (
        broken(Categorical, beside=lambda x, s, other: Categorical([*other.sizes[::-1], *s.sizes[::-1]])),
        Categorical([2, 4]),
        "side by side",
    ),
    "half of the bias": (broken(Spin, bias_of=lambda x, *_: 0.5 * x), Spin(2), "means of the data"),
    "start without variances": (alone(Gaussian, start=lambda *_, **__: None), Gaussian(2), "take the variances"),
    "project that moves": (
        alone(Gaussian, project=lambda self: self.precision.mul_(0.5)),
        Gaussian(2),
        "project changes",
    ),
    "axes beside the replicas": (alone(Gaussian, mean=wrong_for_replicas), Gaussian(3), "of replicas|size of"),
    "takes everything": (alone(Bernoulli, check=takes_all), Bernoulli(2), "takes nan"),
    "column of the part": (alone(Bernoulli, check=no_column), Bernoulli(2), "does not name column"),
    "overflow": (alone(Spin, cumulant=overflows), Spin(2), "not finite"),
    "difference of large numbers": (alone(Bernoulli, cumulant_gain=cancels), Bernoulli(3), "cumulant_gain"),
    "another dtype": (broken(Spin, mean=lambda x, *_: x.double()), Spin(2), "mean of torch.float32"),
}


@pytest.mark.parametrize(("kind", "like", "message"), MUTANTS.values(), ids=MUTANTS)
def test_a_mutant_is_seen(kind, like, message, allow_global_rng):
    mutant = like
    mutant.__class__ = kind
    with pytest.raises((AssertionError, RuntimeError), match=message):
        check_units(mutant)


def test_layers_of_many_states_are_refused():
    with pytest.raises(AssertionError, match="Categorical has 160000 states: give a smaller layer"):
        check_units(Categorical(4, q=20))
