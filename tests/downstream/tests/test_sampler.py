import lightning.pytorch as pl
import pytest
import torch
from sparse_digits.sampler import RandomScan

from memcomp_lightning import rng
from memcomp_lightning.data import Digits, ImageDataModule
from memcomp_lightning.errors import SettingError
from memcomp_lightning.models import DBN
from memcomp_lightning.modules import EnergyPretraining
from memcomp_lightning.samplers import positive_phase
from memcomp_lightning.testing import (
    check_sampler,
    chi_square_p_value,
    small_rbm,
    state_counts,
    visible_probabilities,
)
from memcomp_lightning.training import Greedy


def test_conformance() -> None:
    check_sampler(RandomScan())


def test_share_is_checked() -> None:
    with pytest.raises(SettingError, match=r"share = 0 is not allowed: expected a number in \(0, 1\]"):
        RandomScan(share=0)


def p_value(share_of_bias: float) -> float:
    """Of chains against the enumerated model; with a share other than 1 they see a visible bias that is off."""
    model, drawn_from = small_rbm(4, 3), small_rbm(4, 3)
    with torch.no_grad():
        drawn_from.b *= share_of_bias
    generator = rng.stream(0, "chains")
    sampler = RandomScan(n_sweeps=60, n_chains=20_000)
    positive = positive_phase(drawn_from, torch.zeros(1, 4))
    state = sampler.init(drawn_from, 1, generator=generator)
    v = sampler.sample(drawn_from, state, positive, generator=generator).configurations.v
    return chi_square_p_value(state_counts(v), visible_probabilities(model))


def test_distribution() -> None:
    assert p_value(1.0) > 1e-3
    assert p_value(0.5) < 1e-6


def test_it_trains_a_dbn() -> None:
    dbn = DBN(32, [11, 7])
    module = EnergyPretraining(Greedy(dbn), RandomScan(), iterations=3)
    before = [parameter.detach().clone() for parameter in dbn.parameters()]
    trainer = pl.Trainer(max_epochs=module.n_epochs, logger=False, enable_checkpointing=False)
    trainer.fit(module, datamodule=ImageDataModule(Digits().load(), batch_size=None))
    assert len(module.energy_gaps) == 2
    changed = [not old.equal(new) for old, new in zip(before, dbn.parameters(), strict=True)]
    assert sum(changed) >= 6
