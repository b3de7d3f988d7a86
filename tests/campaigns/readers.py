"""Every reader of files, each with small valid files to begin from and the words of its format."""

import csv
import gzip
import io
import shutil
import subprocess
import sys
import tempfile
import zipfile
from collections.abc import Callable, Sequence
from contextvars import ContextVar
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import torch

from memcomp_lightning.configuration.problems import _state
from memcomp_lightning.data import idx
from memcomp_lightning.data.images import PixelLayout
from memcomp_lightning.data.schema import ImageSchema
from memcomp_lightning.problems import FORMATS, read_problem
from memcomp_lightning.runs.folder import RunFolder
from memcomp_lightning.runs.solve_table import COLUMNS, read_best_known, read_rows, summary, with_gaps
from memcomp_lightning.runs.trust import foreign
from memcomp_lightning.trained.alone import schema_in
from memcomp_lightning.trained.run import load


@dataclass(frozen=True)
class Reader:
    """One way in.

    Attributes:
        file: Name of the file that is read, in a folder of its own.
        read: Reads it, and uses what it found as a command would.
        seeds: Small valid files.
        words: What the format is made of.
        dress: From the bytes that are varied to those of the file: varied archives would only be refused.
        share: Of all inputs.
        beside: Writes what else the folder needs.
        needs: Package without which it is left out.
    """

    file: str
    read: Callable[[Path], Any]
    seeds: Callable[[], Sequence[bytes]]
    words: tuple[str, ...] = ()
    dress: Callable[[bytes], bytes] = bytes
    share: float = 1.0
    beside: Callable[[Path], None] = field(default=lambda folder: None)
    needs: str | None = None


# --------------------------------------------------------------------------------------------------- problem files


def _split(words: str) -> tuple[str, ...]:
    return tuple(words.split())


_BLANKS = ("\n", "\r\n", "\t")
_TABLES = (*_split("# % c 0 1 -1 2.5 1e9 1e-300 0e-9 9007199254740993 ."), *_BLANKS)
_SAID = ("# vartype=SPIN", "# vartype=BINARY", "# offset=3", "constant: 1", "scale=2", "\n# ")
_MTX = _split("%%MatrixMarket matrix coordinate array integer real pattern general symmetric")
_CLAUSES = ("p cnf ", "p wcnf ", " 0\n", "h ", "%\n", "c\n", "-", "1 ", "top ", "999999999999999999 ")
_PROBLEMS: dict[str, tuple[tuple[bytes, ...], tuple[str, ...]]] = {
    "gset": ((b"4 3\n1 2 3\n2 3 -1\n1 4 2.5\n", b"3 2\n1 2\n3 1\n"), _TABLES),
    "beasley": ((b"3 3\n1 1 -3\n1 3 2\n2 3 -5e-1\n",), _TABLES),
    "coo": ((b"# vartype=SPIN\n0 0 0.5\n0 2 -1.25\n", b"# offset=2\n0 1 3\n1 1 -2\n"), (*_TABLES, *_SAID)),
    "qbsolv": ((b"c one\np qubo 0 3 1 2\n0 0 1.5\n0 1 -1\n1 2 2\n",), ("p qubo 0 ", *_TABLES, *_SAID)),
    "mtx": (
        (
            b"%%MatrixMarket matrix coordinate real symmetric\n3 3 2\n1 1 -3\n3 1 2\n",
            b"%%MatrixMarket matrix array integer general\n2 2\n1\n2\n3\n4\n",
            b"%%MatrixMarket matrix coordinate pattern general\n2 2 1\n1 2\n",
        ),
        (*_MTX, *_TABLES),
    ),
    "wcnf": ((b"p wcnf 3 3 10\n10 1 -2 0\n3 2 0\n4.5 -1 3 0\n", b"h 1 2 0\n3 -1 0\n1 -2 3 0\n"), _CLAUSES),
    "cnf": ((b"c\np cnf 3 2\n1 -2 0\n2 3 -1 0\n", b"p cnf 2 2\n1 2\n0 -1 0\n%\n0\n"), _CLAUSES),
}


def _scored(path: Path, format: str | None) -> None:
    """Read a problem and count two states in both of its terms: the file's and the solvers'."""
    problem = read_problem(path, format)
    n = problem.problem.n
    for state in (np.zeros(n), np.ones(n)):
        problem.objective.energy(problem.score(state))
    _ = problem.sizes, problem.n_unused


def _problem(name: str, suffix: str = "") -> Reader:
    seeds, words = _PROBLEMS[name]
    file = f"problem{suffix or FORMATS[name].suffixes[0]}"
    return Reader(file, lambda path: _scored(path, name), lambda: seeds, words, share=8)


def _any_problem() -> Reader:
    seeds = tuple(seed for seeds, _ in _PROBLEMS.values() for seed in seeds)
    words = tuple({word for _, words in _PROBLEMS.values() for word in words})
    return Reader("problem.txt", lambda path: _scored(path, None), lambda: seeds, words, share=10)


def _npz(arrays: dict[str, Any]) -> bytes:
    buffer = io.BytesIO()
    np.savez(buffer, **arrays)
    return buffer.getvalue()


def _npy(array: Any) -> bytes:
    buffer = io.BytesIO()
    np.save(buffer, array)
    return buffer.getvalue()


_NPY = ("'descr': ", "'<f8'", "'|O'", "'<U4'", "'fortran_order': True", "'shape': (", "3, ", "1000000000")
_MATRIX, _BITS = (
    _npy(np.arange(30.0).reshape(10, 3) % 7 / 6),
    _npy(np.arange(24, dtype=np.uint8).reshape(6, 4) % 5 % 2),
)


def _zipped(members: dict[str, bytes]) -> bytes:
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w") as archive:
        for name, content in members.items():
            archive.writestr(name, content)
    return buffer.getvalue()


def _as_weight(data: bytes) -> bytes:
    return _zipped({"weight.npy": data, "b.npy": _npy(np.zeros(3)), "c.npy": _npy(np.ones(2))})


# ----------------------------------------------------------------------------------------------- tables and arrays


def _table(path: Path) -> None:
    from memcomp_lightning.data.tables import Table, read_rows

    data = Table(path=str(path), test_fraction=0.4).load()
    data.described()
    read_rows(path, data.schema, complete=False)
    data.schema.decode(data.test.v)


def _csv_seed() -> bytes:
    rows = [["age", "smoker", "city", "height"]]
    rows += [
        [20 + 3 * k % 7, "yes" if k % 2 else "no", ("Rome", "Oslo", "")[k % 3], 1.5 + k / 7] for k in range(12)
    ]
    text = io.StringIO()
    csv.writer(text, lineterminator="\n").writerows(rows)
    return text.getvalue().encode()


_CSV = (*_split(', ; " NA nan true False 1e31 -1 inf 0x1 1_0'), "\n", "\r\n", "\t", "\xa0")


def _frame() -> Any:
    import pandas as pd

    return pd.read_csv(io.BytesIO(_csv_seed()))


def _parquet() -> bytes:
    buffer = io.BytesIO()
    _frame().to_parquet(buffer, index=False)
    return buffer.getvalue()


def _excel() -> bytes:
    buffer = io.BytesIO()
    _frame().to_excel(buffer, index=False)
    return buffer.getvalue()


def _sheet() -> bytes:
    with zipfile.ZipFile(io.BytesIO(_excel())) as archive:
        return archive.read("xl/worksheets/sheet1.xml")


def _in_workbook(data: bytes) -> bytes:
    with zipfile.ZipFile(io.BytesIO(_excel_once())) as archive:
        return _zipped({n: archive.read(n) if "sheet1" not in n else data for n in archive.namelist()})


_excel_once = cache(_excel)


def _hdf5() -> bytes:
    import h5py

    buffer = io.BytesIO()
    with h5py.File(buffer, "w") as file:
        file["x"] = np.arange(12.0).reshape(6, 2) % 5
    return buffer.getvalue()


def _as_columns(data: bytes) -> bytes:
    return _zipped({"a.npy": data, "b.npy": _npy(np.arange(6.0) % 2)})


def _sparse() -> bytes:
    from scipy.sparse import csr_matrix, save_npz

    buffer = io.BytesIO()
    save_npz(buffer, csr_matrix(np.eye(6)), compressed=False)
    return buffer.getvalue()


def _with_sparse_indices(data: bytes) -> bytes:
    with zipfile.ZipFile(io.BytesIO(_sparse())) as archive:
        return _zipped({n: archive.read(n) if n != "indices.npy" else data for n in archive.namelist()})


def _sparse_indices() -> bytes:
    with zipfile.ZipFile(io.BytesIO(_sparse())) as archive:
        return archive.read("indices.npy")


def _pictures(path: Path) -> None:
    ImageSchema(PixelLayout(1, 3), 0).read(path, complete=False)


def _alignment(path: Path) -> None:
    from memcomp_lightning.data.sequences import Sequences

    data = Sequences(path=str(path), test_fraction=0.4).load()
    data.described()
    data.schema.filled(path, data.schema.read(path, complete=False).v)


_FASTA = (
    b">a one\nACGT-A\n>b\nacgtnA\n>c\nAC\nGTCA\n>d\nACGTCA\n>e\nTTGTCA\n",
    b">p1\nMKV-LY..\n>p2\nMKVaLYg.\n>p3\nMRVWLY..\n>p4\nMRV-LX..\n",
)


# ------------------------------------------------------------------------------------------------ weights and runs


def _torch(content: Any) -> bytes:
    buffer = io.BytesIO()
    torch.save(content, buffer)
    return buffer.getvalue()


@cache
def _weights() -> bytes:
    from memcomp_lightning.models import RBM

    return _torch(RBM(n_visible=3, n_hidden=2).state_dict())


def _pickled() -> bytes:
    with zipfile.ZipFile(io.BytesIO(_weights())) as archive:
        return archive.read("archive/data.pkl")


def _with_pickle(data: bytes) -> bytes:
    with zipfile.ZipFile(io.BytesIO(_weights())) as archive:
        return _zipped({n: archive.read(n) if not n.endswith("data.pkl") else data for n in archive.namelist()})


def _exported() -> bytes:
    from memcomp_lightning.models import RBM
    from memcomp_lightning.trained.export.safetensors import write
    from memcomp_lightning.trained.run import Run

    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "model.safetensors"
        write(Run(path, RBM(n_visible=3, n_hidden=2), None, ImageSchema(PixelLayout(1, 3), 0)), path, "model")
        return path.read_bytes()


_PICKLE = (
    "ctorch._utils\n_rebuild_tensor_v2\n",
    "cos\nsystem\n",
    "cbuiltins\neval\n",
    "ccollections\nOrderedDict\n",
)


@cache
def small_run(folder: str) -> Path:
    """A run folder of a table of four columns, trained for one pass."""
    path = Path(folder).absolute() / "run"
    if not (path / "result.json").is_file():
        path.parent.mkdir(parents=True, exist_ok=True)
        table = path.parent / "people.csv"
        table.write_bytes(_csv_seed())
        settings = ["data=table", f"data.path={table}", "model=one_layer", "model.hidden_sizes=[3]", "logger=none"]
        settings += ["pretrain.iterations=1", "finetune.iterations=0", f"hydra.run.dir={path}"]
        command = [sys.executable, "-m", "memcomp_lightning.cli.train", *settings]
        subprocess.run(command, check=True, capture_output=True, cwd=path.parent)
    return path


def _in_run(file: str, read: Callable[[Path], Any], words: tuple[str, ...], share: float) -> Reader:
    """A file of a run folder, whose other files are as they should be."""

    def beside(folder: Path) -> None:
        shutil.copytree(small_run(str(folder.parent)), folder, dirs_exist_ok=True)

    return Reader(
        file, lambda path: read(path.parent), lambda: [_run_file(file)], words, share=share, beside=beside
    )


def _run_file(file: str) -> bytes:
    return (small_run(str(seeds_folder.get())) / file).read_bytes()


seeds_folder: ContextVar[Path] = ContextVar("seeds_folder")
"""Where the run is trained, parts of which are varied."""


def _of_folder(path: Path) -> None:
    folder = RunFolder(path)
    _ = folder.result, folder.error, folder.finished_stages, folder.history, folder.overrides, folder.rows
    _ = folder.typed_in, folder.schema, folder.settings
    if folder.settings is not None:
        foreign(folder.settings, path)


_JSON = (*_split('null true 1e400 NaN {} [] "" [[ {" -1 0.5 Infinity'), '": ', "\\u0000")
_YAML = ("_target_: ", "!!python/object:", ": ", "- ", "|\n", "? ", "<<: ", *_split("${ } &a *a null { [ ~"))
_NAMED = (*_split("memcomp_lightning. os.system torch. ${oc.env:HOME} .. /etc"), "${hydra:runtime.output_dir}")
_RECORD = (
    b'{"method": "cd", "iterations": 5, "seed": 0, "at": [1, 2], "seconds": [0.5, 1.0], "measures": '
    b'{"test_accuracy": [[0.5, 0.6], [0.7, 0.8]]}}\n'
    b'{"method": "pcd", "iterations": 5, "seed": 0, "at": [1, 2], "seconds": [0.5, 1.0], "measures": '
    b'{"test_accuracy": [[0.4, 0.6], [0.7, 0.9]]}}\n'
)
_FIGURE = (
    b'{"name": "figure4", "title": "t", "data": "d", "against": "iterations", "passes": [1, 2], "claims": [], '
    b'"labels": {"cd": "CD", "pcd": "PCD"}, "chosen": {}, "stop_early": [], "scale": ""}'
)


def _with(name: str, content: bytes) -> Callable[[Path], None]:
    """Writes one file beside the one that is varied."""

    def beside(folder: Path) -> None:
        (folder / name).write_bytes(content)

    return beside


def _figure(path: Path) -> None:
    """What memcomp-report does before it draws."""
    from memcomp_lightning.studies.report import _read, read_results

    results = _read(read_results, path)
    results.table()


def _solved() -> bytes:
    row = dict.fromkeys(COLUMNS, "") | {
        "file": "a.mc",
        "direction": "maximise",
        "value": "3",
        "wall_time_s": "0.1",
    }
    text = io.StringIO()
    csv.writer(text, lineterminator="\n").writerows([COLUMNS, [row[name] for name in COLUMNS]])
    return text.getvalue().encode()


READERS = {
    **{name: _problem(name) for name in _PROBLEMS},
    "any problem": _any_problem(),
    "gzip": Reader(
        "problem.gset.gz", lambda path: _scored(path, "gset"), lambda: [gzip.compress(_PROBLEMS["gset"][0][0])]
    ),
    "rbm": Reader(
        "model.npz",
        lambda path: _scored(path, "rbm"),
        lambda: [_npy(np.arange(6.0).reshape(2, 3) - 2)],
        _NPY,
        _as_weight,
        2,
    ),
    "csv": Reader("table.csv", _table, lambda: [_csv_seed(), b"1;2\n3;4\n5;6\n"], _CSV, share=6, needs="pyarrow"),
    "tsv": Reader("table.tsv", _table, lambda: [_csv_seed().replace(b",", b"\t")], _CSV, needs="pyarrow"),
    "parquet": Reader("table.parquet", _table, lambda: [_parquet()], needs="pyarrow"),
    "excel": Reader(
        "table.xlsx", _table, lambda: [_sheet()], ("<v>", "</c>", "t="), _in_workbook, 0.2, needs="openpyxl"
    ),
    "npy": Reader("table.npy", _table, lambda: [_MATRIX, _BITS], _NPY, share=3, needs="pyarrow"),
    "npz": Reader(
        "table.npz",
        _table,
        lambda: [_npy(np.arange(6.0) % 4), _npy(np.array(list("abcabd")))],
        _NPY,
        _as_columns,
        needs="pyarrow",
    ),
    "sparse": Reader(
        "table.npz", _table, lambda: [_sparse_indices()], _NPY, _with_sparse_indices, needs="pyarrow"
    ),
    "hdf5": Reader("table.h5", _table, lambda: [_hdf5()], needs="h5py"),
    "fasta": Reader(
        "family.fasta", _alignment, lambda: _FASTA, (">", "\n", "-", ".", "X", "?", "\r"), share=8, needs="Bio"
    ),
    "sequence table": Reader(
        "family.csv",
        _alignment,
        lambda: [b"sequence,n\nACGT,1\nAC-T,2\nGCGT,3\nACGA,4\n"],
        _CSV,
        share=2,
        needs="Bio",
    ),
    "pictures": Reader("pictures.npy", _pictures, lambda: [_MATRIX], _NPY, share=4),
    "idx": Reader(
        "images",
        lambda path: idx.parse(path.read_bytes(), 3, "images"),
        lambda: [bytes([0, 0, 8, 3, 0, 0, 0, 1, 0, 0, 0, 2, 0, 0, 0, 2, 1, 2, 3, 4])],
        share=4,
    ),
    "weights": Reader("model.pt", load, lambda: [_weights()], share=2),
    "pickle": Reader("model.pt", load, lambda: [_pickled()], _PICKLE, _with_pickle, 4),
    "safetensors": Reader("model.safetensors", load, lambda: [_exported()], _JSON, share=2, needs="safetensors"),
    "settings": _in_run("settings.yaml", _of_folder, (*_YAML, *_NAMED), 0.3),
    "run": _in_run("settings.yaml", load, (*_YAML, *_NAMED), 0.2),
    "schema of a run": _in_run("schema.json", load, _JSON, 0.2),
    "overrides": _in_run("overrides.json", _of_folder, _JSON, 0.3),
    "schema": Reader("schema.json", schema_in, lambda: [_run_file("schema.json")], _JSON, share=4),
    "records": Reader(
        "records.jsonl",
        lambda path: _figure(path.parent),
        lambda: [_RECORD],
        _JSON,
        share=4,
        beside=_with("figure.json", _FIGURE),
    ),
    "figure": Reader(
        "figure.json",
        lambda path: _figure(path.parent),
        lambda: [_FIGURE],
        _JSON,
        share=3,
        beside=_with("records.jsonl", _RECORD),
    ),
    "state": Reader(
        "solution.json",
        lambda path: _state(str(path)),
        lambda: [b'{"assignment": [0, 1]}', b"01 1"],
        _JSON,
        share=2,
    ),
    "best known": Reader("best.csv", read_best_known, lambda: [b"name,value\nG1,11624\nG2,-3.5\n"], _CSV, share=3),
    "solved": Reader(
        "solved.csv",
        lambda path: summary(with_gaps(read_rows(path), {})),
        lambda: [_solved()],
        _CSV,
        share=1,
    ),
}
"""By name. A run folder is the slowest: its settings are composed."""
