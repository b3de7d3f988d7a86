"""Trials on the machines of a Dask or Ray cluster, which runs already."""

import os
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from importlib import import_module
from typing import Any

from memcomp_lightning.errors import UserError
from memcomp_lightning.processes import Do

CLUSTERS = {
    "dask": (
        "distributed",
        "DASK_SCHEDULER_ADDRESS",
        "tcp://HOST:8786, the scheduler that 'dask scheduler' starts",
    ),
    "ray": ("ray", "RAY_ADDRESS", "HOST:6379, the node that 'ray start --head' makes the first"),
}
"""By name: the package, the variable that says where the cluster is, and what it is set to."""


@contextmanager
def cluster(name: str) -> Iterator[Do[Any]]:
    """Yield a function that does work on a cluster; work of a machine that is lost is done again on another one.

    Raises:
        UserError: The package is not installed, nobody said where the cluster is, or it does not answer.
    """
    package, variable, where = CLUSTERS[name]
    try:
        module = import_module(package)
    except ImportError as error:
        raise UserError(
            f"workers={name} needs {package}, which is not installed: pip install {package}"
        ) from error
    if not os.environ.get(variable):
        raise UserError(f"workers={name} needs a cluster that runs: set {variable}={where}.")
    with {"dask": _dask, "ray": _ray}[name](module, os.environ[variable]) as do:
        yield do


def _unreachable(name: str, address: str, error: Exception) -> UserError:
    variable, where = CLUSTERS[name][1:]
    return UserError(f"no {name} cluster answers at {address} ({error}): set {variable}={where}.")


@contextmanager
def _dask(distributed: Any, address: str) -> Iterator[Do[Any]]:
    try:
        client = distributed.Client(address)
    except OSError as error:
        raise _unreachable("dask", address, error) from error

    def do(function: Callable[[Any], Any], work: Iterable[Any]) -> Iterator[Any]:
        for future in distributed.as_completed([client.submit(function, one, pure=False) for one in work]):
            yield future.result()

    with client:  # what still runs is given up at its end
        yield do


@contextmanager
def _ray(ray: Any, address: str) -> Iterator[Do[Any]]:
    try:
        ray.init(address=address, log_to_driver=False)
    except (ConnectionError, RuntimeError) as error:
        raise _unreachable("ray", address, error) from error

    def do(function: Callable[[Any], Any], work: Iterable[Any]) -> Iterator[Any]:
        remote = ray.remote(num_cpus=1, max_retries=-1)(function)
        waiting = [remote.remote(one) for one in work]
        while waiting:
            done, waiting = ray.wait(waiting)
            yield ray.get(done[0])

    try:
        yield do
    finally:
        ray.shutdown()
