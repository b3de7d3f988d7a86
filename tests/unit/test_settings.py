"""Settings out of range are refused at construction: name, value, what is allowed."""

import dataclasses
import importlib
import inspect
import math
import pkgutil
import re
from collections.abc import Iterator

import pytest

from memcomp_lightning.errors import SettingError
from memcomp_lightning.likelihood import Ais, ReverseAis
from memcomp_lightning.samplers import CD, PCD, Exact, GroundState, Quench
from memcomp_lightning.solvers import AlternatingDescent, BruteForce
from memcomp_lightning.solvers.dmm import (
    AdaptiveEuler,
    BondField,
    ClauseField,
    DmmSolver,
    Heun,
    Recording,
    Splitting,
    Strang,
    WarmRestart,
)

COUNT = "an integer >= 1"
POSITIVE = "a number > 0"
SCHEMES = [AdaptiveEuler, Splitting, Strang, Heun]
REFUSED = [
    (CD, {"k": 0}, COUNT),
    (CD, {"k": 1.5}, COUNT),
    (PCD, {"k": -3}, COUNT),
    (PCD, {"n_chains": 0}, COUNT),
    (Quench, {"beta_hot": 1.01}, "a number in [0, 1]"),
    (Quench, {"beta_hot": -0.01}, "a number in [0, 1]"),
    (Quench, {"beta_hot": math.nan}, "a number in [0, 1]"),
    (Quench, {"n_chains": 0}, COUNT),
    (Exact, {"max_units": 0}, COUNT),
    (Exact, {"max_units": 21}, "an integer from 1 to 20"),
    (Ais, {"n_chains": 1}, "an integer >= 2"),
    *((kind, {name: 0}, COUNT) for kind in (Ais, ReverseAis) for name in ("n_betas", "k")),
    *((kind, {"betas": (0.0, 0.5)}, "numbers that increase from 0 to 1") for kind in (Ais, ReverseAis)),
    (BruteForce, {"max_variables": 0}, COUNT),
    (BruteForce, {"chunk_size": 0}, COUNT),
    (AlternatingDescent, {"n_restarts": 0}, COUNT),
    (AlternatingDescent, {"max_sweeps": 0}, COUNT),
    (DmmSolver, {"n_restarts": 0}, COUNT),
    (DmmSolver, {"max_steps": 0}, COUNT),
    (DmmSolver, {"patience": 0}, COUNT),
    (DmmSolver, {"patience": 12, "n_restarts": 11}, "an integer from 1 to n_restarts = 11, or null"),
    (DmmSolver, {"quench_every": -1}, "an integer >= 0"),
    (DmmSolver, {"quench_every": 1.5}, "an integer >= 0"),
    (DmmSolver, {"kernel": "gpu"}, "one of 'auto', 'compiled', 'reference'"),
    (WarmRestart, {"keep": -0.1}, "a number in [0, 1]"),
    (WarmRestart, {"keep": 1.1}, "a number in [0, 1]"),
    (WarmRestart, {"spread": 0.0}, "a number in (0, 2]"),
    (WarmRestart, {"spread": 2.1}, "a number in (0, 2]"),
    *(
        (scheme, *refused)
        for scheme in SCHEMES
        for refused in (
            ({"change": 0.0}, POSITIVE),
            ({"change": math.nan}, POSITIVE),
            ({"dt_min": 0.0, "dt_max": 2.3}, "a number in (0, dt_max = 2.3]"),
            ({"dt_min": 3.0, "dt_max": 2.3}, "a number in (0, dt_max = 2.3]"),
        )
    ),
    *((Splitting, {"lag": lag}, "a number in [0, 1/2]") for lag in (-0.1, 0.51, math.nan)),
    *((DmmSolver, {"stall": stall}, "a number > 0, or null") for stall in (0.0, -1.0, math.inf, math.nan)),
    (ClauseField, {"alpha": 0.0}, POSITIVE),
    (ClauseField, {"alpha": math.nan}, POSITIVE),
    (ClauseField, {"beta": -0.1}, POSITIVE),
    (ClauseField, {"epsilon": 0.0}, POSITIVE),
    (ClauseField, {"unit_pull": 0.0}, POSITIVE),
    (ClauseField, {"gamma": 0.0}, "a number in (0, 1/2)"),
    (ClauseField, {"gamma": 0.5}, "a number in (0, 1/2)"),
    (ClauseField, {"delta": 0.0, "gamma": 0.13}, "a number in (0, gamma = 0.13]"),
    (ClauseField, {"delta": 0.14, "gamma": 0.13}, "a number in (0, gamma = 0.13]"),
    (ClauseField, {"zeta": -0.1}, "a number >= 0"),
    (BondField, {"kappa": -0.1}, "a number >= 0"),
    *((BondField, {name: 0.0}, POSITIVE) for name in ("alpha", "beta", "gamma", "delta", "zeta")),
    (BondField, {"short_term_min": 0.0}, "a number in (0, 1)"),
    (BondField, {"short_term_min": 1.0}, "a number in (0, 1)"),
    (
        BondField,
        {"short_term_start": 0.1, "short_term_min": 0.2},
        "a number in [short_term_min = 0.2, 1]",
    ),
    (BondField, {"short_term_start": 1.1, "short_term_min": 0.2}, "a number in [short_term_min = 0.2, 1]"),
    *(
        (field, *refused)
        for field in (ClauseField, BondField)
        for refused in (
            ({"long_term_max": 0.99}, "a number >= 1"),
            ({"noise": -0.1}, "a number >= 0"),
            ({"noise": math.nan}, "a number >= 0"),
            ({"spread": 0.0}, "a number in (0, 1]"),
            ({"spread": 1.1}, "a number in (0, 1]"),
        )
    ),
]


@pytest.mark.parametrize(("kind", "setting", "allowed"), REFUSED, ids=lambda x: getattr(x, "__name__", str(x)))
def test_setting_is_refused_with_name_value_and_allowed(kind, setting, allowed):
    name, value = next(iter(setting.items()))
    expected = f"{name} = {value!r} is not allowed: expected {allowed}"
    with pytest.raises(SettingError, match=f"^{re.escape(expected)}"):
        kind(**setting)


@pytest.mark.parametrize(
    ("every", "allowed"),
    [(0, COUNT), (2.5, COUNT), (212, "an integer from 1 to max_steps = 211")],
)
def test_recording_interval_is_refused(every, allowed):
    with pytest.raises(SettingError, match=f"^record.every = {every} is not allowed: expected {allowed}"):
        DmmSolver(max_steps=211, record=Recording(every=every))


def test_readout_is_refused_with_the_options():
    with pytest.raises(
        SettingError, match=r"^readout = 'bst' is not allowed: expected one of 'best', 'time_average'"
    ):
        GroundState(solver=BruteForce(), readout="bst")


@pytest.mark.parametrize("solver", [BruteForce(), DmmSolver()], ids=["without the option", "not recording"])
def test_time_average_of_a_solver_that_records_nothing_is_refused_with_the_remedy(solver):
    message = f"^solver = '{type(solver).__name__}' is not allowed: .* Use DmmSolver.record=Recording"
    with pytest.raises(SettingError, match=message):
        GroundState(solver=solver, readout="time_average")


BOUNDS = [
    (Quench, {"beta_hot": 0.0}),
    (Quench, {"beta_hot": 1.0}),
    (Exact, {"max_units": 20}),
    (DmmSolver, {"patience": 11, "n_restarts": 11}),
    (DmmSolver, {"max_steps": 1}),
    (DmmSolver, {"quench_every": 0}),
    (DmmSolver, {"quench_every": None}),
    (DmmSolver, {"max_steps": None}),
    (WarmRestart, {"keep": 0.0}),
    (WarmRestart, {"keep": 1.0}),
    (WarmRestart, {"spread": 2.0}),
    *((scheme, {"dt_min": 2.3, "dt_max": 2.3}) for scheme in SCHEMES),
    (ClauseField, {"zeta": 0.0}),
    (ClauseField, {"delta": 0.13, "gamma": 0.13}),
    (ClauseField, {"long_term_max": 1.0}),
    (ClauseField, {"noise": 0.0}),
    (ClauseField, {"spread": 1.0}),
    (BondField, {"kappa": 0.0}),
    (BondField, {"long_term_max": 1.0}),
    (BondField, {"noise": 0.0}),
    (BondField, {"short_term_start": 0.2, "short_term_min": 0.2}),
    (BondField, {"short_term_start": 1.0}),
    (PCD, {"n_chains": None}),
]


@pytest.mark.parametrize(("kind", "setting"), BOUNDS, ids=lambda x: getattr(x, "__name__", str(x)))
def test_setting_at_its_bound_is_accepted(kind, setting):
    name, value = next(iter(setting.items()))
    assert getattr(kind(**setting), name) == value


KINDS = [
    CD,
    PCD,
    Quench,
    Exact,
    BruteForce,
    AlternatingDescent,
    DmmSolver,
    WarmRestart,
    ClauseField,
    BondField,
    Ais,
    ReverseAis,
    *SCHEMES,
]


@pytest.mark.parametrize("kind", KINDS)
def test_settings_are_named_frozen_and_known(kind):
    first = dataclasses.fields(kind)[0].name
    settings = kind()
    with pytest.raises(dataclasses.FrozenInstanceError):
        setattr(settings, first, getattr(settings, first))
    with pytest.raises(TypeError, match="positional"):
        kind(getattr(settings, first))
    with pytest.raises(TypeError, match="misspelt"):
        kind(misspelt=1)


def dataclasses_of(package: str) -> Iterator[type]:
    folder = importlib.import_module(f"memcomp_lightning.{package}")
    for found in pkgutil.walk_packages(folder.__path__, f"{folder.__name__}."):
        for _, kind in inspect.getmembers(importlib.import_module(found.name), inspect.isclass):
            if (
                kind.__module__ == found.name
                and dataclasses.is_dataclass(kind)
                and not kind.__name__.startswith("_")
            ):
                yield kind


@pytest.mark.parametrize("package", ["models", "samplers", "likelihood", "problems", "training"])
def test_nothing_changes_after_it_was_checked(package: str) -> None:
    thawed = [kind for kind in dataclasses_of(package) if not kind.__dataclass_params__.frozen]
    assert thawed == []


@pytest.mark.parametrize("package", ["samplers", "likelihood"])
def test_settings_are_given_by_name(package: str) -> None:
    fields = {
        (kind, field.name): field.kw_only for kind in dataclasses_of(package) for field in dataclasses.fields(kind)
    }
    assert all(fields.values()), fields


@pytest.mark.parametrize("kind", [k for k in dataclasses_of("problems") if k.__name__ != "Bipartite"])
def test_problems_are_compared_as_objects(kind: type) -> None:
    """Arrays have no one answer to whether they are equal."""
    assert kind.__eq__ is object.__eq__
    assert kind.__hash__ is object.__hash__
