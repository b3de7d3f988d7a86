"""Models of all units in bits, against their energies state by state; what is forgotten shows."""

import math
from functools import partial

import pytest
import torch

from memcomp_lightning import rng
from memcomp_lightning.enumeration import binary_states
from memcomp_lightning.errors import SettingError
from memcomp_lightning.models import descend, read_bits, units
from memcomp_lightning.models.bit_form import with_real_spread
from memcomp_lightning.models.units import Bits
from memcomp_lightning.problems import from_model
from memcomp_lightning.problems.constrained import Constrained
from memcomp_lightning.problems.from_model import constrained_from_model
from memcomp_lightning.testing import (
    enumerated,
    hidden_kinds,
    small_dbm,
    small_machine,
    small_rbm,
    visible_kinds,
)
from memcomp_lightning.types import Configurations

V, H = visible_kinds(), {name: kind for name, kind in hidden_kinds().items() if not kind.real}
REAL_HIDDEN = units.Gaussian(3, variance=torch.tensor([0.5, 1.0, 2.0]), learned=False)
MAKERS = (
    {f"RBM of {v} and {h}": partial(small_rbm, visible=V[v], hidden=H[h]) for v in V for h in H}
    | {f"machine of {v} and {h}": partial(small_machine, visible=V[v], hidden=H[h]) for v in V for h in ("spins",)}
    | {f"DBM of {v}": partial(small_dbm, visible=V[v]) for v in V}
    | {
        f"RBM of {v} and hidden real units": partial(small_rbm, visible=V[v], hidden=REAL_HIDDEN)
        for v in ("spins", "categories")
    }
)
EVERY = pytest.mark.parametrize("make", MAKERS.values(), ids=MAKERS)


def log_integral(model, x):
    """Log of the integral of exp(-E) over the real units, one by one on a grid, at states of the others."""
    n, total = model.n_visible, -model.energy(x[:, : model.n_visible], x[:, model.n_visible :])
    exact = enumerated(model)
    for unit in exact.variance.nonzero().flatten().tolist():
        # The rule of trapezes: of a normal density as wide as two steps it is right to all digits.
        t = torch.linspace(-40, 40, 321, dtype=torch.float64)
        wide = x[:, None, :].repeat(1, len(t), 1)
        wide[..., unit] = t
        at_zero = x.clone()
        at_zero[:, unit] = 0
        rises = model.energy(wide[..., :n].flatten(0, 1), wide[..., n:].flatten(0, 1)).view(len(x), -1)
        rises = rises - model.energy(at_zero[:, :n], at_zero[:, n:])[:, None]
        own = model.energy(x[:, :n], x[:, n:]) - model.energy(at_zero[:, :n], at_zero[:, n:])
        total = total + own + torch.logsumexp(-rises, -1) + math.log(float(t[1] - t[0]))
    return total


def bits_by_hand(model, x):
    """0 and 1 as they are, spins -1 and +1 as 0 and 1, real units left out."""
    found, begin = [], 0
    for layer in (model.visible, model.hidden):
        for kind in layer.kinds if isinstance(layer, units.Mixed) else [layer]:
            part = x[:, begin : begin + kind.n]
            begin += kind.n
            if not kind.real:
                found.append((part > 0).to(x.dtype))
    return torch.cat(found, dim=-1)


def fits(layer, x):
    """Whether a row is one of a layer's states."""
    try:
        layer.check(x.view(1, -1), pure=True)
    except SettingError:
        return False
    return True


@EVERY
def test_bits_have_the_energy_of_each_state_or_that_of_the_integral_over_real_units(make):
    model = make().double()
    exact, form = enumerated(model), model.in_bits()
    y = bits_by_hand(model, exact.x)
    energy = from_model(model).energy(y)
    torch.testing.assert_close(energy, -log_integral(model, exact.x), rtol=0, atol=1e-9)
    v, h, weight = read_bits(model, form, y)
    torch.testing.assert_close(torch.cat((v, h), dim=-1), exact.x)
    assert weight is None
    if not exact.variance.any():
        torch.testing.assert_close(energy, exact.energy, rtol=0, atol=1e-9)


@EVERY
def test_the_same_with_replica_axes(make):
    several, form = make(replicas=(2, 3)).double(), make(replicas=(2, 3)).double().in_bits()
    y = (rng.uniform((2, 3, 7, len(form.at)), generator=rng.stream(0, "bits")) > 0.5).double()
    energy, found = from_model(several).energy(y), read_bits(several, form, y)
    one = make().double()
    state = several.state_dict()
    for i, j in ((0, 0), (1, 2)):
        own = one.state_dict()
        one.load_state_dict({k: x[i, j] if x.shape != own[k].shape else x for k, x in state.items()})
        torch.testing.assert_close(from_model(one).energy(y[i, j]), energy[i, j])
        for together, alone in zip(found[:2], read_bits(one, form, y[i, j])[:2], strict=True):
            torch.testing.assert_close(together[i, j], alone)


@EVERY
def test_the_constraints_hold_for_states_of_the_units_and_for_no_other_bits(make):
    model = make()
    problem, form = constrained_from_model(model), model.in_bits()
    y = binary_states(min(len(form.at), 16), like=model.b)
    n_categories = sum(
        kind.n_sites
        for layer in (model.visible, model.hidden)
        for kind in (layer.kinds if isinstance(layer, units.Mixed) else [layer])
        if isinstance(kind, units.Categorical)
    )
    assert len(form.groups) == n_categories
    assert isinstance(problem, Constrained) == bool(n_categories)
    if n_categories and y.shape[-1] == len(form.at):
        kept = problem.n_broken(y) == 0
        assert int(kept.sum()) == len(enumerated(model).x)
        v, h, _ = read_bits(model, form, y)
        model.visible.check(v[kept], pure=True)
        model.hidden.check(h[kept], pure=True)
        for broken_v, broken_h in zip(v[~kept][:99], h[~kept][:99], strict=True):
            assert not fits(model.visible, broken_v) or not fits(model.hidden, broken_h)


def test_a_forgotten_factor_of_spins_shows(monkeypatch):
    bits = units.Spin.bits
    for wrong in (
        lambda self: bits(self)._replace(width=torch.ones(self.n)),
        lambda self: bits(self)._replace(low=torch.zeros(self.n)),
        lambda self: Bits(torch.arange(self.n), torch.zeros(self.n), torch.ones(self.n)),
    ):
        model = small_rbm(visible=V["spins"], hidden=H["spins"]).double()
        exact = enumerated(model)
        monkeypatch.setattr(units.Spin, "bits", wrong)
        energy = from_model(model).energy(bits_by_hand(model, exact.x))
        monkeypatch.setattr(units.Spin, "bits", bits)
        assert (energy - exact.energy).abs().max() > 0.1


def test_real_units_that_are_left_out_and_not_integrated_show():
    model = small_rbm(visible=V["real"], hidden=H["spins"]).double()
    x = enumerated(model).x
    expected = -log_integral(model, x)
    y = bits_by_hand(model, x)
    with torch.no_grad():
        for name, parameter in (("couplings", model.weight), ("their biases", model.b)):
            kept = parameter.clone()
            parameter.zero_()
            energy = from_model(model).energy(y)
            parameter.copy_(kept)
            apart = (energy - energy.mean()) - (expected - expected.mean())
            assert apart.abs().max() > 0.1, name
    torch.testing.assert_close(from_model(model).energy(y), expected, rtol=0, atol=1e-9)


def test_without_constraints_the_lowest_bits_are_no_state_of_categories():
    model = small_rbm(visible=V["categories"], hidden=H["bits"]).double()
    with torch.no_grad():
        model.b += 1.0  # a gauge: no state of the units has another energy than before, less 3
    y = binary_states(model.n_units, like=model.b)
    energy = from_model(model).energy(y)
    broken = constrained_from_model(model).n_broken(y)
    assert int(broken[energy.argmin()]) > 0
    assert energy[broken == 0].min() == pytest.approx(float(enumerated(model).energy.min()))


@EVERY
@pytest.mark.parametrize("replicas", [(), (2,)], ids=str)
def test_descents_end_in_states_that_no_class_improves_and_never_rise(make, replicas):
    model = make(replicas=replicas).double()
    n, stream = model.n_visible, rng.stream(0, "starts")
    zero = torch.zeros(*replicas, 53, model.n_units, dtype=torch.float64)
    v, h = (
        layer.sample(part, generator=stream)
        for layer, part in zip((model.visible, model.hidden), zero.split((n, model.n_hidden), -1), strict=True)
    )
    found = descend(model, Configurations(v, h))
    before, after = model.energy(v, h), model.energy(found.v, found.h)
    assert (after <= before + 1e-9).all()
    assert (after < before - 1e-3).any()
    model.hidden.check(found.h)
    x = torch.cat(found[:2], dim=-1)
    for block in model.blocks():
        moved = x.clone()
        moved[..., block.units] = block.kind.mode(block.field(x))
        assert (model.energy(moved[..., :n], moved[..., n:]) > after - 1e-5 * (1 + after.abs())).all()


def test_descents_mend_sites_in_no_state_or_in_several():
    for make in (
        MAKERS["RBM of mixed and categories"],
        MAKERS["machine of categories of several sizes and spins"],
    ):
        model = make()
        form = model.in_bits()
        y = (rng.uniform((101, len(form.at)), generator=rng.stream(0, "bits")) > 0.6).to(torch.float32)
        v, h, _ = descend(model, read_bits(model, form, y))
        model.visible.check(v)
        model.hidden.check(h, pure=True)
        with pytest.raises(SettingError, match="add up to 1"):
            model.visible.check(read_bits(model, form, y).v)


@pytest.mark.parametrize("name", [name for name, make in MAKERS.items() if enumerated(make()).variance.any()])
def test_two_points_have_the_moments_of_real_units_given_the_others(name):
    model = MAKERS[name]().double()
    exact, n = enumerated(model), model.n_visible
    weight = torch.arange(1.0, len(exact.x) + 1, dtype=torch.float64)
    found = with_real_spread(model, Configurations(exact.x[:, :n], exact.x[:, n:], weight))
    x = torch.cat(found[:2], dim=-1).view(2, len(exact.x), -1)
    torch.testing.assert_close(found.weight.view(2, -1), weight.expand(2, -1))
    torch.testing.assert_close(x.mean(0), exact.x)
    torch.testing.assert_close(x.var(0, correction=0), exact.variance.expand_as(exact.x))
    # A real unit adds, on the average, half a nat to the energy at its mean.
    energy = model.energy(found.v, found.h).view(2, -1).mean(0)
    n_real = int((exact.variance > 0).sum())
    torch.testing.assert_close(energy, exact.energy + n_real / 2)
