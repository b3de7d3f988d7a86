import math

import pytest
import torch

from memcomp_lightning.data import (
    SIX_BY_SIX_WITHOUT_CORNERS,
    BarsAndStripes,
    Digits,
    ShiftingBars,
    reduce_images,
)
from memcomp_lightning.errors import SettingError


def test_reduction_is_the_block_mean_of_the_inner_pixels():
    images = (torch.arange(3 * 28 * 28).view(3, 28, 28) % 251) / 250
    reduced = SIX_BY_SIX_WITHOUT_CORNERS.to_picture(reduce_images(images))
    for row in range(6):
        for column in range(6):
            block = images[:, 2 + 4 * row : 6 + 4 * row, 2 + 4 * column : 6 + 4 * column]
            corner = row in (0, 5) and column in (0, 5)
            expected = torch.zeros(3) if corner else block.flatten(1).mean(dim=1)
            torch.testing.assert_close(reduced[:, row, column], expected)


def test_reduction_ignores_the_margin():
    images = torch.ones(2, 28, 28)
    images[:, 2:-2, 2:-2] = 0
    assert not reduce_images(images).any()


@pytest.mark.parametrize("shape", [(28, 28), (3, 28, 27), (3, 784)])
def test_reduction_refuses_other_sizes(shape):
    with pytest.raises(SettingError, match=r"images.shape = "):
        reduce_images(torch.zeros(shape))


def test_digits():
    data = Digits().load()
    assert data.train_v.shape == (1437, 32)
    assert data.test_v.shape == (360, 32)
    assert data.layout is SIX_BY_SIX_WITHOUT_CORNERS
    assert data.train_v.max() == 1
    shares = [label.bincount(minlength=10) / len(label) for label in (data.train_label, data.test_label)]
    torch.testing.assert_close(*shares, rtol=0, atol=0.003)


def test_digits_split_depends_on_its_seed_alone():
    first, again, other = Digits().load(), Digits().load(), Digits(split_seed=1).load()
    assert first.train_v.equal(again.train_v)
    assert not first.train_label.equal(other.train_label)


def test_digits_are_the_pixels_of_the_picture():
    from sklearn.datasets import load_digits

    pictures = torch.from_numpy(load_digits().images).float() / 16
    data = Digits().load()
    mine = SIX_BY_SIX_WITHOUT_CORNERS.to_picture(torch.cat((data.train_v, data.test_v)))
    expected = pictures[:, 1:-1, 1:-1].clone()
    expected[:, ::5, ::5] = 0
    torch.testing.assert_close(mine.sum(dim=0), expected.sum(dim=0))


def test_digits_as_bits():
    grey, above = Digits().load(), Digits(pixels="threshold", threshold=0.25).load()
    assert above.train_v.equal((grey.train_v > 0.25).float())
    assert above.test_v.equal((grey.test_v > 0.25).float())
    assert above.name == "digits_threshold"
    with pytest.raises(SettingError, match="pixels = 'binary'"):
        Digits(pixels="binary")


def test_shifting_bars():
    data = ShiftingBars().load()
    assert data.train_v.shape == (9, 9)
    assert data.n_classes == 9
    assert data.train_label.tolist() == list(range(9))
    for shift in range(9):
        assert data.train_v[shift].equal(data.train_v[0].roll(shift))
    assert data.train_v[0].tolist() == [1] * 5 + [0] * 4
    assert data.test_v.equal(data.train_v)
    inverted = ShiftingBars(inverted=True).load()
    assert inverted.train_v.equal(1 - data.train_v)
    assert inverted.name == "inverted_bars"


def test_copies_repeat_the_training_set():
    data = ShiftingBars(n_pixels=7, bar_length=3, copies=5).load()
    assert data.train_v.shape == (35, 7)
    assert (data.train_v[data.train_label == 4] == data.test_v[4]).all()
    assert BarsAndStripes(side=2, copies=3).load().train_v.shape == (18, 4)


@pytest.mark.parametrize("side", [2, 3, 5])
def test_bars_and_stripes_are_distinct_and_labelled(side):
    data = BarsAndStripes(side=side).load()
    assert len(data.train_v) == 2 * 2**side - 2
    assert len(data.train_v.unique(dim=0)) == len(data.train_v)
    for picture, label in zip(data.layout.to_picture(data.train_v), data.train_label, strict=True):
        constant_rows = bool((picture == picture[:, :1]).all())
        constant_columns = bool((picture == picture[:1]).all())
        assert constant_rows or constant_columns
        assert label == (0 if constant_rows else 1)


@pytest.mark.parametrize(
    ("source", "settings", "name"),
    [
        (ShiftingBars, {"n_pixels": 1}, "n_pixels"),
        (ShiftingBars, {"bar_length": 0}, "bar_length"),
        (ShiftingBars, {"bar_length": 9}, "bar_length"),
        (ShiftingBars, {"copies": 0}, "copies"),
        (BarsAndStripes, {"side": 1}, "side"),
        (BarsAndStripes, {"side": 13}, "side"),
        (BarsAndStripes, {"copies": 0}, "copies"),
        (Digits, {"split_seed": -1}, "split_seed"),
        (Digits, {"split_seed": 2**32}, "split_seed"),
    ],
)
def test_settings_out_of_range_are_refused(source, settings, name):
    value = math.prod(settings.values())
    with pytest.raises(SettingError, match=rf"{name} = {value} is not allowed"):
        source(**settings)
