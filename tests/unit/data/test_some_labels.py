"""Labels for some of the rows: who sees which."""

import pandas as pd
import pytest
import torch

from memcomp_lightning import rng
from memcomp_lightning.data import ImageData, ImageDataModule, PixelLayout
from memcomp_lightning.data.labels import labelled_at
from memcomp_lightning.data.tables import data_of
from memcomp_lightning.errors import SettingError

N_TRAIN, N_TEST = 60, 12
SHARES = [0] * 30 + [1] * 20 + [2] * 10


def labels(n_unlabelled=0):
    """Three classes in all orders; the first rows have no label."""
    order = torch.randperm(N_TRAIN, generator=rng.stream(0, "order"))
    found = torch.tensor(SHARES)[order]
    found[:n_unlabelled] = -1
    return found


def images(n_unlabelled=0, test_label=None):
    """The first pixel of an image is its number, in units of 1/128; test images come after training images."""
    v = (torch.arange(N_TRAIN + N_TEST) / 128).unsqueeze(-1).repeat(1, 2)
    test_label = torch.arange(N_TEST) % 3 if test_label is None else test_label
    layout = PixelLayout(height=1, width=2)
    return ImageData(v[:N_TRAIN], labels(n_unlabelled), v[N_TRAIN:], test_label, 3, layout, "numbered")


def make(n_unlabelled=0, **settings):
    return ImageDataModule(images(n_unlabelled), **{"batch_size": 7} | settings)


def numbers(rows):
    return (rows[0][..., 0] * 128).long()


@pytest.mark.parametrize(("n", "expected"), [(6, [3, 2, 1]), (12, [6, 4, 2]), (3, [1, 1, 1]), (59, [29, 20, 10])])
def test_each_class_has_its_share(n, expected):
    label = labels()
    found = labelled_at(label, n, seed=3)
    assert found.shape == (n,)
    assert found.equal(found.unique())
    assert label[found].bincount().tolist() == expected


@pytest.mark.parametrize("seed", range(20))
def test_shares_of_any_counts_add_up(seed):
    counts = 1 + (40 * rng.uniform((6,), generator=rng.stream(seed, "counts")) ** 4).long()
    label = torch.repeat_interleave(torch.arange(6), counts)
    for n in range(6, len(label) + 1):
        found = label[labelled_at(label, n)].bincount(minlength=6)
        assert found.sum() == n
        assert (found >= 1).all()
        assert (found <= counts).all()
        exact = counts * n / len(label)
        if (exact >= 1).all():  # else the largest classes give what the smallest take
            assert ((found - exact).abs() < 1).all()


def test_draw_follows_its_seed_alone_and_takes_rows_with_a_label():
    label = labels(n_unlabelled=25)
    first, again, other = (labelled_at(label, 10, seed=seed) for seed in (0, 0, 1))
    assert first.equal(again)
    assert not first.equal(other)
    assert (label[first] >= 0).all()
    assert len({tuple(labelled_at(labels(), 6, seed=seed).tolist()) for seed in range(10)}) == 10


def test_replicas_draw_for_themselves():
    found = labelled_at(labels().expand(2, -1), 6)
    assert not found[0].equal(found[1])
    assert labels()[found[1]].bincount().tolist() == [3, 2, 1]


def test_pretraining_sees_all_rows_and_fine_tuning_those_with_a_label():
    whole, tuned = make(n_unlabelled=25), make(n_unlabelled=25, labels="all")
    assert numbers(whole.train).tolist() == list(range(60))
    assert whole.n_labels is None
    assert numbers(tuned.train).tolist() == list(range(25, 60))
    assert (tuned.n_train, tuned.n_labels) == (35, 35)
    assert tuned.class_totals.sum() == 35


def test_without_a_row_that_lacks_one_nothing_changes():
    for settings in ({}, {"partitions": 3}, {"validation_fraction": 0.2}):
        plain, tuned = make(**settings), make(labels="all", **settings)
        assert tuned.n_labels is None
        for part in ("train", "heldout", "test"):
            assert getattr(plain, part)[0].equal(getattr(tuned, part)[0])


def test_test_rows_without_a_label_are_left_out():
    data = images(test_label=torch.tensor([-1, 2] * 6))
    assert ImageDataModule(data, labels=6).test[1].tolist() == [2] * 6
    assert len(ImageDataModule(data).test[1]) == 12
    assert not ImageDataModule(data, labels=6).holds_out


@pytest.mark.parametrize("settings", [{}, {"partitions": 2}])
def test_held_out_rows_come_out_of_the_labels_and_pretraining_does_not_see_them(settings):
    pretrained = make(validation_fraction=0.25, **settings)
    tuned = make(validation_fraction=0.25, labels=12, **settings)
    assert (tuned.n_train, tuned.n_labels) == (9, 12)
    assert tuned.heldout[1].shape == (*tuned.replicas, 3)
    for seen, part in ((pretrained.train, tuned.train), (pretrained.heldout, tuned.heldout)):
        rows = (numbers(x).view(-1, x[1].shape[-1]).tolist() for x in (seen, part))
        assert all(set(taken) < set(own) for own, taken in zip(*rows, strict=True))


def test_where_chance_held_out_few_labels_the_others_are_trained_on():
    tuned = make(n_unlabelled=50, validation_fraction=0.5, labels="all")
    n_held_out = tuned.heldout[1].shape[-1]
    assert 1 <= n_held_out < 5  # else this test tests nothing
    assert tuned.n_train + n_held_out == 10
    all_ten = make(n_unlabelled=50, validation_fraction=0.5, labels=10)
    assert (all_ten.n_train, all_ten.heldout[1].shape[-1]) == (tuned.n_train, n_held_out)


def test_labels_follow_the_seed_and_held_out_rows_do_not():
    first, other = (make(validation_fraction=0.25, labels=12, seed=seed) for seed in (0, 1))
    assert not numbers(first.train).equal(numbers(other.train))
    assert numbers(make(validation_fraction=0.25, seed=0).heldout).equal(
        numbers(make(validation_fraction=0.25, seed=1).heldout)
    )


def test_totals_of_the_classes_count_weights():
    data = make(labels=12)
    assert data.class_totals.tolist() == [6, 4, 2]
    weight = torch.arange(1.0, 61)
    data._train = data._train._replace(rows=data._train.rows._replace(weight=weight))
    own = weight[data._train.at]
    assert data.class_totals.tolist() == [float(own[data._train.label == k].sum()) for k in range(3)]


@pytest.mark.parametrize(
    ("n_unlabelled", "settings", "message"),
    [
        (0, {"labels": 0}, r"finetune.labels = 0 .*integer >= 1"),
        (0, {"labels": "many"}, r"finetune.labels = 'many' "),
        (0, {"labels": 2}, r"finetune.labels = 2 .*each of the 3 classes"),
        (0, {"labels": 61}, r"finetune.labels = 61 .*up to the 60 rows"),
        (20, {"labels": 41}, r"finetune.labels = 41 .*up to the 40 rows"),
        (0, {"labels": 4, "validation_fraction": 0.5}, r"finetune.labels = 4 .*beside the 2 that are held out"),
        (60, {"labels": "all"}, r"labels of the training rows = 0 .*finetune.iterations=0"),
        (59, {"labels": "all", "validation_fraction": 0.1}, r"labels of the held-out rows = 0 "),
    ],
)
def test_labels_that_are_not_there_are_refused(n_unlabelled, settings, message):
    with pytest.raises(SettingError, match=message):
        make(n_unlabelled, **settings)


def test_a_test_set_without_labels_is_refused():
    with pytest.raises(SettingError, match="labels of the test rows = 0"):
        ImageDataModule(images(test_label=torch.full((N_TEST,), -1)), labels=6)


@pytest.mark.parametrize(
    ("column", "expected"),
    [
        (["a", "b", "", "-1", "b", "a"], [0, 1, -1, -1, 1, 0]),
        ([0, 3, None, -1, 3, 0], [0, 1, -1, -1, 1, 0]),
        ([-1, 1, None, -1, 1, 1], [0, 1, -1, 0, 1, 1]),
    ],
)
def test_cells_without_a_label_in_a_table(column, expected):
    frame = pd.DataFrame({"x": [0, 1, 1, 0, 1, 1], "y": pd.Series(column, dtype=object)})
    table = data_of(frame, columns={"label": "y"}, test_fraction=0.2)
    assert table.n_classes == 2
    order = torch.randperm(6, generator=rng.stream(0, "test rows"))
    both = torch.cat((table.train.label, table.test.label))
    assert both[order].tolist() == expected
