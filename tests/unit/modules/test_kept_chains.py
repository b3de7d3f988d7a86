"""A training that goes on from another: its chains, its centres, its random streams."""

from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any

import lightning.pytorch as pl
import pytest
import torch

from memcomp_lightning import rng
from memcomp_lightning.data import ImageDataModule, ShiftingBars
from memcomp_lightning.models import DBN
from memcomp_lightning.modules import EnergyPretraining
from memcomp_lightning.objective import Centring, Offsets
from memcomp_lightning.samplers import CD, PCD, Exact, ModeAssisted, ModeSchedule, tensors_of
from memcomp_lightning.training import EnergyStep, Greedy, StepState, kept_of, state_of

QUIET = {"enable_progress_bar": False, "enable_model_summary": False, "enable_checkpointing": False}


class StoppedError(Exception):
    pass


class Stops(pl.Callback):
    """Ends the process, as it were, at the start of a pass."""

    def __init__(self, at: int, path: Path) -> None:
        self.at, self.path = at, path

    def on_train_epoch_start(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        if trainer.current_epoch == self.at:
            raise StoppedError

    def on_train_epoch_end(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
        if trainer.current_epoch == self.at - 1:
            trainer.save_checkpoint(self.path)


def module(
    weights: DBN | None = None, *, sizes: Sequence[int] = (4, 3), iterations: int = 2, **settings: Any
) -> EnergyPretraining:
    dbn = DBN(9, sizes)
    if weights is not None:
        dbn.load_state_dict(weights.state_dict())
    optimizer = partial(torch.optim.SGD, lr=0.1)
    sampler = PCD(n_chains=6)
    return EnergyPretraining(Greedy(dbn), sampler, iterations=iterations, optimizer=optimizer, **settings)


def fit(
    made: EnergyPretraining,
    folder: Path,
    resume: Path | None = None,
    also: Any = (),
    batch_size: int | None = 5,
) -> EnergyPretraining:
    trainer = pl.Trainer(
        max_epochs=made.n_epochs,
        accelerator="cpu",
        logger=False,
        callbacks=list(also),
        num_sanity_val_steps=0,
        limit_val_batches=0,
        default_root_dir=folder,
        **QUIET,
    )
    data = ImageDataModule(ShiftingBars(copies=2).load(), batch_size=batch_size)
    trainer.fit(made, datamodule=data, ckpt_path=resume, weights_only=True)
    return made


def same(one: Any, other: Any) -> bool:
    if isinstance(one, torch.Tensor):
        return one.equal(other)
    if isinstance(one, dict):
        return one.keys() == other.keys() and all(same(x, other[name]) for name, x in one.items())
    return bool(one == other)


@pytest.mark.parametrize("centring", [None, Centring(rate=0.1)])
def test_an_update_of_the_chains_that_go_on_is_that_of_the_longer_training(
    tmp_path: Path, centring: Centring | None
) -> None:
    """With all images in an update, whose order says nothing."""
    whole: dict[str, Any] = {"sizes": [4], "centring": centring}
    long = fit(module(iterations=4, **whole), tmp_path, batch_size=None)
    short = fit(module(iterations=3, **whole), tmp_path, batch_size=None)
    more = module(short.network, iterations=1, earlier=short.left(), **whole)
    assert same(fit(more, tmp_path, batch_size=None).network.state_dict(), long.network.state_dict())
    assert same(more.left(), long.left())


@pytest.mark.parametrize("at", [1, 2, 3])
def test_an_interruption_changes_nothing(tmp_path: Path, at: int) -> None:
    first = fit(module(), tmp_path)
    left = first.left()
    assert left is not None
    assert list(left["models"]) == ["layer 1", "layer 2"]
    whole = fit(module(first.network, earlier=left), tmp_path)
    assert whole.chains == {"layer 1": "are kept", "layer 2": "are kept"}
    path = tmp_path / "last.ckpt"
    with pytest.raises(StoppedError):
        fit(module(first.network, earlier=left), tmp_path, also=[Stops(at, path)])
    resumed = fit(module(first.network, earlier=left), tmp_path, resume=path)
    assert same(resumed.network.state_dict(), whole.network.state_dict())
    assert same(resumed.left(), whole.left())
    assert resumed.chains == whole.chains


def test_other_seed_begins_other_streams_with_the_chains_that_are_there(tmp_path: Path) -> None:
    first = fit(module(), tmp_path)
    left = first.left()
    same_seed, other = (fit(module(first.network, seed=seed, earlier=left), tmp_path) for seed in (0, 1))
    assert other.chains == same_seed.chains
    assert not same(other.network.state_dict(), same_seed.network.state_dict())
    anew = fit(module(first.network), tmp_path)
    assert not same(anew.network.state_dict(), same_seed.network.state_dict())


def step(sampler: Any, centring: Centring | None = None) -> EnergyStep:
    return EnergyStep(sampler=sampler, centring=centring)


def begun(sampler: Any, kept: dict[str, Any], centring: Centring | None = None, n: int = 4) -> Any:
    model = DBN(9, [4])[0]
    return state_of(kept, step(sampler, centring), model, n, generator=rng.stream(0, "check"))


def state(sampler: Any, n: int = 4) -> StepState:
    offsets = Offsets(torch.full((9,), 0.25), torch.full((4,), 0.75))
    return StepState(sampler.init(DBN(9, [4])[0], n, generator=rng.stream(5, "chains")), offsets)


def test_chains_of_the_same_kind_and_shape_are_kept() -> None:
    pcd = PCD(n_chains=6)
    kept = kept_of(state(pcd), step(pcd))
    found, said = begun(PCD(n_chains=6, k=3), kept, Centring(rate=0.5))
    assert said == "are kept"
    assert found.sampler.x.equal(state(pcd).sampler.x)
    assert found.offsets.visible.unique().tolist() == [0.25]
    assert begun(pcd, kept)[0].offsets is None
    per_image = PCD(n_chains=None)
    kept = kept_of(state(per_image, 4), step(per_image))
    assert begun(per_image, kept)[1] == "are kept"
    for sampler, why, n in (
        (PCD(n_chains=5), "another number", 4),
        (per_image, "another number", 3),
        (CD(), "PCD", 4),
    ):
        found, said = begun(sampler, kept, Centring(rate=0.5), n)
        assert why in said
        assert found.sampler is None
        assert found.offsets.hidden.unique().tolist() == [0.75]


def test_samplers_without_chains_say_so() -> None:
    assert begun(CD(), kept_of(state(CD()), step(CD())))[1] == "are none: CD remembers nothing"


def test_counts_begin_anew_as_schedules_do() -> None:
    schedule = ModeSchedule(n_updates=10)
    assisted = ModeAssisted(inner=PCD(n_chains=6), mode=Exact(), schedule=schedule)
    before = state(assisted)
    before = before._replace(sampler=before.sampler._replace(n_done=torch.tensor(7)))
    found, said = begun(assisted, kept_of(before, step(assisted)))
    assert said == "are kept"
    assert tensors_of(found.sampler)["n_done"] == 0
    assert tensors_of(found.sampler)["inner.x"].equal(tensors_of(before.sampler)["inner.x"])
    other = ModeAssisted(inner=CD(), mode=Exact(), schedule=schedule)
    assert "has others now" in begun(other, kept_of(before, step(assisted)))[1]
