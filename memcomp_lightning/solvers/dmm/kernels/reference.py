"""The readable kernel: plain operations on arrays; any device, field and integrator, all restarts at once."""

from typing import Any

import numpy as np

from memcomp_lightning.arrays import Array, cast, namespace
from memcomp_lightning.problems.maxsat import WeightedMaxSat
from memcomp_lightning.problems.qubo import Qubo
from memcomp_lightning.solvers.alternating_descent import descend
from memcomp_lightning.solvers.dmm.base import Recording, VectorField
from memcomp_lightning.solvers.dmm.integrate import Integrator, Shake, still
from memcomp_lightning.solvers.dmm.kernels.run import Run, Stall, Start, Visited

MAX_SWEEPS = 1000
"""Ends a quench that rounding errors would keep alternating between equal energies."""


@np.errstate(divide="ignore")  # the step of a machine at rest is the longest
def run(
    field: VectorField[Any, Any],
    integrator: Integrator,
    problem: Qubo | WeightedMaxSat,
    start: Start,
    *,
    n_steps: int,
    quench_every: int,
    recording: Recording | None,
    stall: Stall | None = None,
    remember: bool = True,
) -> Run:
    """Integrate for ``n_steps`` steps and keep the best assignment met.

    Args:
        field: The vector field.
        integrator: The scheme of one step.
        problem: With one axis of problems.
        start: Where each restart begins.
        n_steps: Steps a restart.
        quench_every: Read the digital state each so many steps, and descend from a copy of it by single flips; 0
            reads it at each step, without a descent.
        recording: Which records to keep; a recorded restart does not stall.
        stall: When a restart ends before ``n_steps``; None lets all run to the end.
        remember: Whether to return the long-term memories.
    """
    stall, rounds = None if recording is not None else stall, _rounds(start.voltage)
    machine = field.build(problem)
    state = _warmed(field.init(machine, start.voltage), start.kept)
    best = state.voltage > 0
    best_energy = problem.energy(best)
    xp = namespace(best_energy)
    found_at = xp.zeros_like(best_energy, dtype=xp.int64)
    running = xp.ones_like(best_energy, dtype=xp.bool)
    steps, time = xp.zeros_like(found_at), xp.zeros_like(best_energy)
    before: Array | None = None
    times: list[Array] = []
    states: list[Array] = []
    for step in range(n_steps + 1):
        if step > 0:
            shake = _shake(field.noise, start.seed, step - 1)
            moved, dt, before = integrator.step(field, machine, state, before=before, shake=shake)
            state = moved if stall is None else _where(running, moved, state)
            steps, time = steps + cast(running, xp.int64), time + dt
        x = state.voltage > 0
        if quench_every == 0 or step % quench_every == 0:
            # A descent ends at or below its start: its end alone need be compared.
            candidate = quench(problem, x) if quench_every else x
            energy = problem.energy(candidate)
            better = energy < best_energy
            best = xp.where(better[..., None], candidate, best)
            best_energy = xp.minimum(energy, best_energy)
            found_at = xp.where(better, step, found_at)
            if stall is not None:
                running &= step < stall.min_steps + stall.factor * found_at
                if step % (quench_every * rounds or rounds) == 0 and not running.any():
                    break
        if recording is not None and step > 0 and step % recording.every == 0:
            times.append(time)
            states.append(x)
    visited = Visited(xp.stack(times, axis=-1), xp.stack(states, axis=-2)) if times else None
    return Run(best, found_at, steps, state.voltage, _long_term(state) if remember else (), visited)


def quench(problem: Qubo | WeightedMaxSat, x: Array) -> Array:
    """Flip variables as long as that lowers the energy; bool in, bool out.

    A QUBO is descended by blocks of uncoupled variables, MAX-SAT by the steepest single flips.
    """
    xp = namespace(x)
    x = cast(x, problem.linear.dtype if isinstance(problem, Qubo) else xp.float64)
    rounds = _rounds(x)
    for sweep in range(MAX_SWEEPS):
        before = xp.asarray(x, copy=True)
        if isinstance(problem, Qubo):
            descend(problem, x)
        else:
            gain = (1 - 2 * x) * problem.field(x)
            at = gain.argmin(-1)[..., None] == xp.arange(x.shape[-1], device=x.device)
            x = xp.where(at & (gain < 0), 1 - x, x)
        if (sweep + 1) % rounds == 0 and bool((x == before).all()):
            break
    return x > 0.5


def _rounds(like: Array) -> int:
    """Rounds between two checks for the end: off the CPU each check makes Python wait for the device."""
    return 1 if getattr(like.device, "type", "cpu") == "cpu" else 8


def uniform(seed: Array, counter: Array) -> Array:
    """Numbers in [-1, 1) that depend on nothing but the arguments: a hash of both (Murmur3's finaliser)."""
    word = 0xFFFFFFFF
    z = (seed + counter * 0x9E3779B9) & word
    z = ((z ^ (z >> 16)) * 0x85EBCA6B) & word
    z = ((z ^ (z >> 13)) * 0xC2B2AE35) & word
    z = z ^ (z >> 16)
    return (z >> 8) * 2.0**-23 - 1


def _shake(noise: float, seed: Array, step: int) -> Shake:
    """The noise of one step on the voltages."""
    if noise == 0:
        return still

    def shake(state: Any, dt: Array) -> Any:
        n = state.voltage.shape[-1]
        counter = step * n + namespace(seed).arange(n, device=seed.device)
        kick = cast(uniform(seed[..., None], counter), state.voltage.dtype)
        return state._replace(voltage=state.voltage + noise * (dt**0.5)[..., None] * kick)

    return shake


def _where(running: Array, moved: Any, state: Any) -> Any:
    """The restarts that are running have moved, the others have not."""
    return type(state)(
        *(
            namespace(new).where(running.reshape(*running.shape, *(1,) * (new.ndim - running.ndim)), new, old)
            for new, old in zip(moved, state, strict=True)
        )
    )


def _warmed(state: Any, kept: tuple[Array, ...]) -> Any:
    """The state with long-term memories that were kept."""
    names = [name for name in state._fields if name.endswith("long_term")]
    return state._replace(**{name: 1 + memory for name, memory in zip(names, kept, strict=False)})


def _long_term(state: Any) -> tuple[Array, ...]:
    """Long-term memories less their rest value."""
    return tuple(getattr(state, name) - 1 for name in state._fields if name.endswith("long_term"))
