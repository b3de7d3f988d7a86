"""The DMM's CUDA kernel on a device; numba's simulator runs the same checks on every machine."""

import sys
from pathlib import Path

import pytest
import stand_in
from numba import cuda

sys.path.append(str(Path(__file__).parents[1] / "exact" / "solvers" / "dmm"))
import cuda_checks


@pytest.fixture
def numba_device(device: str) -> None:
    if device == stand_in.NAME or not cuda.is_available():
        pytest.skip("numba runs kernels on CUDA alone")


@pytest.mark.parametrize(("kind", "name"), cuda_checks.CASES)
def test_same_trajectories_as_on_the_cpu(kind, name, numba_device):
    cuda_checks.check_trajectories(kind, name, tolerance=1e-3)


def test_same_ends_and_answers_as_on_the_cpu(numba_device):
    cuda_checks.check_ends(tolerance=1e-3)
    cuda_checks.check_solver()
