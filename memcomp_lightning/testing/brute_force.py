"""What a model says, by sums over all its states and integrals by quadrature, from its parameters alone.

Slow and obvious: nothing here asks a model for an energy, a mean or a cumulant. Everything follows from one
function, :func:`log_sum`. Its derivatives by parameters are gradients of likelihoods; by biases they are means.
So it is independent of the models' code, but knows the values of the package's own kinds of units alone. A kind of
one's own is served by :mod:`~memcomp_lightning.testing.enumerated`, which asks the model for its energies.
"""

import itertools
import math
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from memcomp_lightning.models import RBM, BoltzmannMachine
from memcomp_lightning.models.units import Bernoulli, Categorical, Gaussian, Mixed, ReLU, Spin, Units

N_PANELS, N_NODES, REACH = 60, 16, 12.0
"""Panels of the rule of Gauss and Legendre, nodes of each, and standard deviations beyond the means."""


class Site(NamedTuple):
    """A site of a layer.

    Attributes:
        entries: Their numbers in the model.
        values: What they may be, a row a state; None of real units.
        precision: Of real units.
        low: Where real values begin.
    """

    entries: list[int]
    values: Tensor | None
    precision: Tensor | None = None
    low: float = -math.inf


def sites_of(units: Units, begin: int = 0) -> list[Site]:
    """The sites of a layer whose first entry has this number."""
    if isinstance(units, Mixed):
        found = []
        for kind in units.kinds:
            found += sites_of(kind, begin)
            begin += kind.n
        return found
    if isinstance(units, Categorical):
        found = []
        for size in units.sizes:
            entries = list(range(begin, begin + size))
            found.append(Site(entries, torch.tensor([[float(a == b) for b in range(size)] for a in range(size)])))
            begin += size
        return found
    places = range(begin, begin + units.n)
    if isinstance(units, Gaussian):
        return [Site([at], None, units.precision[at - begin]) for at in places]
    if isinstance(units, ReLU):
        return [Site([at], None, torch.ones(()), 0.0) for at in places]
    values = {Bernoulli: [[0.0], [1.0]], Spin: [[-1.0], [1.0]]}[type(units)]
    return [Site([at], torch.tensor(values)) for at in places]


def all_sites(model: RBM | BoltzmannMachine) -> list[Site]:
    """The sites of a model, those of the visible layer first."""
    return sites_of(model.visible) + sites_of(model.hidden, model.n_visible)


def couplings(model: RBM | BoltzmannMachine) -> Tensor:
    """The symmetric matrix of couplings between all entries, ``(n_units, n_units)``, with its gradient."""
    n, n_visible = model.n_units, model.n_visible
    upper = model.b.new_zeros(n, n)
    if isinstance(model, RBM):
        for i in range(model.n_hidden):
            for j in range(n_visible):
                upper[j, n_visible + i] = model.weight[i, j]
    else:
        for at, (first, second) in enumerate(model.pairs.tolist()):
            upper[first, second] = model.coupling[at]
    return upper + upper.T


def energy(model: RBM | BoltzmannMachine, x: Tensor) -> Tensor:
    """E of one configuration x = (v, h), by loops over pairs, units and squares."""
    matrix, bias = couplings(model), torch.cat((model.b, model.c))
    total = x.new_zeros(())
    for i, j in itertools.combinations(range(model.n_units), 2):
        total = total - matrix[i, j] * x[i] * x[j]
    for i in range(model.n_units):
        total = total - bias[i] * x[i]
    for site in all_sites(model):
        if site.precision is not None:
            total = total + site.precision * x[site.entries[0]] ** 2 / 2
    return total


def log_sum(model: RBM | BoltzmannMachine, x: Tensor | None = None, known: Tensor | None = None) -> Tensor:
    r"""Log of the sum of exp(-E) over all units that are not known: log Z without any known ones.

    Real units must not be coupled to each other. The model is in float64, without replica axes.

    Args:
        model: The model.
        x: Values of the units, ``(n_units,)``; those of units that are not known are not read.
        known: Which units are known, ``(n_units,)``; None is none.

    Returns:
        A number, with its gradient by the parameters.
    """
    n = model.n_units
    x = torch.zeros(n, dtype=torch.float64) if x is None else x.double()
    known = torch.zeros(n, dtype=torch.bool) if known is None else known
    matrix, bias = couplings(model), torch.cat((model.b, model.c))
    sites = all_sites(model)
    free = [site for site in sites if not bool(known[site.entries].all())]
    states = torch.where(known, x, 0.0).unsqueeze(0)
    for site in free:
        if site.values is None:
            continue
        states = states.unsqueeze(1).repeat(1, len(site.values), 1)
        states[..., site.entries] = site.values.double()
        states = states.flatten(0, 1)
    log_weight = 0.5 * ((states @ matrix) * states).sum(-1) + states @ bias
    for site in sites:
        (at, *_), precision = site.entries, site.precision
        if precision is None:
            continue
        if bool(known[at]):
            log_weight = log_weight - precision * x[at] ** 2 / 2
            continue
        field = states @ matrix[:, at] + bias[at]
        node, log_width = _rule(field.detach(), precision.detach(), site.low)
        log_weight = log_weight + (
            field.unsqueeze(-1) * node - precision * node.square() / 2 + log_width
        ).logsumexp(-1)
    return log_weight.logsumexp(0)


def _rule(field: Tensor, precision: Tensor, low: float) -> tuple[Tensor, Tensor]:
    """Nodes and log weights of a quadrature that reaches over the means of all fields."""
    mean, deviation = field / precision, float(precision.double() ** -0.5)
    begin = max(low, float(mean.min()) - REACH * deviation)
    end = max(float(mean.max()), low) + REACH * deviation
    node, weight = (torch.from_numpy(part) for part in np.polynomial.legendre.leggauss(N_NODES))
    edges = torch.linspace(begin, end, N_PANELS + 1, dtype=torch.float64)
    half = (edges[1:] - edges[:-1]).unsqueeze(-1) / 2
    return (edges[:-1].unsqueeze(-1) + half * (1 + node)).flatten(), (half * weight).log().flatten()


def log_likelihood(model: RBM | BoltzmannMachine, v: Tensor, observed: Tensor | None = None) -> Tensor:
    """Log p(v) of each row, or of what is observed of it, ``(n,)``, with its gradient."""
    hidden = torch.zeros(model.n_hidden, dtype=torch.float64)
    masks = torch.ones_like(v, dtype=torch.bool) if observed is None else observed
    found = []
    for row, mask in zip(v.double(), masks, strict=True):
        known = torch.cat((mask, hidden.bool()))
        found.append(log_sum(model, torch.cat((torch.where(mask, row, 0.0), hidden)), known))
    return torch.stack(found) - log_sum(model)
