"""A tiny MNIST, and a web server on this machine."""

import functools
import gzip
import hashlib
import http.server
import struct
import threading

import pytest
import torch

from memcomp_lightning.data import mnist_files


def _idx_bytes(values):
    header = struct.pack(f">I{values.ndim}I", 0x0800 | values.ndim, *values.shape)
    return header + values.to(torch.uint8).numpy().tobytes()


@pytest.fixture
def idx_bytes():
    """Turns an array into the bytes of an IDX file."""
    return _idx_bytes


@pytest.fixture
def expect(monkeypatch):
    """Makes the checksums of some files the expected ones."""

    def expect(files):
        table = {name: hashlib.md5(data).hexdigest() for name, data in files.items()}
        monkeypatch.setattr(mnist_files, "MD5", table)

    return expect


@pytest.fixture
def files(expect):
    """A tiny MNIST, the bytes of each file, whose checksums are the expected ones."""
    files = {}
    for subset, n in (("train", 7), ("t10k", 3)):
        images = torch.arange(n * 28 * 28).view(n, 28, 28) * 37 % 256
        files[f"{subset}-images-idx3-ubyte"] = _idx_bytes(images)
        files[f"{subset}-labels-idx1-ubyte"] = _idx_bytes(torch.arange(n))
    expect(files)
    return files


@pytest.fixture
def write():
    """Writes files into a folder, packed or not."""

    def write(folder, files, packed=True):
        for name, data in files.items():
            if packed:
                (folder / f"{name}.gz").write_bytes(gzip.compress(data))
            else:
                (folder / name).write_bytes(data)

    return write


@pytest.fixture
def folder(tmp_path):
    folder = tmp_path / "data" / "MNIST" / "raw"
    folder.mkdir(parents=True)
    return folder


@pytest.fixture
def server(tmp_path, monkeypatch):
    """A web server of an empty folder on this machine: its folder and its address."""

    class Quiet(http.server.SimpleHTTPRequestHandler):
        def log_message(self, *args):
            pass

    monkeypatch.setenv("no_proxy", "*")
    served = tmp_path / "served"
    served.mkdir()
    handler = functools.partial(Quiet, directory=served)
    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), handler) as running:
        thread = threading.Thread(target=running.serve_forever, kwargs={"poll_interval": 0.01})
        thread.start()
        yield served, f"http://127.0.0.1:{running.server_port}/"
        running.shutdown()
        thread.join()
