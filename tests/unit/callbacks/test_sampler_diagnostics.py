"""Mixing of chains: times of processes whose time is known, and what is logged."""

from pathlib import Path
from typing import Any, NamedTuple

import pytest
import torch
from foreign import TheirChains, TheirRBM, fit
from torch import Tensor

from memcomp_lightning import rng
from memcomp_lightning.callbacks import SamplerDiagnostics
from memcomp_lightning.callbacks.sampler_diagnostics import autocorrelation_time
from memcomp_lightning.samplers import CD, PCD

PREFIX = "TheirChains/negative_phase"


def walk(memory: Tensor, n_times: int = 300, n_chains: int = 200) -> Tensor:
    """Autoregressive chains, ``(*replicas, n_times, n_chains)``; rho(t) = memory^t."""
    generator = rng.stream(0, "walk")
    x = torch.zeros(*memory.shape, n_chains)
    series = []
    for _ in range(n_times + 50):
        noise = torch.empty_like(x).normal_(generator=generator)
        x = memory.unsqueeze(-1) * x + (1 - memory.square()).sqrt().unsqueeze(-1) * noise
        series.append(x)
    return torch.stack(series[50:], dim=-2)


def test_time_of_chains_whose_time_is_known() -> None:
    series = walk(torch.tensor([0.0, 0.5, 0.8]), n_chains=2000)
    expected = torch.tensor([1.0, 3.0, 9.0], dtype=torch.float64)  # (1 + memory) / (1 - memory)
    time = autocorrelation_time(series)
    assert time.shape == (3,)
    assert ((time / expected - 1).abs() < 0.08).all(), time
    drifting = (1 + torch.arange(300.0) / 100).unsqueeze(-1) * series + torch.arange(300.0).unsqueeze(-1)
    torch.testing.assert_close(autocorrelation_time(drifting), time, rtol=1e-3, atol=1e-3)


def test_chains_that_never_move_take_as_long_as_the_series() -> None:
    stuck = torch.arange(5.0).expand(8, 5)
    assert autocorrelation_time(stuck).item() == pytest.approx(1 + 2 * 7)
    assert autocorrelation_time(torch.zeros(8, 5)).item() == pytest.approx(1 + 2 * 7)


fits = pytest.mark.usefixtures("allow_global_rng")  # torch's DataLoader draws a base seed
quiet = pytest.mark.filterwarnings("ignore:.*does not have many workers.*")


class Remembers(TheirChains):
    """Keeps chains and energies of the last update of each pass."""

    log_prefix = "TheirChains"

    def __init__(self) -> None:
        super().__init__()
        self.seen: list[Tensor] = []
        self.energies: list[Tensor] = []

    def training_step(self, batch: list[torch.Tensor], batch_idx: int) -> dict[str, Any]:
        self.negative = (outputs := super().training_step(batch, batch_idx))["negative"]
        return outputs

    @torch.no_grad()
    def on_train_epoch_end(self) -> None:
        self.seen.append(self.negative.v)
        self.energies.append(self.model.energy(self.negative.v, self.negative.h))


@fits
@quiet
def test_values_against_chains_that_were_kept(tmp_path: Path) -> None:
    module, trainer = fit(tmp_path, [SamplerDiagnostics(history=3)], module=Remembers(), n_passes=5)
    changed = (module.seen[-1] != module.seen[-2]).float().mean()
    assert changed > 0
    assert trainer.callback_metrics[f"{PREFIX}/bits_changed"] == pytest.approx(float(changed))
    time = autocorrelation_time(torch.stack(module.energies[-3:], dim=-2))
    assert trainer.callback_metrics[f"{PREFIX}/autocorrelation_time"] == pytest.approx(float(time.mean()))


@fits
@quiet
def test_a_resumed_run_goes_on_with_the_series(tmp_path: Path) -> None:
    whole, half, rest = (SamplerDiagnostics() for _ in range(3))
    _, uninterrupted = fit(tmp_path, [whole], module=TheirChains(), n_passes=4)
    _, trainer = fit(tmp_path, [half], module=TheirChains(), n_passes=2)
    trainer.save_checkpoint(tmp_path / "half.ckpt")
    _, resumed = fit(tmp_path, [rest], module=TheirChains(), n_passes=4, resume_from=tmp_path / "half.ckpt")
    assert len(rest.state_dict()["energies"]) == 4
    for name in ("bits_changed", "autocorrelation_time"):
        key = f"{PREFIX}/{name}"
        assert resumed.callback_metrics[key] == uninterrupted.callback_metrics[key]


class Wraps(NamedTuple):
    """A sampler of which only the state matters: it holds that of another, and a count."""

    inner: Any

    def init(self, model: Any, n_chains: int, *, generator: torch.Generator) -> Any:
        return torch.zeros(()), self.inner.init(model, n_chains, generator=generator)


@fits
@quiet
@pytest.mark.parametrize(
    ("sampler", "persists"), [(CD(), False), (PCD(), True), (Wraps(CD()), False), (Wraps(PCD()), True)]
)
def test_chains_that_start_at_the_data_have_no_mixing(tmp_path: Path, sampler: Any, persists: bool) -> None:
    module = TheirRBM()
    module.sampler = sampler
    _, trainer = fit(tmp_path, [SamplerDiagnostics()], module=module)
    assert "TheirRBM/negative_phase/temperature" in trainer.callback_metrics
    assert ("TheirRBM/negative_phase/bits_changed" in trainer.callback_metrics) == persists
