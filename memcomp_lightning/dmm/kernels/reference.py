"""The readable kernel: plain torch on any device, all problems and restarts in one tensor program."""

from typing import NamedTuple, TypeVar

import torch
from torch import Tensor

from memcomp_lightning.dmm.base import HasVoltage, Recording, VectorField
from memcomp_lightning.dmm.integrate import Integrator
from memcomp_lightning.qubo.qubo import Qubo, Trajectory

MachineT = TypeVar("MachineT")
StateT = TypeVar("StateT", bound=HasVoltage)


class Run(NamedTuple):
    """Outcome of one run of all restarts.

    Attributes:
        best: Best assignment a restart, ``(*problems, n_restarts, n)`` in {0, 1}.
        found_at: Step at which it was met, ``(*problems, n_restarts)`` int64.
        trajectory: The records, if asked for.
    """

    best: Tensor
    found_at: Tensor
    trajectory: Trajectory | None


def run(
    field: VectorField[MachineT, StateT],
    integrator: Integrator,
    machine: MachineT,
    state: StateT,
    qubo: Qubo,
    *,
    offset: Tensor,
    n_steps: int,
    recording: Recording | None,
) -> Run:
    """Integrate for ``n_steps`` steps and keep the best assignment that the voltages pass through.

    ``offset`` is the energy at which all clauses are satisfied, ``(*problems,)``.
    """
    exact = qubo.double()
    best = state.voltage > 0
    best_energy = exact.energy(best)
    found_at = torch.zeros(best_energy.shape, dtype=torch.int64, device=best.device)
    time = torch.zeros_like(best_energy)
    recorded_until = time
    records: list[tuple[Tensor, Tensor, Tensor, Tensor]] = []
    for step in range(1, n_steps + 1):
        state, dt = integrator.step(field, machine, state)
        time = time + dt
        x = state.voltage > 0
        energy = exact.energy(x)
        better = energy < best_energy
        best = torch.where(better.unsqueeze(-1), x, best)
        best_energy = torch.minimum(energy, best_energy)
        found_at = torch.where(better, step, found_at)
        if recording is not None and step % recording.every == 0:
            unsatisfied = energy - offset.unsqueeze(-1)
            records.append((time, unsatisfied, x, time - recorded_until))
            recorded_until = time
    trajectory = None
    if recording is not None:
        times, weights, states, dwells = (torch.stack(column, dim=-1) for column in zip(*records, strict=True))
        trajectory = Trajectory(times, weights, states.movedim(-1, -2), dwells)
    return Run(best=best.to(qubo.linear.dtype), found_at=found_at, trajectory=trajectory)
