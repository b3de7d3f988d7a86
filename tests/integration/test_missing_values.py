"""Data with missing values: the mask goes wherever the values go, and both loops train alike."""

from functools import partial
from pathlib import Path
from typing import Any

import lightning.pytorch as pl
import pytest
import torch
from torch import Tensor

from memcomp_lightning import rng
from memcomp_lightning.callbacks import LogLikelihood, ReconstructionError, SaturationGuard
from memcomp_lightning.data import Batches, ImageData, ImageDataModule, ShiftingBars
from memcomp_lightning.data.baselines import independent_log_likelihood
from memcomp_lightning.errors import SettingError
from memcomp_lightning.likelihood import log_likelihood, log_partition_function
from memcomp_lightning.models import DBN, RBM, start_at_means
from memcomp_lightning.models.units import Bernoulli, Categorical, Gaussian, Spin, Units
from memcomp_lightning.modules import DBNClassifier, EnergyPretraining
from memcomp_lightning.samplers import CD, PCD
from memcomp_lightning.training import Greedy, pretrain

OPTIMIZER = partial(torch.optim.SGD, lr=0.1)
KINDS: dict[str, Units] = {
    "bernoulli": Bernoulli(9),
    "spin": Spin(9),
    "categorical": Categorical(9, q=2),
    "gaussian": Gaussian(9),
}


def images(missing: float = 0.2) -> ImageData:
    """Bars of which a fifth of the pixels is NaN."""
    full = ShiftingBars(copies=4).load()
    hidden = rng.uniform(full.train_v.shape, generator=rng.stream(0, "hidden")) < missing
    hidden[:, 0] &= hidden[:, 1:].any(-1).logical_not()  # no row is all hidden
    v = full.train_v.masked_fill(hidden, torch.nan)
    return ImageData(v, full.train_label, v[:9], full.train_label[:9], full.n_classes, full.layout, "holes")


def trainer(folder: Path, n_passes: int, **settings: Any) -> pl.Trainer:
    return pl.Trainer(
        max_epochs=n_passes,
        accelerator="cpu",
        enable_progress_bar=False,
        enable_model_summary=False,
        default_root_dir=folder,
        **{"logger": False, "enable_checkpointing": False, **settings},
    )


@pytest.mark.parametrize(("n_hidden", "sampler"), [(4, CD()), (8, PCD(n_chains=5))], ids=["summed", "drawn"])
@pytest.mark.parametrize("partitions", [1, 2])
@pytest.mark.parametrize("units", KINDS.values(), ids=KINDS)
def test_both_loops_end_with_the_same_weights(
    tmp_path: Path, units: Units, partitions: int, sampler: Any, n_hidden: int
) -> None:
    def data() -> ImageDataModule:
        return ImageDataModule(
            images(), batch_size=6, chunk_size=4, partitions=partitions, validation_fraction=0.2, units=units
        )

    first = RBM(visible=units, n_hidden=n_hidden, replicas=data().replicas)
    second = RBM(visible=units, n_hidden=n_hidden, replicas=data().replicas)
    callbacks = [ReconstructionError(), LogLikelihood(every=1), SaturationGuard(patience=1)]
    module = EnergyPretraining(Greedy(first), sampler, iterations=2, optimizer=OPTIMIZER, centring=None)
    trainer(tmp_path, 2, callbacks=callbacks).fit(module, datamodule=data())
    batches = data().train_batches(0, 1)
    for _ in pretrain(Greedy(second), batches, sampler, iterations=2, optimizer=OPTIMIZER):
        pass
    for one, other in zip(first.parameters(), second.parameters(), strict=True):
        assert one.equal(other)
        assert bool(one.isfinite().all())
    filled = data()
    rows = filled._train.rows._replace(observed=None)  # zeros in place of what is missing: another training
    filled._train = filled._train._replace(rows=rows)
    third = RBM(visible=units, n_hidden=n_hidden, replicas=data().replicas)
    for _ in pretrain(Greedy(third), filled.train_batches(0, 1), sampler, iterations=2, optimizer=OPTIMIZER):
        pass
    assert not first.weight.allclose(third.weight, rtol=0.01)
    likelihood: Any = callbacks[1]
    value = likelihood.history[-1]
    if units.linear:  # no draw of means: the data are values of their units
        v, observed = data().heldout[0], data().heldout_observed
        assert observed is not None
        expected = log_likelihood(first, v, log_partition_function(first), observed=observed).mean(-1)
        torch.testing.assert_close(
            torch.tensor(value["heldout"]), expected.flatten().float(), rtol=1e-4, atol=1e-4
        )


@pytest.mark.parametrize("units", [None, Spin(9), Categorical(9, q=3)], ids=["as they are", "spins", "categories"])
@pytest.mark.parametrize("world_size", [1, 2])
def test_the_mask_stays_beside_its_values(units: Units | None, world_size: int) -> None:
    """Shuffled, in chunks, over two processes, once for each of two seeds."""
    n = 12
    v = torch.arange(n * 9.0).view(n, 9) % 3  # states, when taken as categories
    observed = rng.uniform((n, 9), generator=rng.stream(0, "mask")) < 0.8
    observed[:, 3] = True
    kept = v.to(torch.uint8) if isinstance(units, Categorical) else v
    number = torch.arange(n)
    settings: dict[str, Any] = {"chunk_size": 2, "shuffle": True, "seed": 3, "observed": observed, "units": units}
    for rank in range(world_size):
        batches = Batches(kept, number, 5, **settings, check=False, rank=rank, world_size=world_size)
        for some in (batches, batches.repeated([1, 2])):
            for batch in some:
                assert batch.observed is not None
                sites = torch.where(observed, v, 0.0)[batch.label]
                expected = sites if units is None else units.encode(sites)
                assert batch.v.equal(expected)
                mask = observed[batch.label]
                assert batch.observed.equal(mask if units is None else units.over_sites(mask))


def test_categories_are_kept_as_numbers() -> None:
    data = ImageDataModule(ShiftingBars().load(), units=Categorical(9, q=4))
    batch = next(iter(data.train_batches(0, 1)))
    assert batch.v.shape == (9, 36)
    kept = data.train_batches(0, 1)._v
    assert isinstance(kept, Tensor)
    assert kept.shape == (9, 9)
    assert kept.dtype == torch.uint8
    assert data.units.to_intensity(batch.v).sort(0).values.equal(data.images.train_v.sort(0).values)


@pytest.mark.parametrize("units", KINDS.values(), ids=KINDS)
def test_grey_values_and_back(units: Units) -> None:
    v = torch.tensor([[0.0, 1.0, 1.0, 0.0, 1.0, 0.0, 0.0, 1.0, 0.0]])
    x = units.encode(units.from_intensity(v))
    units.check(x, pure=True)
    assert units.to_intensity(x).equal(v)


def test_grey_values_become_the_nearest_level() -> None:
    units = Categorical([5, 2, 1])
    assert units.from_intensity(torch.tensor([[0.3, 0.6, 0.9]])).tolist() == [[1, 1, 0]]
    mean = torch.tensor([[0.0, 0.5, 0.0, 0.5, 0.0, 0.25, 0.75, 1.0]])
    torch.testing.assert_close(units.to_intensity(mean), torch.tensor([[0.5, 0.75, 0.0]]))


def test_a_checkpoint_goes_on_with_the_mask(tmp_path: Path) -> None:
    def fit(n_passes: int, **settings: Any) -> tuple[EnergyPretraining, pl.Trainer]:
        module = EnergyPretraining(Greedy(RBM(9, 8)), PCD(n_chains=5), iterations=4, optimizer=OPTIMIZER)
        running = trainer(tmp_path, n_passes)
        running.fit(module, datamodule=ImageDataModule(images(), batch_size=6), **settings)
        return module, running

    whole, _ = fit(4)
    _, half = fit(2)
    half.save_checkpoint(tmp_path / "half.ckpt")
    again, _ = fit(4, ckpt_path=tmp_path / "half.ckpt", weights_only=True)
    for one, other in zip(whole.parameters(), again.parameters(), strict=True):
        assert one.equal(other)


def test_deeper_layers_see_draws(tmp_path: Path) -> None:
    dbn = DBN(9, [4, 3])
    module = EnergyPretraining(Greedy(dbn), CD(), iterations=1, optimizer=OPTIMIZER)
    trainer(tmp_path, 2, callbacks=[LogLikelihood(every=1)]).fit(module, datamodule=ImageDataModule(images()))
    assert not dbn[1].weight.equal(DBN(9, [4, 3])[1].weight)


def test_a_classifier_refuses_missing_values(tmp_path: Path) -> None:
    module = DBNClassifier(DBN(9, [4]), n_classes=9, iterations=1)
    with pytest.raises(
        SettingError, match=r"missing values = 'in the data of a classifier'.*finetune.iterations=0"
    ):
        trainer(tmp_path, 1, num_sanity_val_steps=0).fit(module, datamodule=ImageDataModule(images()))


@pytest.mark.parametrize(
    ("observed", "message"),
    [
        (torch.zeros(9, 9, dtype=torch.bool), "values known in row 0 = 0 is not allowed: expected one or more"),
        (torch.ones(9, 8, dtype=torch.bool), r"v_observed.shape = \(9, 8\) is not allowed"),
        (torch.ones(9, 9), "v_observed.dtype = torch.float32 is not allowed"),
    ],
)
def test_masks_that_do_not_fit(observed: Tensor, message: str) -> None:
    with pytest.raises(SettingError, match=message):
        Batches(torch.zeros(9, 9), torch.arange(9), None, 9, False, 0, observed=observed)


@pytest.mark.parametrize(
    "units", [Bernoulli(4), Spin(4), Categorical([2, 3]), Gaussian(4)], ids=lambda u: type(u).__name__
)
def test_independent_units_where_values_are_missing(units: Units) -> None:
    """Against the likelihood of an RBM without couplings, which sums over what is missing."""
    generator = rng.stream(0, "data")
    v = units.sample(torch.zeros(20, units.n), generator=generator)
    observed = units.over_sites(rng.uniform((20, units.n_sites), generator=generator) < 0.7)
    observed[observed.sum(-1) == 0] = True
    rbm = RBM(visible=units, n_hidden=1, weight_init=lambda shape, generator: torch.zeros(shape)).double()
    start_at_means(rbm, v.double(), observed)
    expected = log_likelihood(rbm, v, log_partition_function(rbm), observed=observed).mean()
    found = independent_log_likelihood(v, v, units, train_observed=observed, observed=observed)
    assert found == pytest.approx(float(expected), abs=1e-6)
