"""The kernel for CUDA devices: copy arrays there, start a block of threads for each restart, copy back."""

import math
import warnings
from typing import Any

import numpy as np
from numba import config, cuda
from numba.core.errors import NumbaPerformanceWarning

from memcomp_lightning.arrays import to_numpy
from memcomp_lightning.compiling import announce_compilation
from memcomp_lightning.errors import require
from memcomp_lightning.problems.maxsat import WeightedMaxSat
from memcomp_lightning.problems.qubo import Qubo
from memcomp_lightning.solvers.compiled import float32, grouped
from memcomp_lightning.solvers.dmm.base import Recording
from memcomp_lightning.solvers.dmm.integrate import Integrator, Splitting
from memcomp_lightning.solvers.dmm.kernels import blocks
from memcomp_lightning.solvers.dmm.kernels.fields import FIELDS
from memcomp_lightning.solvers.dmm.kernels.hand_over import constants_of, control_of, finish, sparse_of, steps_of
from memcomp_lightning.solvers.dmm.kernels.run import Run, Stall, Start

announce_compilation()


def obstacle(field: Any, integrator: Integrator) -> str | None:
    """Why this kernel cannot run, and what to do; None if it can."""
    if not cuda.is_available():  # type: ignore[no-untyped-call]
        return (
            "numba finds no CUDA device: it needs one, its driver, and pip install 'numba-cuda[cu12]' (or cu13). "
            "NUMBA_ENABLE_CUDASIM=1 runs the kernel in numba's simulator, which is for tests of small problems."
        )
    if type(field) not in blocks.PASSES:
        known = " and ".join(each.__name__ for each in blocks.PASSES)
        return f"{type(field).__name__} has no CUDA kernel: {known} have one."
    if type(integrator) is not Splitting:
        return f"{type(integrator).__name__} has no CUDA kernel: use Splitting."
    return FIELDS[type(field)].obstacle(field)


def run(
    field: Any,
    integrator: Splitting,
    problem: Qubo | WeightedMaxSat,
    start: Start,
    *,
    n_steps: int,
    quench_every: int,
    recording: Recording | None,
    stall: Stall | None = None,
    remember: bool = True,
) -> Run:
    """Do what ``reference.run`` does, on the CUDA device that numba uses and in float32.

    The host waits for all restarts at once. A restart takes 16 bytes a pair and 40 a variable of device memory.

    Raises:
        SettingError: The problem has clauses of three literals or more.
    """
    longest = max((block.variables.shape[-1] for block in getattr(problem, "longer", ())), default=2)
    remedy = "kernel=auto takes clauses of any length."
    require(longest == 2, "longest clause", longest, "at most 2 literals with kernel=cuda", remedy)
    steps = steps_of(n_steps, quench_every, recording, stall)
    passes, machine = FIELDS[type(field)], field.build(problem)
    n_problems, n_restarts, n = shape = start.voltage.shape
    sparse = sparse_of(passes.listed(machine), problem, n_problems)
    of_problem = {name: to_numpy(value) for name, value in passes.of_problem(field, machine).items()}
    constants = constants_of(field, passes.constants, n_problems, of_problem)
    control = control_of(field, integrator, float32(field.stability(machine)).reshape(-1))
    begins, neighbour, coupling = sparse.digital[:3]
    ends, _ = grouped(sparse.pairs.T.ravel(), n)
    problems = (sparse.pairs, sparse.weight, sparse.polarity, sparse.unit, begins, ends, neighbour, coupling)
    seed = to_numpy(start.seed).astype(np.uint64)
    given = [_there(x) for x in (*problems, sparse.linear, constants, control, seed)]
    n_pairs = max(sparse.weight.shape[1], 1)  # an array of size 0 cannot lie on the device
    n_records = steps[0] // steps[2] if steps[2] else 0

    def empty(*size: int, dtype: type = np.float32) -> Any:
        return cuda.device_array((n_problems, n_restarts, *size), dtype)

    kept = [_there(float32(memory).reshape(*shape[:2], math.prod(memory.shape[2:]))) for memory in start.kept[:2]]
    long, unit_long = kept or (empty(n_pairs), empty(n))
    voltage, best = _there(float32(start.voltage)), _there(np.zeros(shape, np.float32))
    state = (voltage, empty(n_pairs), long, empty(n), unit_long, empty(2 * n_pairs), empty(6, n))
    found_at, last = empty(dtype=np.int64), empty(dtype=np.int64)
    records = max(n_records, 1)
    visited = (empty(records, dtype=np.float64), empty(records, n, dtype=np.bool_))
    with warnings.catch_warnings():
        # A few restarts leave most of a device idle: no reason to tell the user each time.
        warnings.simplefilter("ignore", NumbaPerformanceWarning)
        kind: Any = type(field)
        kernel = blocks.compiled(kind)[n_problems * n_restarts, n_threads(n_pairs)]
        kernel(*given, *steps, not kept, *state, best, found_at, last, *visited)
    out = [x.copy_to_host() for x in (best, found_at, last, *visited)]
    out[3:] = [x[:, :, :n_records] for x in out[3:]]
    memories = []
    if remember:
        of_pairs = long.copy_to_host()[:, :, : sparse.weight.shape[1]]
        memories = [of_pairs.reshape(*shape[:2], *problem.graph.edge_shape), unit_long.copy_to_host()]
    return finish(tuple(out), voltage.copy_to_host(), memories, steps, start.voltage)


def n_threads(n_pairs: int) -> int:
    """Threads of a block, a power of two: eight pairs each, or more of large problems."""
    if getattr(config, "ENABLE_CUDASIM", 0):
        return 4  # the simulator's are threads of Python
    return int(min(max(2 ** math.ceil(math.log2(n_pairs / 8)), 32), blocks.MOST_THREADS))


def _there(x: Any) -> Any:
    """A copy on the device; one of size 0 gets a zero that nothing reads."""
    return cuda.to_device(np.ascontiguousarray(x) if x.size else np.zeros([max(k, 1) for k in x.shape], x.dtype))
