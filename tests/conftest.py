"""Shapes are checked, the global random streams are watched, one thread computes."""

import contextlib
import importlib
import inspect
import sys

import numpy as np
import pytest
import torch
from beartype import beartype
from jaxtyping import AbstractArray, install_import_hook


def check_shapes(function):
    """Check the shape annotations of a signature, and these alone.

    The rest is mypy's: protocols cannot be checked at run time, and a misspelt option shall meet the
    package's own error message.
    """
    function.__annotations__ = {
        name: hint
        for name, hint in function.__annotations__.items()
        if inspect.isclass(hint) and issubclass(hint, AbstractArray)
    }
    return beartype(function)


HOOKED = [f"memcomp_lightning.{name}" for name in ("models", "objective", "qubo", "dmm", "samplers", "likelihood")]

# pytest forgets a module called conftest; the hook looks its checker up by name, at each failure.
sys.modules["memcomp_lightning_tests"] = sys.modules[__name__]
with install_import_hook(HOOKED, "memcomp_lightning_tests.check_shapes"):
    for hooked in HOOKED:
        importlib.import_module(hooked)

torch.set_num_threads(1)

# A project of its own, whose tests run where it is installed: integration/test_downstream.py.
collect_ignore = ["downstream"]


def pytest_sessionstart(session):
    """Compile the kernels before there are several workers, each of which would; later runs load them."""
    options = session.config.option
    if getattr(options, "numprocesses", None) and not options.collectonly:
        from memcomp_lightning import rng
        from memcomp_lightning.dmm import DmmSolver
        from memcomp_lightning.likelihood import log_partition_function
        from memcomp_lightning.qubo import Qubo, from_model
        from memcomp_lightning.testing.conformance import small_rbm

        log_partition_function(small_rbm())
        for problem in (from_model(small_rbm()), Qubo.from_matrix(torch.ones(2, 2))):
            DmmSolver(n_restarts=1, max_steps=1).minimise(problem, generator=rng.stream(0, "compile"))


@contextlib.contextmanager
def _global_rng_untouched():
    torch_before, numpy_before = torch.get_rng_state(), np.random.get_state()  # noqa: NPY002
    yield
    if not torch_before.equal(torch.get_rng_state()):
        pytest.fail("torch's global random stream was used: draw from a named generator")
    if not all(np.array_equal(a, b) for a, b in zip(numpy_before, np.random.get_state(), strict=True)):  # noqa: NPY002
        pytest.fail("numpy's global random stream was used: draw from a named generator")


@pytest.fixture
def global_rng_untouched():
    """The context manager that guards every test."""
    return _global_rng_untouched


@pytest.fixture
def allow_global_rng():
    """For a test of third-party code that draws from the global random streams."""


@pytest.fixture(autouse=True)
def _guard_global_rng(request):
    if "allow_global_rng" in request.fixturenames:
        yield
        return
    with _global_rng_untouched():
        yield
