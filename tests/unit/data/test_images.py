import pytest
import torch

from memcomp_lightning.data import ImageData, PixelLayout
from memcomp_lightning.errors import SettingError


def fields(**changes):
    values = {
        "train_v": torch.full((5, 3), 0.5),
        "train_label": torch.tensor([0, 1, 0, 1, 0]),
        "test_v": torch.ones(2, 3),
        "test_label": torch.tensor([1, 0]),
        "n_classes": 2,
        "layout": PixelLayout(height=2, width=2, pixels=(0, 1, 3)),
        "name": "tiny",
    }
    return values | changes


def with_value(value):
    v = torch.full((5, 3), 0.5)
    v[3, 1] = value
    return v


def test_picture_of_all_pixels_is_row_major():
    v = torch.arange(2 * 15).view(2, 15) / 30
    assert PixelLayout(height=3, width=5).to_picture(v).equal(v.view(2, 3, 5))


def test_picture_has_zero_where_there_is_no_unit():
    layout = PixelLayout(height=2, width=3, pixels=(4, 0))
    picture = layout.to_picture(torch.tensor([[[0.25, 0.75]]]))
    assert layout.n_visible == 2
    assert picture.tolist() == [[[[0.75, 0, 0], [0, 0.25, 0]]]]


@pytest.mark.parametrize("pixels", [(), (0, 0), (6,), (-1,)])
def test_layout_refuses_impossible_pixels(pixels):
    with pytest.raises(SettingError, match=r"pixels = .*from 0 to 5"):
        PixelLayout(height=2, width=3, pixels=pixels)


def test_layout_refuses_other_number_of_units():
    with pytest.raises(SettingError, match=r"v.shape\[-1\] = 5 .* 6 visible units"):
        PixelLayout(height=2, width=3).to_picture(torch.zeros(7, 5))


def test_valid_data_are_accepted():
    data = ImageData(**fields())
    assert data.n_visible == 3


@pytest.mark.parametrize("value", [float("inf"), -float("inf"), -0.25, 1.5])
@pytest.mark.parametrize("name", ["train_v", "test_v"])
def test_intensity_out_of_range_is_named_with_its_index(name, value):
    changes = {name: with_value(value)}
    if name == "test_v":
        changes["test_label"] = torch.zeros(5, dtype=torch.int64)
    with pytest.raises(SettingError, match=rf"{name}\[3, 1\] = {value} .*\[0, 1\].*255"):
        ImageData(**fields(**changes))


@pytest.mark.parametrize("label", [-2, 2])
def test_label_out_of_range_is_named_with_its_index(label):
    labels = torch.tensor([0, 1, 0, label, 1])
    with pytest.raises(SettingError, match=rf"train_label\[3\] = {label} .*from 0 to 1"):
        ImageData(**fields(train_label=labels))


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"train_v": torch.zeros(0, 3)}, r"train_v.shape = \(0, 3\)"),
        ({"train_v": torch.zeros(5, 4)}, r"train_v.shape = \(5, 4\) .*\(n, 3\)"),
        ({"test_v": torch.zeros(2, 1, 3)}, r"test_v.shape = \(2, 1, 3\)"),
        ({"train_label": torch.zeros(4, dtype=torch.int64)}, r"train_label.shape = \(4,\) .*\(5,\)"),
        ({"train_v": torch.zeros(5, 3, dtype=torch.float64)}, r"train_v.dtype = torch.float64"),
        ({"test_label": torch.zeros(2)}, r"test_label.dtype = torch.float32"),
        ({"n_classes": 0}, r"n_classes = 0"),
    ],
)
def test_mismatching_tensors_are_refused(changes, message):
    with pytest.raises(SettingError, match=message):
        ImageData(**fields(**changes))
