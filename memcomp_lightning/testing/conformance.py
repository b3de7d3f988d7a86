"""The conformance kit: what every sampler and every solver must do, whatever its method."""

import dataclasses
from collections.abc import Callable
from typing import TypeVar

import torch
from torch import Generator, Tensor

from memcomp_lightning import rng
from memcomp_lightning.errors import SettingError
from memcomp_lightning.models import DBM, RBM, BoltzmannMachine, EnergyModel, Normal, units
from memcomp_lightning.models.connectivity import full
from memcomp_lightning.models.units import Units
from memcomp_lightning.objective import contrast
from memcomp_lightning.problems import Qubo, from_model
from memcomp_lightning.samplers import positive_phase, tensors_of
from memcomp_lightning.samplers.base import require_sampler
from memcomp_lightning.solvers import BruteForce, QuboSolver
from memcomp_lightning.training import Sampler
from memcomp_lightning.types import Configurations

ModelT = TypeVar("ModelT", RBM, DBM, BoltzmannMachine)


def small_rbm(
    n_visible: int = 7,
    n_hidden: int = 5,
    replicas: tuple[int, ...] = (),
    std: float = 0.8,
    seed: int = 0,
    *,
    visible: Units | None = None,
    hidden: Units | None = None,
) -> RBM:
    """A rectangular RBM with non-zero biases, so that a transpose or a sign shows; of any units."""
    visible, hidden = visible or units.Bernoulli(n_visible), hidden or units.Bernoulli(n_hidden)
    generator = rng.stream(seed, "test model")
    init = Normal(std=std)
    rbm = RBM(visible=visible, hidden=hidden, replicas=replicas, weight_init=init, generator=generator)
    return _with_biases(rbm, generator)


def small_dbm(*, replicas: tuple[int, ...] = (), visible: Units | None = None) -> DBM:
    """A DBM of 5, 3 and 2 units, or of other visible ones, biases drawn as those of :func:`small_rbm`."""
    generator = rng.stream(0, "test model")
    visible = visible or units.Bernoulli(5)
    dbm = DBM(
        hidden_sizes=[3, 2],
        visible=visible,
        replicas=replicas,
        weight_init=Normal(std=0.8),
        generator=generator,
    )
    return _with_biases(dbm, generator)


def small_machine(
    *, replicas: tuple[int, ...] = (), visible: Units | None = None, hidden: Units | None = None
) -> BoltzmannMachine:
    """A Boltzmann machine of 4 visible and 3 hidden units or of others, with biases.

    All but one pair of sites are coupled, and no two real units.
    """
    generator = rng.stream(0, "test model")
    visible, hidden = visible or units.Bernoulli(4), hidden or units.Bernoulli(3)
    pairs, init = full(visible.n_sites + hidden.n_sites)[1:], Normal(std=0.5)
    real = _real_sites(visible)
    pairs = pairs[~torch.isin(pairs, real).all(-1)]
    machine = BoltzmannMachine(
        visible=visible,
        hidden=hidden,
        connectivity=pairs,
        replicas=replicas,
        weight_init=init,
        generator=generator,
    )
    return _with_biases(machine, generator)


def _real_sites(layer: Units) -> Tensor:
    """Numbers of the sites of a layer that are real."""
    found, n = [], 0
    for kind in layer.kinds if isinstance(layer, units.Mixed) else [layer]:
        found += list(range(n, n + kind.n_sites)) if kind.real else []
        n += kind.n_sites
    return torch.tensor(found, dtype=torch.long)


def visible_kinds() -> dict[str, Units]:
    """Small layers of visible units of every kind."""
    variance = torch.tensor([0.5, 1.0, 2.0, 1.5])
    return {
        "bits": units.Bernoulli(4),
        "spins": units.Spin(4),
        "categories": units.Categorical(3, q=3),
        "categories of several sizes": units.Categorical([2, 4, 3]),
        "real": units.Gaussian(4, variance=variance),
        "real of fixed precision": units.Gaussian(4, variance=variance, learned=False),
        "mixed": units.Mixed(
            units.Spin(1), units.Categorical([3, 2]), units.Gaussian(2, variance=variance[:2]), units.Bernoulli(1)
        ),
    }


def hidden_kinds() -> dict[str, Units]:
    """Small layers of hidden units of every kind."""
    return {
        "bits": units.Bernoulli(3),
        "spins": units.Spin(3),
        "categories": units.Categorical([3, 2]),
        "rectified": units.ReLU(3),
    }


def _with_biases(model: ModelT, generator: Generator) -> ModelT:
    with torch.no_grad():
        model.b.normal_(0.3, 0.5, generator=generator)
        model.c.normal_(-0.2, 0.5, generator=generator)
    return model


def check_sampler(
    sampler: Sampler, *, n_data: int = 11, make: Callable[..., RBM | DBM | BoltzmannMachine] = small_rbm
) -> None:
    """Run a sampler on small models with and without replica axes and check the contract.

    Checked: shapes, values that the model's units allow, finite weights, which are non-negative unless
    ``signed_weights`` is True, a gradient for every parameter that does not flow into the sampler, model and state
    left alone, no draw from the global random stream, the same answer from the same stream, and that settings are
    frozen.

    Args:
        sampler: The sampler.
        n_data: Rows of data, which are means under random fields.
        make: Takes ``replicas`` and returns the model, of any kind of units: :func:`small_rbm`, or for samplers of
            any connectivity :func:`small_dbm` and :func:`small_machine` as well.

    Raises:
        AssertionError: Naming what the sampler got wrong.
        SettingError: It lacks a part of a sampler, or its state is no NamedTuple.
    """
    name = type(sampler).__name__
    require_sampler("sampler", sampler)
    _check_frozen(sampler)
    for replicas in ((), (3,), (2, 3)):
        rbm = make(replicas=replicas)
        before = [parameter.detach().clone() for parameter in rbm.parameters()]
        positive = positive_phase(rbm, _data(rbm, n_data, seed=1))
        global_state = torch.get_rng_state()
        answers = []
        for _ in range(2):
            generator = rng.stream(2, "negative_phase")
            state = sampler.init(rbm, n_data, generator=generator)
            kept = [tensor.clone() for tensor in tensors_of(state).values()]
            answers.append(sampler.sample(rbm, state, positive, generator=generator))
            unchanged = all(a.equal(b) for a, b in zip(kept, tensors_of(state).values(), strict=True))
            _check(unchanged, f"{name} changed the state it was given; return a new one")
        _check(global_state.equal(torch.get_rng_state()), f"{name} drew from torch's global random stream")
        unchanged = all(a.equal(b) for a, b in zip(before, rbm.parameters(), strict=True))
        _check(unchanged, f"{name} changed the model")
        first, second = (answer.configurations for answer in answers)
        _check(first.v.equal(second.v) and first.h.equal(second.h), f"{name}: same stream, other answer")
        _check_declarations(sampler, rbm, n_data, first)
        _check_configurations(name, first, rbm, signed=getattr(sampler, "signed_weights", False))
        loss = contrast(rbm, positive, first)
        _check(loss.shape == replicas, f"{name}: contrast has shape {tuple(loss.shape)}, not {replicas}")
        loss.sum().backward()
        for parameter_name, parameter in rbm.named_parameters():
            finite = parameter.grad is not None and bool(parameter.grad.isfinite().all())
            _check(finite, f"{name}: no finite gradient for {parameter_name}")
        for key, value in answers[0].info.items():
            _check(not value.requires_grad, f"{name}: info[{key!r}] carries a gradient")
            _check(tuple(value.shape) in ((), replicas), f"{name}: info[{key!r}] has shape {tuple(value.shape)}")


def _check_frozen(sampler: object) -> None:
    if dataclasses.is_dataclass(sampler):
        settings = [field.name for field in dataclasses.fields(sampler)]
    else:
        settings = list(getattr(sampler, "__dict__", {}))
    for setting in settings:
        try:
            setattr(sampler, setting, getattr(sampler, setting))
        except AttributeError:
            continue
        _check(False, f"{type(sampler).__name__}: the setting {setting!r} can be changed; freeze the class")


@torch.no_grad()
def _data(model: EnergyModel, n: int, seed: int) -> Tensor:
    """Rows that the visible units take: their means under random fields."""
    field = torch.empty(*model.replicas, n, model.n_visible, dtype=torch.float32, device="cpu")
    return model.visible.mean(field.normal_(std=2.0, generator=rng.stream(seed, "data")))


def _check_declarations(sampler: Sampler, rbm: EnergyModel, n_data: int, answer: Configurations) -> None:
    """``uses_data`` and ``shared`` are there, and a sampler that denies using the data does not."""
    name = type(sampler).__name__
    for attribute in ("uses_data", "shared"):
        _check(isinstance(getattr(sampler, attribute, None), bool), f"{name}.{attribute} must be True or False")
    if not sampler.uses_data:
        generator = rng.stream(2, "negative_phase")
        state = sampler.init(rbm, n_data, generator=generator)
        positive = positive_phase(rbm, _data(rbm, n_data, seed=6))
        other = sampler.sample(rbm, state, positive, generator=generator).configurations
        _check(other.v.equal(answer.v), f"{name} says uses_data = False, but other data give another answer")


def _check_configurations(name: str, configurations: Configurations, rbm: EnergyModel, *, signed: bool) -> None:
    v, h, weight = configurations
    _check(v.shape[:-2] == rbm.replicas, f"{name}: v has shape {tuple(v.shape)}, replicas are {rbm.replicas}")
    _check(v.shape[-1] == rbm.n_visible, f"{name}: last axis of v is {v.shape[-1]}, not {rbm.n_visible}")
    _check(h.shape == (*v.shape[:-1], rbm.n_hidden), f"{name}: h has shape {tuple(h.shape)}")
    for layer, kind, x in (("v", rbm.visible, v), ("h", rbm.hidden, h)):
        _check(not x.requires_grad, f"{name}: {layer} carries a gradient")
        if signed:
            continue  # points of an identity, no values
        try:
            kind.check(x)
        except SettingError as error:
            raise AssertionError(f"{name}: {layer} leaves what its units allow: {error}") from None
    if weight is not None:
        _check(weight.shape == v.shape[:-1], f"{name}: weight has shape {tuple(weight.shape)}")
        positive = (signed or bool((weight >= 0).all())) and bool((weight.sum(-1) > 0).all())
        _check(positive and bool(weight.isfinite().all()), f"{name}: weights must be finite, >= 0, not all 0")


def check_solver(solver: QuboSolver, *, finds_optimum: bool = True) -> None:
    """Run a QUBO solver on small problems of every layout and check the contract.

    Checked: shapes, assignments in {0, 1}, energies in float64 that are those of the assignments and never
    below the true minimum, the same answer from the same stream, no draw from the global stream, the problem left
    alone; the true minimum unless told otherwise; and extreme problems: no couplings, one variable, all zeros,
    weights of 1e-30 and 1e30.

    Raises:
        AssertionError: Naming what the solver got wrong.
    """
    name = type(solver).__name__
    matrix = torch.empty(7, 7, dtype=torch.float32, device="cpu").normal_(generator=rng.stream(3, "matrix"))
    batch = torch.empty(2, 3, 5, 5, dtype=torch.float32, device="cpu").normal_(generator=rng.stream(4, "matrix"))
    problems = {
        "RBM": from_model(small_rbm()),
        "two axes of RBMs": from_model(small_rbm(replicas=(2, 3))),
        "dense": Qubo.from_matrix(matrix, offset=torch.tensor(1.5)),
        "batch of dense": Qubo.from_matrix(batch),
        "no couplings": Qubo.from_matrix(torch.diag(torch.tensor([1.0, -2.0, 0.0]))),
        "one variable": Qubo.from_matrix(torch.tensor([[-3.0]])),
        "all zeros": Qubo.from_matrix(torch.zeros(5, 5)),
        "tiny weights": Qubo.from_matrix(matrix * 1e-30),
        "huge weights": Qubo.from_matrix(matrix * 1e30),
    }
    for label, qubo in problems.items():
        exact = BruteForce().minimise(qubo, generator=rng.stream(0, "unused")).best_energy
        global_state, before = torch.get_rng_state(), [part.clone() for part in _numbers(qubo)]
        solution, again = (solver.minimise(qubo, generator=rng.stream(5, "solver")) for _ in range(2))
        where = f"{name} on {label}"
        _check(global_state.equal(torch.get_rng_state()), f"{where} drew from torch's global random stream")
        unchanged = all(a.equal(b) for a, b in zip(before, _numbers(qubo), strict=True))
        _check(unchanged, f"{where} changed the problem")
        shape = solution.energies.shape
        _check(shape[:-1] == qubo.problems, f"{where}: energies have shape {tuple(shape)}")
        _check(solution.assignments.shape == (*shape, qubo.n), f"{where}: assignments of another shape")
        _check(solution.energies.dtype == torch.float64, f"{where}: energies must be float64")
        _check(bool(((solution.assignments == 0) | (solution.assignments == 1)).all()), f"{where}: not binary")
        _check(solution.best.equal(again.best), f"{where}: same stream, other answer")
        was_run = solution.energies.isfinite()
        same = (solution.energies == qubo.energy(solution.assignments))[was_run]
        _check(bool(same.all()), f"{where}: energies are not those of the assignments")
        tolerance = 1e-12 * (1 + exact.abs())
        _check(bool((solution.best_energy >= exact - tolerance).all()), f"{where}: below the true minimum")
        if finds_optimum:
            tolerance = 1e-6 * exact.abs()
            _check(bool((solution.best_energy <= exact + tolerance).all()), f"{where}: minimum not found")
        fit = solution.status.shape == shape and solution.steps.shape == shape
        _check(fit, f"{where}: status or steps of another shape than energies")


def _numbers(qubo: Qubo) -> tuple[Tensor, ...]:
    return qubo.coupling, qubo.linear, qubo.offset


def _check(condition: bool, message: str) -> None:
    if not condition:
        raise AssertionError(message)
