"""Tables from files, frames and arrays: kinds of columns, round trips, and what is refused."""

import gzip
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from memcomp_lightning import rng
from memcomp_lightning.data import Table, TableDataModule
from memcomp_lightning.data.schema import schema_of
from memcomp_lightning.data.tables import TableSchema, data_of
from memcomp_lightning.errors import SettingError, UserError
from memcomp_lightning.models.units import Categorical, Gaussian, Mixed

pd = pytest.importorskip("pandas")

ROWS = "".join(f"{i % 7 + 0.5},{'ab'[i % 2]},{i % 3}\n" for i in range(40))
HEADED = f"x,y,z\n{ROWS}"


def written(folder: Path, text: str | bytes, name: str = "table.csv") -> str:
    path = folder / name
    path.write_bytes(text.encode() if isinstance(text, str) else text)
    return str(path)


def kinds(schema: TableSchema) -> dict[str, str]:
    return {column.name: column.kind for column in schema.columns}


def frame() -> Any:
    n = 60
    age = [float(20 + i % 30) for i in range(n)]
    height = [170 + 0.25 * (i % 11) for i in range(n)]
    colour = [["red", "green", None][i % 3] if i % 2 else "blue" for i in range(n)]
    table = {"age": age, "sex": ["f", "m"] * 30, "height": height, "colour": colour, "spin": [-1, 1] * 30}
    made = pd.DataFrame({**table, "id": range(n), "note": [f"text {i}" for i in range(n)]})
    made.loc[7, "age"] = np.nan
    return pd.concat([made] * 3, ignore_index=True).assign(id=range(3 * n), note=[f"t{i}" for i in range(3 * n)])


def test_kinds_are_found() -> None:
    data = data_of(frame())
    assert kinds(data.schema) == {
        "age": "real",
        "sex": "binary",
        "height": "real",
        "colour": "category",
        "spin": "spin",
    }
    assert data.ignored == {"id": "it counts the rows", "note": "180 different texts"}
    assert data.train.n + data.test.n == 180
    for word in (
        "age",
        "34.61 +- 8.82",
        "note",
        "180 different texts",
        "162 rows to train on, 18 test rows",
        "missing",
    ):
        assert word in data.described()


def test_units_stand_by_kind_and_columns_come_back_in_their_order() -> None:
    data = data_of(frame())
    schema = data.schema
    assert schema.site_names == ["sex", "spin", "colour", "age", "height"]
    assert schema.entry_names == ["sex", "spin", "colour=blue", "colour=green", "colour=red", "age", "height"]
    units = schema.units()
    assert isinstance(units, Mixed)
    assert [type(kind).__name__ for kind in units.kinds] == ["Bernoulli", "Spin", "Categorical", "Gaussian"]
    assert list(schema.decode(data.train.v[:2])) == ["age", "sex", "height", "colour", "spin"]


def test_rows_come_back_as_they_were(tmp_path: Path) -> None:
    own = frame()
    path = tmp_path / "own.parquet"
    own.to_parquet(path)
    schema = data_of(own).schema
    rows = schema.read(path)
    assert rows.observed is not None
    numbers = torch.where(rows.observed, rows.v, torch.nan)
    back = pd.DataFrame(schema.decode(numbers))
    for name in ("sex", "spin"):
        assert back[name].tolist() == own[name].tolist()
    known = own["colour"].notna()
    assert back["colour"][known].tolist() == own["colour"][known].tolist()
    assert back["colour"].isna().tolist() == own["colour"].isna().tolist()
    for name in ("age", "height"):
        np.testing.assert_allclose(back[name], own[name], rtol=1e-5)


def test_whole_numbers_stay_whole() -> None:
    own = pd.DataFrame({"count": [3 * i for i in range(50)], "x": [0.1 * i for i in range(50)]})
    schema = data_of(own, columns={"count": "real"}).schema
    found = schema.decode(torch.tensor([[0.123, 0.5]]))
    assert found["count"].dtype == np.int64
    assert found["x"].dtype == np.float64


def test_real_columns_are_in_standard_deviations() -> None:
    own = pd.DataFrame({"x": 100 + 3 * np.random.default_rng(0).standard_normal(500), "y": ["a", "b"] * 250})
    data = data_of(own)
    v = data.train.v[:, 1]
    assert abs(float(v.mean())) < 1e-5
    assert float(v.var(correction=0)) == pytest.approx(1, abs=1e-5)
    x = data.schema.decode(data.train.v)["x"]
    assert data.schema.log_scale == pytest.approx(np.log(x.std()))


def with_test_row(**cells: Any) -> Any:
    """A frame of 40 rows, with other cells in one that is split off as a test row."""
    own = pd.DataFrame({"x": [0.5 * (i % 7) for i in range(40)], "y": list("abc") * 13 + ["a"]})
    place = torch.randperm(40, generator=rng.stream(0, "test rows")).tolist()
    for name, cell in cells.items():
        own.loc[place.index(39), name] = cell
    return own


def test_test_rows_say_nothing_of_means_and_scales(monkeypatch: pytest.MonkeyPatch) -> None:
    usual, far = (data_of(with_test_row(x=x)) for x in (0.0, 1e6))
    assert far.schema == usual.schema
    assert float(far.test.v.abs().max()) > 1e5
    monkeypatch.setattr("memcomp_lightning.data.tables.readers.ROWS", 7)
    assert data_of(with_test_row(x=1e6)).schema.log_scale == pytest.approx(usual.schema.log_scale)


def test_a_word_of_a_test_row_alone_is_known_and_said() -> None:
    data = data_of(with_test_row(y="rare"), columns={"label": "y"})
    assert "in no training row: y rare" in data.described()
    data = data_of(with_test_row(y="rare"))
    assert data.unseen == {"y": ["rare"]}
    assert "rare" in data.schema.decode(data.test.v)["y"].tolist()
    assert "in no training row" not in data_of(with_test_row()).described()


@pytest.mark.parametrize(("x", "message"), [(0.1, "one value, 0.1, in all"), (None, "no value in the")])
def test_training_rows_that_say_nothing_of_a_column(x: float | None, message: str) -> None:
    own = with_test_row().assign(x=x)
    place = torch.randperm(40, generator=rng.stream(0, "test rows")).tolist()
    own.loc[[place.index(38), place.index(39)], "x"] = [2.5, 3.5]
    with pytest.raises(UserError, match=f"column 'x' has {message} training rows: type another data.split_seed"):
        data_of(own, columns={"x": "real"})


def test_the_schema_survives_json() -> None:
    import json

    data = data_of(frame(), columns={"label": "sex", "age": "category"})
    schema = schema_of(json.loads(json.dumps(data.schema.as_json())))
    assert schema == data.schema
    assert schema.class_names == ["f", "m"]


@pytest.mark.parametrize(
    ("columns", "kind"),
    [
        ({"z": "real"}, {"x": "real", "y": "binary", "z": "real"}),
        ({"all": "category"}, {"x": "category", "y": "category", "z": "category"}),
        ({"x": "ignore"}, {"y": "binary", "z": "category"}),
        ({"label": "z"}, {"x": "real", "y": "binary"}),
    ],
)
def test_kinds_are_chosen(tmp_path: Path, columns: dict[str, str], kind: dict[str, str]) -> None:
    data = Table(path=written(tmp_path, HEADED), columns=columns).load()
    assert kinds(data.schema) == kind


def test_labels_and_weights(tmp_path: Path) -> None:
    text = "x,species,w\n" + "".join(f"{i * 0.3},{['cat', 'dog', ''][i % 3]},{i % 4 + 1}\n" for i in range(60))
    data = Table(path=written(tmp_path, text), columns={"label": "species", "weight": "w"}).load()
    assert kinds(data.schema) == {"x": "real"}
    label, weight = (torch.cat((getattr(data.train, k), getattr(data.test, k))) for k in ("label", "weight"))
    assert torch.bincount(label + 1).tolist() == [20, 20, 20]
    assert torch.bincount(weight.long()).tolist() == [0, 15, 15, 15, 15]
    batch = next(iter(TableDataModule(data, batch_size=7).train_dataloader()))
    assert batch.weight is not None
    assert batch.weight.shape == (7,)


def test_minus_one_is_no_label(tmp_path: Path) -> None:
    text = "x,k\n" + "".join(f"{i * 0.3},{i % 3 - 1}\n" for i in range(30))
    data = Table(path=written(tmp_path, text), columns={"label": "k"}).load()
    assert data.schema.class_names == ["0", "1"]
    assert sorted(set(torch.cat((data.train.label, data.test.label)).tolist())) == [-1, 0, 1]
    assert "10 training rows have none; -1 is none, in 10 rows" in data.described()
    assert "data.columns={label: k, k: category} makes a class of it" in data.described()


@pytest.mark.parametrize(
    ("labels", "columns", "classes"),
    [
        ([-1, 0, 1], {"label": "k", "k": "category"}, ["-1", "0", "1"]),
        ([-1, 1, ""], {"label": "k"}, ["-1", "1"]),
        (["-1", "up", "up"], {"label": "k", "k": "category"}, ["-1", "up"]),
    ],
)
def test_minus_one_is_a_class(tmp_path: Path, labels: list[Any], columns: dict[str, str], classes: Any) -> None:
    text = "x,k\n" + "".join(f"{i * 0.3},{labels[i % 3]}\n" for i in range(30))
    data = Table(path=written(tmp_path, text), columns=columns).load()
    assert data.schema.class_names == classes
    assert int((torch.cat((data.train.label, data.test.label)) == -1).sum()) == 10 * labels.count("")
    assert "; -1 is a class" in data.described()
    assert data.minus_one == 0


def test_each_row_is_in_one_part(tmp_path: Path) -> None:
    path = written(tmp_path, "x,y\n" + "".join(f"{i}.5,{i % 2}\n" for i in range(100)))
    data = Table(path=path, test_fraction=0.3, split_seed=1).load()
    shown = [data.schema.decode(part.v)["x"].round(3).tolist() for part in (data.train, data.test)]
    assert [len(part) for part in shown] == [70, 30]
    assert sorted(shown[0] + shown[1]) == [i + 0.5 for i in range(100)]
    again, other = (Table(path=path, test_fraction=0.3, split_seed=seed).load() for seed in (1, 2))
    assert torch.equal(again.test.v, data.test.v)
    assert not torch.equal(other.test.v, data.test.v)


def test_parts_of_a_file_are_put_together(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Rows that come in several batches are those that come in one."""
    own = frame()
    whole = data_of(own)
    monkeypatch.setattr("memcomp_lightning.data.tables.readers.ROWS", 17)
    parts = data_of(own)
    assert parts.schema.site_names == whole.schema.site_names
    torch.testing.assert_close(parts.train.v, whole.train.v, rtol=0, atol=1e-5)
    assert parts.ignored == whole.ignored


FILES: dict[str, Callable[[Path], str]] = {
    "tsv": lambda folder: written(folder, HEADED.replace(",", "\t"), "t.tsv"),
    "semicolons": lambda folder: written(folder, HEADED.replace(",", ";")),
    "blanks": lambda folder: written(folder, HEADED.replace(",", " , ")),
    "windows": lambda folder: written(folder, "\ufeff" + HEADED.replace("\n", "\r\n")),
    "gzip": lambda folder: written(folder, gzip.compress(HEADED.encode()), "t.csv.gz"),
    "no end": lambda folder: written(folder, HEADED.rstrip()),
}


@pytest.mark.parametrize("name", FILES)
def test_dialects_of_text(tmp_path: Path, name: str) -> None:
    data = Table(path=FILES[name](tmp_path)).load()
    assert kinds(data.schema) == {"x": "real", "y": "binary", "z": "category"}
    plain = Table(path=written(tmp_path, HEADED, "plain.csv")).load()
    assert torch.equal(data.train.v, plain.train.v)


def test_excel(tmp_path: Path) -> None:
    pytest.importorskip("openpyxl")
    path = tmp_path / "t.xlsx"
    pd.DataFrame({"x": [i * 0.7 for i in range(30)], "y": ["u", "v"] * 15}).to_excel(path, index=False)
    assert kinds(Table(path=str(path)).load().schema) == {"x": "real", "y": "binary"}


X = np.random.default_rng(0).integers(0, 2, (50, 6))


def arrays(folder: Path) -> dict[str, str]:
    import h5py
    from scipy.sparse import csr_matrix, save_npz

    np.save(folder / "a.npy", X)
    np.savez(folder / "a.npz", x=X, other=X[:, 0])
    save_npz(folder / "sparse.npz", csr_matrix(X))
    with h5py.File(folder / "a.h5", "w") as file:
        file["rows"] = X.astype(float)
    return {name: str(folder / name) for name in ("a.npy", "a.npz", "sparse.npz", "a.h5")}


def test_arrays_of_every_format(tmp_path: Path) -> None:
    found = [Table(path=path).load() for path in arrays(tmp_path).values()]
    for data in found:
        assert set(kinds(data.schema).values()) == {"binary"}
        assert torch.equal(data.train.v, found[0].train.v)
        assert not data.schema.named


@pytest.mark.parametrize(
    ("array", "kind"),
    [
        (X, "binary"),
        (2 * X - 1, "spin"),
        (np.hstack([X, np.zeros((50, 2))]), "binary"),
        (np.random.default_rng(1).integers(0, 4, (50, 5)), "category"),
        (np.random.default_rng(1).normal(size=(50, 5)), "real"),
        (torch.arange(250.0).view(50, 5) / 7, "real"),
    ],
)
def test_an_array_has_one_kind(array: Any, kind: str) -> None:
    module = TableDataModule.from_array(array, batch_size=10)
    assert {column.kind for column in module.table.schema.columns} == {kind}
    assert next(iter(module.train_dataloader())).v.shape == (10, module.n_visible)


def test_an_array_with_labels_and_gaps() -> None:
    array = np.random.default_rng(0).normal(size=(40, 3))
    array[3, 1] = np.nan
    module = TableDataModule.from_array(array, [0, 1, -1, 1] * 10)
    assert module.n_classes == 2
    assert module.train_observed is not None
    labels = torch.cat((module.train[1], module.test[1]))
    assert torch.bincount(labels + 1).tolist() == [10, 10, 20]
    assert (
        "label  0, 1; 6 training rows have none; -1 is none, in 10 rows: another word makes a" in module.described
    )


def test_a_label_for_each_row() -> None:
    for n in (39, 41):
        with pytest.raises(UserError, match=f"{n} labels for 40 rows: expected one for each row"):
            TableDataModule.from_array(
                np.random.default_rng(0).normal(size=(40, 3)), [0, 1] * (n // 2) + [0] * (n % 2)
            )


def test_columns_that_are_called_like_roles_or_numbers(tmp_path: Path) -> None:
    text = "weight,label,x\n" + "".join(f"{i * 0.7},{'ab'[i % 2]},{i % 3}\n" for i in range(30))
    data = Table(path=written(tmp_path, text), columns={"weight": "ignore", "label": "category"}).load()
    assert kinds(data.schema) == {"label": "category", "x": "category"}
    array = np.random.default_rng(0).normal(size=(40, 3))
    assert data_of(array, columns={2: "ignore"}).schema.n_sites == 2  # as YAML reads numbers


def test_kinds_in_one_column_of_a_frame() -> None:
    with pytest.raises(UserError, match="a column mixes kinds of values"):
        data_of(pd.DataFrame({"x": [1, "a", 2.5, "b"] * 5, "y": range(20)}))


def test_pictures_of_an_array(tmp_path: Path) -> None:
    np.save(tmp_path / "p.npy", np.random.default_rng(0).random((20, 4, 5)))
    data = Table(path=str(tmp_path / "p.npy"), columns="probability", picture=(4, 5)).load()
    assert data.layout is not None
    assert data.layout.height == 4
    assert TableDataModule(data).pixel_layout is data.layout
    with pytest.raises(SettingError, match="height and width of 20 pixels"):
        Table(path=str(tmp_path / "p.npy"), picture=(4, 4)).load()


def test_categories_of_several_sizes() -> None:
    own = pd.DataFrame({"a": list("xyz") * 20, "b": list("stuv") * 15})
    units = data_of(own).units()
    assert isinstance(units, Categorical)
    assert list(units.sizes) == [3, 4]
    assert isinstance(data_of(own.assign(a=np.arange(60) * 0.5)[["a"]]).units(), Gaussian)


REFUSED: dict[str, tuple[str | bytes, dict[str, Any], str]] = {
    "one value": (
        "x,y\n" + "".join(f"{i * 0.1},1\n" for i in range(20)),
        {},
        "column 'y' has one value, 1, in all",
    ),
    "mixed": (HEADED + "abc,a,1\n", {}, "column 'x', row 41: 'abc' is no number, as 40 other cells are"),
    "ragged": (HEADED + "1.5,a\n" + ROWS, {}, "table.csv, row 41: expected 3 cells, found 2"),
    "nothing": ("", {}, "is empty"),
    "no rows": ("x,y\n", {}, "has 0 rows: expected two or more"),
    "empty row": (HEADED + ",,\n", {}, "row 41: every value that the model has is missing"),
    "empty column": ("x,y\n" + "".join(f"{i}.5,\n" for i in range(9)), {}, "column 'y' has no value at all"),
    "one name twice": ("x,x,z\n" + ROWS, {}, "table.csv: two columns have the name 'x'"),
    "no UTF-8": (HEADED.encode("utf-16"), {}, "not text in UTF-8"),
    "label in between": (
        "k,y\n" + "1,a\n2,b\n" * 9 + ",a\n1.5,b\n2,a\n",
        {"columns": {"label": "k"}},
        "table.csv, column 'k', row 20: '1.5' is no class: expected words or whole numbers",
    ),
    "a label that is real": (
        HEADED,
        {"columns": {"label": "z", "z": "real"}},
        "z: real is not allowed: it is the label",
    ),
    "no such column": (
        HEADED,
        {"columns": {"q": "real"}},
        "has no column 'q', which data.columns names: it has x, y",
    ),
    "no such label": (HEADED, {"columns": {"label": "q"}}, "has no column 'q'"),
    "no such kind": (HEADED, {"columns": {"x": "foo"}}, "x: foo is not allowed: expected one of binary, spin"),
    "texts as numbers": (
        HEADED,
        {"columns": {"y": "real"}},
        "column 'y', row 1: 'a' is no number: it cannot be real",
    ),
    "no spin": (HEADED, {"columns": {"z": "spin"}}, "column 'z', row 1: '0' is not allowed: expected -1 or 1"),
    "no probability": (
        HEADED,
        {"columns": {"x": "probability"}},
        "row 2: '1.5' is not allowed: expected a number in",
    ),
    "binary of three": (HEADED, {"columns": {"z": "binary"}}, "column 'z' has 3 different values: too many for a"),
    "huge": (
        "x,y\n1e300,a\n" + "2,b\n3,a\n" * 3,
        {},
        "column 'x', row 1: '1e300' is not allowed: expected a finite number",
    ),
    "nothing left": (HEADED, {"columns": {"all": "ignore"}}, "no column is left for the model"),
    "weights": (
        HEADED,
        {"columns": {"weight": "z"}},
        "column 'z', row 1: '0' is not allowed: expected a number > 0",
    ),
    "all of it for the test": (HEADED, {"test_fraction": 0.001}, "test_fraction = 0.001 is not allowed"),
}


@pytest.mark.parametrize("name", REFUSED)
def test_what_is_refused(tmp_path: Path, name: str) -> None:
    text, settings, message = REFUSED[name]
    with pytest.raises((UserError, SettingError)) as refused:
        Table(path=written(tmp_path, text), **settings).load()
    assert message in str(refused.value)
    assert "\n" not in str(refused.value)


def test_damaged_files(tmp_path: Path) -> None:
    packed = gzip.compress(HEADED.encode() * 30)
    with pytest.raises(UserError, match="ends in the middle"):
        Table(path=written(tmp_path, packed[:120], "t.csv.gz")).load()
    np.save(tmp_path / "a.npy", X)
    whole = (tmp_path / "a.npy").read_bytes()
    with pytest.raises(UserError, match="ends in the middle"):
        Table(path=written(tmp_path, whole[:300], "b.npy")).load()
    np.save(tmp_path / "c.npy", np.array([{}, 1], dtype=object), allow_pickle=True)
    with pytest.raises(UserError, match="damaged"):
        Table(path=str(tmp_path / "c.npy")).load()
    with pytest.raises(UserError, match="there is no such file"):
        Table(path=str(tmp_path / "none.csv")).load()
    with pytest.raises(UserError, match=r"files that end in '\.json' are not read"):
        Table(path=written(tmp_path, "{}", "a.json")).load()


def test_files_that_do_not_fit_the_training_data(tmp_path: Path) -> None:
    path = written(tmp_path, HEADED)
    with pytest.raises(UserError, match=r"t\.csv, column 'y', row 2: 'c' is not allowed: .*training data: a, b"):
        Table(path=path, test=written(tmp_path, "x,y,z\n1.5,a,2\n1.5,c,2\n", "t.csv")).load()
    with pytest.raises(UserError, match=r"t\.csv has no column 'y', which the model has"):
        Table(path=path, validation=written(tmp_path, "x,z\n1.5,2\n", "t.csv")).load()


def test_rows_to_look_at_are_those_that_are_given(tmp_path: Path) -> None:
    looked_at = written(tmp_path, "z,y,x\n1,a,1.5\n2,b,2.5\n", "v.csv")
    data = Table(path=written(tmp_path, HEADED), validation=looked_at).load()
    module = TableDataModule(data)
    assert module.validation is not None
    assert data.schema.decode(data.validation.v)["x"].round(5).tolist() == [1.5, 2.5]  # type: ignore[union-attr]
    with pytest.raises(SettingError, match=r"validation_fraction = 0\.1 is not allowed"):
        TableDataModule(data, validation_fraction=0.1)


def test_some_of_many_rows() -> None:
    module = TableDataModule.from_array(np.random.default_rng(0).normal(size=(1000, 5)))
    type(module).most_numbers, before = 1000, type(module).most_numbers
    try:
        v, label, observed, _ = module.some_train()
    finally:
        type(module).most_numbers = before
    assert 100 <= len(v) <= 200
    assert len(label) == len(v)
    assert observed is None
