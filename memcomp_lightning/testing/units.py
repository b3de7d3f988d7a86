"""The conformance kit of units: what each kind must do, against sums over values and integrals by quadrature."""

import copy
from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
import torch
from scipy import stats
from torch import Tensor

from memcomp_lightning import rng
from memcomp_lightning.errors import SettingError
from memcomp_lightning.models.units import Mixed, Units, all_states
from memcomp_lightning.testing.statistics import chi_square_p_value

MOST_STATES = 2**14
"""States of a layer that are listed for each field at most."""

_ROWS = 4
_DRAWS = 20_000
_SURE = 1e-7
"""A right kind is refused once in so many draws."""


class _Truth(NamedTuple):
    """What follows from the measure of a layer, for fields ``(rows, n)``, by sums or integrals in float64."""

    cumulant: Tensor  # (rows,), of the whole layer
    mean: Tensor  # (rows, n)
    square: Tensor  # (rows, n)
    energy: Tensor  # (rows,)


@torch.no_grad()
def check_units(units: Units) -> None:
    """Check a kind of units on a small layer of it: one's own, or one of the package.

    Checked: the mean is the derivative of the cumulant, which is the log of the sum or integral over the values;
    samples have the right distribution, drawn from the given stream alone; modes, points, entropies, differences
    of cumulants; numbers of states, bits, sites, parts of a layer and layers side by side; biases and parameters
    that follow from data; replica axes; values that are refused; dtypes; fields of 10,000 in float32.

    Args:
        units: A layer of a few units, without replica axes, with at most 2^14 states if it has a list of them.
            Real units are sites of one entry each.

    Raises:
        AssertionError: Naming the kind and what it got wrong.
    """
    name = type(units).__name__
    if isinstance(units, Mixed):
        for kind in units.kinds:
            check_units(kind)
        _check_mixed(units)
    wide = copy.deepcopy(units).double()
    field = _fields(units)
    _check_given_fields(name, wide, field)
    if not isinstance(units, Mixed) or not units.real:
        truth = _truth(name, wide, field)
        if truth is not None:
            _check_truth(name, wide, field, truth)
    _check_draws(name, wide, field)
    _check_sites(name, wide, field)
    _check_measure(name, wide, field)
    _check_parts(name, wide, field)
    _check_numbers(name, wide)
    _check_data(name, wide, field)
    _check_replicas(name, wide)
    _check_numerics(name, units)


def _fields(units: Units, rows: int = _ROWS) -> Tensor:
    """Fields of both signs, ``(rows, n)`` float64, large ones in the last row."""
    like = torch.empty(0, dtype=torch.float64)
    field = 3 * rng.uniform((rows, units.n), generator=rng.stream(0, "fields of units"), like=like) - 1.5
    field[-1] *= 4
    return field


def _optional(function: Callable[[], Tensor]) -> Tensor | None:
    """What a kind defines, or None where it says that it does not."""
    try:
        return function()
    except SettingError:
        return None


def _states(name: str, units: Units) -> Tensor | None:
    """All states of a layer, if it has a list of them."""
    if units.real:
        return None
    try:
        n_states = units.n_states
    except SettingError:
        return None
    _check(n_states <= MOST_STATES, f"{name} has {n_states} states: give a smaller layer, of up to {MOST_STATES}")
    return all_states(units, torch.empty(0, dtype=torch.float64))


# ------------------------------------------------------------------------------------------- given the fields


def _check_given_fields(name: str, units: Units, field: Tensor) -> None:
    cumulant = units.cumulant(field)
    expected = (*field.shape[:-1], units.n_sites)
    _check(cumulant.shape == expected, f"{name}: cumulant has shape {tuple(cumulant.shape)}, not {expected}")
    for what, values in (("mean", units.mean(field)), ("mode", units.mode(field))):
        _check(values.shape == field.shape, f"{name}: {what} has shape {tuple(values.shape)}")
    step, slope = 1e-4, torch.empty_like(field)
    for entry in range(units.n):
        moved = torch.zeros(units.n, dtype=field.dtype)
        moved[entry] = step
        change = units.cumulant(field + moved) - units.cumulant(field - moved)
        elsewhere = change.clone()
        elsewhere[..., int(units.site_of()[entry])] = 0
        _check(_near(elsewhere, 0.0), f"{name}: the field of entry {entry} moves the cumulant of another site")
        slope[..., entry] = change.sum(-1) / (2 * step)
    _check(_near(units.mean(field), slope, 1e-6), f"{name}: the mean is not the derivative of the cumulant")


def _truth(name: str, units: Units, field: Tensor) -> _Truth | None:
    if units.real:
        return _by_quadrature(units, field)
    states = _states(name, units)
    if states is None:
        return None
    log_weight = field @ states.T - units.energy(states)
    p = log_weight.softmax(-1)
    return _Truth(log_weight.logsumexp(-1), p @ states, p @ states.square(), p @ units.energy(states))


def _by_quadrature(units: Units, field: Tensor) -> _Truth:
    """Of real units, each alone."""
    parts = []
    for entry in range(units.n):
        x, log_width = _nodes(units, field, entry)
        energy = _energies(units, entry, x)
        log_weight = field[:, entry, None] * x - energy + log_width
        p = log_weight.softmax(-1)
        moments = ((p * value).sum(-1) for value in (x, x.square(), energy))
        parts.append((log_weight.logsumexp(-1), *moments))
    cumulant, mean, square, energy = (torch.stack(part, dim=-1) for part in zip(*parts, strict=True))
    return _Truth(cumulant.sum(-1), mean, square, energy.sum(-1))


def _nodes(units: Units, field: Tensor, entry: int) -> tuple[Tensor, Tensor]:
    """Nodes ``(rows, nodes)`` and log weights of Gauss and Legendre's rule on many panels."""
    moved = torch.zeros(units.n, dtype=field.dtype)
    moved[entry] = 1e-4
    mean, slope = (
        units.mean(field)[:, entry],
        (units.mean(field + moved) - units.mean(field - moved))[:, entry] / 2e-4,
    )
    reach = 14 * slope.clamp(min=1e-12).sqrt().amax()
    low, high = float((mean - reach).min()), float((mean + reach).max())
    if not _allows(units, entry, low):
        low = 0.0
    node, weight = (torch.from_numpy(part) for part in np.polynomial.legendre.leggauss(16))
    edges = torch.linspace(low, high, 201, dtype=torch.float64)
    half = (edges[1:] - edges[:-1]).unsqueeze(-1) / 2
    x = (edges[:-1].unsqueeze(-1) + half * (1 + node)).flatten()
    return x.expand(len(field), -1), (half * weight).log().flatten()


def _allows(units: Units, entry: int, value: float) -> bool:
    """Whether a value is one of a real unit, others being where their modes are."""
    v = units.mode(torch.ones(1, units.n, dtype=torch.float64))
    v[..., entry] = value
    try:
        units.check(v, pure=True)
    except SettingError:
        return False
    return True


def _energies(units: Units, entry: int, x: Tensor) -> Tensor:
    """``-log mu`` of values of one entry."""
    wide = torch.zeros(*x.shape, units.n, dtype=x.dtype)
    energy = units.energy(wide)
    wide[..., entry] = x
    return units.energy(wide) - energy


def _check_truth(name: str, units: Units, field: Tensor, truth: _Truth) -> None:
    sum_of = "integral" if units.real else "sum"
    _check(
        _near(units.cumulant(field).sum(-1), truth.cumulant),
        f"{name}: the cumulant is not the log of the {sum_of} over the values",
    )
    _check(_near(units.mean(field), truth.mean), f"{name}: the mean is not that of the {sum_of} over the values")
    points = torch.stack(units.points(field))
    _check(_near(points.mean(0), truth.mean), f"{name}: the points do not have the mean")
    energy = torch.stack([units.energy(values) for values in points]).mean(0)
    _check(_near(energy, truth.energy), f"{name}: the points do not have the expected energy")
    if not units.linear:
        _check(_near(points.square().mean(0), truth.square), f"{name}: the points do not have the second moments")
    mode = units.mode(field)
    states = _states(name, units)
    if states is not None:
        best = (field @ states.T - units.energy(states)).amax(-1)
        found = (field * mode).sum(-1) - units.energy(mode)
        _check(_near(found, best), f"{name}: the mode is not the likeliest state")
        p = (field @ states.T - units.energy(states)).softmax(-1)
        entropy = _optional(lambda: units.negative_entropy(units.mean(field)))
        right = entropy is None or _near(entropy, (p * p.log()).sum(-1))
        _check(right, f"{name}: negative_entropy is not the sum of p log p")
    else:
        for entry in range(units.n):
            x, _ = _nodes(units, field, entry)
            own = mode[:, entry, None]
            log_p = field[:, entry, None] * x - _energies(units, entry, x)
            highest = field[:, entry, None] * own - _energies(units, entry, own)
            _check(bool((highest >= log_p - 1e-9).all()), f"{name}: the mode is not the likeliest value")


def _check_draws(name: str, units: Units, field: Tensor) -> None:
    before = torch.get_rng_state()
    kept = [tensor.clone() for tensor in units.state_dict().values()]
    for row in field:
        wide = row.expand(_DRAWS, -1)
        with torch.enable_grad():
            drawn, again = (units.sample(wide, generator=rng.stream(1, "draws of units")) for _ in range(2))
        _check(not drawn.requires_grad, f"{name}: sample carries a gradient")
        _check(drawn.equal(again), f"{name}: same stream, other sample")
        _check_distribution(name, "sample", units, row, drawn)
        means = units.mean(wide)
        by_mean = units.sample_of_mean(means, generator=rng.stream(2, "draws of units"))
        if by_mean is not None:
            _check_distribution(name, "sample_of_mean", units, row, by_mean)
    _check(before.equal(torch.get_rng_state()), f"{name} drew from torch's global random stream")
    same = all(a.equal(b) for a, b in zip(kept, units.state_dict().values(), strict=True))
    _check(same, f"{name} changed its parameters")


def _check_distribution(name: str, method: str, units: Units, field: Tensor, drawn: Tensor) -> None:
    """By each site of discrete units, by each value of real ones."""
    _check(drawn.shape == (_DRAWS, units.n), f"{name}: {method} has shape {tuple(drawn.shape)}")
    try:
        units.check(drawn, pure=True)
    except SettingError as error:
        raise AssertionError(f"{name}: {method} draws values that check refuses: {error}") from error
    wrong = f"{name}: {method} has not the distribution of the fields"
    if isinstance(units, Mixed):  # the parts are drawn one after the other
        for kind, values, own in zip(units.kinds, units._split(drawn), units._split(field), strict=True):
            _check_distribution(name, method, kind, own, values)
    elif units.real:
        for entry in range(units.n):
            x, log_width = _nodes(units, field.unsqueeze(0), entry)
            log_weight = field[entry] * x[0] - _energies(units, entry, x[0]) + log_width
            # The distribution at the middle between two nodes.
            below = log_weight.softmax(-1).cumsum(-1)
            edges = torch.cat(((x[0, 1:] + x[0, :-1]) / 2, x[0, -1:])).numpy()
            cdf = np.interp(drawn[:, entry].numpy(), edges, below.numpy(), left=0.0)
            p = stats.kstest(cdf, "uniform").pvalue
            _check(p > _SURE, f"{wrong}, entry {entry}")
    else:
        states = _states(name, units)
        if states is None:
            return
        key = 1.7 ** torch.arange(units.n, dtype=torch.float64)
        ordered, at = (states @ key).sort()
        number = at[torch.searchsorted(ordered, drawn @ key - 1e-9).clamp(max=len(at) - 1)]
        _check(bool((states[number] == drawn).all()), f"{name}: {method} draws what is no state")
        p = (field @ states.T - units.energy(states)).softmax(-1)
        counts = torch.bincount(number, minlength=len(states))
        _check(chi_square_p_value(counts, p) > _SURE, wrong)


# --------------------------------------------------------------------------------------- sites, measure, parts


def _check_sites(name: str, units: Units, field: Tensor) -> None:
    site_of = units.site_of()
    _check(site_of.shape == (units.n,) and site_of.dtype == torch.int64, f"{name}: site_of is not (n,) int64")
    _check(site_of.device.type == "cpu", f"{name}: site_of is not on the CPU")
    in_order = bool((site_of.diff() >= 0).all()) and site_of.unique().equal(torch.arange(units.n_sites))
    _check(in_order, f"{name}: site_of does not rise from 0 to n_sites - 1")
    numbers = torch.arange(units.n_sites, dtype=field.dtype).expand(2, -1)
    _check(units.over_sites(numbers).equal(numbers[:, site_of]), f"{name}: over_sites and site_of disagree")
    sums = torch.zeros(len(field), units.n_sites, dtype=field.dtype).index_add(-1, site_of, field)
    _check(_near(units.site_sums(field), sums), f"{name}: site_sums and site_of disagree")


def _check_measure(name: str, units: Units, field: Tensor) -> None:
    x = torch.cat(units.points(field))
    energy = units.energy(x)
    _check(energy.shape == x.shape[:-1], f"{name}: energy has shape {tuple(energy.shape)}")
    if units.linear:
        _check(_near(energy, 0.0), f"{name} says that its measure is constant, but energy is not 0")
    else:
        of_sites = units.site_energies(x)
        _check(of_sites.shape == (len(x), units.n_sites), f"{name}: site_energies has another shape")
        _check(_near(of_sites.sum(-1), energy), f"{name}: site_energies do not add up to energy")
    weight = rng.uniform(energy.shape, generator=rng.stream(3, "weights"), like=energy) - 0.5
    total = units.total_energy(x, weight)
    _check(_near(total, (weight * energy).sum(-1)), f"{name}: total_energy is not the weighted sum of energy")
    curvature = units.curvature
    if curvature is not None and not isinstance(units, Mixed):
        expected = 0.5 * (curvature * x.square()).sum(-1)
        _check(_near(energy, expected), f"{name}: energy is not half of curvature x^2")


def _check_parts(name: str, units: Units, field: Tensor) -> None:
    site_of = units.site_of()
    for sites in ([], [0], list(range(0, units.n_sites, 2)), list(range(units.n_sites))):
        entries = torch.isin(site_of, torch.tensor(sites, dtype=torch.long)).nonzero().flatten()
        part, own = units.select(entries), field[..., entries]
        where = f"{name}: the part of sites {sites}"
        _check(part.n == len(entries) and part.n_sites == len(sites), f"{where} has other numbers of units")
        _check(_near(part.mean(own), units.mean(field)[..., entries]), f"{where} has other means")
        _check(_near(part.cumulant(own), units.cumulant(field)[..., sites]), f"{where} has other cumulants")
        _check(part.mode(own).equal(units.mode(field)[..., entries]), f"{where} has other modes")
        values = part.mean(own)
        wide = torch.zeros_like(field)
        wide[..., entries] = values
        energy = units.energy(wide) - units.energy(torch.zeros_like(field))
        _check(
            _near(part.energy(values) - part.energy(torch.zeros_like(values)), energy), f"{where}: other energy"
        )
        moving = [key for key, parameter in part.named_parameters() if parameter.requires_grad]
        _check(not moving, f"{where} has parameters that training would change: {moving}; copy them")
    together = units.beside(copy.deepcopy(units))
    if together is not None:
        twice = torch.cat((field, 0.5 * field), dim=-1)
        apart = units.mean(field), units.mean(0.5 * field)
        right = together.n == 2 * units.n and _near(together.mean(twice), torch.cat(apart, dim=-1))
        _check(right, f"{name}: two layers side by side have other means")
    if units.n_sites:
        other = Mixed(units, copy.deepcopy(units))
        right = _near(other.mean(torch.cat((field, field), dim=-1)), torch.cat([units.mean(field)] * 2, dim=-1))
        _check(right, f"{name}: mixed with itself it has other means")


def _check_mixed(units: Mixed) -> None:
    """The parts side by side."""
    wide: Mixed = copy.deepcopy(units).double()
    field = _fields(units)
    parts = list(zip(wide.kinds, wide._split(field), strict=True))
    for what, whole, each in (
        ("mean", wide.mean(field), [kind.mean(own) for kind, own in parts]),
        ("mode", wide.mode(field), [kind.mode(own) for kind, own in parts]),
        ("cumulant", wide.cumulant(field), [kind.cumulant(own) for kind, own in parts]),
    ):
        _check(_near(whole, torch.cat(each, dim=-1)), f"Mixed: {what} is not that of the parts")
    points = torch.stack(wide.points(field))
    energy = torch.stack([wide.energy(values) for values in points]).mean(0)
    expected = sum(
        torch.stack([kind.energy(values) for values in kind.points(own)]).mean(0) for kind, own in parts
    )
    _check(_near(energy, expected), "Mixed: the points do not have the energy of the parts")
    _check(_near(points.mean(0), wide.mean(field)), "Mixed: the points do not have the mean")
    _check(wide.real == any(kind.real for kind in wide.kinds), "Mixed: real is not that of the parts")
    _check(wide.linear == all(kind.linear for kind in wide.kinds), "Mixed: linear is not that of the parts")


# ----------------------------------------------------------------------------------------------- numbers, bits


def _check_numbers(name: str, units: Units) -> None:
    states = _states(name, units)
    if states is not None:
        _check(states.shape == (units.n_states, units.n), f"{name}: states have shape {tuple(states.shape)}")
        _check(len(states.unique(dim=0)) == len(states), f"{name}: two numbers have one state")
        try:
            units.check(states, pure=True)
        except SettingError as error:
            raise AssertionError(f"{name}: check refuses a state: {error}") from error
        numbers = torch.arange(units.n_states).flip(0)[:6].reshape(-1, 1)
        narrow = units.states(numbers, like=torch.empty(0, dtype=torch.float32))
        right = narrow.dtype == torch.float32 and narrow.double().equal(states[numbers])
        _check(right, f"{name}: states depend on the shape of the numbers, or are not in the dtype of like")
        none = units.select(torch.arange(0))
        right = none.n_states == 1 and none.states(torch.arange(1), like=states).shape == (1, 0)
        _check(right, f"{name}: a layer without units has not the one empty state")
    try:
        bits = units.bits()
    except SettingError:
        return
    sizes = {len(part) for part in (bits.at, bits.low, bits.width)}
    _check(len(sizes) == 1 and len(bits.at.unique()) == len(bits.at), f"{name}: parts of bits do not fit")
    if states is None or len(bits.at) != units.n:
        return
    allowed = _assignments(len(bits.at), bits.groups)
    found = torch.zeros(len(allowed), units.n, dtype=torch.float64)
    found[:, bits.at] = bits.low.double() + bits.width.double() * allowed
    same = found.shape == states.shape and found.unique(dim=0).equal(states.unique(dim=0))
    _check(same, f"{name}: the bits that its groups allow are not its states")


def _assignments(n: int, groups: Sequence[Sequence[int]]) -> Tensor:
    """All bits with exactly one on in each group, ``(assignments, n)`` float64."""
    grouped = {bit for group in groups for bit in group}
    found = torch.zeros(1, n, dtype=torch.float64)
    for choice in [*groups, *([bit] for bit in range(n) if bit not in grouped)]:
        options = torch.zeros(len(choice), n, dtype=torch.float64)
        options[torch.arange(len(choice)), torch.tensor(choice)] = 1
        if choice[0] not in grouped:
            options = torch.cat((torch.zeros(1, n, dtype=torch.float64), options))
        found = (found.unsqueeze(1) + options).flatten(0, 1)
    return found


# --------------------------------------------------------------------------------------------- data, replicas


def _check_data(name: str, units: Units, field: Tensor) -> None:
    drawn = units.sample(field, generator=rng.stream(4, "draws of units"))
    for v, pure in ((drawn, True), (drawn, False), (units.mean(field), False)):
        try:
            units.check(v, pure=pure)
        except SettingError as error:
            raise AssertionError(f"{name}: check refuses values of the units, or their means: {error}") from error
    spoiled = drawn.clone()
    entries = (units.site_of() == units.n_sites - 1).nonzero().flatten()
    spoiled[1, entries] = torch.nan
    for pure in (True, False):
        try:
            units.check(spoiled, pure=pure, column=7)
        except SettingError as error:
            at = f"column {7 + units.n_sites - 1},"
            _check(at in str(error), f"{name}: check does not name {at} of a value that is nan: {error}")
        else:
            _check(False, f"{name}: check takes nan")
        units.check(spoiled, ~spoiled.isnan(), pure=pure)
    n = 1e9
    mean = units.mean(field)
    bias = units.bias_of(n * mean, n)
    _check(bias.shape == mean.shape, f"{name}: bias_of has shape {tuple(bias.shape)}")
    _check(_near(units.mean(bias), mean, 1e-6), f"{name}: bias_of does not have the means of the data")
    counts = torch.full_like(mean, n)
    _check(_near(units.bias_of(n * mean, counts), bias), f"{name}: bias_of does not take a number for each entry")
    _check(
        bool(units.bias_of(0 * mean, 3.0).isfinite().all()), f"{name}: bias_of data without values is not finite"
    )
    started = copy.deepcopy(units)
    parameters = list(started.parameters())
    variance = torch.linspace(0.5, 2.0, units.n, dtype=field.dtype)
    started.start(mean[0], variance)
    bias = started.bias_of(n * mean[:1], n)
    _check(_near(started.mean(bias), mean[:1], 1e-6), f"{name}: after start, bias_of does not have the means")
    curvature = started.curvature
    if parameters and curvature is not None and curvature.requires_grad and not isinstance(units, Mixed):
        _check(_near(curvature.detach(), 1 / variance), f"{name}: start does not take the variances")
    kept = [tensor.clone() for tensor in units.state_dict().values()]
    units.project()
    same = all(a.equal(b) for a, b in zip(kept, units.state_dict().values(), strict=True))
    _check(same, f"{name}: project changes parameters that are allowed")


def _check_replicas(name: str, units: Units) -> None:
    """Two layers that differ, on one axis and on two, against each alone."""
    singles = [copy.deepcopy(units), copy.deepcopy(units)]
    with torch.no_grad():
        for tensor in singles[1].state_dict().values():
            tensor.mul_(1.5)
    for replicas in ((2,), (2, 1)):
        whole = units.for_replicas(replicas)
        with torch.no_grad():
            for key, tensor in whole.state_dict().items():
                together = torch.stack([single.state_dict()[key] for single in singles])
                fits = tensor.shape == (*replicas, *together.shape[1:])
                _check(fits, f"{name}: for_replicas gives {key} the shape {tuple(tensor.shape)}")
                tensor.copy_(together.reshape(tensor.shape))
        field = _fields(units, 6)
        for axes in ((3,), (3, 1)):  # one axis of rows, and another one
            own = field.reshape(2, *axes, units.n)
            wide = own.reshape(*replicas, *axes, units.n)
            for what in ("mean", "mode", "cumulant", "points", "energy", "sample"):
                found = _of(whole, what, wide)
                each = [_of(single, what, some) for single, some in zip(singles, own, strict=True)]
                expected = torch.stack(each, dim=1 if what == "points" else 0).reshape(found.shape)
                same = what == "sample" or _near(found, expected)
                _check(same, f"{name}: {what} of replicas is not that of each")


def _of(units: Units, what: str, field: Tensor) -> Tensor:
    if what == "points":
        return torch.stack(units.points(field))
    if what == "sample":
        return units.sample(field, generator=rng.stream(5, "draws of units"))
    found: Tensor = getattr(units, what)(field)
    return found


# --------------------------------------------------------------------------------------------------- numerics


def _check_numerics(name: str, units: Units) -> None:
    field = _fields(units)
    wide = copy.deepcopy(units).double()
    for dtype in (torch.float32, torch.float64):
        own, some = copy.deepcopy(units).to(dtype), field.to(dtype)
        for what in ("mean", "mode", "cumulant", "points", "energy", "sample"):
            found = _of(own, what, some)
            _check(found.dtype == dtype, f"{name}: {what} of {dtype} is {found.dtype}")
        for beta, target in ((0.0, 0.3), (0.7, 1.0), (1.0, 0.25)):
            gain = own.cumulant_gain(some, beta, target)
            true = (wide.cumulant(target * some.double()) - wide.cumulant(beta * some.double())).sum(-1)
            _check(gain.dtype == torch.float64, f"{name}: cumulant_gain is not float64")
            tolerance = 1e-5 if dtype == torch.float32 else 1e-9
            right = gain.shape == true.shape and _near(gain, true, tolerance)
            _check(right, f"{name}: cumulant_gain from {beta} to {target} is not the difference of cumulants")
    narrow = copy.deepcopy(units).float()
    signs = torch.ones(3, units.n)
    signs[1] = -1
    signs[2, ::2] = -1
    for size in (1e4, 30.0):
        extreme = size * signs
        for what in ("mean", "mode", "cumulant", "points", "sample"):
            found = _of(narrow, what, extreme)
            _check(bool(found.isfinite().all()), f"{name}: {what} at fields of {size:g} is not finite in float32")
            if what != "sample":
                true = _of(wide, what, extreme.double())
                close = torch.isclose(found.double(), true, rtol=1e-4, atol=1e-6).all()
                _check(bool(close), f"{name}: {what} at fields of {size:g} is another one in float32")
        gain = narrow.cumulant_gain(extreme, 0.2, 0.9)
        true = wide.cumulant_gain(extreme.double(), 0.2, 0.9)
        right = bool(gain.isfinite().all()) and bool(torch.isclose(gain, true, rtol=1e-4).all())
        _check(right, f"{name}: cumulant_gain at fields of {size:g} is wrong in float32")


def _near(found: Tensor, true: Tensor | float, tolerance: float = 1e-8) -> bool:
    """Whether numbers agree, relative to their size where that is above one."""
    expected = torch.as_tensor(true, dtype=found.dtype)
    if isinstance(true, Tensor) and found.shape != true.shape:
        return False
    return bool(((found - expected).abs() <= tolerance * (1 + expected.abs())).all())


def _check(condition: bool, message: str) -> None:
    if not condition:
        raise AssertionError(message)
