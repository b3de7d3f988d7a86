r"""Sums over the states of one layer of an RBM, the other one summed in closed form.

A state s of the enumerated layer has the weight :math:`exp(g.s) \prod_i (1 + exp(W s + c)_i)`, with the units i of
the other layer. The layer is split: s = (t, u), a *prefix* t and the few last units u. The field is then
A_i(t) + B_i(u), so that 1 + exp(A) exp(B) needs no exponential for each pair of state and unit. ``kernel.py``
multiplies these factors on the CPU; a tensor program stands beside it as reference and for all other devices.
"""

import logging
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor, as_completed
from functools import cache
from itertools import product
from types import ModuleType

import torch
from jaxtyping import Float
from torch import Tensor
from tqdm.auto import tqdm

from memcomp_lightning.enumeration import binary_states
from memcomp_lightning.likelihood.layers import Layers, log_weights

log = logging.getLogger(__name__)

Block = tuple[slice, slice]

N_SECOND = 8
"""Units of u: 2^8 numbers a unit of the other layer, which stay in the second-level cache for 784 of them."""

_COMPILED_PAIRS, _REFERENCE_PAIRS = 2**28, 2**23
"""Work in a block: a twentieth of a second, and 64 MiB."""


def prefix_log_weights(
    layers: Layers,
    *,
    n_second: int | None = None,
    block: int | None = None,
    compiled: bool | None = None,
    progress: bool = False,
) -> Float[Tensor, "replicas prefixes"]:
    """Log of the summed weights of all states with the same prefix; their logsumexp is log Z.

    It is float64 on the model's device, of ``2^(n_enumerated - n_second)`` prefixes.

    Args:
        layers: The model.
        n_second: Units of u; None is ``N_SECOND`` or all.
        block: Prefixes at a time; None is what fits the memory.
        compiled: Use the kernel; None is where the model lies on the CPU.
        progress: Log an estimate of the time and show a bar.
    """
    n_second = min(N_SECOND, layers.n_enumerated) if n_second is None else n_second
    cpu = _cpu() if compiled or (compiled is None and layers.weight.device.type == "cpu") else None
    n_replicas, n_prefixes = layers.weight.shape[0], 2 ** (layers.n_enumerated - n_second)
    pairs = 2**n_second * layers.n_other
    together = 1 if cpu else max(1, _REFERENCE_PAIRS // pairs)
    if block is None:
        block = max(1, (_COMPILED_PAIRS if cpu else _REFERENCE_PAIRS // min(together, n_replicas)) // pairs)
    blocks = list(product(_slices(n_replicas, together), _slices(n_prefixes, block)))
    out = torch.empty(n_replicas, n_prefixes, dtype=torch.float64, device="cpu")
    if cpu:
        prepared = [cpu.prepare(layers.part(r), n_second) for r in range(n_replicas)]
        cpu.sum_compiled(prepared[0], slice(0, 0))  # compiles, which is no part of the estimate of the time

        def work(at: Block) -> None:
            out[at] = cpu.sum_compiled(prepared[at[0].start], at[1])
    else:
        second = binary_states(n_second, like=layers.weight)

        def work(at: Block) -> None:
            prefixes = binary_states(
                layers.n_enumerated - n_second, start=at[1].start, stop=at[1].stop, like=layers.weight
            )
            # On the CPU at once: the bar and Ctrl-C then follow the device.
            out[at] = log_weights(layers.part(at[0]), prefixes.unsqueeze(0), second).logsumexp(-1).cpu()

    n_threads = torch.get_num_threads() if cpu else 1
    _run(blocks, work, n_threads, progress)
    return out.to(layers.weight.device)


@cache
def _cpu() -> ModuleType | None:
    """The compiled kernel, if it can be loaded."""
    try:
        from memcomp_lightning.likelihood import cpu
    except (ImportError, RuntimeError) as error:  # the second: no folder to keep compiled code in
        log.info("numba: %s. Plain torch is used, many times slower. Install numba or set NUMBA_CACHE_DIR.", error)
        return None
    return cpu


def _slices(n: int, size: int) -> list[slice]:
    return [slice(start, min(start + size, n)) for start in range(0, n, size)]


def _run(blocks: list[Block], work: Callable[[Block], None], n_threads: int, progress: bool) -> None:
    """Work off the blocks, the first one alone and timed, the others on threads."""
    with tqdm(total=len(blocks), desc="enumeration", unit="block", disable=not progress) as bar:
        begin = time.perf_counter()
        work(blocks[0])
        bar.update()
        rest = blocks[1:]
        if progress:
            seconds = (time.perf_counter() - begin) * len(rest) / n_threads
            log.info("Enumeration of %d blocks: about %.2g s on %d threads", len(blocks), seconds, n_threads)
        if n_threads <= 1 or len(rest) <= 1:
            for at in rest:
                work(at)
                bar.update()
            return
        with ThreadPoolExecutor(n_threads, thread_name_prefix="memcomp-likelihood") as pool:
            try:
                for job in as_completed([pool.submit(work, at) for at in rest]):
                    job.result()
                    bar.update()
            except BaseException:
                pool.shutdown(wait=False, cancel_futures=True)
                raise
