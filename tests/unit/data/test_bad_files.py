"""What is wrong with a file is said in a line, with the file, the column and the row, whatever the format."""

import bz2
import gzip
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.sparse import coo_matrix, csr_matrix, save_npz

from memcomp_lightning import rng
from memcomp_lightning.data import PixelLayout, Table
from memcomp_lightning.data.schema import ImageSchema, schema_of
from memcomp_lightning.errors import UserError

h5py = pytest.importorskip("h5py")
pd = pytest.importorskip("pandas")
pytest.importorskip("openpyxl")

N = 30
PICTURES = ImageSchema(PixelLayout(2, 2), 0)


def numbers() -> Any:
    return rng.numpy_stream(0, "numbers").standard_normal((N, 4)).round(3)


def hdf5(path: Path, array: Any, name: str = "x") -> None:
    with h5py.File(path, "w") as file:
        file[name] = array


ARRAYS: dict[str, Callable[[Path, Any], None]] = {
    "a.npy": lambda path, array: np.save(path, array, allow_pickle=True),
    "a.npz": lambda path, array: np.savez(path, x=array, y=array),
    "packed.npz": lambda path, array: np.savez_compressed(path, x=array),
    "a.h5": hdf5,
    "grouped.h5": lambda path, array: hdf5(path, array, "of/x"),
}
FRAMES: dict[str, Callable[[Path, Any], None]] = {
    "a.csv": lambda path, frame: frame.to_csv(path, index=False),
    "a.parquet": lambda path, frame: frame.to_parquet(path, index=False),
    "a.xlsx": lambda path, frame: frame.to_excel(path, index=False),
}


def written(folder: Path, name: str, content: Any) -> Path:
    path = folder / name
    (ARRAYS | FRAMES)[name](path, content)
    return path


def refused(read: Callable[[], object], *words: str) -> None:
    with pytest.raises(UserError) as caught:
        read()
    assert "\n" not in str(caught.value)
    for word in words:
        assert word in str(caught.value)


def frame() -> Any:
    return pd.DataFrame(numbers(), columns=list("abcd"))


WHOLE: dict[str, Callable[[Path], object]] = {
    **{name: lambda path: written(path.parent, path.name, numbers()) for name in ARRAYS},
    **{name: lambda path: written(path.parent, path.name, frame()) for name in ("a.parquet", "a.xlsx")},
    "sparse.npz": lambda path: save_npz(path, csr_matrix(numbers())),
    "a.csv.gz": lambda path: path.write_bytes(gzip.compress(frame().to_csv(index=False).encode())),
    "a.csv.bz2": lambda path: path.write_bytes(bz2.compress(frame().to_csv(index=False).encode())),
}


@pytest.mark.parametrize("name", WHOLE)
def test_files_that_end_in_the_middle(tmp_path: Path, name: str) -> None:
    path = tmp_path / name
    WHOLE[name](path)
    content = path.read_bytes()
    assert Table(path=str(path)).load().n_sites == 4
    for length in (3, 40, len(content) // 2, len(content) - 9):
        path.write_bytes(content[:length])
        refused(Table(path=str(path)).load, str(path), "is damaged, or ends in the middle")
        if path.suffix in (".npy", ".npz"):
            refused(lambda: PICTURES.read(path), f"{path} cannot be read as an array of pictures")


def test_a_table_that_ends_in_the_middle_of_a_row(tmp_path: Path) -> None:
    path = tmp_path / "a.csv"
    path.write_text(frame().to_csv(index=False) + "1,2,3\n")
    refused(Table(path=str(path)).load, f"a.csv, row {N + 1}: expected 4 cells, found 3. The file ends in the")


@pytest.mark.parametrize("name", [*FRAMES, "a.npy", "a.npz", "grouped.h5"])
def test_cells_that_are_not_allowed(tmp_path: Path, name: str) -> None:
    array, column = numbers(), "'b'" if name in FRAMES else "'1'"

    def changed(row: Any, at: Any, value: float) -> Path:
        some = array.copy()
        some[row, at] = value
        return written(tmp_path, name, pd.DataFrame(some, columns=list("abcd")) if name in FRAMES else some)

    every = slice(None)
    refused(Table(path=str(changed(every, 1, 1.5))).load, name, f"column {column} has one value, 1.5")
    refused(Table(path=str(changed(6, every, np.nan))).load, f"{name}, row 7: every value that the model has is")
    path = changed(6, 1, np.inf)
    refused(Table(path=str(path)).load, f"{name}, column {column}, row 7: 'inf'", f"{{{column[1]}: category}}")
    path, words = changed(0, 0, 1.0), f"{name}, column {column}, row 1: '{array[0, 1]}' is no class"
    refused(Table(path=str(path), columns={"label": column[1]}).load, words)


@pytest.mark.parametrize("name", ARRAYS)
@pytest.mark.parametrize(
    ("array", "message"),
    [
        (np.array(3.0), "an array of shape (): expected rows and columns"),
        (np.arange(9.0), "an array of shape (9,): expected rows and columns"),
        (np.ones((9, 2)) * 1j, "an array of complex128: expected numbers"),
        (np.zeros((0, 3)), "has 0 rows"),
    ],
    ids=["no axis", "one axis", "complex", "no rows"],
)
def test_arrays_that_are_no_tables(tmp_path: Path, name: str, array: Any, message: str) -> None:
    path = written(tmp_path, name, array)
    refused(Table(path=str(path)).load, name, message)


@pytest.mark.parametrize("kind", [">f8", ">i4", "f2", "longdouble"])
def test_numbers_of_any_length_and_byte_order_are_read(tmp_path: Path, kind: str) -> None:
    array = np.round(numbers() * 8).astype(kind)
    found = Table(path=str(written(tmp_path, "a.npy", array)), columns="real").load()
    plain = Table(path=str(written(tmp_path, "packed.npz", array.astype(float))), columns="real").load()
    assert found.train.v.equal(plain.train.v)


def test_arrays_in_files_of_other_layouts(tmp_path: Path) -> None:
    save_npz(tmp_path / "coo.npz", coo_matrix(numbers()))
    assert Table(path=str(tmp_path / "coo.npz")).load().n_sites == 4
    np.savez(tmp_path / "none.npz")
    (tmp_path / "named_npz.npy").write_bytes((tmp_path / "none.npz").read_bytes())
    refused(Table(path=str(tmp_path / "named_npz.npy")).load, "holds several arrays: let its name end in .npz")
    written(tmp_path, "a.npy", numbers()).rename(tmp_path / "named_npy.npz")
    assert Table(path=str(tmp_path / "named_npy.npz")).load().n_sites == 4
    hdf5(tmp_path / "two.h5", numbers(), "of/x")
    with h5py.File(tmp_path / "two.h5", "a") as file:
        file["y"] = 1.0
    np.save(tmp_path / "objects.npy", np.array([[{}]], dtype=object), allow_pickle=True)
    refused(Table(path=str(tmp_path / "none.npz")).load, "none.npz holds no array")
    refused(
        Table(path=str(tmp_path / "two.h5")).load, "two.h5 holds the arrays of/x, y: call the one that is meant x"
    )
    refused(Table(path=str(tmp_path / "objects.npy")).load, "it is no array of numbers or texts")
    assert Table(path=str(tmp_path / "two.h5"), key="of/x").load().n_sites == 4


@pytest.mark.parametrize("columns", [None, {"3": "ignore"}])
def test_arrays_of_another_width_do_not_fit_a_run(tmp_path: Path, columns: dict[str, str] | None) -> None:
    path = written(tmp_path, "a.npy", numbers())
    schema = schema_of(Table(path=str(path), columns=columns).load().schema.as_json())  # as a run keeps it
    assert schema.read(path, complete=False).n == N
    for width in (2, 9):
        np.save(tmp_path / "other.npy", np.resize(numbers(), (N, width)))
        words = f"other.npy has {width} columns: expected 4, as the array of the training"
        refused(lambda: schema.read(tmp_path / "other.npy", complete=False), words)


@pytest.mark.parametrize(
    ("array", "message"),
    [
        (np.array([["a"] * 4]), "values of the kind <U1: expected numbers in [0, 1]"),
        (np.ones((2, 4)) * 1j, "values of the kind complex128"),
        (np.zeros((3, 5)), "the shape (3, 5): expected rows of 4 pixels"),
        (np.full((2, 4), 1.5), "row 1, pixel 0: 1.5 is not a number in [0, 1]"),
    ],
)
def test_pictures_that_do_not_fit_a_run(tmp_path: Path, array: Any, message: str) -> None:
    refused(lambda: PICTURES.read(written(tmp_path, "a.npy", array)), "a.npy", message)
    np.savez(tmp_path / "b.npz", a=array, b=array)
    refused(
        lambda: PICTURES.read(tmp_path / "b.npz"), "b.npz holds the arrays a, b: call the one of the pictures x"
    )


def test_two_columns_of_one_name(tmp_path: Path) -> None:
    twice = frame().set_axis(list("abab"), axis=1)
    twice.to_csv(tmp_path / "a.csv", index=False)
    refused(Table(path=str(tmp_path / "a.csv")).load, "a.csv: two columns have the name 'a'")
    import pyarrow as pa
    from pyarrow import parquet

    from memcomp_lightning.data.tables import data_of

    parquet.write_table(pa.table(list(numbers().T), names=list("abab")), tmp_path / "a.parquet")
    refused(Table(path=str(tmp_path / "a.parquet")).load, "a.parquet: two columns have the name 'a'")
    refused(lambda: data_of(twice), "two columns have the name 'a'")


def test_numbers_that_are_too_far_from_the_mean(tmp_path: Path) -> None:
    """Single precision would make infinity of them."""
    path, other = tmp_path / "a.csv", tmp_path / "b.csv"
    path.write_text("a,b\n" + "".join(f"{1 + k * 1e-12},{k % 3}.5\n" for k in range(N)))
    other.write_text("a,b\n1,0.5\n1e29,1.5\n")
    schema = Table(path=str(path)).load().schema
    refused(lambda: schema.read(other), "column 'a', row 2", "'1e29' is not allowed", "standard deviations")


def test_whole_numbers_that_no_integer_holds_come_back(tmp_path: Path) -> None:
    path = tmp_path / "a.csv"
    path.write_text("a,b\n" + "".join(f"{k}e20,{k % 3}.5\n" for k in (*range(N), 5)))
    schema = Table(path=str(path)).load().schema
    found = schema.decode(schema.read(path).v)["a"]
    np.testing.assert_allclose(found, [k * 1e20 for k in (*range(N), 5)], rtol=1e-5, atol=1e14)


def test_words_that_are_numbers_beyond_what_floats_tell_apart(tmp_path: Path) -> None:
    """Of two keys one word would be made."""
    path = tmp_path / "a.csv"
    path.write_text("a,b\n" + "".join(f"{9007199254740992 + k % 3},{k % 3}.5\n" for k in range(N)))
    refused(Table(path=str(path), columns={"a": "category"}).load, "column 'a'", "2^53")


def test_damaged_hdf5(tmp_path: Path) -> None:
    path = tmp_path / "a.h5"
    hdf5(path, numbers())
    content = bytearray(path.read_bytes())
    for at in range(0, len(content), 16):
        spoilt = content.copy()
        spoilt[at] ^= 0xFF
        path.write_bytes(spoilt)
        said = ""
        try:
            Table(path=str(path)).load()
        except UserError as error:
            said = str(error)
        assert said.isprintable()
