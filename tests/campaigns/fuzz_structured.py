"""Valid and nearly valid files of each format, made from known structures, so that no reading is taken on trust.

    python tests/campaigns/fuzz_structured.py --out runs/fuzz_structured

hypothesis makes the choices; where it is not installed, they are made at random. What a file means is said by what
it was made from, or, where it was spoilt, by the plain readers of ``obvious_readers.py``: a file that is read
otherwise is a finding, as is one that is refused though it is valid. The overrides of a command line are composed
by Hydra, a few a second: their number is ``--overrides``.
"""

import io
import json
import random
import sys
import tempfile
from collections.abc import Callable, Iterator, Sequence
from fractions import Fraction
from functools import partial
from importlib.util import find_spec
from pathlib import Path
from typing import Any, NamedTuple, Protocol, TypeVar

sys.path.insert(0, str(Path(__file__).parent))

import fuzz_bytes
import ledger
import numpy as np
import obvious_readers as obvious
from judged import REFUSALS, WrongError, judge

from memcomp_lightning.problems import FORMATS, read_problem

PER_BATCH = 5_000
"""Inputs of a batch."""

T = TypeVar("T")


class Dice(Protocol):
    """Where choices come from."""

    def number(self, low: int, high: int) -> int:
        """An integer of a range, both ends among it."""


class Random:
    """Choices of a seed."""

    def __init__(self, seed: str) -> None:
        self._generator = random.Random(seed)

    def number(self, low: int, high: int) -> int:
        return self._generator.randint(low, high)


def pick(dice: Dice, options: Sequence[T]) -> T:
    return options[dice.number(0, len(options) - 1)]


def rarely(dice: Dice, once_in: int = 8) -> bool:
    return dice.number(1, once_in) == once_in


class Input(NamedTuple):
    """A file.

    Attributes:
        content: Of it.
        valid: Whether it must be read.
        truth: What it means, where that is known without reading it.
    """

    content: bytes
    valid: bool
    truth: Any = None


# ----------------------------------------------------------------------------------------------- problem files

_NUMBERS = (
    "0",
    "1",
    "-1",
    "2.5",
    "-0.125",
    "+3",
    "1e2",
    "1.5e-3",
    ".5",
    "7.",
    "9007199254740993",
    "1e-12",
    "-1E+3",
)
_INTEGERS = ("1", "2", "3", "10", "0", "123456789012345678")


def _lines(dice: Dice, rows: Sequence[str], comments: Sequence[str]) -> bytes:
    """Rows among comments and blanks, with the line ends of any system."""
    found = []
    for row in rows:
        if comments and rarely(dice, 12):
            found.append(pick(dice, comments))
        if rarely(dice):
            row = pick(dice, (f" {row}", f"{row} ", row.replace(" ", "  "), row.replace(" ", "\t")))
        found.append(row)
    end = pick(dice, ("\n", "\n", "\n", "\r\n", "\r"))
    text = end.join(found) + (end if dice.number(0, 3) else "")
    return (b"\xef\xbb\xbf" if rarely(dice, 30) else b"") + text.encode()


_ASIDE = ("", "# a remark", "% another", "c", "c words", "// x")


def _pairs(dice: Dice, low: int, n: int, *, ordered: Callable[[int, int], tuple[int, int]] | None = None) -> Any:
    entries = []
    for _ in range(dice.number(0, 6)):
        i, j = dice.number(low, low + n - 1), dice.number(low, low + n - 1)
        i, j = (i, j) if ordered is None else ordered(i, j)
        entries.append((i, j, pick(dice, _NUMBERS)))
    return entries


def _gset(dice: Dice) -> bytes:
    n = dice.number(1, 5)
    edges = _pairs(dice, 1, n)
    bare = rarely(dice)
    rows = [f"{i} {j}" if bare else f"{i} {j} {w}" for i, j, w in edges]
    return _lines(dice, [f"{n} {len(edges)}", *rows], _ASIDE)


def _beasley(dice: Dice) -> bytes:
    n = dice.number(1, 5)
    entries = _pairs(dice, 1, n, ordered=lambda i, j: (min(i, j), max(i, j)))
    return _lines(dice, [f"{n} {len(entries)}", *(f"{i} {j} {q}" for i, j, q in entries)], _ASIDE)


def _coo(dice: Dice) -> bytes:
    entries = _pairs(dice, 0, dice.number(1, 5)) or [(0, 0, "1")]
    said = [pick(dice, ("# vartype=SPIN", "# vartype=BINARY"))] if dice.number(0, 1) else []
    said += [f"# offset={pick(dice, _NUMBERS)}"] if rarely(dice, 4) else []
    return _lines(dice, [*said, *(f"{i} {j} {q}" for i, j, q in entries)], _ASIDE)


def _qbsolv(dice: Dice) -> bytes:
    n = dice.number(1, 5)
    entries = sorted(_pairs(dice, 0, n), key=lambda entry: entry[0] != entry[1])
    own = sum(i == j for i, j, _ in entries)
    rows = [f"p qubo 0 {n} {own} {len(entries) - own}", *(f"{i} {j} {q}" for i, j, q in entries)]
    return _lines(dice, rows, _ASIDE)


def _mtx(dice: Dice) -> bytes:
    n, symmetric = dice.number(1, 4), dice.number(0, 1)
    kind = "symmetric" if symmetric else "general"
    if dice.number(0, 2):
        order = (lambda i, j: (max(i, j), min(i, j))) if symmetric else None
        entries, pattern = _pairs(dice, 1, n, ordered=order), rarely(dice)
        rows = [f"{i} {j}" if pattern else f"{i} {j} {q}" for i, j, q in entries]
        field = "pattern" if pattern else pick(dice, ("real", "integer"))
        body = [f"{n} {n} {len(entries)}", *rows]
        banner = f"%%MatrixMarket matrix coordinate {field} {kind}"
    else:
        count = n * (n + 1) // 2 if symmetric else n * n
        body = [f"{n} {n}", *(pick(dice, _NUMBERS) for _ in range(count))]
        banner = f"%%MatrixMarket matrix array real {kind}"
    content = _lines(dice, [banner.upper() if rarely(dice) else banner, *body], ("", "% x"))
    return content if content.lstrip(b"\xef\xbb\xbf").startswith(b"%%") else banner.encode() + b"\n" + content


def _clause(dice: Dice, n: int) -> str:
    literals = [pick(dice, (1, -1)) * dice.number(1, n) for _ in range(dice.number(0, 4))]
    return " ".join(map(str, [*literals, 0]))


def _cnf(dice: Dice) -> bytes:
    n = dice.number(1, 5)
    clauses = [_clause(dice, n) for _ in range(dice.number(0, 5))]
    text = [" ".join(clauses)] if clauses and rarely(dice) else clauses
    end = ["%", "0"] if rarely(dice) else []
    return _lines(dice, [f"p cnf {n} {len(clauses)}", *text, *end], ("", "c words", "c"))


def _wcnf(dice: Dice) -> bytes:
    n, count, old = dice.number(1, 5), dice.number(0, 5), dice.number(0, 1)
    if old:
        top = f" {pick(dice, ('5', '10', '2.5'))}" if dice.number(0, 2) else ""
        weights = [pick(dice, ("0", "1", "5", "10", "2.25", "1e1")) for _ in range(count)]
        head = [f"p wcnf {n} {count}{top}"]
    else:
        weights, head = [pick(dice, ("h", "1", "3", "0.5", *_INTEGERS[:3])) for _ in range(max(1, count))], []
    return _lines(dice, [*head, *(f"{weight} {_clause(dice, n)}" for weight in weights)], ("", "c words", "c"))


_WRITERS: dict[str, Callable[[Dice], bytes]] = {
    "gset": _gset,
    "beasley": _beasley,
    "coo": _coo,
    "qbsolv": _qbsolv,
    "mtx": _mtx,
    "cnf": _cnf,
    "wcnf": _wcnf,
}
_WORDS = (
    b"0",
    b"-1",
    b"1",
    b"6",
    b"1e400",
    b"nan",
    b"inf",
    b"1_0",
    b"0x1",
    b"1.5",
    b"#",
    b"c",
    b"h",
    b"p",
    b"%",
    b"\xff",
)


def spoilt(dice: Dice, content: bytes, words: Sequence[bytes] = _WORDS) -> bytes:
    """A file with one or two words or lines changed, doubled, lost or exchanged."""
    for _ in range(dice.number(1, 2)):
        lines = content.split(b"\n")
        at = dice.number(0, len(lines) - 1)
        cells = lines[at].split(b" ")
        word = dice.number(0, len(cells) - 1)
        match dice.number(0, 6):
            case 0:
                cells[word] = pick(dice, words)
            case 1:
                cells.insert(word, pick(dice, words))
            case 2:
                del cells[word]
            case 3:
                cells[word] += pick(dice, words)
            case 4:
                cells *= 2
            case 5:
                other = dice.number(0, len(lines) - 1)
                lines[at], lines[other] = lines[other], lines[at]
                cells = lines[at].split(b" ")
            case _:
                cells = cells[:word]
        lines[at] = b" ".join(cells)
        content = b"\n".join(lines)
    return content


def problem_of(name: str, dice: Dice) -> Input:
    content = _WRITERS[name](dice)
    return Input(spoilt(dice, content), False) if dice.number(0, 1) else Input(content, True)


def unnamed_of(name: str, dice: Dice) -> Input:
    """A valid file whose name does not say its format; lines that may be of several formats are refused."""
    return Input(_WRITERS[name](dice), False)


def check_unnamed(name: str, path: Path, given: Input) -> None:
    """Read a problem whose format follows from its lines."""
    if name.startswith("wcnf") and len(given.content.split()) == 2:
        return  # one empty clause of some weight is a graph without edges, too
    words = [line.split() for line in given.content.decode("utf-8-sig").splitlines()]
    if name.startswith("coo") and ["c"] in [line[:1] for line in words]:
        return  # entries of 0 below a comment of DIMACS are clauses
    check_problem(name.removesuffix(" by its lines"), path, given, read=lambda path, _: read_problem(path))


def check_problem(name: str, path: Path, given: Input, read: Callable[..., Any] = read_problem) -> None:
    """Read a problem, and count some states in both ways."""
    try:
        meant: obvious.Meaning | None = obvious.PROBLEMS[name](given.content)
    except obvious.RefusedError as error:
        if given.valid:
            raise WrongError(f"the second reader refuses a valid file: {error}") from error
        meant = None
    except obvious.UnsureError:
        read(path, name)
        return
    problem = read(path, name)
    if meant is None:
        raise WrongError("read, though the format has no such file")
    if problem.n != meant.n:
        raise WrongError(f"{problem.n} variables, not {meant.n}")
    if meant.n > 1000:
        return
    states = [[0] * meant.n, [1] * meant.n]
    states += [[(k * 7 + i * i * (k + 3)) % 3 % 2 for i in range(meant.n)] for k in range(3)]
    for state in states:
        score, (value, broken) = problem.score(np.array(state)), meant.score(state)
        if (Fraction(score.value), score.hard_unsatisfied) != (value, broken):
            raise WrongError(
                f"{state} counts {score.value} and {score.hard_unsatisfied}, not {value} and {broken}"
            )
        energy = Fraction(problem.objective.energy(score))
        found = float(problem.problem.energy(np.array(state, float)[problem.variables][None])[0])
        scale = sum(abs(part) for part in _sizes(problem))
        if abs(found - float(energy)) > 1e-12 * (scale + 1):
            raise WrongError(f"the energy of {state} is {found}, not {float(energy)}")


def _sizes(problem: Any) -> Iterator[float]:
    counted = problem.objective.counting
    numbers = getattr(counted, "numbers", None) or counted.weight
    yield from (9 * abs(x) for x in numbers.double().tolist())
    yield float(problem.objective.penalty) * max(1, len(getattr(counted, "hard", ())))


# -------------------------------------------------------------------------------------------- tables and arrays


def _column(dice: Dice, n: int) -> list[str]:
    kind = dice.number(0, 5)
    if kind == 0:
        return [
            pick(dice, ("Rome", "Oslo", "São Paulo", "a,b", 'say ""x""', "true story", "1 2")) for _ in range(n)
        ]
    if kind == 1:
        return [pick(dice, ("yes", "no")) for _ in range(n)]
    if kind == 2:
        return [pick(dice, ("True", "false", "TRUE")) for _ in range(n)]
    if kind == 3:
        return [str(dice.number(-40, 40) * 250) for _ in range(n)]
    if kind == 4:
        return [f"{dice.number(-9999, 9999) / 1000}e{dice.number(-12, 12)}" for _ in range(n)]
    return [pick(dice, ("-1", "1", "+1", "-1.0")) for _ in range(n)]


def csv_of(dice: Dice) -> Input:
    n, width = dice.number(4, 12), dice.number(2, 4)
    columns = [_column(dice, n) for _ in range(width)]
    for column in columns:
        for row in range(n):
            if rarely(dice, 10):
                column[row] = pick(dice, ("", "NA", "?", "  ", "nan"))
    names = [pick(dice, ("a", "b c", "é", "x.y", "d,e")) + str(k) for k in range(width)]
    rows = [[_quoted(cell) for cell in row] for row in [names, *map(list, zip(*columns, strict=True))]]
    end = pick(dice, ("\n", "\n", "\r\n"))
    content = (end.join(",".join(row) for row in rows) + (end if dice.number(0, 3) else "")).encode()
    content = (b"\xef\xbb\xbf" if rarely(dice, 20) else b"") + content
    words = (b",", b'"', b"1e31", b"inf", b"0x1", b"1_0", b"x", b"\xff", b";", b"true", b"-1")
    return Input(spoilt(dice, content, words), False) if dice.number(0, 1) else Input(content, True)


def _quoted(cell: str) -> str:
    return f'"{cell}"' if "," in cell or '"' in cell else cell


def check_csv(_: str, path: Path, given: Input) -> None:
    """Read a table, and write its rows again in the words of the file."""
    from memcomp_lightning.data.tables import Table, read_rows
    from memcomp_lightning.errors import SettingError, UserError

    try:
        data = Table(path=str(path), test_fraction=0.4).load()
    except (UserError, SettingError):
        return  # a column may say nothing, or mix words and numbers
    try:
        names, rows = obvious.table(given.content)
    except obvious.UnsureError:
        return
    found = read_rows(path, data.schema, complete=False)
    v = found.v if found.observed is None else found.v.masked_fill(~found.observed, float("nan"))
    if len(v) != len(rows):
        raise WrongError(f"{len(v)} rows, not {len(rows)}")
    for name, column in data.schema.decode(v).items():
        if name not in names:
            raise WrongError(f"a column {name!r}, where there are {names}")
        cells = [row[names.index(name)] for row in rows]
        spread = max([abs(float(x)) for x in cells if _is_number(x)], default=0.0)
        for row, (cell, told) in enumerate(zip(cells, column.tolist(), strict=True), start=1):
            if not _same(cell, told, spread):
                raise WrongError(f"column {name!r}, row {row}: {told!r}, not {cell!r}")


def _is_number(cell: str | None) -> bool:
    return cell is not None and bool(obvious._NUMBER.fullmatch(cell))


def _same(cell: str | None, told: Any, spread: float) -> bool:
    if cell is None or told is None or told != told:
        return cell is None and (told is None or told != told)
    if isinstance(told, str):
        return cell == told or (cell.lower() in ("true", "false") and cell == told.lower())
    return _is_number(cell) and abs(float(cell) - float(told)) <= 1e-6 * (abs(float(cell)) + spread)


_TYPES = ("<f8", "<f4", ">f8", ">f4", "<i8", ">i4", "|u1", "|i1", "|b1", "<f2", ">u2")


def npy_of(dice: Dice) -> Input:
    n, width = dice.number(4, 9), dice.number(1, 4)
    kind = pick(dice, _TYPES)
    values = [dice.number(0, 1) if kind == "|b1" else dice.number(0, 9) for _ in range(n * width)]
    array = np.array(values).reshape(n, width).astype(kind)
    if kind[1] == "f" and dice.number(0, 1):
        array = (array / 8).astype(kind)
    if rarely(dice, 3):
        array = np.asfortranarray(array)
    content = npy_bytes(array)
    if not dice.number(0, 3):
        at = dice.number(0, len(content) - 1)
        return Input(content[:at] + bytes([dice.number(0, 255)]) + content[at + 1 :], False)
    return Input(content, True)


def npy_bytes(array: Any) -> bytes:
    buffer = io.BytesIO()
    np.save(buffer, array)
    return buffer.getvalue()


def check_npy(_: str, path: Path, given: Input) -> None:
    """Read the rows of an array as batches of a table, and as pictures."""
    from memcomp_lightning.data.tables.readers import opened
    from memcomp_lightning.errors import UserError

    try:
        batches = list(opened(path).batches)
    except UserError:
        if given.valid:
            raise WrongError("a valid array is refused") from None
        return
    shape, flat = obvious.npy(given.content)
    found = [
        x for batch in batches for row in zip(*(c.to_pylist() for c in batch.columns), strict=True) for x in row
    ]
    if [_plain(x) for x in found] != [_plain(x) for x in flat]:
        raise WrongError(f"other numbers than in the array of shape {shape}")


def _plain(x: float) -> float | str:
    return "nan" if x != x else float(x)


def fasta_of(dice: Dice) -> Input:
    letters = pick(dice, ("ACGT-", "ACGU-N", "ACDEFGHIKLMNPQRSTVWY-X", "ACGTacgt.-"))
    length, end = dice.number(1, 8), pick(dice, ("\n", "\n", "\r\n", "\r"))
    lines: list[str] = []
    for k in range(dice.number(2, 7)):
        sequence = "".join(pick(dice, letters) for _ in range(length))
        cut = dice.number(0, length)
        lines += [f">{pick(dice, ('s', 's one', '>x', ' '))}{k}"]
        lines += [sequence[:cut], sequence[cut:]] if rarely(dice) else [sequence]
    content = (end.join(lines) + (end if dice.number(0, 2) else "")).encode()
    words = (b">", b"\xff", b"*", b"a", b"B", b"?", b"")
    return Input(spoilt(dice, content, words), False) if dice.number(0, 1) else Input(content, True)


def check_fasta(_: str, path: Path, given: Input) -> None:
    """Read sequences; their letters as numbers come back as letters."""
    from memcomp_lightning.data.sequences.alignment import aligned
    from memcomp_lightning.data.sequences.files import read_sequences
    from memcomp_lightning.data.sequences.schema import SequenceSchema

    file = read_sequences(path)
    meant = obvious.fasta(given.content)
    if list(zip(file.names, file.sequences, strict=True)) != meant:
        raise WrongError("other names or sequences")
    alignment = aligned(file)
    schema = SequenceSchema(alignment.n_sites, alignment.alphabet.name)
    told = schema.decode(_with_gaps(schema.numbers(alignment, complete=False)))["sequence"].tolist()
    other = {"rna": ("T", "U"), "dna": ("U", "T")}.get(schema.alphabet, ("", ""))
    for (name, sequence), letters in zip(meant, told, strict=True):
        kept = "".join(s for s in sequence if not (alignment.removed and (s.islower() or s == ".")))
        plain = kept.upper().replace(".", "-").replace("?", schema.known.missing)
        plain = plain.replace(*other) if other[0] else plain
        if plain != letters:
            raise WrongError(f"{name}: {letters}, not {plain}")


def _with_gaps(numbers: Any) -> Any:
    import torch

    return torch.from_numpy(numbers.astype(np.float32)).masked_fill_(
        torch.from_numpy(numbers == 255), float("nan")
    )


def idx_of(dice: Dice) -> Input:
    shape = [dice.number(0, 3) for _ in range(3)]
    body = bytes(dice.number(0, 255) for _ in range(shape[0] * shape[1] * shape[2]))
    content = bytes([0, 0, 8, 3]) + b"".join(axis.to_bytes(4, "big") for axis in shape) + body
    if dice.number(0, 1):
        at = dice.number(0, len(content) - 1)
        return Input(content[:at] + bytes([dice.number(0, 255)]) + content[at + 1 :], False)
    return Input(content, 0 not in shape)


def check_idx(_: str, path: Path, given: Input) -> None:
    """Read the bytes of pictures."""
    from memcomp_lightning.data import idx

    found = idx.parse(path.read_bytes(), 3, "pictures")
    shape, values = obvious.idx(given.content)
    if (tuple(found.shape), found.flatten().tolist()) != (shape, values):
        raise WrongError("other bytes")


def records_of(dice: Dice) -> Input:
    truth = []
    for k in range(dice.number(0, 4)):
        at = list(range(1, dice.number(1, 3) + 1))
        values = [[dice.number(0, 1000) / 1000 for _ in range(2)] for _ in at]
        one = {"method": pick(dice, ("cd", "pcd", "é")), "seed": k, "at": at, "seconds": [float(x) for x in at]}
        truth.append(one | {"measures": {"test_accuracy": values}, "choosing": rarely(dice)})
    content = "".join(json.dumps(one) + "\n" for one in truth).encode()
    if dice.number(0, 1) and content:
        words = (b'"x"', b"null", b"[]", b"{", b"}", b",", b"1", b"NaN", b"\xff")
        return Input(spoilt(dice, content, words), False)
    return Input(content, True, truth)


def check_records(_: str, path: Path, given: Input) -> None:
    """Read records; each has what stands in its line."""
    from memcomp_lightning.studies.records import Records

    found = Records(path.parent, path.name).all
    lines = given.content.decode("utf-8", "replace").split("\n")
    told = [json.loads(line) for line in lines[: len(found)]]
    for record, line in zip(found, told, strict=True):
        for name, value in line.items():
            if repr(getattr(record, name)) != repr(value):
                raise WrongError(f"{name} is {getattr(record, name)!r}, not {value!r}")
        if not (_numbers(record.at) and _numbers(record.seconds) and isinstance(record.method, str)):
            raise WrongError(
                f"a record with at={record.at!r}, seconds={record.seconds!r}, method={record.method!r}"
            )
    if given.valid and len(found) != len(given.truth):
        raise WrongError(f"{len(found)} records, not {len(given.truth)}")


def _numbers(values: Any) -> bool:
    return isinstance(values, list) and all(isinstance(x, int | float) for x in values)


def schema_of_dice(dice: Dice) -> Input:
    columns: list[dict[str, Any]] = []
    for k in range(dice.number(1, 4)):
        columns.append(
            {"name": f"c{k}"}
            | pick(
                dice,
                (
                    {"kind": "real", "mean": 0.5, "scale": 2.0, "whole": False},
                    {"kind": "binary", "words": ["no", "yes"]},
                    {"kind": "category", "words": [1, 2, 3]},
                    {"kind": "spin"},
                    {"kind": "probability"},
                ),
            )
        )
    schema: dict[str, Any] = {"data": "table", "named": True, "label": None, "weight": None, "columns": columns}
    if rarely(dice, 3):
        schema = {"data": "images", "height": 2, "width": 2, "pixels": None, "n_classes": 0}
    if rarely(dice, 3):
        schema = {"data": "sequences", "n_sites": 3, "alphabet": "dna", "letters": "ACGT-", "insertions": None}
    valid = bool(dice.number(0, 1))
    if not valid:
        part = pick(dice, (schema, *schema.get("columns", ())))
        name = pick(dice, list(part))
        part[name] = pick(dice, (None, "x", 0, -1, 1e9, [], {}, [1, "a"], True, float("nan"), "../x", [0], "real"))
    return Input(json.dumps(schema).encode(), valid, schema)


def check_schema(_: str, path: Path, given: Input) -> None:
    """Read a schema, use it, and write it again."""
    import torch

    from memcomp_lightning.trained.alone import schema_in

    schema = schema_in(path)
    if json.loads(json.dumps(schema.as_json())) != json.loads(json.dumps(given.truth)):
        raise WrongError(f"is {schema.as_json()}")
    schema.units()
    _ = schema.class_names, schema.entry_names, schema.site_names, schema.log_scale
    schema.decode(torch.zeros(1, schema.n_sites))


# ---------------------------------------------------------------------------------------------------- overrides


def override_of(dice: Dice) -> Input:
    """An override with the value that it means; spoilt ones must be refused by a line, or be read."""
    name, text, value = pick(dice, _SETTINGS)(dice)
    typed = f"{name}={text}"
    if dice.number(0, 1):
        at = dice.number(0, len(typed))
        sign = pick(
            dice, ("=", ",", "[", "}", "'", '"', " ", "..", "${", "\\", "é", "+", "~", "@", ":", "\t", "\x1b")
        )
        cut = typed[at + dice.number(0, 2) :]
        return Input((typed[:at] + sign + cut).encode(), False)
    return Input(typed.encode(), True, [name, value])


def _whole(name: str, low: int) -> Callable[[Dice], tuple[str, str, Any]]:
    def made(dice: Dice) -> tuple[str, str, Any]:
        number = dice.number(low, 10**6)
        return name, str(number), number

    return made


def _real(dice: Dice) -> tuple[str, str, Any]:
    text = f"{dice.number(1, 9999)}e-{dice.number(3, 9)}"
    return "pretrain.optimizer.lr", text, float(text)


def _list(dice: Dice) -> tuple[str, str, Any]:
    sizes = [dice.number(1, 900) for _ in range(dice.number(1, 4))]
    return "model.hidden_sizes", pick(dice, ("[{}]", "[ {} ]")).format(",".join(map(str, sizes))), sizes


def _truth(dice: Dice) -> tuple[str, str, Any]:
    word = pick(dice, ("true", "false", "True", "FALSE"))
    return "pretrain.keep_best", word, word.lower() == "true"


def _path(dice: Dice) -> tuple[str, str, Any]:
    signs = "abc XYZ019._-=,()[]{}'\"$&;:+éß"
    text = "a" + "".join(pick(dice, signs) for _ in range(dice.number(0, 12))) + "z"
    return "model.weights", text, text


_SETTINGS = (
    _whole("seed", 0),
    _whole("pretrain.iterations", 0),
    _whole("data.chunk_size", 1),
    _real,
    _list,
    _truth,
    _path,
)


def check_override(_: str, path: Path, given: Input) -> None:
    """Compose a command line with one override, as memcomp-train does before it builds anything."""
    from omegaconf import DictConfig, OmegaConf

    from memcomp_lightning.cli.arguments import read
    from memcomp_lightning.cli.overrides import check_command_line

    kept: list[DictConfig] = []
    line = read([given.content.decode(), f"hydra.run.dir={path.parent}/run"])
    if line.shows or line.multirun:
        return
    check_command_line(
        line, config_name="config", check=lambda config, _: kept.append(config), folders=(str(path.parent),) * 2
    )
    if given.valid:
        name, value = given.truth
        found = OmegaConf.select(kept[-1], name)
        plain = OmegaConf.to_container(found) if OmegaConf.is_config(found) else found
        if plain != value:
            raise WrongError(f"{name} is {plain!r}, not {value!r}")


# --------------------------------------------------------------------------------------------- the campaign


class Kind(NamedTuple):
    """What is made, and how it is checked.

    Attributes:
        file: Name of the file.
        make: An input from choices.
        check: Reads the file, and raises ``WrongError`` if it is read wrongly.
        share: Of all inputs.
        needs: Package without which it is left out.
    """

    file: str
    make: Callable[[Dice], Input]
    check: Callable[[str, Path, Input], None]
    share: float = 1.0
    needs: str | None = None


KINDS = {
    **{
        name: Kind(f"problem{FORMATS[name].suffixes[0]}", partial(problem_of, name), check_problem)
        for name in _WRITERS
    },
    **{
        f"{name} by its lines": Kind("problem.txt", partial(unnamed_of, name), check_unnamed, 0.3)
        for name in _WRITERS
        if name != "beasley"  # whose lines are those of the G-set: its files must say so
    },
    "csv": Kind("table.csv", csv_of, check_csv, 0.5, "pyarrow"),
    "npy": Kind("table.npy", npy_of, check_npy, 0.5, "pyarrow"),
    "fasta": Kind("family.fasta", fasta_of, check_fasta, 0.5, "Bio"),
    "idx": Kind("images", idx_of, check_idx, 0.3),
    "records": Kind("records.jsonl", records_of, check_records, 0.5),
    "schema": Kind("schema.json", schema_of_dice, check_schema, 0.5, "pyarrow"),
}
"""By name."""

OVERRIDES = Kind("overrides", override_of, check_override)


def attempt(case: str, *, folder: Path) -> ledger.Outcome:
    """Make and check the inputs of one batch."""
    name, number, count = case.split("/")
    contents: list[int] = []
    findings = tried(name, number, int(count), folder, contents=contents)
    return ledger.Outcome(kind=name, tried=len(contents), findings=findings, facts={"bytes": sum(contents)})


def tried(
    name: str,
    number: str,
    count: int,
    folder: Path,
    kind: Kind | None = None,
    contents: list[int] | None = None,
) -> list[str]:
    """A sentence for each kind of thing that is wrong; ``contents`` gets the bytes of each input."""
    kind = kind or (OVERRIDES if name == "override" else KINDS[name])
    marks: dict[str, str] = {}
    with tempfile.TemporaryDirectory(dir=fuzz_bytes.quick_place()) as scratch:
        path = Path(scratch) / kind.file

        def one(given: Input) -> None:
            path.write_bytes(given.content)
            if contents is not None:
                contents.append(len(given.content))
            finding = judge(lambda: _checked(kind, name, path, given), limits=name != "override")
            if finding is not None and finding.mark not in marks:
                again = f"python tests/campaigns/fuzz_structured.py --out OTHER --batch '{name}/{number}/{count}'"
                marks[finding.mark] = f"{finding.text} Input: {given.content!r} Again: {again}"
                fuzz_bytes.keep(folder, f"structured {name}", given.content, finding.mark, finding.text, again)

        for given in _inputs(kind, f"{name} {number}", count, one):
            one(given)
    return list(marks.values())


def _checked(kind: Kind, name: str, path: Path, given: Input) -> None:
    """Check an input; a valid one that is refused is wrong, too."""
    try:
        kind.check(name, path, given)
    except REFUSALS as error:
        if given.valid:
            raise WrongError(f"a valid file is refused: {error}") from error
        raise


def _inputs(kind: Kind, seed: str, count: int, one: Callable[[Input], None]) -> Iterator[Input]:
    """Inputs of choices at random; those of hypothesis are tried here."""
    if find_spec("hypothesis") is None:
        dice = Random(seed)
        yield from (kind.make(dice) for _ in range(count))
        return
    import hypothesis
    from hypothesis import strategies

    class Drawn:
        def __init__(self, draw: Callable[[Any], Any]) -> None:
            self._draw = draw

        def number(self, low: int, high: int) -> int:
            return int(self._draw(strategies.integers(low, high)))

    @strategies.composite
    def inputs(draw: Any) -> Input:
        return kind.make(Drawn(draw))

    @hypothesis.seed(seed)
    @hypothesis.settings(
        max_examples=count,
        database=None,
        deadline=None,
        phases=[hypothesis.Phase.generate],
        suppress_health_check=list(hypothesis.HealthCheck),
    )
    @hypothesis.given(inputs())
    def every(given: Input) -> None:
        one(given)

    every()


def cases(count: int, overrides: int) -> Iterator[str]:
    """Batches of all kinds in turn, by their shares."""
    usable = {name: kind for name, kind in KINDS.items() if not kind.needs or find_spec(kind.needs)}
    total = sum(kind.share for kind in usable.values())
    batches = []
    for name, share, size in [
        *((name, count * kind.share / total, PER_BATCH) for name, kind in usable.items()),
        ("override", overrides, 250),
    ]:
        left, number = round(share), 0
        while left > 0:
            batches.append((number, name, min(left, size)))
            left, number = left - min(left, size), number + 1
    yield from (f"{name}/{number}/{inputs}" for number, name, inputs in sorted(batches, key=lambda b: b[0]))


def main() -> int:
    lines = ledger.parser(__doc__, count=100_000, what="files")
    lines.add_argument("--overrides", type=int, default=10_000, help="override strings (default 10000)")
    lines.add_argument("--batch", help="try one batch alone, as a finding names it: NAME/NUMBER/COUNT")
    given = lines.parse_args()
    given.out.mkdir(parents=True, exist_ok=True)
    tries: Callable[[str], ledger.Outcome] = partial(attempt, folder=given.out)
    batches = [given.batch] if given.batch else list(cases(given.count, given.overrides))
    return ledger.run(given.out, batches, tries, workers=given.workers)


if __name__ == "__main__":
    sys.exit(main())
