"""Arrays of others: damaged headers, members that are no arrays, and sizes that the file does not have."""

import io
import zipfile

import numpy as np
import pytest
from scipy.sparse import csr_matrix, save_npz

from memcomp_lightning.array_files import ArrayFileError, opened_arrays
from memcomp_lightning.data import PixelLayout, Table
from memcomp_lightning.data.schema import ImageSchema
from memcomp_lightning.errors import UserError
from memcomp_lightning.problems import ProblemFileError, read_problem

pytest.importorskip("pyarrow")


def npy(array):
    buffer = io.BytesIO()
    np.save(buffer, array)
    return buffer.getvalue()


WHOLE = npy(np.arange(12.0).reshape(4, 3) / 12)
DAMAGED = {
    "open bracket": WHOLE.replace(b"(4, 3)", b"(4, 3 "),
    "too large": WHOLE.replace(b"(4, 3), ", b"(4000000000, 3), ")[: len(WHOLE)],
    "negative": WHOLE.replace(b"(4, 3), ", b"(-4, 3), "),
    "no header": WHOLE[:8],
    "version": WHOLE[:6] + b"\x09" + WHOLE[7:],
    "text": b"hello",
    "nothing": b"",
}


@pytest.mark.parametrize("content", DAMAGED.values(), ids=DAMAGED)
def test_damaged_arrays_are_refused_everywhere(tmp_path, content):
    path, archive = tmp_path / "a.npy", tmp_path / "a.npz"
    path.write_bytes(content)
    with zipfile.ZipFile(archive, "w") as file:
        file.writestr("x.npy", content)
        file.writestr("weight.npy", content)
    with pytest.raises(ArrayFileError), opened_arrays(path):
        pass
    with opened_arrays(archive) as found, pytest.raises(ArrayFileError, match="x: "):
        found["x"]
    for name in (path, archive):
        with pytest.raises(UserError, match="cannot be read"):
            ImageSchema(PixelLayout(1, 3), 0).read(name)
        with pytest.raises(UserError, match="damaged"):
            Table(path=str(name)).load()
        with pytest.raises(ProblemFileError, match="no readable arrays"):
            read_problem(name, "rbm")


def test_a_member_that_is_no_array(tmp_path):
    with zipfile.ZipFile(tmp_path / "a.npz", "w") as file:
        file.writestr("x", b"hello")
    with opened_arrays(tmp_path / "a.npz") as found, pytest.raises(ArrayFileError):
        found["x"]


def test_large_numbers_are_no_grey_values(tmp_path):
    np.save(tmp_path / "a.npy", np.full((2, 3), 1e300))
    with pytest.raises(UserError, match=r"pixel 0: 1e\+300 is not a number in \[0, 1\]"):
        ImageSchema(PixelLayout(1, 3), 0).read(tmp_path / "a.npy")


@pytest.mark.parametrize("shape", [(0, 3), (0, 0), (2, 0), (0, 1, 3)])
def test_no_pictures(tmp_path, shape):
    np.save(tmp_path / "a.npy", np.zeros(shape))
    with pytest.raises(UserError, match="expected rows of 3 pixels"):
        ImageSchema(PixelLayout(1, 3), 0).read(tmp_path / "a.npy")


@pytest.mark.parametrize("index", [-1, 6, 2**31 - 1])
def test_sparse_matrices_whose_indices_lie_outside(tmp_path, index):
    """SciPy would write there."""
    matrix = csr_matrix(np.eye(6))
    matrix.indices[2] = index
    save_npz(tmp_path / "a.npz", matrix)
    with pytest.raises(UserError, match="damaged"):
        Table(path=str(tmp_path / "a.npz")).load()


def test_sparse_matrices_as_they_should_be(tmp_path):
    save_npz(tmp_path / "a.npz", csr_matrix(np.tile(np.eye(3), (3, 1))))
    assert Table(path=str(tmp_path / "a.npz")).load().n_sites == 3


@pytest.mark.parametrize("shape", [(5, 0), (5, 10**9)])
def test_arrays_of_no_columns_or_too_many(tmp_path, shape):
    matrix = csr_matrix((shape[0], max(1, shape[1])))
    path = tmp_path / ("a.npz" if shape[1] else "a.npy")
    if shape[1]:
        save_npz(path, matrix)
    else:
        np.save(path, np.zeros(shape))
    with pytest.raises(UserError, match=r"column or more|at most 1,000,000 columns"):
        Table(path=str(path)).load()
