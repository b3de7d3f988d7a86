"""Ground states of RBMs with units of every kind: small ones by enumeration, large ones by the best known."""

import time
from collections.abc import Callable, Iterator
from statistics import median
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from memcomp_lightning import rng
from memcomp_lightning.models import RBM, Normal
from memcomp_lightning.models.bit_form import descend
from memcomp_lightning.models.units import Bernoulli, Categorical, Gaussian, Mixed, Spin, Units, all_states
from memcomp_lightning.samplers import BlockAnnealing, GroundState, NegativePhaseSampler, positive_phase
from memcomp_lightning.solvers import GibbsAnnealing, Portfolio
from memcomp_lightning.solvers.dmm import DmmSolver
from memcomp_lightning.types import Configurations

Sampler = NegativePhaseSampler[Any, Any]
SAMPLERS: dict[str, Sampler] = {
    "DMM": GroundState(solver=DmmSolver()),
    "annealing": GroundState(solver=GibbsAnnealing(n_sweeps=1000)),
    "best": GroundState(solver=Portfolio()),
    "block annealing": BlockAnnealing(),
}
SMALL: dict[str, Callable[[], tuple[Units, Units]]] = {
    "Potts, 12 bits": lambda: (Categorical(3, q=3), Bernoulli(3)),
    "Potts, 20 bits": lambda: (Categorical(4, q=3), Bernoulli(8)),
    "Potts of unequal q, spins, 20 bits": lambda: (Categorical([2, 3, 4, 5]), Spin(6)),
    "Gaussian, 12 bits": lambda: (Gaussian(20), Bernoulli(12)),
    "Gaussian, 20 bits": lambda: (Gaussian(20), Spin(20)),
    "mixed, 16 bits": lambda: (Mixed(Bernoulli(3), Categorical([3, 3]), Gaussian(4)), Spin(7)),
    "mixed, 20 bits": lambda: (Mixed(Bernoulli(4), Spin(3), Categorical([3, 4]), Gaussian(3)), Bernoulli(6)),
}
LARGE = (53, 21, 100)
"""Sites, states of a site, and hidden units: as many as the Kunitz alignment asks for."""

STRENGTHS = (0.1, 1.0)
"""Standard deviations of weights and biases."""

N_STARTS = 10_000
"""Of descents, which give one more number to compare with."""


def random_rbm(visible: Units, hidden: Units, strength: float, seed: int) -> RBM:
    """Weights and biases are normal; real units have precisions of 1/2 to 2."""
    generator = rng.stream(seed, "ground states")
    rbm = RBM(visible=visible, hidden=hidden, weight_init=Normal(std=strength), generator=generator)
    with torch.no_grad():
        for bias in (rbm.b, rbm.c):
            bias.normal_(0.0, strength, generator=generator)
        for units in rbm.visible.modules():
            if isinstance(units, Gaussian):
                precision = 2 ** rng.uniform((units.n,), generator=generator).mul(2).sub(1)
                units.precision.copy_(precision)
    return rbm.requires_grad_(False)


def n_real(rbm: RBM) -> int:
    return sum(units.n for units in rbm.visible.modules() if isinstance(units, Gaussian))


def minimum(rbm: RBM) -> float:
    """The lowest energy with real units at their means: all hidden states, with the likeliest visible units."""
    hidden, lowest = all_states(rbm.hidden, rbm.b).double(), list[Tensor]()
    wide = RBM(visible=rbm.visible, hidden=rbm.hidden).double()
    wide.load_state_dict(rbm.state_dict())
    for h in hidden.split(4096):
        v = wide.visible.mode(wide.visible_field(h))
        lowest.append(wide.energy(v, h).min())
    return float(torch.stack(lowest).detach().min())


class Found(NamedTuple):
    """The lowest energy, real units at their means; CPU seconds; sites in exactly one state before the repair."""

    energy: float
    seconds: float
    kept: float


def found_by(rbm: RBM, sampler: Sampler, seed: int) -> Found:
    generator = rng.stream(seed, "solver")
    nothing = positive_phase(rbm, rbm.visible.mode(rbm.b[None]))
    begin = time.process_time()
    state = sampler.init(rbm, 1, generator=generator)
    (v, h, _), _, info = sampler.sample(rbm, state, nothing, generator=generator)
    spent = time.process_time() - begin
    # Real units stand a standard deviation from their means, which costs a half each.
    energy = float(rbm.double().energy(v.double(), h.double()).min()) - n_real(rbm.float()) / 2
    return Found(energy, spent, float(info.get("feasible_sites", torch.tensor(1.0))))


def descents(rbm: RBM, n_starts: int, seed: int) -> tuple[float, float]:
    """The lowest of many descents from random visible units, and CPU seconds."""
    generator, begin, lowest = rng.stream(seed, "descents"), time.process_time(), np.inf
    for _ in range(0, n_starts, 1000):
        v = rbm.visible.sample(rbm.b.new_zeros(min(n_starts, 1000), rbm.n_visible), generator=generator)
        h = rbm.hidden.mode(rbm.hidden_field(v))
        found = descend(rbm, Configurations(v, h))
        lowest = min(lowest, float(rbm.energy(found.v, found.h).min()))
    return lowest, time.process_time() - begin


def small(n_problems: int) -> Iterator[dict[str, Any]]:
    for name, make in SMALL.items():
        solved = {label: list[bool]() for label in SAMPLERS}
        spent = {label: list[float]() for label in SAMPLERS}
        for seed in range(n_problems):
            rbm = random_rbm(*make(), 1.0, seed)
            known = minimum(rbm)
            for label, sampler in SAMPLERS.items():
                energy, seconds, _ = found_by(rbm, sampler, seed)
                assert energy > known - 1e-3, (name, seed, label, energy, known)
                solved[label].append(energy < known + 1e-4 * max(1.0, abs(known)))
                spent[label].append(seconds)
        for label in SAMPLERS:
            counted = f"{sum(solved[label])} of {n_problems}"
            yield {"models": name, "solver": label, "solved": counted, "ms": round(1e3 * median(spent[label]), 1)}


def large(n_seeds: int, shape: tuple[int, int, int], n_starts: int) -> Iterator[dict[str, Any]]:
    n_sites, q, n_hidden = shape
    for strength in STRENGTHS:
        energies = {label: list[float]() for label in (*SAMPLERS, "descents")}
        spent, kept = {label: list[float]() for label in energies}, {label: list[float]() for label in SAMPLERS}
        for seed in range(n_seeds):
            rbm = random_rbm(Categorical(n_sites, q), Bernoulli(n_hidden), strength, seed)
            for label in energies:
                if label == "descents":
                    energy, seconds = descents(rbm, n_starts, seed)
                else:
                    energy, seconds, share = found_by(rbm, SAMPLERS[label], seed)
                    kept[label].append(share)
                energies[label].append(energy)
                spent[label].append(seconds)
        known = np.min(list(energies.values()), axis=0)
        for label in energies:
            gap = (np.array(energies[label]) - known) / np.abs(known)
            row = {"models": f"Potts, {n_sites} sites, q = {q}, {n_hidden} hidden, deviation {strength:g}"}
            row |= {"solver": f"{label}, {n_starts} starts" if label == "descents" else label}
            row |= {"solved": f"{int((gap < 1e-6).sum())} of {n_seeds} (best known)"}
            row |= {"ms": str(round(1e3 * median(spent[label]))), "gap, %": f"{100 * float(gap.mean()):.3f}"}
            if isinstance(SAMPLERS.get(label), GroundState):
                row |= {"sites in one state before repair, %": f"{100 * float(np.mean(kept[label])):.1f}"}
            yield row


def measure(*, quick: bool) -> Iterator[dict[str, Any]]:
    """A row for each family and solver. CPU seconds of one thread; what is compiled is compiled before."""
    warm = random_rbm(Categorical(3, q=3), Bernoulli(3), 1.0, 0)
    for sampler in SAMPLERS.values():
        found_by(warm, sampler, 0)
        found_by(random_rbm(Gaussian(2), Spin(14), 1.0, 0), sampler, 0)
    yield from small(2 if quick else 50)
    yield from large(1 if quick else 5, (6, 4, 5) if quick else LARGE, 100 if quick else N_STARTS)
