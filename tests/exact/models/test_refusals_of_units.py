"""What kinds of units, and rows of them, refuse at the edges: by name, column and value."""

from functools import partial

import numpy as np
import pytest
import torch

from memcomp_lightning import rng
from memcomp_lightning.errors import SettingError
from memcomp_lightning.likelihood import log_partition_function
from memcomp_lightning.likelihood.both_ways import estimate_both_ways
from memcomp_lightning.models import RBM, BoltzmannMachine, start_at_means
from memcomp_lightning.models.base import EnergyModel
from memcomp_lightning.models.init import independent_bias
from memcomp_lightning.models.units import Bernoulli, Categorical, Gaussian, Mixed, ReLU, Spin
from memcomp_lightning.objective import contrast
from memcomp_lightning.samplers import CD, BlockAnnealing
from memcomp_lightning.testing import brute_force
from memcomp_lightning.training import Greedy, pretrain
from memcomp_lightning.training.given import as_batch
from memcomp_lightning.types import Batch, Configurations

NAN = float("nan")


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: Categorical([2, 2.5]), r"number of states of site 1 = 2\.5"),
        (lambda: Categorical(2.5, 2), r"n_sites = 2\.5"),
        (lambda: Categorical(3), "q = None is not allowed: expected the number of states of every site"),
        (lambda: Categorical([2, 3], 4), "q = 4 is not allowed: expected None where"),
        (lambda: Gaussian(2, variance="a"), "variance = 'a' is not allowed: expected a number > 0"),
        (lambda: Gaussian(2, variance=None), "variance = None is not allowed"),
        (lambda: Gaussian(2, variance=1e-40), "variance of column 0 = .* finite and with a finite inverse"),
        (lambda: Mixed("a"), "part of mixed units = 'a' is not allowed: expected a kind"),
    ],
)
def test_settings_of_kinds(make, message):
    with pytest.raises(SettingError, match=message):
        make()


def test_numbers_of_numpy_are_numbers():
    assert Categorical(np.int64(3), np.int64(2)).sizes == (2, 2, 2)
    assert Categorical(torch.tensor([2, 3])).sizes == (2, 3)


def test_a_variance_of_data_without_a_finite_precision():
    v = 1e-21 * rng.uniform((50, 2), generator=rng.stream(0, "data"))
    with pytest.raises(SettingError, match="variance of column 0"):
        start_at_means(RBM(visible=Gaussian(2), n_hidden=2), v)


def trained_on(rbm: EnergyModel, v: torch.Tensor) -> None:
    list(pretrain(Greedy(rbm), v, CD(), iterations=1, optimizer=partial(torch.optim.SGD, lr=0.05)))


@pytest.mark.parametrize(
    ("rbm", "v", "message"),
    [
        (
            RBM(visible=Categorical(2, 3), n_hidden=2),
            [[1, NAN, 0, 0, 0, 1], [0, 1, 0, 0, 1, 0]],
            "observed entries of site 0 in row 0 = 'a part' is not allowed",
        ),
        (RBM(visible=Spin(2), n_hidden=2), [[NAN, NAN], [NAN, NAN]], "batch, values known in row 0 = 0"),
        (RBM(visible=Spin(2), n_hidden=2), [[1, -1], [NAN, NAN]], "batch, values known in row 1 = 0"),
    ],
)
def test_masks_of_tensors_that_are_batches(rbm, v, message):
    with pytest.raises(SettingError, match=message):
        trained_on(rbm, torch.tensor(v))


def test_whole_sites_may_be_missing():
    batch = as_batch(torch.tensor([[NAN, NAN, NAN, 0.0, 0.0, 1.0]]), Categorical(2, 3))
    assert batch.observed.tolist() == [[False] * 3 + [True] * 3]


@pytest.mark.parametrize("observed", [False, True])
def test_mixed_layers_of_replicas_take_data_without_the_axis(observed):
    mixed = Mixed(Gaussian(2), Spin(2), Bernoulli(1))
    rbm = RBM(visible=mixed, n_hidden=3, replicas=(2,))
    alone = RBM(visible=Mixed(Gaussian(2), Spin(2), Bernoulli(1)), n_hidden=3)
    v = torch.tensor([[0.1, 0.2, 1, 1, 0], [0.3, 0.1, -1, 1, 1], [0.5, 0.4, 1, -1, 0], [-0.2, 0.1, -1, -1, 1]])
    mask = torch.ones_like(v, dtype=torch.bool)
    mask[0, 2] = not observed
    for model in (rbm, alone):
        start_at_means(model, v, observed=mask if observed else None)
    assert torch.allclose(rbm.b, alone.b.expand(2, -1))
    assert independent_bias(v, rbm.visible).shape == (2, 5)
    found = estimate_both_ways(rbm, v, n_chains=4, n_betas=20, n_sweeps=5, seed=0)
    assert found.up.log_z.shape == (2,)


def test_the_energy_of_a_ground_state_of_rectified_units_is_that_of_the_state():
    """As no form in bits integrates them out, energies of several runs can be compared."""
    generator = rng.stream(0, "model")
    model = RBM(visible=Bernoulli(5), hidden=ReLU(3))
    with torch.no_grad():
        model.weight.normal_(generator=generator)
        model.c.normal_(generator=generator)
    v = torch.cartesian_prod(*[torch.tensor([0.0, 1.0])] * 5)
    lowest = model.energy(v, model.hidden.mode(model.hidden_field(v))).min().item()
    nothing = Configurations(v[:1], model.hidden_mean(v[:1]))
    sampler = BlockAnnealing(n_chains=32, n_sweeps=50)
    state = sampler.init(model, 1, generator=generator)
    found = sampler.sample(model, state, nothing, generator=generator)
    assert float(found.info["ground_state_energy"]) == pytest.approx(lowest, abs=1e-5)


def test_masks_of_batches_are_looked_at_before_they_train() -> None:
    model = RBM(visible=Categorical([3, 2]), hidden=Spin(2))
    v = model.visible.encode(torch.tensor([[0.0, 1.0], [2.0, 0.0]]))
    label = torch.zeros(2, dtype=torch.long)
    half, none = torch.ones(2, 2, 5, dtype=torch.bool)
    half[1, 3] = none[1] = False
    for observed, message in (
        (half, r"observed entries of site 1 in row 1 = 'a part'"),
        (none, r"batch, values known in row 1 = 0"),
    ):
        with pytest.raises(SettingError, match=message):
            as_batch(Batch(v, label, 1.0, True, observed=observed), model.visible)


def test_one_site_of_several_states_is_a_model_of_its_own() -> None:
    """Its biases alone: without other sites there are no pairs."""
    for visible in (Categorical(1, q=3), Gaussian(1, variance=0.5), Spin(1)):
        model = BoltzmannMachine(visible=visible, n_hidden=0).double()
        with torch.no_grad():
            model.b.uniform_(-1, 1, generator=rng.stream(0, "biases"))
        torch.testing.assert_close(log_partition_function(model), brute_force.log_sum(model).detach())


def test_energies_of_rectified_units_are_constants_where_their_states_carry_a_graph() -> None:
    model = RBM(visible=Spin(2), hidden=ReLU(2)).double()
    v = torch.tensor([[1.0, -1.0], [1.0, 1.0]]).double()
    gradients = []
    for detached in (False, True):
        h = model.hidden.points(model.hidden_field(v))[0]
        h = h.detach() if detached else h
        loss = contrast(model, Configurations(v, h), Configurations(-v, h.flip(0)))
        gradients.append(torch.autograd.grad(loss.sum(), [model.c, model.weight]))
    torch.testing.assert_close(*gradients)


def test_sizes_are_taken_from_arrays_and_a_variance_is_no_switch() -> None:
    assert Categorical(np.array([2, 3])).sizes == (2, 3)
    with pytest.raises(SettingError, match="variance = True is not allowed: expected a number > 0"):
        Gaussian(2, variance=True)
