"""Brute force and descent against all energies; all solvers with numpy and with torch."""

import dataclasses
import subprocess
import sys

import numpy as np
import pytest
import torch

from memcomp_lightning import rng
from memcomp_lightning.arrays import to_numpy
from memcomp_lightning.enumeration import binary_states
from memcomp_lightning.errors import SettingError
from memcomp_lightning.problems import Bipartite, EdgeList, Qubo, WeightedMaxSat, from_model
from memcomp_lightning.solvers import (
    AlternatingDescent,
    BranchAndBound,
    BruteForce,
    CrossoverAnnealing,
    GibbsAnnealing,
    Portfolio,
    Status,
    TabuSearch,
)
from memcomp_lightning.solvers.dmm import BondField, ClauseField, DmmSolver, Recording, WarmRestart
from memcomp_lightning.testing.conformance import small_rbm


def matrix(*shape):
    return torch.empty(shape, dtype=torch.float64).normal_(generator=rng.stream(0, "test draws"))


PROBLEMS = {
    "model 7 x 5": from_model(small_rbm(7, 5).double()),
    "models 5 x 7": from_model(small_rbm(5, 7, replicas=(2, 3)).double()),
    "dense": Qubo.from_matrix(matrix(11, 11), matrix()),
    "batch of dense": Qubo.from_matrix(matrix(2, 3, 7, 7), matrix(2, 3)),
}


@pytest.fixture(params=PROBLEMS)
def qubo(request):
    return PROBLEMS[request.param]


def all_states(qubo):
    states = binary_states(qubo.n, like=qubo.linear)
    return states.expand(*qubo.problems, *states.shape)


def solve(solver, qubo, seed=0):
    return solver.minimise(qubo, generator=rng.stream(seed, "solver"))


@pytest.mark.parametrize("chunk_size", [2**16, 13])
def test_brute_force_is_the_minimum_over_all_states(qubo, chunk_size):
    solution = solve(BruteForce(chunk_size=chunk_size), qubo)
    lowest, index = qubo.energy(all_states(qubo)).min(-1)
    torch.testing.assert_close(solution.best_energy, lowest, rtol=1e-13, atol=0)
    expected = all_states(qubo).take_along_dim(index[..., None, None], dim=-2).squeeze(-2)
    assert solution.best.equal(expected)
    assert solution.energies.shape == (*qubo.problems, 1)
    assert (solution.status == Status.OPTIMAL).all()


def test_brute_force_refuses_more_variables_than_allowed():
    with pytest.raises(SettingError, match=r"variables to enumerate = 11 .* at most max_variables = 7"):
        solve(BruteForce(max_variables=7), PROBLEMS["dense"])


def test_brute_force_counts_the_smaller_layer_of_a_model():
    qubo = PROBLEMS["model 7 x 5"]
    assert solve(BruteForce(max_variables=5), qubo).steps.tolist() == [32]
    with pytest.raises(SettingError, match="variables to enumerate = 5"):
        solve(BruteForce(max_variables=3), qubo)


def test_descent_never_rises(qubo):
    energies = torch.stack(
        [solve(AlternatingDescent(n_restarts=23, max_sweeps=k), qubo).energies for k in range(1, 8)]
    )
    assert (energies.diff(dim=0) <= 1e-12).all()
    assert (energies.diff(dim=0) < -1e-3).any()


def test_descent_first_sweep_does_not_rise_above_the_start(qubo):
    shape = (*qubo.problems, 23, qubo.n)
    start = (rng.uniform(shape, generator=rng.stream(0, "solver"), like=qubo.linear) < 0.5).double()
    after = solve(AlternatingDescent(n_restarts=23, max_sweeps=1), qubo).energies
    assert (after <= qubo.energy(start) + 1e-12).all()


def test_descent_ends_where_no_block_improves(qubo):
    solution = solve(AlternatingDescent(n_restarts=23), qubo)
    assert (solution.status == Status.CONVERGED).all()
    for block in qubo.graph.blocks():
        width = block.stop - block.start
        for setting in binary_states(width, like=qubo.linear):
            other = solution.assignments.clone()
            other[..., block] = setting
            assert (qubo.energy(other) >= solution.energies - 1e-12).all()


def test_descent_with_many_restarts_finds_the_minimum(qubo):
    best = solve(AlternatingDescent(n_restarts=211), qubo).best_energy
    torch.testing.assert_close(best, solve(BruteForce(), qubo).best_energy)


def test_descent_says_when_its_sweeps_were_used_up():
    solution = solve(AlternatingDescent(n_restarts=23, max_sweeps=1), PROBLEMS["dense"])
    assert (solution.status == Status.STEP_BUDGET).any()
    assert (solution.steps == 1).all()


def test_best_is_the_restart_of_lowest_energy(qubo):
    solution = solve(AlternatingDescent(n_restarts=23), qubo)
    assert solution.best.shape == (*qubo.problems, qubo.n)
    torch.testing.assert_close(qubo.energy(solution.best.unsqueeze(-2)).squeeze(-1), solution.energies.amin(-1))


def test_messages_count_the_restarts_with_advice():
    solution = solve(AlternatingDescent(n_restarts=23), PROBLEMS["batch of dense"])
    assert solution.messages() == {f"CONVERGED: {Status.CONVERGED.advice}": 6 * 23}


@pytest.mark.parametrize("name", ["model 7 x 5", "models 5 x 7"])
def test_branch_and_bound_proves_the_minimum(name):
    qubo = PROBLEMS[name]
    solution = solve(BranchAndBound(), qubo)
    torch.testing.assert_close(solution.best_energy, solve(BruteForce(), qubo).best_energy, rtol=1e-13, atol=0)
    assert (solution.status == Status.OPTIMAL).all()
    assert (solution.steps < 2**6).all()


@pytest.mark.parametrize(("n_visible", "n_hidden"), [(23, 17), (17, 23)])
def test_branch_and_bound_finds_what_descent_misses(n_visible, n_hidden):
    """Mean-cancelled couplings, of which descent rarely finds the minimum."""
    weight = matrix(5, n_hidden, n_visible)
    rbm = small_rbm(n_visible, n_hidden, replicas=(5,)).double()
    with torch.no_grad():
        rbm.weight.copy_(weight)
        rbm.b.copy_(-weight.sum(-2) / 2)
        rbm.c.copy_(-weight.sum(-1) / 2)
    qubo = from_model(rbm)
    solution = solve(BranchAndBound(), qubo)
    assert (solution.status == Status.OPTIMAL).all()
    torch.testing.assert_close(solution.best_energy, solve(BruteForce(), qubo).best_energy, rtol=1e-12, atol=0)
    assert (solution.best_energy < solve(AlternatingDescent(n_restarts=3), qubo).best_energy - 1e-6).any()


def test_branch_and_bound_says_when_it_gave_up():
    solution = solve(BranchAndBound(max_nodes=3), PROBLEMS["models 5 x 7"])
    assert (solution.status == Status.STEP_BUDGET).all()
    assert torch.isfinite(solution.energies).all()


def test_branch_and_bound_refuses_other_graphs():
    with pytest.raises(SettingError, match="takes two fully coupled layers"):
        solve(BranchAndBound(), PROBLEMS["dense"])


def test_annealing_finds_the_minimum(qubo):
    best = solve(GibbsAnnealing(n_restarts=53, n_sweeps=101), qubo).best_energy
    torch.testing.assert_close(best, solve(BruteForce(), qubo).best_energy)


def test_annealing_beats_as_many_descents():
    qubo = from_model(small_rbm(31, 29).double())
    annealed = solve(GibbsAnnealing(n_restarts=101), qubo).energies
    descended = solve(AlternatingDescent(n_restarts=101), qubo).energies
    assert annealed.mean() < descended.mean()


# ------------------------------------------------------------------------------------------------ proofs


def test_brute_force_of_integers_compares_them_as_integers():
    """The two states of lowest energy differ by 1 in 2^60."""
    rows, columns = torch.tensor([0, 1, 0]), torch.tensor([0, 1, 1])
    values = torch.tensor([-(2**60), -(2**60) - 1, 2**61])
    exact = solve(BruteForce(), Qubo.from_coo(2, rows, columns, values))
    assert exact.best.tolist() == [0, 1]
    assert exact.status.tolist() == [Status.OPTIMAL]
    rounded = solve(BruteForce(), Qubo.from_coo(2, rows, columns, values.double()))
    assert rounded.status.tolist() == [Status.ROUNDED]


def test_brute_force_of_integers_in_two_layers():
    qubo = integer_layers(4, 3, -(2**40), 0)
    exact = Qubo(qubo.graph, qubo.coupling.long(), qubo.linear.long(), qubo.offset.long())
    assert solve(BruteForce(), exact).best_energy.equal(solve(BruteForce(), qubo).best_energy)


def test_brute_force_says_of_each_problem_whether_it_is_proven():
    matrix = torch.tensor([[[3.0, 1.0], [0.0, -1.0]], [[2.0**54, 1.0], [0.0, -1.0]]], dtype=torch.float64)
    assert solve(BruteForce(), Qubo.from_matrix(matrix)).status.flatten().tolist() == [
        Status.OPTIMAL,
        Status.ROUNDED,
    ]


@pytest.mark.parametrize("solver", [BruteForce(), AlternatingDescent(n_restarts=3), GibbsAnnealing(n_restarts=3)])
def test_no_variables_have_one_state(solver):
    nothing = torch.zeros(0, dtype=torch.int64)
    solution = solve(solver, Qubo.from_coo(0, nothing, nothing, torch.zeros(0), torch.tensor(2.5)))
    assert solution.best.shape == (0,)
    assert (solution.energies == 2.5).all()


def integer_layers(n_first, n_second, largest, seed):
    """Two layers of random integers, of which many states are a small part of the energy apart."""
    generator = rng.stream(seed, "test draws")
    draws = [
        torch.randint(-9, 10, shape, generator=generator) for shape in ((n_second, n_first), (n_first + n_second,))
    ]
    coupling, linear = (draw.double() for draw in draws)
    linear[0] = largest
    return Qubo(Bipartite(n_first, n_second), coupling, linear, torch.zeros((), dtype=torch.float64))


@pytest.mark.parametrize("largest", [0, -(2**40)])
def test_branch_and_bound_of_integers_is_exact(largest):
    """A part in 1e9 of the energy is thousands of steps here: a proof to that precision proves nothing."""
    for seed in range(8):
        qubo = integer_layers(7, 5, largest, seed)
        proven, lowest = solve(BranchAndBound(), qubo), solve(BruteForce(), qubo)
        assert proven.best_energy.item() == lowest.best_energy.item()
        assert proven.status.tolist() == lowest.status.tolist() == [Status.OPTIMAL]


def test_branch_and_bound_searches_what_lies_a_step_below_its_descent(monkeypatch):
    qubo = integer_layers(7, 5, -(2**40), 0)
    lowest = solve(BruteForce(), qubo)

    def descend(self, qubo, *, generator):
        """Another state, a few steps above."""
        states = all_states(qubo)
        energies = qubo.energy(states)
        near = states[(energies > lowest.best_energy) & (energies < lowest.best_energy + 9)][:1]
        return dataclasses.replace(lowest, assignments=near, energies=qubo.energy(near))

    monkeypatch.setattr(AlternatingDescent, "minimise", descend)
    assert solve(BranchAndBound(), qubo).best_energy.item() == lowest.best_energy.item()


def test_branch_and_bound_proves_nothing_of_integers_that_float64_rounds():
    assert solve(BranchAndBound(), integer_layers(5, 3, -(2**54), 0)).status.tolist() == [Status.ROUNDED]


# ------------------------------------------------------------------------------------------------ libraries


def machine(field, kernel):
    """Few steps: the libraries round differently, and the machines are chaotic."""
    record, warm = Recording(every=3), WarmRestart()
    return DmmSolver(
        field=field, n_restarts=6, patience=3, max_steps=11, record=record, warm=warm, kernel=kernel, stall=None
    )


SOLVERS = {
    "brute force": BruteForce(),
    "branch and bound": BranchAndBound(),
    "descent": AlternatingDescent(n_restarts=7),
    "annealing, compiled": GibbsAnnealing(n_restarts=7, n_sweeps=5, kernel="compiled"),
    "annealing, reference": GibbsAnnealing(n_restarts=7, n_sweeps=5, kernel="reference"),
    "tabu, compiled": TabuSearch(n_restarts=7, n_steps=30, kernel="compiled"),
    "tabu, reference": TabuSearch(n_restarts=7, n_steps=30, kernel="reference"),
    "crossover, compiled": CrossoverAnnealing(n_restarts=7, n_sweeps=3, n_rounds=4, kernel="compiled"),
    "crossover, reference": CrossoverAnnealing(n_restarts=7, n_sweeps=3, n_rounds=4, kernel="reference"),
    "best": Portfolio(n_restarts=9, effort=0.1),
    "clauses, compiled": machine(ClauseField(), "compiled"),
    "clauses, reference": machine(ClauseField(), "reference"),
    "bonds, compiled": machine(BondField(), "compiled"),
    "bonds, reference": machine(BondField(), "reference"),
}


LITERALS = [[1, 2, 3], [-1, 4, -5], [2, -3, 6, 7], [-2, -4], [5, -6], [-7], [3, 5], [-3, -6, 1]]
CLAUSES = WeightedMaxSat.from_clauses(7, LITERALS, [1.0, 2.0, 1.5, 0.7, 0.4, 0.3, 1.0, 0.9])
EVERY = PROBLEMS | {"MAX-SAT": CLAUSES.alike(torch.zeros(()))}


def takes(solver, problem):
    if isinstance(problem, WeightedMaxSat):
        return isinstance(solver, DmmSolver) and isinstance(solver.field, ClauseField)
    return isinstance(problem.graph, Bipartite) or not isinstance(solver, BranchAndBound)


@pytest.mark.parametrize("draws", [rng.stream, rng.numpy_stream], ids=["draws of torch", "draws of numpy"])
@pytest.mark.parametrize(
    ("name", "problem"),
    [(name, problem) for name in SOLVERS for problem in EVERY if takes(SOLVERS[name], EVERY[problem])],
)
def test_the_same_problem_in_numpy_and_in_torch_has_the_same_answer(name, problem, draws):
    given = EVERY[problem]
    ours, theirs = (
        SOLVERS[name].minimise(one, generator=draws(0, "solver")) for one in (given.alike(np.zeros(())), given)
    )
    for field in ("assignments", "energies", "status", "steps", "best", "best_energy"):
        a, b = getattr(ours, field), getattr(theirs, field)
        assert isinstance(a, np.ndarray | np.generic)
        assert isinstance(b, torch.Tensor)
        rounding = 1e-12 if "energ" in field else 0
        np.testing.assert_allclose(a, b.numpy(), rtol=rounding, atol=rounding, strict=True)
    assert (ours.trajectory is None) == (theirs.trajectory is None)
    for a, b in zip(ours.trajectory or (), theirs.trajectory or (), strict=True):
        assert isinstance(a, np.ndarray)
        np.testing.assert_allclose(a, b.numpy(), rtol=1e-4, atol=1e-4, strict=True)


WITHOUT_TORCH = """
import sys
import numpy as np
import memcomp_lightning.problems, memcomp_lightning.solvers, memcomp_lightning.solvers.dmm
from memcomp_lightning.problems import Qubo
from memcomp_lightning.solvers import BruteForce, GibbsAnnealing
from memcomp_lightning.solvers.dmm import DmmSolver

qubo = Qubo.from_matrix(np.random.default_rng(0).normal(size=(5, 5)))
solvers = BruteForce(), GibbsAnnealing(), DmmSolver(), DmmSolver(kernel="reference")
print(*(solver.minimise(qubo, generator=np.random.default_rng(1)).best_energy for solver in solvers))
assert "torch" not in sys.modules
"""


def test_problems_in_numpy_are_solved_without_torch():
    done = subprocess.run([sys.executable, "-c", WITHOUT_TORCH], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    lowest, *others = map(float, done.stdout.split())
    assert others == pytest.approx([lowest] * 3)
    assert lowest < 0


HEAVY = {"torch", "lightning", "sklearn", "joblib", "tqdm", "pandas", "matplotlib"}


@pytest.mark.parametrize(
    ("arguments", "n", "besides"),
    [
        (["problem=path.txt"], 3, {"scipy", "numba", "dimod"}),
        (["problem=path.txt", "solver=annealing"], 30, set()),
        (["path.txt", "solver=annealing", "seed=0,1", "--output", "table.csv"], 30, set()),
    ],
    ids=["enumerated", "compiled kernels", "a table"],
)
def test_the_command_imports_what_it_needs(tmp_path, arguments, n, besides):
    (tmp_path / "path.txt").write_text(f"{n} {n - 1}\n" + "".join(f"{i} {i + 1} 1\n" for i in range(1, n)))
    program = f"""
import sys
from memcomp_lightning.cli.solve import main
sys.argv[1:] = {arguments}
try:
    main()
except SystemExit as end:
    assert not end.code
print(*({HEAVY | besides} & sys.modules.keys()), file=sys.stderr)
"""
    done = subprocess.run(
        [sys.executable, "-c", program], cwd=tmp_path, capture_output=True, text=True, check=False
    )
    assert (done.returncode, done.stderr.split()) == (0, [])
    assert "cut weight" in done.stdout


@pytest.mark.parametrize("library", ["numpy", "torch"])
@pytest.mark.parametrize(
    "solver",
    [
        AlternatingDescent(),
        GibbsAnnealing(n_sweeps=5),
        GibbsAnnealing(n_sweeps=5, kernel="reference"),
        TabuSearch(n_steps=5),
        TabuSearch(n_steps=5, kernel="reference"),
        CrossoverAnnealing(n_sweeps=2, n_rounds=2),
        CrossoverAnnealing(n_sweeps=2, n_rounds=2, kernel="reference"),
        DmmSolver(n_restarts=6, max_steps=20),
        DmmSolver(n_restarts=6, max_steps=20, kernel="reference"),
    ],
    ids=lambda solver: f"{type(solver).__name__}, {getattr(solver, 'kernel', 'plain')}",
)
def test_whole_numbers_are_searched_as_real_ones(solver, library):
    numbers = np.random.default_rng(0).integers(-9, 10, (40, 40))
    whole = Qubo.from_matrix(numbers if library == "numpy" else torch.from_numpy(numbers))
    found = solver.minimise(whole, generator=rng.numpy_stream(0, "solver"))
    as_real = solver.minimise(whole.double(), generator=rng.numpy_stream(0, "solver"))
    assert (found.assignments == as_real.assignments).all()
    assert (found.energies == as_real.energies).all()
    assert len(np.unique(to_numpy(found.assignments), axis=0)) > 1


def test_pairs_and_numbers_of_two_libraries_become_one():
    pairs = Bipartite(2, 2).edges()
    problem = Qubo(EdgeList(4, pairs), torch.ones(4), torch.ones(4), torch.zeros(()))
    assert problem.energy(torch.ones(1, 4)).tolist() == [8.0]
    read_only = np.broadcast_to(np.ones(()), (4,))
    assert Qubo(Bipartite(2, 2), np.ones((2, 2)), read_only, np.zeros(())).alike(torch.zeros(())).linear.sum() == 4
