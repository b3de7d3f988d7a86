"""Every sampler and solver passes the published kit; broken ones do not."""

import dataclasses
from dataclasses import dataclass
from functools import partial

import pytest
import torch

from memcomp_lightning import rng
from memcomp_lightning.enumeration import binary_states
from memcomp_lightning.errors import SettingError
from memcomp_lightning.models import DBN
from memcomp_lightning.models.chains import sweep
from memcomp_lightning.models.units import ReLU
from memcomp_lightning.modules import EnergyPretraining
from memcomp_lightning.problems import Qubo
from memcomp_lightning.samplers import (
    CD,
    PCD,
    BlockAnnealing,
    Exact,
    GroundState,
    ModeAssisted,
    ModeSchedule,
    ParallelTempering,
    PseudoLikelihood,
    Quench,
)
from memcomp_lightning.solvers import (
    AlternatingDescent,
    BruteForce,
    CrossoverAnnealing,
    GibbsAnnealing,
    Portfolio,
    TabuSearch,
)
from memcomp_lightning.solvers.dmm import BondField, DmmSolver, Heun, Recording, WarmRestart
from memcomp_lightning.testing import (
    check_sampler,
    check_solver,
    hidden_kinds,
    small_dbm,
    small_machine,
    small_rbm,
    visible_kinds,
)
from memcomp_lightning.training import Greedy
from memcomp_lightning.types import Configurations, NegativePhase

SOLVERS = {
    "DMM": DmmSolver(n_restarts=11, max_steps=101),
    "DMM with patience": DmmSolver(n_restarts=28, patience=11, max_steps=101),
    "DMM that records": DmmSolver(n_restarts=11, max_steps=101, record=Recording(every=7)),
    "DMM with both": DmmSolver(n_restarts=28, patience=11, max_steps=101, record=Recording(every=7)),
    "DMM with warm restarts": DmmSolver(n_restarts=28, patience=7, max_steps=101, warm=WarmRestart()),
    "DMM with default settings": DmmSolver(),
    "DMM without descents": DmmSolver(n_restarts=67, max_steps=1009, quench_every=0),
    "DMM of bonds": DmmSolver(field=BondField(), n_restarts=11, max_steps=101, record=Recording(every=7)),
    "DMM in plain torch": DmmSolver(n_restarts=11, max_steps=41, kernel="reference"),
    "DMM of bonds in plain torch": DmmSolver(
        field=BondField(), n_restarts=11, max_steps=41, record=Recording(every=7), kernel="reference"
    ),
    "DMM of another scheme": DmmSolver(integrator=Heun(), n_restarts=11, max_steps=41),
    "descent": AlternatingDescent(n_restarts=53),
    "annealing": GibbsAnnealing(n_restarts=53),
    "annealing in plain operations": GibbsAnnealing(n_restarts=53, n_sweeps=20, kernel="reference"),
    "tabu": TabuSearch(n_restarts=11),
    "tabu in plain operations": TabuSearch(n_restarts=11, n_steps=101, kernel="reference"),
    "crossover": CrossoverAnnealing(n_restarts=11, n_sweeps=20),
    "crossover in plain operations": CrossoverAnnealing(
        n_restarts=11, n_sweeps=10, n_rounds=5, kernel="reference"
    ),
    "best": Portfolio(n_restarts=11),
    "brute force": BruteForce(),
    "brute force in chunks": BruteForce(chunk_size=13),
}
ALWAYS = ModeSchedule(n_updates=1, p_max=1.0, delay=-1e3)
NEVER = ModeSchedule(n_updates=1, p_max=0.0)
SAMPLERS = {
    "CD-1": CD(),
    "CD-3": CD(k=3),
    "CD-1 of means": CD(visible="mean", hidden="sample"),
    "PCD": PCD(n_chains=None),
    "PCD with its own chains": PCD(k=3, n_chains=23),
    "PCD with chains for each image": PCD(n_chains=None, chains_per_datum=3),
    "parallel tempering": ParallelTempering(k=3, n_chains=7, n_temperatures=5),
    "parallel tempering of two": ParallelTempering(k=2, n_chains=None, n_temperatures=2),
    "always the mode": ModeAssisted(inner=PCD(), mode=GroundState(solver=BruteForce()), schedule=ALWAYS),
    "never the mode": ModeAssisted(inner=PCD(), mode=GroundState(solver=BruteForce()), schedule=NEVER),
    "exact": Exact(),
    "pseudo-likelihood": PseudoLikelihood(),
    "pseudo-likelihood of two sites": PseudoLikelihood(n_sites=2),
    "quench": Quench(),
    "quench, one start an image": Quench(n_chains=None),
    "annealing in blocks": BlockAnnealing(n_chains=7, n_sweeps=5),
    "time average": GroundState(
        solver=DmmSolver(n_restarts=5, max_steps=53, record=Recording(every=8)), readout="time_average"
    ),
    "time average with patience": GroundState(
        solver=DmmSolver(n_restarts=11, patience=2, max_steps=53, record=Recording(every=8)),
        readout="time_average",
    ),
}
# How a solver works is none of the sampler's business: these stand for all, with restarts not run, and records.
GROUND_STATES = {
    f"ground state by {name}": GroundState(solver=SOLVERS[name])
    for name in ("DMM", "DMM with both", "DMM with warm restarts", "annealing", "brute force")
}
SAMPLERS |= GROUND_STATES


@pytest.mark.parametrize("sampler", SAMPLERS.values(), ids=SAMPLERS)
def test_sampler_keeps_the_contract(sampler):
    check_sampler(sampler)


V, H = visible_kinds(), hidden_kinds()
MODELS = (
    {f"RBM of {name} and spins": partial(small_rbm, visible=kind, hidden=H["spins"]) for name, kind in V.items()}
    | {f"RBM of categories and {name}": partial(small_rbm, visible=V["categories"], hidden=H[name]) for name in H}
    | {f"DBM of {name}": partial(small_dbm, visible=V[name]) for name in ("categories", "mixed")}
    | {
        f"machine of {name}": partial(small_machine, visible=V[name], hidden=H["spins"])
        for name in ("spins", "categories of several sizes", "mixed")
    }
)
OF_EVERY_KIND = {
    name: SAMPLERS[name]
    for name in (
        "CD-1",
        "PCD",
        "parallel tempering",
        "exact",
        "quench",
        "annealing in blocks",
        "always the mode",
    )
} | {"ground state": GroundState(solver=DmmSolver(n_restarts=4, patience=2, max_steps=11))}


OF_SOLVERS = (
    "RBM of spins and spins",
    "RBM of categories of several sizes and spins",
    "RBM of real and spins",
    "RBM of categories and categories",
    "RBM of categories and rectified",
    "machine of mixed",
)
"""Enough for what calls a solver: test_units_samplers.py has the ground states of the others."""
TRIED = [
    (name, model)
    for name, sampler in OF_EVERY_KIND.items()
    for model in MODELS
    if model in OF_SOLVERS or not isinstance(sampler, GroundState | ModeAssisted)
]


@pytest.mark.parametrize(("name", "model"), TRIED)
def test_sampler_keeps_the_contract_with_units_of_every_kind(name, model):
    make = MODELS[model]
    sampler = OF_EVERY_KIND[name]
    if isinstance(make().hidden, ReLU) and isinstance(sampler, GroundState | ModeAssisted):
        with pytest.raises(
            SettingError, match=r"units = 'ReLU' is not allowed: expected units with a form in bits"
        ):
            check_sampler(sampler, make=make)
    else:
        check_sampler(sampler, make=make)


def test_what_some_units_cannot_do_is_refused_by_name():
    real, of_states = small_rbm(visible=V["real"]), small_rbm(visible=V["categories"])
    stream = rng.stream(0, "negative_phase")
    with pytest.raises(SettingError, match=r"visible = 'mean' is not allowed: expected 'sample' for real units"):
        CD(visible="mean").init(real, 3, generator=stream)
    check_sampler(CD(visible="mean"), make=partial(small_rbm, visible=V["real of fixed precision"]))
    check_sampler(CD(visible="mean"), make=partial(small_rbm, visible=V["categories"]))
    with pytest.raises(SettingError, match=r"readout = 'time_average' is not allowed: expected 'best' for categ"):
        SAMPLERS["time average"].init(of_states, 3, generator=stream)
    check_sampler(SAMPLERS["time average"], make=partial(small_rbm, visible=V["real"], hidden=H["spins"]))


OF_TWO_LAYERS = ("CD-1 of means",)


@pytest.mark.parametrize("make", [small_dbm, small_machine])
@pytest.mark.parametrize("name", [name for name in SAMPLERS if name not in OF_TWO_LAYERS])
def test_sampler_keeps_the_contract_for_any_connectivity(name, make):
    check_sampler(SAMPLERS[name], make=make)


@pytest.mark.parametrize("name", OF_TWO_LAYERS)
def test_what_needs_two_layers_says_so(name):
    with pytest.raises(SettingError, match=r"for a model other than an RBM"):
        check_sampler(SAMPLERS[name], make=small_dbm)


@pytest.mark.parametrize("solver", SOLVERS.values(), ids=SOLVERS)
def test_solver_keeps_the_contract(solver):
    check_solver(solver)


def test_solver_with_too_few_steps_keeps_all_but_the_optimum():
    hasty = DmmSolver(n_restarts=2, max_steps=1, quench_every=0)
    check_solver(hasty, finds_optimum=False)
    with pytest.raises(AssertionError, match=r"DmmSolver on .*: minimum not found"):
        check_solver(hasty)


# --- broken samplers --------------------------------------------------------------------------------------


@dataclass(frozen=True, kw_only=True, slots=True)
class BrokenSampler(PCD):
    """A right sampler; what breaks it is one method a subclass."""


class ChangesItsState(BrokenSampler):
    def sample(self, model, state, positive, *, generator):
        state.x.copy_(sweep(model, state.x, generator=generator))
        return NegativePhase(Configurations(state.x, model.hidden_mean(state.x).detach()), state, {})


class DrawsFromTheGlobalStream(BrokenSampler):
    def sample(self, model, state, positive, *, generator):
        torch.empty(3).normal_()
        return PCD.sample(self, model, state, positive, generator=generator)


class DrawsFromTheGlobalStreamAtInit(BrokenSampler):
    def init(self, model, n_chains, *, generator):
        torch.empty(3).normal_()
        return PCD.init(self, model, n_chains, generator=generator)


class CarriesAGradient(BrokenSampler):
    def sample(self, model, state, positive, *, generator):
        v = model.visible_mean(model.hidden_mean(state.x))
        return NegativePhase(Configurations(v, model.hidden_mean(v).detach()), state, {})


def wraps(change):
    """A sampler whose answer is changed by ``change(negative, model)``."""

    class Wrapped(BrokenSampler):
        def sample(self, model, state, positive, *, generator):
            return change(PCD.sample(self, model, state, positive, generator=generator), model)

    return Wrapped


def with_configurations(**changes):
    def change(negative, model):
        parts = {name: make(negative.configurations, model) for name, make in changes.items()}
        return negative._replace(configurations=negative.configurations._replace(**parts))

    return wraps(change)


class ChangesTheModel(BrokenSampler):
    def sample(self, model, state, positive, *, generator):
        with torch.no_grad():
            model.b += 0.1
        return PCD.sample(self, model, state, positive, generator=generator)


class IgnoresTheStream(BrokenSampler):
    def sample(self, model, state, positive, *, generator):
        generator.manual_seed(CALLS.append(0) or len(CALLS))
        return PCD.sample(self, model, state, positive, generator=generator)


CALLS = []

BROKEN_SAMPLERS = [
    (ChangesItsState, "changed the state it was given"),
    (DrawsFromTheGlobalStream, "drew from torch's global random stream"),
    (DrawsFromTheGlobalStreamAtInit, "drew from torch's global random stream"),
    (CarriesAGradient, "v carries a gradient"),
    (ChangesTheModel, "changed the model"),
    (IgnoresTheStream, "same stream, other answer"),
    (with_configurations(v=lambda x, model: 2 * x.v - 1), r"v leaves what its units allow: v in column"),
    (
        with_configurations(h=lambda x, model: model.hidden_field(x.v).detach()),
        r"h leaves what its units allow: v in column",
    ),
    (with_configurations(h=lambda x, model: x.h[..., 1:]), "h has shape"),
    (with_configurations(v=lambda x, model: x.v[..., 1:]), "last axis of v is 6, not 7"),
    (with_configurations(h=lambda x, model: model.hidden_mean(x.v)), "h carries a gradient"),
    (with_configurations(weight=lambda x, model: -x.v.sum(-1)), "weights must be finite, >= 0, not all 0"),
    (with_configurations(weight=lambda x, model: 0 * x.v[..., 0]), "weights must be finite, >= 0, not all 0"),
    (with_configurations(weight=lambda x, model: x.v), "weight has shape"),
    (
        wraps(lambda negative, model: negative._replace(info={"energy": model.weight.sum()})),
        r"info\['energy'\] carries a gradient",
    ),
    (
        wraps(lambda negative, model: negative._replace(info={"energy": torch.zeros(11)})),
        r"info\['energy'\] has shape",
    ),
]


@pytest.mark.parametrize(("broken", "message"), BROKEN_SAMPLERS, ids=[message for _, message in BROKEN_SAMPLERS])
@pytest.mark.usefixtures("allow_global_rng")
def test_kit_refuses_a_broken_sampler(broken, message):
    with pytest.raises(AssertionError, match=f"^{broken.__name__}.*{message}"):
        check_sampler(broken())


def test_kit_accepts_the_sampler_that_the_broken_ones_derive_from():
    check_sampler(BrokenSampler())


def test_kit_refuses_settings_that_can_be_changed():
    @dataclass
    class Thawed:
        k: int = 1
        init = PCD.init
        sample = PCD.sample
        uses_data, shared, n_chains = False, False, None

    with pytest.raises(AssertionError, match=r"^Thawed: the setting 'k' can be changed; freeze the class"):
        check_sampler(Thawed())


def test_kit_refuses_what_is_no_sampler_and_states_that_no_checkpoint_keeps():
    with pytest.raises(SettingError, match=r"sampler = 'PCD' is not allowed: expected .* an object, no class"):
        check_sampler(PCD)

    class Forgetful:
        uses_data, shared = True, False

        def init(self, model, n_chains, *, generator):
            return {"chain": torch.zeros(3)}

        def sample(self, model, state, positive, *, generator):
            return NegativePhase(positive, state, {})

    with pytest.raises(SettingError, match="state of the sampler = 'dict' is not allowed: expected a NamedTuple"):
        check_sampler(Forgetful())
    with pytest.raises(SettingError, match="state of the sampler = 'dict'"):
        EnergyPretraining(Greedy(DBN(4, [3])), Forgetful())


# --- broken solvers ---------------------------------------------------------------------------------------


def solver_with(change):
    class BrokenSolver:
        def minimise(self, qubo, *, generator):
            return change(BruteForce().minimise(qubo, generator=generator), qubo)

    return BrokenSolver()


def replaced(**changes):
    def change(solution, qubo):
        parts = {name: make(solution, qubo) for name, make in changes.items()}
        return dataclasses.replace(solution, **parts)

    return solver_with(change)


class GlobalSolver:
    def minimise(self, qubo, *, generator):
        torch.empty(3).normal_()
        return BruteForce().minimise(qubo, generator=generator)


class ChangesTheProblem:
    def minimise(self, qubo, *, generator):
        qubo.linear.add_(1)
        solution = BruteForce().minimise(qubo, generator=generator)
        return dataclasses.replace(solution, energies=qubo.energy(solution.assignments))


class StreamlessSolver:
    def minimise(self, qubo, *, generator):
        # Of many restarts, so that two answers are never the same by chance.
        generator.manual_seed(CALLS.append(0) or len(CALLS))
        return AlternatingDescent(n_restarts=16).minimise(qubo, generator=generator)


def highest_state(solution, qubo):
    states = binary_states(qubo.n, like=qubo.linear).expand(*qubo.problems, -1, -1)
    index = qubo.energy(states).argmax(-1)
    return states.take_along_dim(index[..., None, None], dim=-2)


BROKEN_SOLVERS = {
    "energies are not those of the assignments": replaced(energies=lambda s, q: s.energies - 1),
    "energies must be float64": replaced(energies=lambda s, q: s.energies.float()),
    "not binary": replaced(assignments=lambda s, q: 2 * s.assignments - 1),
    "assignments of another shape": replaced(assignments=lambda s, q: s.assignments[..., 1:]),
    "energies have shape": replaced(energies=lambda s, q: s.energies.flatten()[None, None, None]),
    "status or steps": replaced(status=lambda s, q: s.status[..., 0]),
    "minimum not found": replaced(assignments=highest_state, energies=lambda s, q: q.energy(highest_state(s, q))),
    "drew from torch's global random stream": GlobalSolver(),
    "changed the problem": ChangesTheProblem(),
    "same stream, other answer": StreamlessSolver(),
}


@pytest.mark.parametrize(("message", "solver"), BROKEN_SOLVERS.items(), ids=BROKEN_SOLVERS)
@pytest.mark.usefixtures("allow_global_rng")
def test_kit_refuses_a_broken_solver(message, solver):
    with pytest.raises(AssertionError, match=f"^{type(solver).__name__} on .*{message}"):
        check_solver(solver)


def test_kit_refuses_an_energy_below_the_minimum(monkeypatch):
    """Only a wrong energy function gets there: elsewhere the energies are compared with it first."""
    energy = Qubo.energy

    class Lowered:
        def minimise(self, qubo, *, generator):
            solution = BruteForce().minimise(qubo, generator=generator)
            monkeypatch.setattr(Qubo, "energy", lambda self, x: energy(self, x) - 1)
            return dataclasses.replace(solution, energies=qubo.energy(solution.assignments))

    with pytest.raises(AssertionError, match=r"^Lowered on .*: below the true minimum"):
        check_solver(Lowered())
