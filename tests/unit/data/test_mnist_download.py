import gzip
import threading

import pytest

from memcomp_lightning.data import Mnist, mnist_files


def test_missing_files_are_named_when_download_is_off(files, folder, write):
    write(folder, files)
    for name in ("t10k-images-idx3-ubyte", "train-labels-idx1-ubyte"):
        (folder / f"{name}.gz").unlink()
    with pytest.raises(FileNotFoundError) as caught:
        Mnist(data_dir=str(folder.parents[1]), download=False).load()
    message = str(caught.value)
    assert str(folder / "t10k-images-idx3-ubyte") in message
    assert str(folder / "train-labels-idx1-ubyte") in message
    assert "train-images" not in message
    for hint in ("download=False", "MEMCOMP_DATA_DIR", "data=digits"):
        assert hint in message


def test_download_passes_over_a_failing_mirror(files, tmp_path, server, monkeypatch, write):
    served, address = server
    (served / "good").mkdir()
    write(served / "good", files)
    monkeypatch.setattr(mnist_files, "MIRRORS", (f"{address}absent/", f"{address}good/"))
    settings = {"data_dir": str(tmp_path / "new"), "pixels": "grey"}
    data = Mnist(**settings).load()
    assert data.train_v.shape == (7, 784)
    fetched = tmp_path / "new" / "MNIST" / "raw"
    assert sorted(path.name for path in fetched.iterdir()) == sorted(f"{name}.gz" for name in files)
    mnist_files._arrays.cache_clear()
    assert Mnist(**settings, download=False).load().train_v.equal(data.train_v)


def test_present_files_are_not_fetched(files, folder, server, monkeypatch, write):
    served, address = server
    name = "t10k-labels-idx1-ubyte"
    write(served, {name: files[name]})
    write(folder, {other: data for other, data in files.items() if other != name})
    monkeypatch.setattr(mnist_files, "MIRRORS", (address,))
    assert Mnist(data_dir=str(folder.parents[1])).load().test_label.tolist() == [0, 1, 2]


def test_failed_download_says_what_each_mirror_answered(files, tmp_path, server, monkeypatch, write):
    served, address = server
    (served / "other").mkdir()
    (served / "cut").mkdir()
    write(served / "other", dict.fromkeys(files, b"something else"))
    for name, data in files.items():
        (served / "cut" / f"{name}.gz").write_bytes(gzip.compress(data)[:-11])
    mirrors = tuple(f"{address}{folder}/" for folder in ("absent", "other", "cut"))
    monkeypatch.setattr(mnist_files, "MIRRORS", mirrors)
    with pytest.raises(FileNotFoundError) as caught:
        Mnist(data_dir=str(tmp_path / "new")).load()
    lines = str(caught.value).splitlines()
    answers = [line for line in lines if address in line]
    assert len(answers) == 3
    for answer, expected in zip(answers, ("404", "MD5", "complete gzip"), strict=True):
        assert expected in answer
    assert sum(str(tmp_path / "new") in line for line in lines) == 4
    assert not (tmp_path / "new").exists()


def test_interrupted_write_leaves_nothing(tmp_path, monkeypatch):
    def interrupt(self, target):
        raise KeyboardInterrupt

    monkeypatch.setattr("pathlib.Path.replace", interrupt)
    with pytest.raises(KeyboardInterrupt):
        mnist_files._write(tmp_path / "raw" / "file.gz", b"content")
    assert list((tmp_path / "raw").iterdir()) == []


def test_folder_that_cannot_be_written_is_named(files, tmp_path, server, monkeypatch, write):
    served, address = server
    write(served, files)
    monkeypatch.setattr(mnist_files, "MIRRORS", (address,))
    (tmp_path / "new").write_text("a file where the folder should be")
    with pytest.raises(FileNotFoundError, match="cannot be written to"):
        Mnist(data_dir=str(tmp_path / "new")).load()


def test_several_writers_leave_one_whole_file(tmp_path):
    path = tmp_path / "file.gz"
    contents = [bytes([k]) * 100_003 for k in range(5)]
    threads = [threading.Thread(target=mnist_files._write, args=(path, data)) for data in contents]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert path.read_bytes() in contents
    assert [entry.name for entry in tmp_path.iterdir()] == ["file.gz"]
