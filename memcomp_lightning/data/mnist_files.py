"""The four files of MNIST: where they are, how they get there, what must be in them."""

import contextlib
import http.client
import os
import tempfile
import urllib.error
import urllib.request
from functools import lru_cache
from pathlib import Path

from jaxtyping import UInt8
from torch import Tensor
from tqdm import tqdm

from memcomp_lightning.data import idx

MIRRORS = (
    "https://ossci-datasets.s3.amazonaws.com/mnist/",
    "https://storage.googleapis.com/cvdf-datasets/mnist/",
)
"""Folders that serve each file as ``<name>.gz``, tried in this order."""

MD5 = {
    "train-images-idx3-ubyte": "6bbc9ace898e44ae57da46a324031adb",
    "train-labels-idx1-ubyte": "a25bea736e30d166cdddb491f175f624",
    "t10k-images-idx3-ubyte": "2646ac647ad5339dbf082846283269ea",
    "t10k-labels-idx1-ubyte": "27ae3e4e09519cfbb04c329615203637",
}
"""MD5 of the *uncompressed* bytes of each file: the same file has been packed in more than one way."""

ATTEMPTS = 2
"""How often a download asks all mirrors."""

TIMEOUT_S = 20.0
"""How long a download waits for a silent mirror."""


Labelled = tuple[UInt8[Tensor, "n 28 28"], UInt8[Tensor, " n"]]
"""Images and their labels."""


def cache_folder() -> Path:
    """Return ``$XDG_CACHE_HOME/memcomp_lightning``, or ``~/.cache/memcomp_lightning``."""
    return Path(os.environ.get("XDG_CACHE_HOME") or "~/.cache").expanduser().absolute() / "memcomp_lightning"


def raw_folder(data_dir: str | None) -> Path:
    """Return ``MNIST/raw`` in ``data_dir``, else in the folder of ``MEMCOMP_DATA_DIR``, else in the cache."""
    root = data_dir or os.environ.get("MEMCOMP_DATA_DIR")
    return (Path(root).expanduser().absolute() if root else cache_folder()) / "MNIST" / "raw"


def read(data_dir: str | None, *, download: bool) -> tuple[Labelled, Labelled]:
    """Return training and test set, after fetching the files that are missing.

    Args:
        data_dir: See :func:`raw_folder`.
        download: Whether missing files may be fetched from the mirrors.

    Raises:
        FileNotFoundError: A file is missing and could not be fetched.
        CorruptFileError: A file does not hold what it must.
    """
    folder = raw_folder(data_dir)
    missing = [name for name in MD5 if _find(folder, name) is None]
    if missing and not download:
        raise FileNotFoundError(_missing_message(folder, missing, ["not asked: download=False"]))
    for position, name in enumerate(missing):
        answers = _fetch(folder, name)
        if answers:
            raise FileNotFoundError(_missing_message(folder, missing[position:], answers))
    return _arrays(folder)


@lru_cache(maxsize=2)
def _arrays(folder: Path) -> tuple[Labelled, Labelled]:
    """Return the arrays of a folder that holds all files: shared between loads, never written to."""
    return _read_pair(folder, "train"), _read_pair(folder, "t10k")


def _read_pair(folder: Path, subset: str) -> Labelled:
    images = _read_array(folder, f"{subset}-images-idx3-ubyte", n_axes=3)
    labels = _read_array(folder, f"{subset}-labels-idx1-ubyte", n_axes=1)
    if images.shape != (len(labels), 28, 28):
        raise idx.CorruptFileError(
            f"{folder}/{subset}-*: expected images of shape ({len(labels)}, 28, 28), one for each label, "
            f"got {tuple(images.shape)}."
        )
    return images, labels


def _read_array(folder: Path, name: str, n_axes: int) -> Tensor:
    # A file that another process removes in this moment raises FileNotFoundError with its own name.
    path = _find(folder, name) or folder / name
    data, source = path.read_bytes(), str(path)
    try:
        data = idx.checked(idx.unpacked(data, source) if path.suffix == ".gz" else data, MD5[name], source)
        return idx.parse(data, n_axes, source)
    except idx.CorruptFileError as error:
        raise idx.CorruptFileError(f"{error} Delete the file: the next run fetches it again.") from error


def _find(folder: Path, name: str) -> Path | None:
    candidates = (folder / name, folder / f"{name}.gz")
    return next((path for path in candidates if path.is_file()), None)


def _fetch(folder: Path, name: str) -> list[str]:
    """Download one file; return nothing on success, else what each mirror answered."""
    answers = []
    for _ in range(ATTEMPTS):
        for mirror in MIRRORS:
            url = f"{mirror}{name}.gz"
            try:
                packed = _download(url)
                idx.checked(idx.unpacked(packed, url), MD5[name], url)
            # URLError and time-outs are OSErrors; a connection cut short is an HTTPException.
            except (OSError, http.client.HTTPException, idx.CorruptFileError) as error:
                answers.append(f"{url}: {type(error).__name__}: {error}")
                if isinstance(error, urllib.error.HTTPError):
                    error.close()
                continue
            try:
                _write(folder / f"{name}.gz", packed)
            except OSError as error:
                return [f"{url}: fetched, but the folder cannot be written to: {error}"]
            return []
    return list(dict.fromkeys(answers))


def _download(url: str) -> bytes:
    with urllib.request.urlopen(url, timeout=TIMEOUT_S) as response:
        length = response.headers.get("Content-Length")
        total = int(length) if length else None
        data = bytearray()
        # disable=None: no bar where stderr is a file.
        with tqdm(desc=url, total=total, unit="B", unit_scale=True, disable=None) as progress:
            while block := response.read(1 << 16):
                data += block
                progress.update(len(block))
    return bytes(data)


def _write(path: Path, data: bytes) -> None:
    """Write a file at once: others see no file or the whole file, whoever of several processes comes last."""
    path.parent.mkdir(parents=True, exist_ok=True)
    descriptor, name = tempfile.mkstemp(prefix=f".{path.name}.", dir=path.parent)
    partial = Path(name)
    try:
        with os.fdopen(descriptor, "wb") as file:
            file.write(data)
        # mkstemp grants the owner alone; data that a shared folder holds is for all to read.
        partial.chmod(0o644)
        partial.replace(path)
    except BaseException:
        with contextlib.suppress(FileNotFoundError):
            partial.unlink()
        raise


def _missing_message(folder: Path, missing: list[str], answers: list[str]) -> str:
    lines = [
        "MNIST is incomplete. Missing:",
        *(f"  {folder / name} (or {name}.gz)" for name in missing),
        "Mirrors:",
        *(f"  {answer}" for answer in answers),
        "Set MEMCOMP_DATA_DIR (or data_dir) to a folder that holds MNIST/raw/ with these files, "
        "or train on the digits that need no download: data=digits.",
    ]
    return "\n".join(lines)
