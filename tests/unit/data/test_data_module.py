import lightning.pytorch as pl
import pytest
import torch

from memcomp_lightning.data import ImageData, ImageDataModule, PixelLayout
from memcomp_lightning.data.missing import split_missing
from memcomp_lightning.errors import SettingError

N_TRAIN, N_TEST = 41, 13


def images():
    """Each image carries its number, in units of 1/64; test images come after training images."""
    number = torch.arange(N_TRAIN + N_TEST)
    v = torch.stack((number / 64, torch.zeros(len(number)), torch.ones(len(number))), dim=-1)
    label = number % 7
    return ImageData(
        train_v=v[:N_TRAIN],
        train_label=label[:N_TRAIN],
        test_v=v[N_TRAIN:],
        test_label=label[N_TRAIN:],
        n_classes=7,
        layout=PixelLayout(height=1, width=3),
        name="numbered",
    )


def numbers(batches):
    """The numbers of the images, ``(*replicas, n)``."""
    for batch in batches:
        assert batch.label.equal((batch.v[..., 0] * 64).long() % 7)
    return torch.cat([(batch.v[..., 0] * 64).long() for batch in batches], dim=-1)


def make(**settings):
    return ImageDataModule(images(), **({"batch_size": 5} | settings))


def test_whole_set_has_no_replica_axis():
    data = make()
    assert data.replicas == ()
    assert (data.n_train, data.n_visible, data.n_classes) == (41, 3, 7)
    assert data.pixel_layout == PixelLayout(height=1, width=3)
    assert numbers(data.train_dataloader()).sort().values.tolist() == list(range(41))
    for loader in (data.val_dataloader(), data.test_dataloader()):
        assert numbers(loader).tolist() == list(range(41, 54))


def test_partitions_are_disjoint_and_equal():
    data = make(partitions=3)
    assert data.replicas == (3,)
    assert data.n_train == 13
    train = numbers(data.train_dataloader())
    assert train.shape == (3, 13)
    assert len(train.unique()) == 39
    assert train.max() < 41


def test_partition_does_not_depend_on_the_training_seed():
    def parts(**settings):
        return numbers(make(partitions=3, **settings).train_dataloader()).sort(dim=-1).values

    assert parts(seed=1).equal(parts(seed=2))
    assert not parts(partition_seed=1).equal(parts())


@pytest.mark.parametrize("partitions", [1, 3])
def test_held_out_images_are_not_trained_on(partitions):
    data = make(partitions=partitions, validation_fraction=0.3)
    n_part = 41 // partitions
    n_held_out = round(0.3 * n_part)
    train, held_out = numbers(data.train_dataloader()), numbers(data.val_dataloader())
    assert train.shape == (*data.replicas, n_part - n_held_out)
    assert held_out.shape == (*data.replicas, n_held_out)
    assert data.n_train == n_part - n_held_out
    assert len(torch.cat((train, held_out), dim=-1).unique()) == partitions * n_part
    assert held_out.max() < 41


def test_partition_is_the_same_with_and_without_held_out_images():
    whole = numbers(make(partitions=3).train_dataloader()).sort(dim=-1).values
    data = make(partitions=3, validation_fraction=0.3)
    both = torch.cat((numbers(data.train_dataloader()), numbers(data.val_dataloader())), dim=-1)
    assert both.sort(dim=-1).values.equal(whole)


def test_replicas_share_the_test_images_without_a_copy():
    data = make(partitions=3, chunk_size=5)
    batches = list(data.test_dataloader())
    assert [batch.label.shape for batch in batches] == [(3, 4), (3, 4), (3, 5)]
    assert [batch.closes_step for batch in batches] == [False, False, True]
    assert sum(batch.share for batch in batches) == pytest.approx(1)
    storage = data.images.test_v.untyped_storage().data_ptr()
    assert all(batch.v.untyped_storage().data_ptr() == storage for batch in batches)
    assert numbers(batches).equal(torch.arange(41, 54).expand(3, -1))


@pytest.mark.parametrize("partitions", [1, 3])
def test_parts_are_taken_from_the_images_without_a_copy(partitions):
    data = make(partitions=partitions, validation_fraction=0.3, labels=12, chunk_size=3)
    for loader in (data.train_dataloader(), data.val_dataloader()):
        assert loader._v.data_ptr() == data.images.train_v.data_ptr()
    assert numbers(data.val_dataloader()).equal((data.heldout[0][..., 0] * 64).long())
    twice = numbers(data.val_dataloader().repeated([0, 1]))
    assert twice.equal(numbers(data.val_dataloader()).view(partitions, -1).repeat(2, 1))


def test_a_mask_over_zeros_needs_no_copy():
    v, observed = torch.tensor([[0.0, 1.0], [1.0, 1.0]]), torch.tensor([[False, True], [True, True]])
    assert split_missing(v, observed, "v")[0] is v
    for odd in (2.0, torch.nan):
        v[0, 0] = odd
        assert split_missing(v, observed, "v")[0].tolist() == [[0, 1], [1, 1]]


def test_all_images_at_once():
    data = make(batch_size=None)
    (batch,) = data.train_dataloader()
    assert batch.v.data_ptr() == data.images.train_v.data_ptr()


class Recorder(pl.LightningModule):
    """Writes down the images of each step, and saves a checkpoint where it is told to."""

    def __init__(self, save_at=None, path=None):
        super().__init__()
        self.automatic_optimization = False
        self.unused = torch.nn.Parameter(torch.zeros(()))
        self.save_at, self.path = save_at, path
        self.seen, self.held_out = [], []

    def configure_optimizers(self):
        return torch.optim.SGD([self.unused], lr=0.1)

    def training_step(self, batch, batch_idx):
        self.seen.append((self.current_epoch, batch_idx, numbers([batch]).tolist()))
        if batch.closes_step:
            self.optimizers().step()

    def on_train_batch_end(self, outputs, batch, batch_idx):
        if self.save_at == (self.current_epoch, batch_idx):
            self.trainer.save_checkpoint(self.path)

    def on_train_epoch_end(self):
        if self.save_at == (self.current_epoch, "end"):
            self.trainer.save_checkpoint(self.path)

    def validation_step(self, batch, batch_idx):
        self.held_out.append(batch)


def fit(recorder, data, max_epochs, resume=None, **settings):
    trainer = pl.Trainer(
        accelerator="cpu",
        max_epochs=max_epochs,
        logger=False,
        enable_checkpointing=False,
        enable_progress_bar=False,
        enable_model_summary=False,
        **settings,
    )
    trainer.fit(recorder, datamodule=data, ckpt_path=resume)
    return recorder


# Lightning 2.6 builds a LeafSpec, which torch 2.13 deprecates.
with_lightning = pytest.mark.filterwarnings("ignore:.*LeafSpec.*:FutureWarning")


@with_lightning
def test_lightning_chooses_the_order_of_each_epoch():
    data = make(batch_size=11, chunk_size=7)
    recorder = fit(Recorder(), data, max_epochs=2, num_sanity_val_steps=0)
    loader = data.train_dataloader()
    expected = []
    for epoch in range(2):
        loader.set_epoch(epoch)
        expected += [(epoch, index, numbers([batch]).tolist()) for index, batch in enumerate(loader)]
    assert len(expected) == 2 * (3 * 2 + 2)
    assert recorder.seen == expected
    assert len(recorder.held_out) == 2 * 2
    assert recorder.held_out[1].closes_step is True


@with_lightning
@pytest.mark.parametrize("save_at", [(1, 0), (1, 3), (1, 7), (0, "end"), (1, "end")])
@pytest.mark.parametrize("limit", [1.0, 4])
def test_resumed_run_sees_what_the_uninterrupted_one_sees(save_at, limit, tmp_path):
    settings = {"max_epochs": 3, "limit_train_batches": limit, "limit_val_batches": 0}
    n_batches = 8 if limit == 1.0 else 4
    epoch, index = save_at
    if index == 7:
        save_at = epoch, n_batches - 1
    path = str(tmp_path / "saved.ckpt")
    whole = fit(Recorder(save_at, path), make(batch_size=11, chunk_size=7), **settings).seen
    resumed = fit(Recorder(), make(batch_size=11, chunk_size=7), resume=path, **settings).seen
    n_done = epoch * n_batches + (n_batches if index in ("end", 7) else index + 1)
    assert resumed == whole[n_done:]


class TwoProcesses:
    """The part of a trainer that the data module reads."""

    world_size = 2

    def __init__(self, global_rank):
        self.global_rank = global_rank


def test_training_is_sharded_and_evaluation_is_not():
    seen = []
    for rank in range(2):
        data = make(batch_size=7)
        data.trainer = TwoProcesses(rank)
        seen.append(numbers(data.train_dataloader()))
        assert len(numbers(data.val_dataloader())) == 13
    assert [len(part) for part in seen] == [5 * 4 + 3, 5 * 3 + 3]
    assert torch.cat(seen).sort().values.tolist() == list(range(41))


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"batch_size": 0}, r"batch_size = 0 "),
        ({"partitions": 0}, r"partitions = 0 "),
        ({"partitions": 42}, r"partitions = 42 .*41"),
        ({"validation_fraction": -0.1}, r"validation_fraction = -0.1 .*\[0, 1\)"),
        ({"validation_fraction": 1.0}, r"validation_fraction = 1.0 .*\[0, 1\)"),
        ({"validation_fraction": 0.01}, r"validation_fraction = 0.01 .*holds out 0"),
        ({"validation_fraction": 0.99}, r"validation_fraction = 0.99 .*holds out 41"),
        ({"chunk_size": 0}, r"chunk_size = 0 "),
        ({"seed": -1}, r"seed = -1 "),
        ({"partition_seed": -1}, r"partition_seed = -1 "),
    ],
)
def test_settings_are_checked_at_construction(settings, message):
    with pytest.raises(SettingError, match=message):
        make(**settings)


def test_batch_may_be_all_images_that_are_not_held_out():
    assert len(make(batch_size=37, validation_fraction=0.1).train_dataloader()) == 1


def test_first_partitions_are_the_first_of_all():
    everything = ImageDataModule(images(), partitions=5, batch_size=None)
    few = ImageDataModule(images(), partitions=5, first_partitions=2, batch_size=None)
    assert few.replicas == (2,)
    (all_parts,), (first,) = everything.train_batches(0, 1), few.train_batches(0, 1)
    assert first.v.equal(all_parts.v[:2])
    assert ImageDataModule(images(), first_partitions=3, batch_size=None).replicas == ()


@pytest.mark.parametrize("partitions", [1, 3])
@pytest.mark.parametrize("batch_size", [None, 7])
def test_repeated_batches_are_those_of_each_seed(partitions, batch_size):
    def batches(seed):
        data = ImageDataModule(images(), partitions=partitions, batch_size=batch_size, seed=seed)
        return data.train_batches(0, 1)

    together, alone = batches(0).repeated([4, 9, 4]), [batches(seed) for seed in (4, 9, 4)]
    for epoch in (0, 3):
        for part in (together, *alone):
            part.set_epoch(epoch)
        for whole, *parts in zip(together, *alone, strict=True):
            assert whole.v.equal(torch.cat([part.v.view(-1, *part.v.shape[-2:]) for part in parts]))
            assert whole.label.equal(torch.cat([part.label.view(-1, part.label.shape[-1]) for part in parts]))
            assert all(whole[2:] == part[2:] for part in parts)
