import gzip
import os
import struct

import pytest
import torch

from memcomp_lightning.data import CorruptFileError, Mnist, ReducedMnist, idx, mnist_files, reduce_images
from memcomp_lightning.errors import SettingError

needs_mnist = pytest.mark.skipif(
    not os.environ.get("MEMCOMP_DATA_DIR"), reason="MEMCOMP_DATA_DIR is not set: no MNIST"
)


@pytest.mark.parametrize("packed", [True, False])
def test_files_are_read_packed_or_not(files, folder, packed, write):
    write(folder, files, packed)
    data = Mnist(data_dir=str(folder.parents[1]), download=False).load()
    assert data.train_v.shape == (7, 784)
    assert data.test_v.shape == (3, 784)
    assert data.train_label.tolist() == list(range(7))
    expected = torch.arange(7 * 784).view(7, 784) * 37 % 256 / 255
    torch.testing.assert_close(data.train_v, expected)
    assert (data.name, data.n_classes, data.layout.height) == ("mnist", 10, 28)


def test_environment_names_the_folder(files, folder, monkeypatch, write):
    write(folder, files)
    monkeypatch.setenv("MEMCOMP_DATA_DIR", str(folder.parents[1]))
    assert ReducedMnist(download=False).load().train_v.shape == (7, 32)


def test_default_folder_is_in_the_cache(monkeypatch, tmp_path):
    monkeypatch.delenv("MEMCOMP_DATA_DIR", raising=False)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    assert mnist_files.raw_folder(None) == tmp_path / "memcomp_lightning" / "MNIST" / "raw"
    monkeypatch.setenv("XDG_CACHE_HOME", "")
    monkeypatch.setenv("HOME", str(tmp_path))
    assert mnist_files.raw_folder(None) == tmp_path / ".cache" / "memcomp_lightning" / "MNIST" / "raw"


def test_pixels(files, folder, write):
    write(folder, files)
    settings = {"data_dir": str(folder.parents[1]), "download": False}
    grey = Mnist(**settings).load().train_v
    above = Mnist(**settings, pixels="threshold", threshold=0.25).load()
    assert above.train_v.equal((grey > 0.25).float())
    drawn, again, other = (Mnist(**settings, pixels="stochastic", seed=seed).load().train_v for seed in (3, 3, 5))
    assert drawn.equal(again)
    assert not drawn.equal(other)
    assert ((drawn == 0) | (drawn == 1)).all()
    # Mean of 5,488 draws with variance <= 1/4 each: five standard errors are 0.034.
    assert abs(float((drawn - grey).mean())) < 0.034
    assert not drawn[grey == 0].any()
    assert drawn[grey == 1].all()


def test_reduced_is_the_reduction_of_grey(files, folder, write):
    write(folder, files)
    settings = {"data_dir": str(folder.parents[1]), "download": False}
    grey = Mnist(**settings).load().test_v
    assert ReducedMnist(**settings).load().test_v.equal(reduce_images(grey.view(3, 28, 28)))


def test_reduced_pixels_are_those_of_the_reduced_image(files, folder, write):
    write(folder, files)
    settings = {"data_dir": str(folder.parents[1]), "download": False}
    grey, above = ReducedMnist(**settings).load(), ReducedMnist(**settings, pixels="threshold").load()
    assert above.train_v.equal((grey.train_v > 0.5).float())
    assert above.name == "reduced_mnist_threshold"


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"pixels": "gray"}, r"pixels = 'gray' .*'grey', 'threshold', 'stochastic'"),
        ({"threshold": 1.0}, r"threshold = 1.0"),
        ({"threshold": -0.1}, r"threshold = -0.1"),
        ({"seed": -1}, r"seed = -1"),
    ],
)
def test_settings_out_of_range_are_refused(settings, message):
    with pytest.raises(SettingError, match=message):
        Mnist(**settings)


def test_truncated_gzip_is_named(files, folder, write):
    write(folder, files)
    broken = folder / "t10k-images-idx3-ubyte.gz"
    broken.write_bytes(broken.read_bytes()[:-11])
    with pytest.raises(CorruptFileError, match=r"t10k-images-idx3-ubyte.gz: expected a complete gzip"):
        Mnist(data_dir=str(folder.parents[1])).load()


def test_file_that_is_no_gzip_is_named(files, folder, write):
    write(folder, files)
    (folder / "train-labels-idx1-ubyte.gz").write_bytes(b"<html>")
    with pytest.raises(CorruptFileError, match=r"train-labels-idx1-ubyte.gz: expected .*gzip"):
        Mnist(data_dir=str(folder.parents[1])).load()


def test_wrong_checksum_is_named(files, folder, write):
    write(folder, files)
    data = bytearray(files["train-images-idx3-ubyte"])
    data[-1] ^= 1
    (folder / "train-images-idx3-ubyte.gz").write_bytes(gzip.compress(data))
    with pytest.raises(CorruptFileError, match=r"train-images.*gz: expected .*MD5 .*Delete the file"):
        Mnist(data_dir=str(folder.parents[1])).load()


def test_images_and_labels_must_belong_together(files, folder, expect, write, idx_bytes):
    files["t10k-labels-idx1-ubyte"] = idx_bytes(torch.arange(2))
    expect(files)
    write(folder, files)
    with pytest.raises(CorruptFileError, match=r"t10k-.*\(2, 28, 28\).*got \(3, 28, 28\)"):
        Mnist(data_dir=str(folder.parents[1])).load()


def test_idx_arrays_are_parsed(idx_bytes):
    values = torch.arange(2 * 3 * 5).view(2, 3, 5)
    assert idx.parse(idx_bytes(values), 3, "file").equal(values.to(torch.uint8))


@pytest.mark.parametrize(
    ("data", "message"),
    [
        (b"\0\0", r"file: expected a header of 8 bytes, got 2 bytes"),
        (struct.pack(">II", 0x0803, 1) + b"x", r"magic number 0x00000801 .*got 0x00000803"),
        (struct.pack(">II", 0x0D01, 1) + b"x", r"magic number 0x00000801 .*got 0x00000d01"),
        (struct.pack(">II", 0x0801, 3) + b"xx", r"expected 3 bytes .*\(3,\).*got 2"),
        (struct.pack(">II", 0x0801, 1) + b"xx", r"expected 1 bytes .*\(1,\).*got 2"),
        (struct.pack(">II", 0x0801, 0), r"expected values, got the shape \(0,\)"),
    ],
)
def test_idx_errors(data, message):
    with pytest.raises(CorruptFileError, match=message):
        idx.parse(data, 1, "file")


def test_an_idx_file_of_huge_axes_without_values():
    with pytest.raises(CorruptFileError, match="expected values"):
        idx.parse(struct.pack(">IIII", 0x0803, 0, 2**32 - 1, 2**32 - 1), 3, "file")


@pytest.mark.needs_mnist
@needs_mnist
def test_real_mnist():
    data = Mnist(download=False).load()
    assert data.train_v.shape == (60_000, 784)
    assert data.test_v.shape == (10_000, 784)
    assert data.train_label[:5].tolist() == [5, 0, 4, 1, 9]
    assert data.test_label[:5].tolist() == [7, 2, 1, 0, 4]
    assert float(data.train_v.mean()) == pytest.approx(0.1307, abs=1e-4)


@pytest.mark.needs_mnist
@needs_mnist
def test_real_reduced_mnist():
    data = ReducedMnist(download=False).load()
    assert data.train_v.shape == (60_000, 32)
    picture = data.layout.to_picture(data.train_v[data.train_label == 0].mean(dim=0))
    # A zero is dark in its middle and bright around it.
    assert picture[2:4, 2:4].mean() < picture[2:4, 1].mean()
