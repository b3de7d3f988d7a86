"""First biases of rows with weights: a weight counts as so many repeats do."""

import pytest
import torch

from memcomp_lightning import rng
from memcomp_lightning.models import RBM, independent_bias, start_at_means
from memcomp_lightning.models.units import Bernoulli, Categorical, Gaussian, Mixed, Spin, Units

KINDS: dict[str, Units] = {
    "bernoulli": Bernoulli(6),
    "spin": Spin(6),
    "categorical": Categorical([2, 4]),
    "gaussian": Gaussian(6),
    "mixed": Mixed(Bernoulli(2), Categorical(1, q=3), Gaussian(1)),
}
TIMES = torch.tensor([1, 3, 2, 1, 4])


def data(units: Units) -> torch.Tensor:
    """Five rows of values of the units."""
    numbers = rng.uniform((5, units.n), generator=rng.stream(0, "data"))
    drawn = units.sample(numbers, generator=rng.stream(0, "values"))
    return drawn.double()


def started(units: Units, *arguments: torch.Tensor | None) -> dict[str, torch.Tensor]:
    rbm = RBM(visible=units, n_hidden=2).double()
    start_at_means(rbm, *arguments)
    return dict(rbm.state_dict())


@pytest.mark.parametrize("masked", [False, True])
@pytest.mark.parametrize("name", KINDS)
def test_weights_count_as_repeats(name: str, masked: bool) -> None:
    units = KINDS[name]
    v, observed = data(units), None
    if masked:
        observed = torch.ones_like(v, dtype=torch.bool)
        observed[1] = units.over_sites(torch.arange(units.n_sites) > 0)
    repeated = None if observed is None else observed.repeat_interleave(TIMES, dim=0)
    expected = started(units, v.repeat_interleave(TIMES, dim=0), repeated)
    found = started(units, v, observed, TIMES.double())
    plain = started(units, v, observed)
    assert set(found) == set(expected)
    for parameter in expected:
        torch.testing.assert_close(found[parameter], expected[parameter])
    assert not found["b"].allclose(plain["b"], rtol=0.01)


@pytest.mark.parametrize("name", KINDS)
def test_weights_of_one_change_nothing(name: str) -> None:
    units = KINDS[name]
    v = data(units)
    plain, weighted = started(units, v), started(units, v, None, torch.ones(5))
    for parameter in plain:
        torch.testing.assert_close(weighted[parameter], plain[parameter])


def test_bits_by_hand() -> None:
    v = torch.tensor([[1.0], [0.0]])
    bias = independent_bias(v, weight=torch.tensor([0.5, 2.0]))
    assert bias.item() == pytest.approx(torch.tensor(1.5 / 3.0).log().item())
