"""The kernel for CUDA devices against the CPU's: here in numba's simulator, on a device in ``tests/gpu``."""

import os
import subprocess
import sys
from pathlib import Path

import pytest
from numba import cuda

from memcomp_lightning.errors import SettingError
from memcomp_lightning.solvers.dmm import DmmSolver


def test_same_trajectories_and_states_in_the_simulator():
    environment = os.environ | {"NUMBA_ENABLE_CUDASIM": "1"}
    program = [sys.executable, str(Path(__file__).with_name("cuda_checks.py"))]
    done = subprocess.run(program, env=environment, capture_output=True, text=True, timeout=300)
    assert done.stdout == "alike\n", done.stderr


def test_without_a_device_the_error_says_what_to_do():
    if cuda.is_available():
        pytest.skip("there is a CUDA device")
    with pytest.raises(SettingError, match=r"kernel = 'cuda' is not allowed.*no CUDA device.*numba-cuda.*CUDASIM"):
        DmmSolver(kernel="cuda")
