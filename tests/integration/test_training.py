"""The modules inside a Trainer, without the command line."""

from collections.abc import Callable
from functools import partial
from typing import Any

import lightning.pytorch as pl
import pytest
import torch
from running import FAST, Outcome

from memcomp_lightning import rng
from memcomp_lightning.data import ImageData, ImageDataModule, PixelLayout, ShiftingBars
from memcomp_lightning.models import DBN, Normal
from memcomp_lightning.modules import BaselineClassifier, DBNClassifier, EnergyPretraining, StageModule
from memcomp_lightning.samplers import CD, PCD, Exact
from memcomp_lightning.training import Greedy, MomentumSchedule, evaluate

Run = Callable[..., Outcome]


def images(n: int = 101, n_visible: int = 7, n_classes: int = 3) -> ImageData:
    generator = rng.stream(0, "images")
    v = rng.uniform((n, n_visible), generator=generator)
    label = torch.arange(n) % n_classes
    v[torch.arange(n), label] = 0.95  # the label can be seen
    return ImageData(
        train_v=v,
        train_label=label,
        test_v=v[:53],
        test_label=label[:53],
        n_classes=n_classes,
        layout=PixelLayout(1, n_visible),
        name="made up",
    )


def fit(module: StageModule, data: ImageDataModule, *callbacks: pl.Callback, **settings: Any) -> pl.Trainer:
    trainer = pl.Trainer(
        **{"max_epochs": module.n_epochs, **settings},
        accelerator="cpu",
        logger=False,
        enable_checkpointing=False,
        enable_progress_bar=False,
        enable_model_summary=False,
        num_sanity_val_steps=0,
        callbacks=list(callbacks),
    )
    trainer.fit(module, datamodule=data)
    return trainer


def trained_dbn(
    sampler: Any = None, *, chunk_size: int = 10_000, batch_size: int | None = None, **settings: Any
) -> DBN:
    dbn = DBN(7, [5, 3], weight_init=Normal(std=0.5))
    module = EnergyPretraining(
        Greedy(dbn), sampler or Exact(), iterations=4, centring=None, schedules=[MomentumSchedule()]
    )
    fit(module, ImageDataModule(images(), batch_size=None, chunk_size=chunk_size))
    return dbn


@torch.no_grad()
def mean_log_likelihood(dbn: DBN, data: ImageDataModule) -> float:
    """Of the test images under the lowest RBM, in nats, by enumeration."""
    v = next(iter(data.test_dataloader())).v
    states = torch.cartesian_prod(*[torch.tensor([0.0, 1.0])] * dbn.n_visible)
    log_z = torch.logsumexp(-dbn[0].free_energy(states), dim=0)
    return float((-dbn[0].free_energy(v) - log_z).mean())


def test_chunks_of_a_full_batch_give_the_update_of_the_whole() -> None:
    whole, chunked = trained_dbn(), trained_dbn(chunk_size=17)
    for expected, found in zip(whole.parameters(), chunked.parameters(), strict=True):
        torch.testing.assert_close(found, expected, rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize(("sampler", "calls_an_epoch"), [(PCD(n_chains=3), 1), (CD(), 6)], ids=["pcd", "cd"])
def test_one_negative_phase_an_update_unless_it_starts_at_the_data(sampler: Any, calls_an_epoch: int) -> None:
    calls: list[int] = []

    class Counting:
        uses_data, shared, init = sampler.uses_data, sampler.shared, staticmethod(sampler.init)

        def sample(self, model: Any, state: Any, positive: Any, *, generator: torch.Generator) -> Any:
            calls.append(positive.v.shape[-2])
            return sampler.sample(model, state, positive, generator=generator)

    trained_dbn(Counting(), chunk_size=17)
    assert len(calls) == 2 * 4 * calls_an_epoch
    assert max(calls) <= 17, "no more activations than a chunk's are held at once"


def test_pretraining_one_layer_leaves_the_others_alone() -> None:
    dbn = DBN(7, [5, 3], weight_init=Normal(std=0.5))
    before = [parameter.detach().clone() for parameter in dbn.parameters()]
    module = EnergyPretraining(Greedy(dbn), Exact(), iterations=4)
    fit(module, ImageDataModule(images(), batch_size=None), max_epochs=4)
    changed = [not a.equal(b) for a, b in zip(before, dbn.parameters(), strict=True)]
    assert changed == [True, True, True, False, False, False]


def test_exact_pretraining_raises_the_likelihood_of_shifting_bars() -> None:
    data = ImageDataModule(ShiftingBars().load(), batch_size=None)
    dbn = DBN(9, [5], weight_init=Normal(std=0.1))

    before = mean_log_likelihood(dbn, data)
    fit(
        EnergyPretraining(Greedy(dbn), Exact(), iterations=300, optimizer=partial(torch.optim.Adam, lr=0.05)), data
    )
    after = mean_log_likelihood(dbn, data)
    assert before < -6.0, "nearly uniform over 2^9 states"
    assert after > -3.0, "nearly uniform over the nine bars: log 9 = 2.2"


@pytest.mark.parametrize(
    "optimizer", [torch.optim.SGD, torch.optim.Adam, torch.optim.AdamW, torch.optim.RMSprop, torch.optim.Adagrad]
)
def test_any_optimizer_raises_the_likelihood(optimizer: type[torch.optim.Optimizer]) -> None:
    data = ImageDataModule(ShiftingBars().load(), batch_size=None)
    dbn = DBN(9, [5], weight_init=Normal(std=0.1))
    before = mean_log_likelihood(dbn, data)
    fit(EnergyPretraining(Greedy(dbn), Exact(), iterations=50, optimizer=partial(optimizer, lr=0.1)), data)
    assert mean_log_likelihood(dbn, data) > before + 0.1


def test_momentum_switches_within_each_layer() -> None:
    seen: list[tuple[int, int, float]] = []

    class Watch(pl.Callback):
        def on_train_batch_start(self, trainer: pl.Trainer, pl_module: Any, batch: Any, batch_idx: int) -> None:
            momentum = pl_module.active_optimizer.param_groups[0]["momentum"]
            seen.append((pl_module.layer, pl_module.iteration, momentum))

    module = EnergyPretraining(
        Greedy(DBN(7, [5, 3])), Exact(), iterations=4, schedules=[MomentumSchedule(0.1, 0.5, switch_at=3)]
    )
    fit(module, ImageDataModule(images(), batch_size=None), Watch())
    assert seen == [(layer, i, 0.1 if i < 3 else 0.5) for layer in (0, 1) for i in range(4)]


def test_momentum_schedule_refuses_an_optimizer_without_momentum() -> None:
    settings = {"optimizer": torch.optim.Adam, "schedules": [MomentumSchedule()]}
    module = EnergyPretraining(Greedy(DBN(7, [5])), Exact(), iterations=1, **settings)
    with pytest.raises(ValueError, match=r"optimizer = 'Adam'.*schedules.momentum=null"):
        fit(module, ImageDataModule(images(), batch_size=None))


@pytest.mark.parametrize("kind", ["dbn", "baseline"])
@pytest.mark.parametrize("partitions", [1, 2])
def test_classifiers_learn(kind: str, partitions: int) -> None:
    data = ImageDataModule(images(), batch_size=10, partitions=partitions)
    optimizer = partial(torch.optim.Adam, lr=0.05)
    module: StageModule
    if kind == "dbn":
        dbn = DBN(7, [11], replicas=data.replicas, weight_init=Normal(std=0.5))
        module = DBNClassifier(dbn, n_classes=3, iterations=30, optimizer=optimizer)
    else:
        module = BaselineClassifier(
            7,
            [11],
            n_classes=3,
            replicas=data.replicas,
            weight_init=Normal(std=0.5),
            iterations=30,
            optimizer=optimizer,
        )
    before = evaluate(module.network, data.test_dataloader()).accuracy
    trainer = fit(module, data)
    after = evaluate(module.network, data.test_dataloader())
    assert after.accuracy.shape == data.replicas
    assert bool((after.accuracy > 0.8).all())
    assert bool((before < 0.7).all())
    trainer.test(module, datamodule=data, verbose=False)


def test_replicas_learn_as_they_would_alone() -> None:
    data = ImageDataModule(images(), batch_size=None, partitions=2)
    both = DBN(7, [5], replicas=(2,), weight_init=Normal(std=0.5))
    alone = DBN(7, [5])
    alone.load_state_dict({name: tensor[1] for name, tensor in both.state_dict().items()})
    fit(EnergyPretraining(Greedy(both), Exact(), iterations=3), data)
    batch = next(iter(data.train_dataloader()))
    part = ImageData(
        train_v=batch.v[1],
        train_label=batch.label[1],
        test_v=batch.v[1],
        test_label=batch.label[1],
        n_classes=3,
        layout=PixelLayout(1, 7),
        name="one part",
    )
    fit(EnergyPretraining(Greedy(alone), Exact(), iterations=3), ImageDataModule(part, batch_size=None))
    for name, tensor in alone.state_dict().items():
        torch.testing.assert_close(both.state_dict()[name][1], tensor, rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize(("hidden", "given", "n_threads"), [(5, None, 1), (3000, None, 3), (5, "3", 3)])
def test_small_updates_take_one_thread(
    memcomp_train: Run, monkeypatch: pytest.MonkeyPatch, hidden: int, given: str | None, n_threads: int
) -> None:
    """Those who train side by side are in each other's way otherwise; what somebody sets stands."""
    seen = set()
    monkeypatch.delenv("OMP_NUM_THREADS", raising=False)
    if given is not None:
        monkeypatch.setenv("OMP_NUM_THREADS", given)
    monkeypatch.setattr(torch, "get_num_threads", lambda: 3)
    monkeypatch.setattr(torch, "set_num_threads", seen.add)
    outcome = memcomp_train(*FAST, "sampler=cd", f"model.hidden_sizes=[{hidden}]", "hydra.run.dir=run")
    assert outcome.status == 0, outcome.err
    assert seen == ({1, 3} if n_threads == 1 else set())
