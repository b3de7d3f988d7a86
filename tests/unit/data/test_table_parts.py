"""Tables in several files: read as one, and shared by several processes."""

import os
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from omegaconf import OmegaConf

from memcomp_lightning.configuration.rows import _files_of
from memcomp_lightning.data import Batches, Table, TableData, TableDataModule
from memcomp_lightning.data.tables.parts import files_of, in_blocks
from memcomp_lightning.errors import SettingError, UserError

pd = pytest.importorskip("pandas")
pa = pytest.importorskip("pyarrow")

N = 601
CUTS = (0, 7, 150, 151, 400, N)


def frame() -> Any:
    draw = np.random.default_rng(0)
    made = pd.DataFrame(
        {
            "bit": draw.integers(0, 2, N),
            "x": draw.normal(3.0, 2.0, N),
            "word": draw.choice(["red", "green", "blue"], N),
            "count": draw.integers(0, 1000, N),
            "w": draw.uniform(0.5, 2.0, N),
        }
    )
    made.loc[5, "word"] = "rare"
    return made


def written(folder: Path, ending: str, *, gaps: bool = False) -> tuple[str, str]:
    """A table in one file and in five."""
    table = frame()
    if gaps:
        table.loc[::9, "x"] = np.nan
    (folder / "parts").mkdir()

    def write(some: Any, path: Path) -> None:
        if ending == "csv":
            some.to_csv(path, index=False)
        elif ending == "parquet":
            some.to_parquet(path, index=False)
        else:
            np.save(path, some[["x", "count"]].to_numpy())

    write(table, folder / f"all.{ending}")
    for number, (begin, end) in enumerate(pairwise(CUTS)):
        write(table.iloc[begin:end], folder / "parts" / f"{number}.{ending}")
    return str(folder / f"all.{ending}"), str(folder / "parts")


def same(one: Any, other: Any) -> bool:
    return all(
        (a is None and b is None) or (a is not None and b is not None and a.equal(b))
        for a, b in zip(one, other, strict=True)
    )


@pytest.mark.parametrize("ending", ["csv", "parquet", "npy"])
@pytest.mark.parametrize("gaps", [False, True])
def test_parts_are_the_joined_file_to_the_last_bit(tmp_path: Path, ending: str, gaps: bool) -> None:
    whole, parts = written(tmp_path, ending, gaps=gaps)
    one = Table(path=whole).load()
    for path in (parts, f"{parts}/*.{ending}"):
        other = Table(path=path).load()
        assert other.schema.as_json() == one.schema.as_json()
        assert same(other.train, one.train)
        assert same(other.test, one.test)
        assert other.name == path
    rows = one.schema.read(Path(parts))
    assert same(rows, one.schema.read(Path(whole)))


def test_which_files_are_meant(tmp_path: Path) -> None:
    for name in ("b.csv", "a.csv", "c.parquet", ".hidden.csv", "_SUCCESS", "notes.md"):
        (tmp_path / name).write_text("x\n")
    (tmp_path / "[1].csv").write_text("x\n")
    assert [path.name for path in files_of(str(tmp_path))] == ["[1].csv", "a.csv", "b.csv", "c.parquet"]
    assert [path.name for path in files_of(f"{tmp_path}/?.csv")] == ["a.csv", "b.csv"]
    assert [path.name for path in files_of(f"{tmp_path}/[1].csv")] == ["[1].csv"]
    with pytest.raises(UserError, match=r"z\*.csv matches no file in"):
        files_of(f"{tmp_path}/z*.csv")
    (tmp_path / "empty").mkdir()
    with pytest.raises(UserError, match=r"this folder holds no table. Known are files that end in .csv"):
        files_of(str(tmp_path / "empty"))


def parts_of(folder: Path, *texts: str) -> str:
    for number, text in enumerate(texts):
        (folder / f"{number}.csv").write_text(text)
    return str(folder)


def rows(*cells: str) -> str:
    return "x,word\n" + "".join(f"{cell},{'ab'[k % 2]}\n" for k, cell in enumerate(cells))


def test_errors_name_the_part_and_its_row(tmp_path: Path) -> None:
    good = [str(k / 7) for k in range(20)]
    path = parts_of(tmp_path, rows(*good), rows(*good[:3], "spam", *good))
    with pytest.raises(UserError, match=r"column 'x', row 4 of .*1.csv: 'spam' is no number"):
        Table(path=path).load()
    path = parts_of(tmp_path, rows(*good), rows(*good[:3], "1e40", *good))
    with pytest.raises(UserError, match=r"column 'x', row 4 of .*1.csv: '1e40' is not allowed"):
        Table(path=path).load()
    path = parts_of(tmp_path, rows(*good), rows(*good[:5], "0.5").replace("0.5,b", ","))
    with pytest.raises(UserError, match=r"1.csv, row 6: every value that the model has is missing"):
        Table(path=path).load()


def test_parts_of_other_columns_are_refused_and_another_order_is_not(tmp_path: Path) -> None:
    good = [str(k / 7) for k in range(20)]
    turned = "word,x\n" + "".join(f"{'ab'[k % 2]},{cell}\n" for k, cell in enumerate(good))
    table = Table(path=parts_of(tmp_path, rows(*good), turned)).load()
    assert table.train.n + table.test.n == 40
    with pytest.raises(UserError, match=r"1.csv has other columns than .*0.csv: 'y' is in .*1.csv alone"):
        Table(
            path=parts_of(
                tmp_path,
                rows(*good),
                rows(*good).replace("word", "word,y").replace("a\n", "a,1\n").replace("b\n", "b,2\n"),
            )
        ).load()
    with pytest.raises(UserError, match=r"1.csv has other columns than"):
        Table(path=parts_of(tmp_path, rows(*good), "".join(rows(*good).splitlines(keepends=True)[1:]))).load()


def test_whole_numbers_in_one_part_and_others_in_the_next(tmp_path: Path) -> None:
    whole, broken = pa.table({"x": pa.array(range(50))}), pa.table({"x": pa.array(np.arange(50) / 3)})
    for name, some in (("a", whole), ("b", broken)):
        pa.parquet.write_table(some.append_column("y", pa.array([0, 1] * 25)), tmp_path / f"{name}.parquet")
    assert Table(path=str(tmp_path)).load().schema.site_names == ["y", "x"]
    texts = pa.table({"x": pa.array(["one", "two"] * 25), "y": pa.array([0, 1] * 25)})
    pa.parquet.write_table(texts, tmp_path / "c.parquet")
    with pytest.raises(UserError, match="a column is of another kind in one part than in the one before it"):
        Table(path=str(tmp_path)).load()


def test_blocks_have_one_size_whatever_is_read() -> None:
    whole = pa.table({"x": pa.array(range(40_000))})
    for size in (1, 7000, 16_384, 40_000):
        if size > 1:
            found = list(in_blocks(whole.to_batches(max_chunksize=size)))
            assert [block.num_rows for block in found] == [16_384, 16_384, 7_232]
            assert pa.Table.from_batches(found).equals(whole)


# ---------------------------------------------------------------------------------------------------------- shares


def shared(path: str, n: int, **settings: Any) -> list[TableData]:
    return [Table(path=path, share=(rank, n), **settings).load() for rank in range(n)]


def modules(path: str, n: int, columns: dict[str, str] | None = None, **settings: Any) -> list[TableDataModule]:
    return [TableDataModule(data, **settings) for data in shared(path, n, columns=columns or {"w": "ignore"})]


def in_order(v: torch.Tensor) -> torch.Tensor:
    return torch.from_numpy(np.unique(v.numpy(), axis=0))


@pytest.mark.parametrize("n", [1, 2, 3, 5])
@pytest.mark.parametrize("fraction", [0.0, 0.2])
def test_processes_hold_each_row_once_and_hold_out_the_same(tmp_path: Path, n: int, fraction: float) -> None:
    whole, parts = written(tmp_path, "csv", gaps=True)
    one = TableDataModule(Table(path=whole, columns={"w": "ignore"}).load(), validation_fraction=fraction)
    found = modules(parts, n, validation_fraction=fraction)
    assert {module.table.schema.as_json()["columns"][1]["mean"] for module in found} == {
        one.table.schema.as_json()["columns"][1]["mean"]
    }
    for which in ("train", "heldout", "test"):
        expected = getattr(one, which)[0]
        own = [getattr(module, which)[0] for module in found]
        assert sum(map(len, own)) == len(expected)
        assert in_order(torch.cat(own)).equal(in_order(expected))
    assert {module.n_train for module in found} == {one.n_train}
    held = [len(module.table.train.v) + len(module.table.test.v) for module in found]
    assert max(held) - min(held) <= 1
    assert all(module.train_observed is not None for module in found)
    joined = TableDataModule(Table(path=parts, columns={"w": "ignore"}).load(), validation_fraction=fraction)
    assert all(module.fingerprints == joined.fingerprints for module in found)
    assert list(joined.fingerprints) == list(one.fingerprints)
    other = TableDataModule(Table(path=parts, columns={"w": "ignore"}, split_seed=1).load())
    assert other.fingerprints["train"] != joined.fingerprints["train"]
    assert f"{one.table.train.n:,} rows to train on, {one.table.test.n:,} test rows" in found[-1].described
    for module in found:
        assert in_order(module.some_train().v).equal(in_order(one.train[0]))
        assert in_order(module.some_heldout()[0]).equal(in_order(one.heldout[0]))


@pytest.mark.parametrize("n", [2, 3])
@pytest.mark.parametrize(("batch_size", "chunk_size"), [(None, 10_000), (50, 10_000), (90, 9)])
def test_a_pass_sees_every_row_once_and_the_gradient_is_that_of_all_rows(
    tmp_path: Path, n: int, batch_size: int | None, chunk_size: int
) -> None:
    _, parts = written(tmp_path, "parquet")
    found = modules(parts, n, batch_size=batch_size, chunk_size=chunk_size)
    passes = [list(module.train_batches(rank, n)) for rank, module in enumerate(found)]
    assert len({tuple(batch.closes_step for batch in batches) for batches in passes}) == 1
    seen = torch.cat([batch.v for batches in passes for batch in batches])
    assert len(seen) == found[0].n_train
    assert in_order(seen).equal(in_order(torch.cat([module.train[0] for module in found])))
    of_step: list[torch.Tensor] = []
    mean = torch.zeros(seen.shape[1])
    for batches in zip(*passes, strict=True):
        of_step += [batch.v for batch in batches]
        mean += sum(batch.share * batch.v.mean(0) for batch in batches) / n
        assert all(len(batch.v) <= chunk_size for batch in batches)
        if batches[0].closes_step:
            torch.testing.assert_close(mean, torch.cat(of_step).mean(0), rtol=1e-5, atol=1e-6)
            of_step, mean = [], torch.zeros(seen.shape[1])
    later = found[0].train_batches(0, n)
    later.set_epoch(1)
    if len(passes[0]) > 1:
        assert not torch.cat([batch.v for batch in later]).equal(torch.cat([batch.v for batch in passes[0]]))


def test_weights_count_over_all_processes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    _, parts = written(tmp_path, "csv")
    found = modules(parts, 2, {"weight": "w"}, batch_size=100)
    told: list[list[float]] = []

    def gather(of_all: list[Any], own: list[float]) -> None:
        told.append(own)
        of_all[:] = told[:2] if len(told) > 1 else [own, own]

    monkeypatch.setattr(torch.distributed, "all_gather_object", gather)
    for rank, module in enumerate(found):  # what each tells the other
        next(iter(module.train_batches(rank, 2)))
    passes = [list(module.train_batches(rank, 2)) for rank, module in enumerate(found)]
    for batches in zip(*passes, strict=True):
        weights = [batch.weight for batch in batches]
        means = [batch.share * (w @ batch.v) / w.sum() for batch, w in zip(batches, weights, strict=True)]
        expected = torch.cat(weights) @ torch.cat([batch.v for batch in batches]) / torch.cat(weights).sum()
        torch.testing.assert_close(sum(means) / 2, expected, rtol=1e-5, atol=1e-6)


def test_what_cannot_be_shared_is_refused(tmp_path: Path) -> None:
    _, parts = written(tmp_path, "csv")
    data = shared(parts, 2)[0]
    module = TableDataModule(data)
    with pytest.raises(SettingError, match="this is process 0 of 2, which holds a share of the rows"):
        module.train_batches(0, 1)
    with pytest.raises(SettingError, match="this is process 0 of 2"):
        module.train_dataloader()
    with pytest.raises(SettingError, match="partitions = 2 is not allowed: expected 1 where processes share rows"):
        TableDataModule(data, partitions=2)
    with pytest.raises(SettingError, match="labels = 'all' is not allowed"):
        TableDataModule(data, labels="all")
    with pytest.raises(SettingError, match="a share of which each process holds a row; theirs are"):
        TableDataModule(data, validation_fraction=0.002)
    with pytest.raises(SettingError, match="held = "):
        Batches(torch.zeros(3, 2), torch.zeros(3).long(), 1, 9, True, 0, rank=0, world_size=2, held=[2, 3])


def test_rows_in_files_of_their_own_are_whole_in_each_process(tmp_path: Path) -> None:
    whole, parts = written(tmp_path, "csv")
    found = [
        TableDataModule(Table(path=parts, test=whole, validation=whole, share=(rank, 2)).load())
        for rank in range(2)
    ]
    assert [module.table.n_train for module in found] == [N, N]
    assert [len(module.train[0]) for module in found] == [300, 301]
    for module in found:
        assert len(module.test[0]) == len(module.heldout[0]) == len(module.some_heldout()[0]) == N
        assert sum(len(batch.v) for batch in module.val_dataloader()) == N


def test_a_part_that_has_changed_is_read_anew(tmp_path: Path) -> None:
    _, parts = written(tmp_path, "csv")
    for path in (parts, f"{parts}/*.csv"):
        source = OmegaConf.create({"path": path})
        before = _files_of(source)
        os.utime(Path(parts) / "2.csv", ns=(1, len(path)))
        assert _files_of(source) != before


def test_each_process_is_told_of_a_cell_in_the_block_of_another(tmp_path: Path) -> None:
    good = [str(k / 30) for k in range(20)]
    path = parts_of(tmp_path, rows(*good), rows(*good[:3], "7", *good))
    for rank in range(2):
        with pytest.raises(UserError, match=r"column 'x', row 4( of .*1.csv)?: '7' is not allowed"):
            Table(path=path, columns={"x": "probability"}, share=(rank, 2)).load()
