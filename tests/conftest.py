"""Shapes are checked, the global random streams are watched, one thread computes.

Two variables of the environment, which ``portability.sh`` sets:

* ``MEMCOMP_SEED``: other random streams than usual, in this process. No test may pass by luck.
* ``MEMCOMP_THREADS``: of torch and of the DMM, usually 1.
"""

import contextlib
import dataclasses
import functools
import importlib
import inspect
import os
import signal
import subprocess
import sys
from pathlib import Path

import jaxtyping
import numpy as np
import pytest
import torch
from beartype import beartype
from jaxtyping import AbstractArray, install_import_hook

from memcomp_lightning import rng

# A shell lets what it starts in the background ignore Ctrl-C, which some tests send.
if signal.getsignal(signal.SIGINT) == signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)

if SEED := os.environ.get("MEMCOMP_SEED"):

    def reseeded(usual):
        @functools.wraps(usual)
        def stream(seed, name, *args, **kwargs):
            # The models stay: on them depends how many samples tell a wrong sampler from a right one.
            return usual(seed if name == "test model" else f"{SEED}/{seed}", name, *args, **kwargs)

        return stream

    # Before another module takes them from there.
    rng.stream, rng.numpy_stream = reseeded(rng.stream), reseeded(rng.numpy_stream)


def is_shape(hint):
    return inspect.isclass(hint) and issubclass(hint, AbstractArray)


def check_shapes(function):
    """Check the shape annotations of a signature, and these alone.

    The rest is mypy's: protocols cannot be checked at run time, and a misspelt option shall meet the
    package's own error message.
    """
    function.__annotations__ = {name: hint for name, hint in function.__annotations__.items() if is_shape(hint)}
    return beartype(function)


def jaxtyped_where_there_are_shapes(*, typechecker):
    """The decorator of the hook, for what has a shape to check: around the rest it would take most of the time."""

    def decorate(decorated):
        if dataclasses.is_dataclass(decorated):
            hints = [field.type for field in dataclasses.fields(decorated)]
        else:
            hints = getattr(decorated, "__annotations__", {}).values()
        return jaxtyped(decorated, typechecker=typechecker) if any(map(is_shape, hints)) else decorated

    return decorate


jaxtyped, jaxtyping.jaxtyped = jaxtyping.jaxtyped, jaxtyped_where_there_are_shapes

LAYERS = ("models", "objective", "problems", "solvers", "samplers", "likelihood")
HOOKED = [f"memcomp_lightning.{name}" for name in LAYERS]

# pytest forgets a module called conftest; the hook looks its checker up by name, at each failure.
sys.modules["memcomp_lightning_tests"] = sys.modules[__name__]
with install_import_hook(HOOKED, "memcomp_lightning_tests.check_shapes"):
    for hooked in HOOKED:
        importlib.import_module(hooked)

torch.set_num_threads(int(os.environ.get("MEMCOMP_THREADS", "1")))

# A project of its own, whose tests run where it is installed: integration/test_downstream.py.
collect_ignore = ["downstream"]

COMPILE = Path(__file__).with_name("compile_kernels.py")


def pytest_sessionstart(session):
    """Compile the kernels before there are several workers, each of which would; later runs load them."""
    options = session.config.option
    if getattr(options, "numprocesses", None) and not options.collectonly:
        compilers = [subprocess.Popen([sys.executable, COMPILE, part]) for part in ("lanes", "others")]
        if sum(compiler.wait() for compiler in compilers):
            pytest.exit("the kernels do not compile", returncode=1)


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


@contextlib.contextmanager
def _threads(n):
    before = torch.get_num_threads()
    torch.set_num_threads(n)
    try:
        yield
    finally:
        torch.set_num_threads(before)


@pytest.fixture
def threads():
    """A context manager in which torch computes in so many threads."""
    return _threads


@pytest.fixture(autouse=True)
def _guard_threads():
    before = torch.get_num_threads()
    yield
    after = torch.get_num_threads()
    torch.set_num_threads(before)
    if after != before:
        pytest.fail(f"the number of torch's threads was changed from {before} to {after}, and not back")


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
