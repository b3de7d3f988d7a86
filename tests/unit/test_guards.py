"""The guards in tests/conftest.py do guard."""

import os

import numpy as np
import pytest
import torch
from jaxtyping import TypeCheckError

from memcomp_lightning import objective
from memcomp_lightning.models import DBN, BatchNorm
from memcomp_lightning.testing.conformance import small_rbm
from memcomp_lightning.types import Configurations


def test_batch_of_one_that_would_broadcast_is_refused():
    rbm = small_rbm()
    with pytest.raises(TypeCheckError, match="energy"):
        rbm.energy(torch.zeros(11, 7), torch.zeros(1, 5))


def test_missing_replica_axis_that_would_broadcast_is_refused():
    rbm = small_rbm(replicas=(3,))
    with pytest.raises(TypeCheckError, match="replicas"):
        rbm.free_energy(torch.zeros(11, 7))


def test_integer_bits_are_refused():
    with pytest.raises(TypeCheckError, match="visible_of"):
        DBN(7, [5, 3]).visible_of(0, torch.zeros(11, 7, dtype=torch.long))


def test_wrong_result_shape_is_refused():
    class WrongModel:
        def total_energy(self, v, h, weight):
            return 0.0

    nothing = Configurations(torch.zeros(1, 2), torch.zeros(1, 3))
    with pytest.raises(TypeCheckError, match="contrast"):
        objective.contrast(WrongModel(), nothing, nothing)


def test_right_shapes_pass():
    assert BatchNorm(5, replicas=(3,))(torch.ones(3, 11, 5)).shape == (3, 11, 5)


@pytest.mark.usefixtures("allow_global_rng")
@pytest.mark.parametrize(
    ("draw", "library"),
    [
        (lambda: torch.empty(3).normal_(), "torch"),
        (lambda: np.random.normal(), "numpy"),  # noqa: NPY002
    ],
)
def test_draw_from_a_global_stream_is_noticed(global_rng_untouched, draw, library):
    with pytest.raises(pytest.fail.Exception, match=f"{library}'s global random stream"), global_rng_untouched():
        draw()


def test_draw_from_a_generator_is_not_noticed(global_rng_untouched):
    with global_rng_untouched():
        torch.empty(3).normal_(generator=torch.Generator())


def test_number_of_threads():
    assert torch.get_num_threads() == int(os.environ.get("MEMCOMP_THREADS", "1"))
