"""Couplings and fields of Ising models on a grid, recovered from samples, beside the known ones.

Samples are drawn by the model itself, by exact elimination of rows: independent, so that nothing has to mix.
"""

from collections.abc import Iterator
from functools import partial
from typing import Any, NamedTuple

import numpy as np
import torch
from intervals import interval, shown
from numpy.typing import NDArray
from sklearn.linear_model import LogisticRegression
from torch import Tensor
from torch.optim import Adam

from memcomp_lightning import rng
from memcomp_lightning.data import Batches
from memcomp_lightning.models import DBN, RBM, BoltzmannMachine, Normal
from memcomp_lightning.models.connectivity import grid
from memcomp_lightning.models.units import Spin
from memcomp_lightning.samplers import PCD, GroundState, ModeAssisted, ModeSchedule, PseudoLikelihood
from memcomp_lightning.solvers import GibbsAnnealing
from memcomp_lightning.training import Boltzmann, Greedy, pretrain
from memcomp_lightning.training.schedules import LearningRateDecay

N_ROWS, BATCH = 5_000, 200
RATES = (0.01, 0.03, 0.1)
PASSES = {"64 hidden spins": 300}
"""Passes of models that need more than 20, tried on grids that are not measured; 1,000 were a little better."""
Matrix = NDArray[np.float64]


class Grid(NamedTuple):
    """Couplings to the right ``(side, side - 1)`` and down ``(side - 1, side)``, and fields ``(side, side)``."""

    right: Matrix
    down: Matrix
    field: Matrix

    @classmethod
    def draw(cls, side: int, kind: str, generator: np.random.Generator) -> "Grid":
        """Couplings of -0.5 and 0.5, or normal ones of that deviation; fields are normal, of deviation 0.2."""

        def couplings(*shape: int) -> Matrix:
            if kind == "Gaussian":
                return generator.normal(size=shape) * 0.5
            return generator.choice([-0.5, 0.5], shape)

        fields = generator.normal(size=(side, side)) * 0.2
        return cls(couplings(side, side - 1), couplings(side - 1, side), fields)

    @property
    def matrix(self) -> Matrix:
        """Symmetric couplings of all pairs of sites, ``(n, n)``."""
        side = len(self.field)
        site, found = np.arange(side**2).reshape(side, side), np.zeros((side**2, side**2))
        found[site[:, :-1], site[:, 1:]] = self.right
        found[site[:-1], site[1:]] = self.down
        return found + found.T

    def energy(self, spins: Matrix) -> Matrix:
        """E of states ``(..., side, side)``."""
        pairs = (self.right * spins[..., :-1] * spins[..., 1:]).sum((-1, -2))
        pairs += (self.down * spins[..., :-1, :] * spins[..., 1:, :]).sum((-1, -2))
        return -pairs - (self.field * spins).sum((-1, -2))

    def sample(self, n: int, generator: np.random.Generator) -> tuple[Matrix, float]:
        """Independent states ``(n, side, side)``, and log Z: sites are summed one by one, then drawn backwards.

        ``weights[k]`` has, for the last ``side`` sites before site k, the sum of all weights of the sites before
        them; a state of ``side`` spins is a binary number whose lowest bit is the newest.
        """
        side = len(self.field)
        number = np.arange(2**side)
        newest, oldest = 2 * (number & 1) - 1, 2 * (number >> (side - 1)) - 1
        log_weight, kept = np.zeros(2**side), list[Matrix]()
        for k in range(side**2):
            row, column = divmod(k, side)
            total = np.full((2**side, 2), -np.inf)
            for bit in (0, 1):
                spin = 2 * bit - 1
                gain = np.full(2**side, self.field[row, column] * spin)
                if column:
                    gain += self.right[row, column - 1] * newest * spin
                if row:
                    gain += self.down[row - 1, column] * oldest * spin
                total[:, bit] = log_weight + gain
            if k < side:  # nothing is above the first row: only zeros stand there
                total[number >= 2**k] = -np.inf
            kept.append(total)
            after = np.full(2**side, -np.inf)
            moved = (2 * number[:, None] + np.arange(2)) % 2**side
            np.logaddexp.at(after, moved, total)
            log_weight = after
        log_z = float(np.logaddexp.reduce(log_weight))
        state = generator.choice(2**side, n, p=np.exp(log_weight - log_z))
        spins = np.empty((n, side**2))
        for k in reversed(range(side**2)):
            bit = state & 1
            spins[:, k] = 2 * bit - 1
            # What stood before: the oldest spin was 0 or 1.
            low = state >> 1
            zero, one = kept[k][low, bit], kept[k][low + 2 ** (side - 1), bit]
            top = generator.random(n) < 1 / (1 + np.exp(np.clip(zero - one, -700, 700)))
            state = low + 2 ** (side - 1) * top
        return spins.reshape(n, side, side), log_z


class Data(NamedTuple):
    """Rows of several seeds, ``(n_seeds, rows, n)``, and what they were drawn from."""

    rows: Tensor
    coupling: Matrix
    field: Matrix


def data_of(side: int, kind: str, seeds: list[int], n_rows: int) -> Data:
    rows, coupling, field = list[Matrix](), list[Matrix](), list[Matrix]()
    for seed in seeds:
        generator = rng.numpy_stream(seed, f"ising {kind}")
        known = Grid.draw(side, kind, generator)
        rows.append(known.sample(n_rows, generator)[0].reshape(n_rows, -1))
        coupling.append(known.matrix)
        field.append(known.field.ravel())
    return Data(torch.tensor(np.stack(rows), dtype=torch.float32), np.stack(coupling), np.stack(field))


class Errors(NamedTuple):
    """One number a seed: root mean squares of errors, and a correlation with the known couplings of all pairs."""

    bonds: list[float]
    other_pairs: list[float]
    fields: list[float]
    correlation: list[float]

    @classmethod
    def of(cls, data: Data, coupling: Matrix, field: Matrix) -> "Errors":
        n, found = data.rows.shape[-1], list[tuple[float, ...]]()
        upper = np.triu_indices(n, 1)
        for true, own, true_field, own_field in zip(data.coupling, coupling, data.field, field, strict=True):
            difference, bond = (own - true)[upper], true[upper] != 0
            of_bonds, of_others = difference[bond], difference[~bond]
            rms = [float(np.sqrt((x**2).mean())) for x in (of_bonds, of_others, own_field - true_field)]
            found.append((*rms, float(np.corrcoef(own[upper], true[upper])[0, 1])))
        return cls(*map(list, zip(*found, strict=True)))


def logistic(data: Data) -> tuple[Matrix, Matrix]:
    """The largest pseudo-likelihood, by a logistic regression for each site, couplings averaged over both ends."""
    n_seeds, _, n = data.rows.shape
    coupling, field = np.zeros((n_seeds, n, n)), np.zeros((n_seeds, n))
    for seed, rows in enumerate(data.rows.double().numpy()):
        for site in range(n):
            others = np.delete(np.arange(n), site)
            model = LogisticRegression(C=np.inf, tol=1e-5).fit(rows[:, others], rows[:, site])
            coupling[seed, site, others] = model.coef_[0] / 2
            field[seed, site] = model.intercept_[0] / 2
    return (coupling + coupling.swapaxes(1, 2)) / 2, field


def effective(rbm: RBM, contexts: Tensor, chunk: int = 32) -> tuple[Matrix, Matrix]:
    """Couplings and fields that an RBM of spins has among its visible units, averaged over contexts.

    A coupling is a quarter of F(+-) + F(-+) - F(++) - F(--), a field half of F(-) - F(+) less what the couplings
    give: of a model with couplings of pairs alone they do not depend on the context.
    """
    with torch.no_grad():
        pull, n = rbm.hidden_field(contexts), contexts.shape[-1]
        weight, coupling = rbm.weight.mT, contexts.new_zeros(*rbm.replicas, n, n)

        def cumulant(field: Tensor) -> Tensor:
            return rbm.hidden.cumulant(field).sum(-1)

        alone, pairs = contexts.new_zeros(contexts.shape), all_pairs(n)
        for site in range(n):
            base = pull - contexts[..., site, None] * weight[..., None, site, :]
            shift = weight[..., None, site, :]
            alone[..., site] = (cumulant(base + shift) - cumulant(base - shift)) / 2
        for i, j in (part.T for part in pairs.split(chunk)):
            one, other = (weight[..., k, None, :] for k in (i, j))
            base = pull.unsqueeze(-3)
            base = base - contexts.mT[..., i, :, None] * one - contexts.mT[..., j, :, None] * other
            same = cumulant(base + one + other) + cumulant(base - one - other)
            mean = ((same - cumulant(base + one - other) - cumulant(base - one + other)) / 4).mean(-1)
            coupling[..., i, j] = coupling[..., j, i] = mean
        field = rbm.b + (alone - contexts @ coupling).mean(-2)
        return coupling.double().numpy(), field.double().numpy()


def all_pairs(n: int) -> Tensor:
    return torch.triu_indices(n, n, 1).T


def sampler_of(method: str, n_updates: int) -> Any:
    if "pseudo-likelihood" in method:
        return PseudoLikelihood()
    chains = PCD(k=1, n_chains=BATCH)
    if "mode" not in method:
        return chains
    mode = GroundState(solver=GibbsAnnealing(n_sweeps=100, n_restarts=8))
    return ModeAssisted(inner=chains, mode=mode, schedule=ModeSchedule(n_updates=n_updates))


MODELS = {
    "the grid's pairs": ("PCD-1", "pseudo-likelihood"),
    "all pairs": ("PCD-1", "pseudo-likelihood", "PCD-1, mode-assisted"),
    "64 hidden spins": ("PCD-1", "PCD-1, mode-assisted"),
}
"""Which couplings there are, and the ways of training."""


def trained(data: Data, model: str, method: str, rate: float, passes: int) -> tuple[Matrix, Matrix]:
    """Couplings and fields of the models of all seeds, trained side by side."""
    n_seeds, n_rows, n = data.rows.shape
    side = round(n**0.5)
    batches = Batches(data.rows, torch.zeros(n_seeds, n_rows).long(), BATCH, n_rows, shuffle=True, seed=0)
    stage: Any
    if "hidden" in model:
        rbm = RBM(visible=Spin(n), hidden=Spin(n), replicas=(n_seeds,), weight_init=Normal(std=0.05))
        stage = Greedy(_as_network(rbm))
    else:
        connectivity = grid(side, side) if "grid" in model else None
        visible = Spin(n)
        machine = BoltzmannMachine(n_hidden=0, visible=visible, connectivity=connectivity, replicas=(n_seeds,))
        stage = Boltzmann(machine)
    for _ in pretrain(
        stage,
        batches,
        sampler_of(method, passes * len(batches)),
        iterations=passes,
        optimizer=partial(Adam, lr=rate),
        schedules=[LearningRateDecay(passes)],
    ):
        pass
    if "hidden" in model:
        return effective(rbm, data.rows[:, :100])
    coupling = np.zeros((n_seeds, n, n))
    first, second = machine.pairs.T.numpy()
    coupling[:, first, second] = coupling[:, second, first] = machine.coupling.detach().double().numpy()
    return coupling, machine.b.detach().double().numpy()


def _as_network(rbm: RBM) -> DBN:
    """A DBN of this RBM alone: hidden units of a DBN are in {0, 1}."""
    network = DBN(visible=rbm.visible, hidden_sizes=[rbm.n_hidden], replicas=rbm.replicas)
    network.rbms[0] = rbm
    return network


def measure(*, quick: bool) -> Iterator[dict[str, Any]]:
    """A row for each kind of couplings, model and way of training."""
    side, n_rows, seeds, passes = (3, 1000, [0, 1], 2) if quick else (8, N_ROWS, [0, 1, 2, 3, 4], 20)

    def row(kind: str, model: str, method: str, errors: Errors, rate: float | str = "") -> dict[str, Any]:
        found = {name: shown(values) for name, values in errors._asdict().items()}
        return {"couplings": kind, "model": model, "training": method, **found, "rate": rate}

    for kind in ("-0.5 and 0.5", "Gaussian"):
        data, other = (data_of(side, kind, some, n_rows) for some in (seeds, [100]))
        yield row(kind, "all pairs", "logistic regressions", Errors.of(data, *logistic(data)))
        for model, methods in MODELS.items():
            for method in methods:
                # On a grid that is not measured.
                def error(rate: float) -> float:
                    found = Errors.of(other, *trained(other, model, method, rate, n_passes))  # noqa: B023
                    return interval(found.bonds)[0]

                n_passes = passes if quick else PASSES.get(model, passes)
                rate = min(RATES, key=error)
                found = Errors.of(data, *trained(data, model, method, rate, n_passes))
                yield row(kind, model, method, found, rate)
