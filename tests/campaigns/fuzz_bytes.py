"""Bytes that come near to valid files, by the million, through every reader of files.

    python tests/campaigns/fuzz_bytes.py --out runs/fuzz_bytes

atheris varies them so that new lines of the readers run; where it is not installed, bytes are changed at random.
Each batch is a process of its own, so that one which dies or hangs is a finding like others. What is wrong is
written to ``findings`` in the folder, with the line that shows it again.
"""

import hashlib
import json
import mmap
import os
import random
import signal
import sys
import tempfile
import time
import traceback
from collections.abc import Callable, Iterator, Sequence
from contextlib import nullcontext, suppress
from functools import partial
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import Any, NoReturn

sys.path.insert(0, str(Path(__file__).parent))

import ledger

PER_BATCH = 20_000
"""Inputs of a batch of a reader whose share is 1 or more."""

SILENT_S = 60.0
"""A process that reads no input for so long hangs."""

LONGEST = 4096
"""Bytes of an input."""


# ---------------------------------------------------------------------------------------------------- one batch


def changed(generator: random.Random, seeds: Sequence[bytes], words: Sequence[bytes]) -> bytes:
    """A seed with a few changes: bits, bytes, words of the format, parts doubled, lost or of another seed."""
    data = bytearray(generator.choice(seeds))
    for _ in range(generator.choice((1, 1, 1, 2, 3, 8))):
        at = generator.randrange(len(data) + 1)
        end = min(len(data), at + generator.choice((1, 1, 4, 16)))
        match generator.randrange(6):
            case 0 if data:
                data[at % len(data)] ^= 1 << generator.randrange(8)
            case 1:
                data[at:at] = bytes([generator.randrange(256)])
            case 2 if words:
                data[at : at + generator.choice((0, 1, 4))] = generator.choice(words)
            case 3:
                del data[at:end]
            case 4:
                data[at:at] = data[at:end] * generator.choice((1, 2, 50))
            case 5:
                other = generator.choice(seeds)
                cut = generator.randrange(len(other) + 1)
                data[at:] = other[cut:]
    return bytes(data[:LONGEST])


class Batch:
    """Tries inputs of one reader, and keeps what it finds.

    Args:
        name: Of the reader.
        folder: Of the campaign.
        scratch: A folder for the file that is read.
        progress: A file in which the number of inputs stands.
    """

    def __init__(self, name: str, folder: Path, scratch: Path, progress: Path | None = None) -> None:
        from readers import READERS, seeds_folder

        seeds_folder.set(folder)
        self.name, self.reader, self.folder = name, READERS[name], folder
        self.place = scratch / "reading"
        self.place.mkdir()
        self.reader.beside(self.place)
        self.path = self.place / self.reader.file
        self.seeds = list(self.reader.seeds())
        self.words = [word.encode() for word in self.reader.words]
        self.marks: dict[str, int] = {}
        self.n = 0
        self._count: Any = None
        if progress is not None:
            progress.write_bytes(bytes(8))
            with progress.open("r+b") as file:
                self._count = mmap.mmap(file.fileno(), 8)

    def __call__(self, data: bytes) -> None:
        """Try one input."""
        from judged import judge

        self.n += 1
        if self._count is not None:
            self._count[:] = self.n.to_bytes(8, "little")
        try:
            content = self.reader.dress(data)
        except ValueError:
            return
        self.path.write_bytes(content)
        finding = judge(lambda: self.reader.read(self.path))
        if finding is None or self.marks.get(finding.mark, 1 << 30) <= len(content):
            return
        self.marks[finding.mark] = len(content)
        keep(self.folder, self.name, content, finding.mark, finding.text)


def keep(folder: Path, name: str, content: bytes, mark: str, text: str, again: str | None = None) -> None:
    """Write an input that was found, with what was wrong and the line that shows it again.

    A smaller input takes the place of a larger one with the same mark.
    """
    stem = f"{name.replace(' ', '_')}-{hashlib.sha256(mark.encode()).hexdigest()[:8]}"
    place = folder / "findings"
    place.mkdir(parents=True, exist_ok=True)
    file, note = place / f"{stem}.bin", place / f"{stem}.json"
    if file.exists() and note.exists() and file.stat().st_size <= len(content):
        return
    file.write_bytes(content)
    again = again or f"python tests/campaigns/fuzz_bytes.py --again {file}"
    note.write_text(json.dumps({"reader": name, "mark": mark, "text": text, "again": again}), encoding="utf-8")


def batch(name: str, number: int, inputs: int, folder: Path, scratch: Path, progress: Path | None = None) -> None:
    """Try the inputs of one batch, by atheris if it is there."""
    if find_spec("atheris") is None:
        tried = Batch(name, folder, scratch, progress)
        generator = random.Random(f"{name} {number}")
        for seed in tried.seeds:
            tried(seed)
        for _ in range(inputs):
            tried(changed(generator, tried.seeds, tried.words))
        return
    import atheris

    tried = Batch(name, folder, scratch, progress)
    corpus = folder / "corpus" / name.replace(" ", "_")
    corpus.mkdir(parents=True, exist_ok=True)
    for seed in tried.seeds:
        (corpus / hashlib.sha256(seed).hexdigest()[:16]).write_bytes(seed)
    settings = [f"-runs={inputs}", f"-seed={number + 1}", f"-max_len={LONGEST}", "-rss_limit_mb=0", "-timeout=600"]
    if tried.words:
        lines = ('"' + "".join(f"\\x{byte:02x}" for byte in word) + '"' for word in tried.words)
        words = scratch / "words.dict"
        words.write_text("\n".join(lines), encoding="ascii")
        settings.append(f"-dict={words}")
    atheris.Setup([sys.argv[0], *settings, str(corpus)], tried)
    atheris.Fuzz()


# ------------------------------------------------------------------------------------------------- the campaign


def attempt(case: str, *, folder: Path) -> ledger.Outcome:
    """Run one batch in a process of its own, forked from this one, where all is imported."""
    name, number, inputs = case.split("/")
    before = _notes(folder, name)
    with tempfile.TemporaryDirectory(dir=quick_place()) as scratch:
        began, progress = time.monotonic(), Path(scratch) / "progress"
        child = os.fork()
        if child == 0:
            _child(name, int(number), int(inputs), folder, Path(scratch), progress)
        ended = _watched(child, progress)
        tried = int.from_bytes(progress.read_bytes(), "little") if progress.exists() else 0
        if ended is not None:
            from readers import READERS

            path = Path(scratch) / "reading" / READERS[name].file
            content = path.read_bytes() if path.exists() else b""
            keep(folder, name, content, ended, f"{ended}; {_log(folder, name)} may say more.")
    found = [said for file, said in _notes(folder, name).items() if before.get(file) != said]
    texts = [f"{note['text']} Again: {note['again']}" for note in map(json.loads, found)]
    return ledger.Outcome(kind=name, tried=tried, findings=texts, facts={"seconds": time.monotonic() - began})


def _child(name: str, number: int, inputs: int, folder: Path, scratch: Path, progress: Path) -> NoReturn:
    status = 1
    try:
        with _log(folder, name).open("a", encoding="utf-8") as log:
            os.dup2(log.fileno(), 1)
            os.dup2(log.fileno(), 2)
        batch(name, number, inputs, folder, scratch, progress)
        status = 0
    except SystemExit as end:
        status = int(end.code or 0)
    except BaseException:
        traceback.print_exc()
    finally:
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(status)


def _log(folder: Path, name: str) -> Path:
    return folder / f"log-{name.replace(' ', '_')}.txt"


def _notes(folder: Path, name: str) -> dict[str, str]:
    """What was found so far with one reader, by file."""
    notes = {path.name: path.read_text(encoding="utf-8") for path in sorted((folder / "findings").glob("*.json"))}
    return {file: text for file, text in notes.items() if json.loads(text)["reader"] == name}


def quick_place() -> str | None:
    """A folder in memory, where there is one: each input is a file."""
    return "/dev/shm" if Path("/dev/shm").is_dir() else None


def _watched(child: int, progress: Path) -> str | None:
    """Wait for a batch; None if it came to its end, else how it ended."""
    last, since = b"", time.monotonic()
    while True:
        done, status = os.waitpid(child, os.WNOHANG)
        if done:
            break
        time.sleep(0.1)
        now = progress.read_bytes() if progress.exists() else b""
        if now != last:
            last, since = now, time.monotonic()
        elif time.monotonic() - since > SILENT_S:
            os.kill(child, signal.SIGKILL)
            os.waitpid(child, 0)
            return f"reads for more than {SILENT_S:g} s"
    code = os.waitstatus_to_exitcode(status)
    if code == 0:
        return None
    return (
        f"ends the process by {signal.Signals(-code).name}" if code < 0 else f"ends the process with status {code}"
    )


def prepare() -> None:
    """Import what readers need, with atheris' marks in each line of this package if it is there."""
    os.environ.update(OMP_NUM_THREADS="1", ARROW_DEFAULT_MEMORY_POOL="system", MALLOC_ARENA_MAX="1")
    marked: Any = nullcontext()
    if find_spec("atheris") is not None:
        import atheris

        marked = atheris.instrument_imports(include=["memcomp_lightning"], enable_loader_override=False)
    with marked:
        for name in ("readers", *_LATE):
            with suppress(ModuleNotFoundError):
                import_module(name)


_LATE = (
    "memcomp_lightning.data.tables",
    "memcomp_lightning.data.sequences",
    "memcomp_lightning.studies.report",
    "memcomp_lightning.trained.export.safetensors",
    "pandas",
    "pyarrow.parquet",
    "pyarrow.csv",
    "h5py",
    "openpyxl",
    "Bio.SeqIO.FastaIO",
    "scipy.sparse",
)
"""Imported by readers when they read."""


def cases(count: int, names: Sequence[str]) -> Iterator[str]:
    """Batches of all readers in turn, by their shares."""
    from readers import READERS

    shares = {name: READERS[name].share for name in names}
    total = sum(shares.values())
    batches = []
    for name, share in shares.items():
        left, number = max(1, round(count * share / total)), 0
        while left > 0:
            inputs = min(left, round(PER_BATCH * min(1.0, share)))
            batches.append((number, name, inputs))
            left, number = left - inputs, number + 1
    yield from (f"{name}/{number}/{inputs}" for number, name, inputs in sorted(batches, key=lambda b: b[0]))


def again(file: Path) -> int:
    """Read one kept input once more; 1 if it is still a finding."""
    note = json.loads(file.with_suffix(".json").read_text(encoding="utf-8"))
    prepare()
    with tempfile.TemporaryDirectory() as folder:
        found = show(note["reader"], file.read_bytes(), Path(folder))
    print("read, or refused as it should be" if found is None else found)
    return int(found is not None)


def show(name: str, content: bytes, folder: Path) -> str | None:
    """What is wrong with how a reader reads a file; None if nothing is."""
    from judged import judge

    one = Batch(name, folder, folder)
    one.path.write_bytes(content)
    finding = judge(lambda: one.reader.read(one.path))
    return None if finding is None else finding.text


def main() -> int:
    lines = ledger.parser(__doc__, count=1_000_000, what="inputs")
    lines.add_argument("--only", nargs="*", help="readers (default: all)")
    if sys.argv[1:2] == ["--again"]:
        return again(Path(sys.argv[2]))
    given = lines.parse_args()
    given.out.mkdir(parents=True, exist_ok=True)
    prepare()
    from readers import READERS, small_run

    small_run(str(given.out))
    names = given.only or [name for name, reader in READERS.items() if not reader.needs or find_spec(reader.needs)]
    tries: Callable[[str], ledger.Outcome] = partial(attempt, folder=given.out)
    return ledger.run(given.out, list(cases(given.count, names)), tries, workers=given.workers)


if __name__ == "__main__":
    sys.exit(main())
