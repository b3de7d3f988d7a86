"""The compiled kernels against the readable one, step by step and after many steps."""

import ast
import dataclasses
import inspect
import os
import re
import runpy
import time
from functools import partial
from pathlib import Path
from types import SimpleNamespace

import numba
import numpy as np
import pytest
import torch
from numba.core.dispatcher import Dispatcher

from memcomp_lightning import rng
from memcomp_lightning.likelihood import kernel as likelihood_kernel
from memcomp_lightning.problems import Bipartite, EdgeList, Qubo, WeightedMaxSat, from_qubo
from memcomp_lightning.problems.maxsat import Clauses
from memcomp_lightning.solvers import Status
from memcomp_lightning.solvers.compiled import forget_outdated
from memcomp_lightning.solvers.dmm import BondField, ClauseField, DmmSolver, Recording, Splitting, WarmRestart
from memcomp_lightning.solvers.dmm.kernels import common, cpu, hand_over, lanes, prepare, reference, rows
from memcomp_lightning.solvers.dmm.kernels import digital as digital_state
from memcomp_lightning.solvers.dmm.kernels import fields as compiled_fields
from memcomp_lightning.solvers.dmm.kernels.run import Stall, Start
from memcomp_lightning.solvers.kernels import annealing, branch_and_bound, crossover, tabu

# Small steps and slow memories, so that rounding errors stay small for some steps: the machines are chaotic.
SLOW = Splitting(change=0.3, dt_min=0.01, dt_max=0.4, lag=0.2)
BONDS = BondField(
    alpha=1.5,
    beta=2.0,
    gamma=0.6,
    kappa=1.3,
    delta=0.5,
    zeta=1.5,
    short_term_start=0.3,
    short_term_min=0.02,
    long_term_max=4.0,
    noise=0.0,
    spread=0.9,
    integrator=SLOW,
)
FIELDS = {
    "clauses": ClauseField(
        alpha=2.0,
        beta=1.5,
        gamma=0.25,
        delta=0.1,
        epsilon=0.1,
        zeta=0.0,
        long_term_max=2.0,
        unit_pull=0.8,
        noise=0.0,
        spread=0.8,
        integrator=SLOW,
    ),
    "bonds": BONDS,
    "bonds with moving Y": dataclasses.replace(BONDS, gamma=2.5, delta=4.0, zeta=1.0, long_term_max=1.8),
}
RESTARTS = [1, 8, 17, 28, 33]


def normal(*shape, seed=0):
    return torch.empty(shape).normal_(generator=rng.stream(seed, "test draws"))


def bipartite(n_first, n_second, n_problems, seed=0):
    graph = Bipartite(n_first, n_second)
    shape = (n_problems, *graph.edge_shape)
    coupling, linear = normal(*shape, seed=seed), normal(n_problems, graph.n, seed=seed + 1)
    coupling[normal(*graph.edge_shape, seed=seed + 2).expand(shape) > 1.2] = 0
    return Qubo(graph, coupling, linear, normal(n_problems, seed=seed + 3))


def listed(n, n_problems, seed=0):
    """Every variable has a linear term: rounding decides where a field is exactly 0."""
    used = (normal(n, n, seed=seed + 1) > 0.2) | torch.eye(n, dtype=torch.bool)
    return Qubo.from_matrix(normal(n_problems, n, n, seed=seed) * used, normal(n_problems, seed=seed + 2))


def maxsat(n, n_problems, lengths=((3, 40), (4, 9), (5, 4)), n_pairs=20, seed=0):
    """Pairs, units and longer clauses, padded to five literals."""

    def literals(number, length, seed):
        draw = rng.uniform((number, n), generator=rng.stream(seed, "test draws"))
        return draw.argsort(-1)[:, :length], normal(number, length, seed=seed + 1).sign()

    pairs, polarity = literals(n_pairs, 2, seed)
    return WeightedMaxSat(
        graph=EdgeList(n=n, pairs=pairs),
        weight=normal(n_problems, n_pairs, seed=seed + 2).abs(),
        first=polarity[:, 0],
        second=polarity[:, 1],
        unit=0.5 * normal(n_problems, n, seed=seed + 3),
        offset=normal(n_problems, seed=seed + 4),
        longer=tuple(
            Clauses(*literals(number, length, seed + 10 * length), normal(n_problems, number, seed=length).abs())
            for length, number in lengths
        ),
    )


PROBLEMS = {
    "bipartite 17 + 11": bipartite(17, 11, 2),
    "bipartite 11 + 17": bipartite(11, 17, 2),
    "one bipartite": bipartite(9, 7, 1),
    "listed": listed(13, 3),
    "one listed": listed(13, 1),
}
SCALED = {
    "ferromagnet": Qubo(Bipartite(13, 7), -torch.ones(1, 7, 13), normal(1, 20, seed=9), torch.zeros(1)),
    "fields": Qubo(Bipartite(5, 7), normal(1, 7, 5), 1e4 * normal(1, 12, seed=9), torch.zeros(1)),
}
CLAUSES = {
    "pairs and longer clauses": maxsat(17, 2),
    "3-SAT": maxsat(17, 1, lengths=((3, 70),), n_pairs=0),
    "pairs": maxsat(17, 2, lengths=(), n_pairs=40),
}


EVERY = PROBLEMS | CLAUSES


def cases(*keys):
    """Names of fields with names of problems: bonds have two ends."""
    return pytest.mark.parametrize(
        ("key", "name"), [(key, name) for key in keys for name in EVERY if key == "clauses" or name in PROBLEMS]
    )


def start(problem, n_restarts, field, long_term_max=None, seed=0):
    """Voltages, and seeds of the noise; with memories at rest or kept ones."""
    generator, shape = rng.stream(seed, "start"), (problem.offset.shape[0], n_restarts)
    draw = rng.uniform((*shape, problem.n), generator=generator)
    seeds = torch.randint(2**32, shape, generator=generator)
    kept = ()
    if long_term_max is not None:
        longer = sum(block.weight.shape[-1] for block in getattr(problem, "longer", ()))
        sizes = [problem.graph.edge_shape, (problem.n,), (longer,)]
        if isinstance(problem.graph, Bipartite):
            sizes.pop()
        kept = tuple((long_term_max - 1) * rng.uniform((*shape, *size), generator=generator) for size in sizes)
    return Start(field.spread * (2 * draw - 1), kept, seeds)


def both(field, problem, begin, n_steps=8, quench_every=0, recording=Recording(every=1), stall=None):  # noqa: B008
    settings = {"n_steps": n_steps, "quench_every": quench_every, "recording": recording, "stall": stall}
    return tuple(kernel.run(field, field.integrator, problem, begin, **settings) for kernel in (reference, cpu))


def alike(problem, ours, theirs, tolerance=1e-3):
    torch.testing.assert_close(theirs.voltage, ours.voltage, rtol=0, atol=tolerance)
    for a, b in zip(ours.kept, theirs.kept, strict=False):
        torch.testing.assert_close(b, a, rtol=0, atol=tolerance)
    assert theirs.best.equal(ours.best)
    assert theirs.steps.equal(ours.steps)
    assert (theirs.visited is None) == (ours.visited is None)
    if ours.visited is not None:
        torch.testing.assert_close(theirs.visited.time, ours.visited.time, rtol=1e-3, atol=0)
        assert theirs.visited.states.equal(ours.visited.states)


# --- the same steps ---------------------------------------------------------------------------------------


@cases(*FIELDS)
def test_same_trajectories(key, name):
    field, problem = FIELDS[key], EVERY[name]
    for n_restarts in RESTARTS:
        ours, theirs = both(field, problem, start(problem, n_restarts, field))
        alike(problem, ours, theirs)
        assert not ours.visited.states[:, :, 0].equal(ours.visited.states[:, :, -1])


@cases(*FIELDS)
def test_same_noise(key, name):
    field, problem = dataclasses.replace(FIELDS[key], noise=0.4), EVERY[name]
    begin = start(problem, 17, field)
    ours, theirs = both(field, problem, begin, n_steps=5)
    alike(problem, ours, theirs)
    silent, _ = both(FIELDS[key], problem, begin, n_steps=5)
    assert (silent.voltage - ours.voltage).abs().max() > 0.1


@pytest.mark.parametrize("quench_every", [1, 3])
@pytest.mark.parametrize("name", PROBLEMS)
@pytest.mark.parametrize("key", FIELDS)
def test_same_quenches(key, name, quench_every):
    field, problem = FIELDS[key], PROBLEMS[name]
    ours, theirs = both(field, problem, start(problem, 17, field), quench_every=quench_every)
    alike(problem, ours, theirs)
    ours, _ = both(field, problem, start(problem, 17, field), n_steps=3, quench_every=quench_every)
    plain, _ = both(field, problem, start(problem, 17, field), n_steps=3)
    assert (problem.energy(ours.best) < problem.energy(plain.best) - 1e-3).any()


@pytest.mark.parametrize("recording", [None, Recording(every=3), Recording(every=8), Recording(every=9)], ids=str)
@pytest.mark.parametrize("name", ["bipartite 17 + 11", "listed"])
@pytest.mark.parametrize("key", ["clauses", "bonds"])
def test_same_records(key, name, recording):
    field, problem = FIELDS[key], PROBLEMS[name]
    ours, theirs = both(field, problem, start(problem, 17, field), recording=recording)
    if recording == Recording(every=9):
        assert theirs.visited.states.shape == (problem.offset.shape[0], 17, 0, problem.n)
        return
    alike(problem, ours, theirs)
    _, silent = both(field, problem, start(problem, 17, field), recording=None)
    assert silent.voltage.equal(theirs.voltage)


@cases("clauses", "bonds with moving Y")
def test_same_ways_on_from_kept_memories(key, name):
    field, problem = FIELDS[key], EVERY[name]
    begin = start(problem, 17, field, (1 + field.long_term_max) / 2)
    ours, theirs = both(field, problem, begin, n_steps=5)
    alike(problem, ours, theirs)
    forgot, _ = both(field, problem, begin._replace(kept=()), n_steps=5)
    assert (forgot.voltage - ours.voltage).abs().max() > 0.05


@pytest.mark.parametrize(
    ("name", "quench_every"),
    [("pairs and longer clauses", 0), *((name, k) for name in ("bipartite 17 + 11", "listed") for k in (0, 1, 3))],
)
def test_same_stalls(name, quench_every):
    """A restart that has stalled keeps its voltages and memories, whatever its neighbours do.

    With longer clauses the kernels quench by different flips, which changes when a restart stalls.
    """
    field, problem = FIELDS["clauses"], EVERY[name]
    settings = {"n_steps": 9, "quench_every": quench_every, "recording": None}
    ours, theirs = both(field, problem, start(problem, 33, field), stall=Stall(2, 1.5), **settings)
    alike(problem, ours, theirs)
    assert ours.found_at.equal(theirs.found_at)
    assert len(ours.steps.unique()) > 1
    reading = max(quench_every, 1)
    due = (2 + 1.5 * ours.found_at).div(reading).ceil() * reading
    assert (ours.steps == due.clamp(max=9)).all()
    recorded = both(field, problem, start(problem, 5, field), n_steps=9, stall=Stall(1, 0.0))
    assert all((run.steps == 9).all() for run in recorded)


@pytest.mark.parametrize("key", ["clauses", "bonds"])
def test_memories_are_returned_if_asked_for(key):
    problem, field = PROBLEMS["bipartite 17 + 11"], FIELDS[key]
    begin, settings = start(problem, 5, field), {"n_steps": 8, "quench_every": 1, "recording": None}
    for kernel in (cpu, reference):
        kept, forgotten = (
            kernel.run(field, SLOW, problem, begin, **settings, remember=remember) for remember in (True, False)
        )
        assert kept.kept
        assert not forgotten.kept
        assert kept.voltage.equal(forgotten.voltage)


# --- scaling ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("size", [1e-30, 1.0, 1e30])
@pytest.mark.parametrize("name", ["bipartite 17 + 11", "bipartite 11 + 17", "one bipartite", *SCALED])
@pytest.mark.parametrize("field", [ClauseField(), BondField()], ids=["clauses", "bonds"])
def test_compiled_scaling_is_that_of_the_field(field, name, size):
    """And the padding, which moves nothing, holds zeros."""
    problem = (PROBLEMS | SCALED)[name]
    problem = Qubo(problem.graph, size * problem.coupling, size * problem.linear, problem.offset)
    machine, n_problems = field.build(problem), problem.offset.shape[0]
    found = cpu._prepared(field, problem, problem.graph)
    width, height, n_first, n_second = found.sizes

    def matrix(x, rows=height, columns=width, used=(n_second, n_first)):
        x = torch.from_numpy(x).reshape(n_problems, rows, columns)
        assert not x[:, used[0] :].any()
        assert not x[:, :, used[1] :].any()
        return x[:, : used[0], : used[1]]

    def vector(x):
        x = torch.from_numpy(x)
        assert not x[:, n_first:width].any()
        assert not x[:, width + n_second :].any()
        return torch.cat((x[:, :n_first], x[:, width : width + n_second]), dim=-1)

    if isinstance(field, ClauseField):
        weight, unit, scalars = (
            machine.weight * machine.first,
            machine.unit,
            (machine.stability, 1.0, machine.degree.unsqueeze(-1)),
        )
    else:
        weight, unit, scalars = (
            machine.bond,
            machine.field,
            (1.0, machine.pull_scale.squeeze(-1), found.scalars[:, 2:]),
        )
    close = partial(torch.testing.assert_close, rtol=1e-4, atol=1e-5, check_dtype=False)
    close(matrix(found.weight, n_second + n_second % 2), weight.squeeze(-3))
    close(vector(found.unit), unit.squeeze(-2))
    for ours, theirs in zip(found.scalars.T, scalars, strict=False):
        close(torch.from_numpy(ours.copy()), torch.as_tensor(theirs).expand(n_problems, 1).squeeze(-1))
    coupling, linear = matrix(found.coupling), vector(found.linear)
    ratio = linear / problem.linear
    close(ratio, ratio[:, :1].expand(ratio.shape), rtol=1e-5)
    close(ratio.log2(), ratio.log2().round())
    close(coupling, problem.coupling * ratio[:, :1, None])
    assert matrix(found.transposed, width, height, (n_first, n_second)).equal(coupling.mT)
    assert max(coupling.abs().max(), linear.abs().max()) <= 1


@pytest.mark.parametrize("name", ["bipartite 17 + 11", "listed", "pairs and longer clauses"])
def test_large_steps_of_the_memories_end_at_their_bounds(name):
    """alpha delta dt > 1: an unbounded Euler step of a decaying memory would pass its lower bound."""
    field = dataclasses.replace(
        FIELDS["clauses"],
        alpha=30.0,
        gamma=0.3,
        delta=0.2,
        long_term_max=5.0,
        integrator=Splitting(change=1.0, dt_min=0.5, dt_max=0.5),
    )
    problem = EVERY[name]
    ours, theirs = both(field, problem, start(problem, 17, field, 3.0), n_steps=3)
    for memory in theirs.kept:
        assert (memory >= 0).all()
        assert (memory <= 4).all()
    alike(problem, ours, theirs)


@pytest.mark.parametrize("field", [ClauseField(noise=0.0), BondField(noise=0.0)], ids=["clauses", "bonds"])
@pytest.mark.parametrize("name", PROBLEMS)
def test_same_first_steps_with_the_default_constants(name, field):
    problem = PROBLEMS[name]
    ours, theirs = both(field, problem, start(problem, 17, field), n_steps=2, quench_every=1)
    torch.testing.assert_close(theirs.voltage, ours.voltage, rtol=0, atol=1e-3)
    assert theirs.visited.states.equal(ours.visited.states)


@pytest.mark.parametrize("key", FIELDS)
def test_solver_gives_the_same_answer_with_either_kernel(key):
    """Also with groups of restarts that go on from the ends of earlier ones, problem by problem."""
    for problem in (PROBLEMS["bipartite 17 + 11"], PROBLEMS["listed"]):
        compiled, plain = (
            DmmSolver(
                field=FIELDS[key], n_restarts=12, patience=4, max_steps=5, warm=WarmRestart(), kernel=kernel
            ).minimise(problem, generator=rng.stream(0, "solver"))
            for kernel in ("compiled", "reference")
        )
        assert compiled.assignments.equal(plain.assignments)
        assert compiled.energies.equal(plain.energies)
        assert (compiled.status == Status.NOT_RUN).equal(plain.status == Status.NOT_RUN)


# --- after many steps -------------------------------------------------------------------------------------


def same_success(ours, theirs):
    """Means of the energies found, problem by problem, within five standard errors of their difference."""
    error = ((ours.var(-1) + theirs.var(-1)) / ours.shape[-1]).sqrt()
    assert (error > 0).all()
    return bool(((ours.mean(-1) - theirs.mean(-1)).abs() < 5 * error).all())


@pytest.mark.parametrize(
    ("field", "problem"),
    [
        (ClauseField(), bipartite(37, 41, 3, seed=50)),
        (BondField(), bipartite(37, 41, 3, seed=50)),
        (ClauseField(), listed(71, 3, seed=60)),
        (BondField(), listed(71, 3, seed=60)),
        (ClauseField(), maxsat(40, 2, lengths=((3, 160),), n_pairs=0)),
    ],
    ids=["clauses, bipartite", "bonds, bipartite", "clauses, listed", "bonds, listed", "clauses, 3-SAT"],
)
def test_same_success_after_many_steps(field, problem):
    begin = start(problem, 64, field)
    ours, theirs = (problem.energy(run.best) for run in both(field, problem, begin, n_steps=40, recording=None))
    assert same_success(ours, theirs)
    stopped_early = cpu.run(field, field.integrator, problem, begin, n_steps=8, quench_every=0, recording=None)
    assert not same_success(ours, problem.energy(stopped_early.best))


# --- layouts, batches, lanes and threads ------------------------------------------------------------------


def as_list(qubo):
    """The same problem with its pairs listed."""
    graph = EdgeList(n=qubo.n, pairs=torch.as_tensor(qubo.graph.edges()))
    return Qubo(graph, qubo.coupling.flatten(-2), qubo.linear, qubo.offset)


def as_listed_maxsat(qubo):
    """The MAX-SAT form of a bipartite problem with its pairs listed: the encodings of two layouts differ."""
    clauses = from_qubo(qubo)
    flat = {
        key: getattr(clauses, key).expand(clauses.weight.shape).flatten(-2)
        for key in ("weight", "first", "second")
    }
    return dataclasses.replace(clauses, graph=as_list(qubo).graph, **flat)


@pytest.mark.parametrize("name", ["bipartite 17 + 11", "bipartite 11 + 17", "one bipartite"])
@pytest.mark.parametrize("key", FIELDS)
def test_matrix_and_list_of_the_same_problem_have_the_same_trajectory(key, name):
    """These are two kernels: vectors along the rows of the matrix, vectors along the restarts."""
    field, problem = FIELDS[key], PROBLEMS[name]
    other = as_listed_maxsat(problem) if isinstance(field, ClauseField) else as_list(problem)
    begin = start(problem, 28, field)
    settings = {"n_steps": 8, "quench_every": 0, "recording": Recording(every=1)}
    ours = cpu.run(field, SLOW, problem, begin, **settings)
    theirs = cpu.run(field, SLOW, other, begin, **settings)
    alike(problem, ours._replace(kept=()), theirs)


def bits(run):
    return [run.best, run.found_at, run.voltage, *run.kept, *(run.visited or ())]


def compiled(problem, begin, field, n_steps=150):
    settings = {"n_steps": n_steps, "quench_every": 2, "recording": Recording(every=50)}
    return bits(cpu.run(field, field.integrator, problem, begin, **settings))


EVERY_LAYOUT = ["bipartite 17 + 11", "listed", "pairs and longer clauses"]


@pytest.mark.parametrize("name", EVERY_LAYOUT)
@pytest.mark.parametrize("field", [ClauseField(noise=0.1), BondField()], ids=["clauses", "bonds"])
def test_number_of_threads_does_not_change_a_bit(field, name, threads):
    problem = EVERY[name]
    if name in CLAUSES and isinstance(field, BondField):
        problem = problem.without_longer()
    begin = start(problem, 70, field)
    with threads(1):
        one = compiled(problem, begin, field)
    with threads(2):
        two = compiled(problem, begin, field)
    assert all(a.equal(b) for a, b in zip(one, two, strict=True))


@pytest.mark.parametrize("name", EVERY_LAYOUT)
@pytest.mark.parametrize("field", [ClauseField(noise=0.1), BondField()], ids=["clauses", "bonds"])
def test_other_restarts_do_not_change_a_bit(field, name):
    """Idle lanes, too: 33 restarts take three blocks, five take a narrower one."""
    problem = EVERY[name]
    if name in CLAUSES and isinstance(field, BondField):
        problem = problem.without_longer()
    begin = start(problem, 33, field)
    every = cpu.run(field, field.integrator, problem, begin, n_steps=90, quench_every=0, recording=None)
    few = begin._replace(voltage=begin.voltage[:, 28:], seed=begin.seed[:, 28:])
    some = cpu.run(field, field.integrator, problem, few, n_steps=90, quench_every=0, recording=None)
    assert some.voltage.equal(every.voltage[:, 28:])
    assert all(a.equal(b[:, 28:]) for a, b in zip(some.kept, every.kept, strict=True))


@pytest.mark.parametrize("key", ["clauses", "bonds"])
@pytest.mark.parametrize("name", ["bipartite", "listed"])
def test_other_problems_do_not_matter(name, key):
    field = FIELDS[key]
    problem = bipartite(17, 11, 5, seed=20) if name == "bipartite" else listed(13, 5, seed=30)
    begin = start(problem, 17, field)
    together = compiled(problem, begin, field, n_steps=8)
    for at in range(5):
        one = slice(at, at + 1)
        part = Qubo(problem.graph, problem.coupling[one], problem.linear[one], problem.offset[one])
        alone = compiled(part, Start(begin.voltage[one], (), begin.seed[one]), field, n_steps=8)
        for a, b in zip(together, alone, strict=True):
            torch.testing.assert_close(a[one], b, rtol=1e-4, atol=1e-4)


# --- digital states ---------------------------------------------------------------------------------------


def after_flips(problem, x, energies):
    """Energies after the flip of each variable, ``(n_problems, n_restarts, n)``."""
    change = 1 - 2 * x.double()
    return energies.unsqueeze(-1) + change * problem.field(x.to(torch.get_default_dtype())).double()


@pytest.mark.parametrize("name", EVERY)
@pytest.mark.parametrize("field", [ClauseField(), BondField()], ids=["clauses", "bonds"])
def test_best_is_the_lowest_of_all_states_and_cannot_be_improved_by_a_flip(field, name):
    problem = EVERY[name]
    if name in CLAUSES and isinstance(field, BondField):
        problem = problem.without_longer()
    solver = DmmSolver(
        field=field, n_restarts=33, max_steps=150, quench_every=1, record=Recording(every=1), kernel="compiled"
    )
    solution = solver.minimise(problem, generator=rng.stream(0, "solver"))
    energies = problem.energy(solution.assignments)
    assert solution.energies.equal(energies)
    visited = solution.trajectory.assignments
    lowest = torch.stack([problem.energy(state) for state in visited.unbind(2)], dim=-1).amin(-1)
    assert (energies <= lowest + 1e-5).all()
    assert (after_flips(problem, solution.assignments, energies) >= energies.unsqueeze(-1) - 1e-5).all()
    first = visited[:, :, 0]
    energies = problem.energy(first)
    assert (after_flips(problem, first, energies) < energies.unsqueeze(-1) - 1e-3).any()


@pytest.mark.parametrize("name", EVERY)
def test_best_without_quenches_is_the_state_at_the_step_it_was_found_at(name):
    problem, field = EVERY[name], ClauseField()
    begin = start(problem, 17, field)
    settings = {"n_steps": 100, "quench_every": 0, "recording": Recording(every=1)}
    run = cpu.run(field, field.integrator, problem, begin, **settings)
    states = torch.cat(((begin.voltage > 0).unsqueeze(2), run.visited.states), dim=2)
    assert states.take_along_dim(run.found_at[..., None, None], dim=2).squeeze(2).equal(run.best)
    energies = torch.stack([problem.energy(state) for state in states.unbind(2)], dim=-1)
    torch.testing.assert_close(problem.energy(run.best), energies.amin(-1), rtol=1e-6, atol=1e-6)
    assert (run.found_at > 0).any()


@pytest.mark.parametrize("quench_every", [0, 1])
@pytest.mark.parametrize("name", PROBLEMS)
def test_best_is_said_to_come_when_it_was_first_met(name, quench_every):
    """Not when it was met again with an energy that rounding made lower."""
    problem, field = PROBLEMS[name], FIELDS["bonds"]
    ours, theirs = both(field, problem, start(problem, 33, field), n_steps=20, quench_every=quench_every)
    same = (ours.best == theirs.best).all(-1)
    assert same.float().mean() > 0.8
    assert theirs.found_at[same].equal(ours.found_at[same])


@pytest.mark.parametrize("lanes", [4, 8, 16])
@pytest.mark.parametrize("name", ["listed", *CLAUSES])
def test_local_fields_and_energies_follow_the_flips(name, lanes):
    """In each lane by itself."""
    problem = EVERY[name]
    n_problems, n = problem.offset.shape[0], problem.n
    sparse = hand_over.sparse_of(
        compiled_fields.FIELDS[ClauseField].listed(ClauseField().build(problem)), problem, n_problems
    )
    generator, width = rng.stream(5, "flips"), np.uint64(lanes)
    x0 = (rng.uniform((n, lanes), generator=generator) < 0.5).float()
    for p in range(n_problems):
        offsets, neighbours, coupling, in_clause, clause_of, weight = sparse.digital
        own = (offsets, neighbours, coupling[p], in_clause, clause_of)
        digital = (*own, sparse.variables, sparse.longer_polarity, weight[p])
        x, local, first = x0.numpy().ravel().copy(), np.empty(n * lanes, np.float32), np.empty(lanes)
        true = np.empty(sparse.longer_weight.shape[1] * lanes, np.float32)
        digital_state.local_fields_listed(width, digital, sparse.linear[p], x, local, true, first)
        unit, energy = scale_of(problem, p) / scale_of_arrays(sparse, p), first.copy()

        def check(energy, x=x, local=local, first=first, unit=unit, p=p):
            states, begin = (torch.zeros(n_problems, lanes, n) for _ in range(2))
            states[p], begin[p] = torch.from_numpy(x.reshape(n, lanes).T.copy()), x0.T
            expected, fields = (
                problem.field(states)[p].double(),
                torch.from_numpy(local.reshape(n, lanes).T.copy()),
            )
            torch.testing.assert_close(fields.double() * unit, expected, rtol=1e-4, atol=1e-5)
            change = (problem.energy(states) - problem.energy(begin))[p]
            np.testing.assert_allclose((energy - first) * unit, change, rtol=1e-4, atol=1e-5)

        check(energy)
        for _ in range(60):
            i, before = int(torch.randint(n, (), generator=generator)), x.reshape(n, lanes).copy()
            flips = (rng.uniform((lanes,), generator=generator) < 0.5).numpy()
            change = ((1 - 2 * before[i]) * flips).astype(np.float32)
            energy += change * local.reshape(n, lanes)[i]
            digital_state.flip_listed(width, digital, x, local, true, i, change)
            changed = np.argwhere(x.reshape(n, lanes) != before)
            assert changed.tolist() == [[i, k] for k in np.flatnonzero(flips)]
            check(energy)
        fresh, fresh_true, again = np.empty_like(local), np.empty_like(true), np.empty(lanes)
        digital_state.local_fields_listed(width, digital, sparse.linear[p], x, fresh, fresh_true, again)
        np.testing.assert_allclose(fresh, local, atol=1e-5)
        np.testing.assert_allclose(again, energy, atol=1e-5)
        np.testing.assert_array_equal(fresh_true, true)


def scale_of(problem, p):
    """A number that the kernel divides by its scale: the sum of all parts of the energy."""
    if isinstance(problem, Qubo):
        return float(problem.coupling[p].abs().sum())
    return float(problem.weight[p].sum() + sum(block.weight[p].sum() for block in problem.longer))


def scale_of_arrays(sparse, p):
    return float(np.abs(sparse.digital[2][p]).sum() / 2 + sparse.digital[5][p].sum())


def test_quench_of_the_readable_kernel_ends_where_no_flip_helps():
    for problem in (*PROBLEMS.values(), *CLAUSES.values()):
        x = rng.uniform((problem.offset.shape[0], 23, problem.n), generator=rng.stream(0, "states")) < 0.5
        down = reference.quench(problem, x)
        energies = problem.energy(down)
        assert (energies <= problem.energy(x)).all()
        assert (after_flips(problem, down, energies) >= energies.unsqueeze(-1) - 1e-5).all()


# --- noise ------------------------------------------------------------------------------------------------


def test_noise_is_uniform_and_a_function_of_seed_and_counter():
    seed, counter = torch.tensor([[0], [1], [2**32 - 1]]), torch.arange(20000)
    draw = reference.uniform(seed, counter)
    assert draw.shape == (3, 20000)
    assert draw.min() >= -1
    assert draw.max() < 1
    assert (draw.mean(-1).abs() < 5 / (3 * 20000) ** 0.5).all()
    assert ((draw.square().mean(-1) - 1 / 3).abs() < 0.02).all()
    correlation = (draw[:, 1:] * draw[:, :-1]).mean(-1) * 3
    assert (correlation.abs() < 5 / 20000**0.5).all()
    assert (draw @ draw.T / 20000 * 3 - torch.eye(3)).abs().max() < 5 / 20000**0.5
    assert reference.uniform(seed, counter).equal(draw)
    large = reference.uniform(seed, counter + 2**33)
    assert large.min() >= -1
    assert large.max() < 1


def test_hash_is_that_of_murmur3():
    """Against plain integers."""
    word = 2**32 - 1

    def hashed(seed, counter):
        z = (seed + counter * 0x9E3779B9) & word
        z = ((z ^ (z >> 16)) * 0x85EBCA6B) & word
        z = ((z ^ (z >> 13)) * 0xC2B2AE35) & word
        return ((z ^ (z >> 16)) >> 8) * 2.0**-23 - 1

    for seed in (0, 7, 2**31, word):
        for counter in (0, 1, 12345, 2**31, 2**40 + 3):
            assert reference.uniform(torch.tensor(seed), torch.tensor(counter)).item() == hashed(seed, counter)


# --- the cache --------------------------------------------------------------------------------------------


def test_outdated_kernels_are_removed_though_another_process_does_so_too(tmp_path):
    """A file that is listed and no longer there, here a link to nothing, is no error; a new one stays."""
    for name, age in (("old", 1e9), ("new", 0)):
        path = tmp_path / f"lanes.{name}.nbi"
        path.touch()
        os.utime(path, (time.time() - age,) * 2)
    (tmp_path / "lanes.gone.nbi").symlink_to("nowhere")
    kernel = SimpleNamespace(
        stats=SimpleNamespace(cache_path=str(tmp_path)), py_func=lanes.integrate_all.py_func, __name__="new"
    )
    forget_outdated.__wrapped__(kernel, (lanes,))
    assert {path.name for path in tmp_path.iterdir()} == {"lanes.gone.nbi", "lanes.new.nbi"}


# --- a field of another package -----------------------------------------------------------------------------


def test_passes_of_the_page_take_the_same_steps(monkeypatch):
    """The example of docs/extending.md: one row of the table, and the kernel integrates its field."""
    # Compiled here and now: most of the time would be that of making it fast.
    monkeypatch.setattr(numba.config, "OPT", 0)
    page = (Path(__file__).parents[4] / "docs/extending.md").read_text(encoding="utf-8")
    (block,) = [b for b in re.findall(r"```python\n(.*?)```", page, flags=re.DOTALL) if "class Gradient" in b]
    made = {}
    exec(compile(block, "extending.md", "exec"), made)
    try:
        field = made["fast"].field
        for name in ("listed", "bipartite 17 + 11"):
            begin = start(PROBLEMS[name], 17, field)
            alike(PROBLEMS[name], *both(field, PROBLEMS[name], begin, n_steps=20, quench_every=3))
        kept = [part for part in vars(lanes).values() if isinstance(part, Dispatcher) and part.stats.cache_path]
        assert "Downhill" not in str([part.signatures for part in kept]), "on disk it is of no use to anybody"
        runpy.run_path(cpu.__file__)  # imported for the first time after the field is there
    finally:
        del compiled_fields.FIELDS[made["Gradient"]]


def test_outdated_passes_of_our_own_fields_are_found():
    """Wherever they lie, a change of them makes the kernels on disk old."""
    rows = compiled_fields.FIELDS.values()
    of_fields = {part.py_func.__module__ for row in rows for part in (row.start, row.advance)}
    of_fields -= {"documentation"}  # of the page that another test has run
    assert of_fields
    assert of_fields <= {module.__name__ for module in cpu._INLINED}


# --- the same code in every process ------------------------------------------------------------------------


ENTRIES = {"rows.integrate_all", "lanes.integrate_all", "prepare.prepare", "branch_and_bound.search"}
ENTRIES |= {
    "kernel.sum_over_second",
    "annealing.anneal_layers",
    "annealing.anneal_pairs",
    "tabu.search",
    "crossover.evolve",
}


def test_constants_have_the_names_of_their_places():
    for names in (common.CONSTANTS, common.CONTROL):
        assert [getattr(common, name.upper()) for name in names] == list(range(len(names)))


COMPILED = [
    common,
    digital_state,
    rows,
    lanes,
    prepare,
    branch_and_bound,
    annealing,
    crossover,
    tabu,
    likelihood_kernel,
]


@pytest.mark.parametrize("module", COMPILED, ids=lambda module: module.__name__)
def test_arrays_of_a_kernel_are_contiguous(module):
    """Numba takes the rows of an array that is unpacked for strided ones, which vector code cannot read."""
    for node in ast.walk(ast.parse(inspect.getsource(module))):
        if isinstance(node, ast.Assign) and isinstance(node.targets[0], ast.Tuple):
            assert not (isinstance(node.value, ast.Call) and "np." in ast.unparse(node.value.func)), node.lineno


@pytest.mark.parametrize("module", COMPILED, ids=lambda module: module.__name__)
def test_what_a_kernel_calls_becomes_a_part_of_it(module):
    """Else the process that compiles it runs other machine code than those that load it, with other last bits.

    There the linker finds two copies of a called function, of which one was optimised alone.
    """
    functions = {name: part for name, part in vars(module).items() if isinstance(part, Dispatcher)}
    own = {name: part for name, part in functions.items() if part.__module__ == module.__name__}
    assert own
    for name, function in own.items():
        if f"{module.__name__.rpartition('.')[2]}.{name}" not in ENTRIES:
            options = function.targetoptions
            assert options.get("forceinline") or options.get("inline") == "always", name
