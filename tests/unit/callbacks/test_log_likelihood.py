"""Log-likelihoods against enumeration, of images drawn from grey ones."""

from pathlib import Path

import pytest
import torch
from foreign import IMAGES, TheirChains, TheirRBM, fit

from memcomp_lightning import rng
from memcomp_lightning.callbacks import LogLikelihood
from memcomp_lightning.enumeration import binary_states
from memcomp_lightning.errors import SettingError
from memcomp_lightning.metrics import MeanLogLikelihood, MeanLogPseudoLikelihood
from memcomp_lightning.models import RBM, Normal

pytestmark = pytest.mark.filterwarnings("ignore:.*does not have many workers.*")
fits = pytest.mark.usefixtures("allow_global_rng")  # torch's DataLoader draws a base seed


def log_partition_function(rbm: RBM) -> torch.Tensor:
    states = binary_states(rbm.n_visible, like=rbm.b).expand(*rbm.replicas, -1, -1)
    return (-rbm.free_energy(states).double()).logsumexp(-1)


def log_pseudo_likelihood(rbm: RBM, v: torch.Tensor) -> torch.Tensor:
    gains = []
    for unit in range(rbm.n_visible):
        flipped = v.clone()
        flipped[..., unit] = 1 - flipped[..., unit]
        gains.append(rbm.free_energy(flipped) - rbm.free_energy(v))
    return torch.nn.functional.logsigmoid(torch.stack(gains, dim=-1).double())


@fits
@pytest.mark.parametrize("kind", [TheirRBM, TheirChains])
@pytest.mark.parametrize("method", ["exact", "ais"])
def test_values_against_enumeration(tmp_path: Path, kind: type[TheirRBM], method: str) -> None:
    callback = LogLikelihood(every=2, method=method, n_images=7, n_chains=200, n_betas=200, seed=4)
    module, trainer = fit(tmp_path, [callback], module=kind())
    rbm, logged, prefix = module.model, trainer.callback_metrics, kind.__name__
    train = IMAGES[10:].expand(*rbm.replicas, -1, -1)  # the last batches that hold at least seven images
    train = rng.bernoulli(train, generator=rng.stream(4, "log_likelihood", 0))
    bits = rng.stream(4, "log_likelihood", 1)
    batches = [rng.bernoulli(part.expand(*rbm.replicas, -1, -1), generator=bits) for part in IMAGES.split(5)]
    with torch.no_grad():
        log_z = log_partition_function(rbm)
        on_train = (-rbm.free_energy(train)).mean(-1) - log_z
        heldout = (-rbm.free_energy(torch.cat(batches, dim=-2))).mean(-1) - log_z
    tolerance = 1e-5 if method == "exact" else 0.02
    assert logged[f"{prefix}/log_z"] == pytest.approx(float(log_z.mean()), abs=tolerance)
    assert logged[f"{prefix}/log_likelihood_train"] == pytest.approx(float(on_train.mean()), abs=tolerance)
    assert logged[f"{prefix}/log_likelihood_heldout"] == pytest.approx(float(heldout.mean()), abs=tolerance)
    assert (f"{prefix}/log_z_standard_error" in logged) == (method == "ais")


@fits
@pytest.mark.parametrize("method", ["exact", "ais"])
def test_training_is_the_same_bit_for_bit(tmp_path: Path, method: str) -> None:
    callback = LogLikelihood(every=1, method=method, n_chains=5, n_betas=5)
    watched, _ = fit(tmp_path, [callback])
    alone, _ = fit(tmp_path, [])
    assert all(a.equal(b) for a, b in zip(watched.parameters(), alone.parameters(), strict=True))


@fits
def test_a_model_too_large_to_enumerate_is_refused_before_training(tmp_path: Path) -> None:
    with pytest.raises(SettingError, match=r"units to enumerate for LogLikelihood = 5 .* at most 4 units"):
        fit(tmp_path, [LogLikelihood(method="exact", max_units=4)])


def test_settings_out_of_range_are_refused() -> None:
    with pytest.raises(SettingError, match=r"method = 'guess'.*'exact', 'ais'"):
        LogLikelihood(method="guess")  # type: ignore[arg-type]
    with pytest.raises(SettingError, match="n_chains = 1"):
        LogLikelihood(n_chains=1)


def test_metrics_add_up_over_batches_and_processes() -> None:
    rbm = RBM(6, 5, replicas=(2,), weight_init=Normal(std=0.5))
    v = rng.bernoulli(IMAGES.expand(2, -1, -1), generator=rng.stream(0, "bits"))
    with torch.no_grad():
        log_z = log_partition_function(rbm)
        likelihood = (-rbm.free_energy(v).double() - log_z.unsqueeze(-1)).mean(-1)
        pseudo = log_pseudo_likelihood(rbm, v).sum(-1).mean(-1)
    own, other = MeanLogLikelihood(replicas=(2,)), MeanLogLikelihood(replicas=(2,))
    own.update(rbm, v[:, :5], log_z)
    own.update(rbm, v[:, 5:8], log_z)
    other.update(rbm, v[:, 8:], log_z)
    own.merge_state(other)  # what dist_reduce_fx does between processes
    torch.testing.assert_close(own.compute(), likelihood, rtol=1e-5, atol=1e-5)
    metric = MeanLogPseudoLikelihood(replicas=(2,))
    for part in v.split(4, dim=-2):
        metric.update(rbm, part)
    torch.testing.assert_close(metric.compute(), pseudo, rtol=1e-5, atol=1e-5)
    metric.reset()
    metric.update(rbm, v)
    torch.testing.assert_close(metric.compute(), pseudo, rtol=1e-5, atol=1e-5)
