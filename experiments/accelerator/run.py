"""What an accelerator makes of the slow parts, each beside the CPU, and for what the host waits there.

    python experiments/accelerator/run.py --out FOLDER                    # on CUDA, under ten minutes
    python experiments/accelerator/run.py --out FOLDER --only cd pcd      # some of it
    python experiments/accelerator/run.py --out FOLDER --device cpu       # the CPU, and what would be waited for
    python experiments/accelerator/run.py --out FOLDER --device cpu --quick   # small: does everything run?

FOLDER has what was found after each row: results.json, table.csv, table.md. The same command goes on from there.
"""

import argparse
import platform
import signal
import statistics
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import torch
import waits
from work import QUICK, WORKS, Size, Work

from memcomp_lightning.errors import UserError
from memcomp_lightning.files import as_csv, read_json, write_json, write_text

Found = dict[str, dict[str, Any]]

COUNTED = "counted"
"""In place of a device: what is counted on the one that stands in."""

ENOUGH = 5
"""Repetitions; the table has their median."""

COLUMNS = (
    *(
        "row",
        "what",
        "unit",
        "device",
        "s a unit",
        "s a whole",
        "whole",
        "x CPU",
        "units a piece",
        "waits a piece",
    ),
    *("repetitions", "note"),
)


class OverrunError(Exception):
    """A piece of work took longer than four times the budget."""


@contextmanager
def stopped_after(seconds: float) -> Iterator[None]:
    """Raise an OverrunError in a piece of work that takes too long, between two of its operations."""
    if not hasattr(signal, "setitimer"):  # Windows
        yield
        return

    def stop(*_: object) -> None:
        raise OverrunError

    before = signal.signal(signal.SIGALRM, stop)
    signal.setitimer(signal.ITIMER_REAL, seconds)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
        signal.signal(signal.SIGALRM, before)


def seconds_of(piece: Callable[[], int], device: str) -> float:
    """Of a unit of the work, once the device is done with the piece."""
    begin = time.perf_counter()
    n = piece()
    if device == "cuda":
        torch.cuda.synchronize()
    return (time.perf_counter() - begin) / n


def measured(work: Work, device: str, size: Size, budget: float) -> dict[str, Any]:
    """Seconds of a unit in each repetition, what the first piece took, and what came in between.

    The first piece warms up and may compile; the budget is for the repetitions. Work that takes too long ends, and
    what it did counts.
    """
    seconds: list[float] = []
    found: dict[str, Any] = {"seconds": seconds, "first_s": None, "note": ""}
    begin = time.perf_counter()
    try:
        with stopped_after(4 * budget):
            piece = work.start(device, size)
            found["first_s"], warm = seconds_of(piece, device), time.perf_counter()
            while len(seconds) < ENOUGH and time.perf_counter() - warm < budget:
                seconds.append(seconds_of(piece, device))
            if device == "cuda":
                found["units"] = piece()
                found["waits"] = dict(waits.counted(piece, device))
    except OverrunError:
        found["note"] = f"stopped after {time.perf_counter() - begin:.0f} s"
    except UserError as error:
        found["note"] = str(error)
    except Exception as error:  # the other rows are worth having
        found["note"] = f"{type(error).__name__}: {error}".splitlines()[0]
    if not found["note"] and len(seconds) < ENOUGH:
        found["note"] = f"{len(seconds)} repetitions in {budget:g} s"
    return found


def would_wait(work: Work, size: Size) -> dict[str, Any]:
    """For what the host would wait in a piece of work on any accelerator."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)  # more would wait for each other in work that is as small as this
    try:
        with waits.usable():
            piece = work.start(waits.STAND_IN, size)
            n = piece()
            return {"waits": dict(waits.counted(piece, waits.STAND_IN)), "units": n}
    finally:
        torch.set_num_threads(threads)


def rows_of(found: Found) -> Iterator[dict[str, Any]]:
    """The table: a row for each work and device; on the CPU with the waits that an accelerator would cause."""
    for name, work in WORKS.items():
        beside = found.get(f"cpu/{work.beside or name}", {}).get("seconds")
        for device in ("cuda", "cpu"):
            if (own := found.get(f"{device}/{name}")) is None:
                continue
            typical = statistics.median(own["seconds"]) if own["seconds"] else None
            n, whole = work.whole
            ratio = statistics.median(beside) / typical if beside and typical and device != "cpu" else None
            source = own if device == "cuda" else found.get(f"{COUNTED}/{name}", {})
            waited = sum(source["waits"].values()) if "waits" in source else None
            cells = (name, work.what, work.unit, device, typical, typical and n * typical, whole, ratio)
            cells += (source.get("units"), waited, len(own["seconds"]), own["note"])
            yield dict(zip(COLUMNS, cells, strict=True))


def shown(value: object) -> str:
    return "" if value is None else f"{value:.3g}" if isinstance(value, float) else str(value)


def report(folder: Path, settings: dict[str, Any], found: Found) -> str:
    """Write all that was found; return the page."""
    write_json(folder / "results.json", {"settings": settings, "found": found})
    rows = [list(row.values()) for row in rows_of(found)]
    write_text(folder / "table.csv", as_csv([COLUMNS, *rows]))
    lines = [f"| {' | '.join(COLUMNS)} |", f"|{' --- |' * len(COLUMNS)}"]
    lines += [f"| {' | '.join(map(shown, row))} |" for row in rows]
    lines += [
        "",
        "Waits of a piece, by the line that causes them; on the CPU those that a device would cause:",
        "",
    ]
    for key, own in found.items():
        if "waits" in own:
            places = ", ".join(f"{n} x {place}" for place, n in own["waits"].items()) or "none"
            lines.append(f"- {key}, {own['units']} x {WORKS[key.partition('/')[2]].unit}: {places}")
    machine = ", ".join(f"{name} {value}" for name, value in settings.items())
    small = ["**Small work: these are no measurements.**", ""] if settings["sizes"] != "full" else []
    page = "\n".join([machine, "", *small, *lines]) + "\n"
    write_text(folder / "table.md", page)
    return page


def settings_of(device: str, size: str) -> dict[str, Any]:
    name = torch.cuda.get_device_name() if device == "cuda" else "none"
    threads = torch.get_num_threads()
    return {"accelerator": name, "sizes": size, "threads": threads, "torch": torch.__version__} | {
        "processor": platform.processor() or platform.machine()
    }


def run(
    folder: Path,
    device: str,
    names: list[str],
    *,
    size: Size,
    budget: float,
    until: float,
    label: str,
    small: Size = QUICK,
) -> Found:
    """Measure what the folder has not yet, the accelerator first; waits are counted in small work."""
    folder.mkdir(parents=True, exist_ok=True)
    settings, results = settings_of(device, label), folder / "results.json"
    kept = read_json(results) if results.exists() else {"settings": settings, "found": {}}
    if kept["settings"] != settings:
        raise SystemExit(f"{folder} has results of {kept['settings']}, this is {settings}: give another --out.")
    found: Found = kept["found"]
    for place in (*(("cuda",) if device == "cuda" else ()), COUNTED, "cpu"):
        for name in names:
            work, key = WORKS[name], f"{place}/{name}"
            compiled, twin = name.endswith("_kernel"), work.beside is not None
            if key in found or (place == COUNTED and compiled) or (place == "cpu" and twin):
                continue  # numba's kernels are no work of torch; on the CPU all draws are the host's
            if time.perf_counter() > until:
                print(f"{key}: not begun, the time is up", flush=True)
                continue
            begin = time.perf_counter()
            found[key] = would_wait(work, small) if place == COUNTED else measured(work, place, size, budget)
            print(f"{key}: {time.perf_counter() - begin:.1f} s {found[key].get('note', '')}", flush=True)
            report(folder, settings, found)
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, required=True, metavar="FOLDER")
    parser.add_argument(
        "--device", choices=("cuda", "cpu"), default="cuda" if torch.cuda.is_available() else "cpu"
    )
    parser.add_argument("--only", nargs="+", choices=list(WORKS), default=list(WORKS), metavar="NAME")
    parser.add_argument("--quick", action="store_true", help="small work")
    parser.add_argument("--budget", type=float, default=15.0, help="seconds for a row and device (default 15)")
    parser.add_argument("--seconds", type=float, default=500.0, help="no row begins after so many (default 500)")
    given = parser.parse_args()
    if given.device == "cuda" and not torch.cuda.is_available():
        parser.error("torch finds no CUDA device: --device cpu measures the CPU, and what a device would wait for")
    size, label = (QUICK, "quick") if given.quick else (Size(), "full")
    until = time.perf_counter() + given.seconds
    run(given.out, given.device, given.only, size=size, budget=given.budget, until=until, label=label)
    print((given.out / "table.md").read_text())


if __name__ == "__main__":
    main()
