"""What a campaign has tried: a line of JSON for each case, so that it goes on where it was cut off.

A campaign is a list of cases, each a name that fixes it wholly (its kind and seed), and a function that tries one.
``run`` tries those that the ledger does not hold yet and prints the summary, which docs/reliability.md keeps.
"""

import argparse
import json
import os
import platform
import sys
import time
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import FIRST_COMPLETED, ProcessPoolExecutor, wait
from dataclasses import asdict, dataclass, field
from datetime import date
from itertools import islice
from pathlib import Path

HANGS_AFTER = 300
"""Seconds after which what a cluster does is taken to hang."""


@dataclass(frozen=True, kw_only=True)
class Outcome:
    """What came of a case.

    Attributes:
        kind: What the summary counts it under.
        tried: How many inputs, problems or moments the case holds.
        findings: A sentence for each that did not hold, with what it takes to see it again.
        facts: Numbers to keep, for people who look into the ledger.
    """

    kind: str
    tried: int = 1
    findings: list[str] = field(default_factory=list)
    facts: dict[str, float | str] = field(default_factory=dict)


def parser(description: str | None, *, count: int, what: str) -> argparse.ArgumentParser:
    """Arguments that all campaigns have."""
    lines = argparse.ArgumentParser(description=(description or "").splitlines()[0])
    lines.add_argument("--out", type=Path, required=True, help="folder of the ledger; an old one goes on")
    lines.add_argument("--count", type=int, default=count, help=f"{what} in all (default {count})")
    lines.add_argument("--workers", type=int, default=os.cpu_count() or 1, help="processes (default: one a core)")
    return lines


def run(folder: Path, cases: Sequence[str], attempt: Callable[[str], Outcome], *, workers: int) -> int:
    """Try the cases that are not in the ledger yet; print the summary; 1 if anything was found."""
    folder.mkdir(parents=True, exist_ok=True)
    file = folder / "ledger.jsonl"
    known = {line["case"] for line in read(file)}
    left = [case for case in cases if case not in known]
    print(f"{len(cases) - len(left)} of {len(cases)} cases are in {file}", file=sys.stderr)
    began = time.monotonic()
    with file.open("a", encoding="utf-8") as ledger:
        for number, (case, outcome) in enumerate(_tried(left, attempt, workers), 1):
            ledger.write(json.dumps({"case": case, **asdict(outcome)}) + "\n")
            ledger.flush()
            for finding in outcome.findings:
                print(f"{case}: {finding}", file=sys.stderr)
            if number % max(1, len(left) // 20) == 0:
                minutes = (time.monotonic() - began) / 60
                print(f"{number} of {len(left)} in {minutes:.1f} minutes", file=sys.stderr)
    lines = read(file)
    print(summary(lines))
    return int(any(line["findings"] for line in lines))


def _tried(cases: Sequence[str], attempt: Callable[[str], Outcome], workers: int) -> Iterable[tuple[str, Outcome]]:
    """Each case with its outcome, as they come; few wait at a time, so that Ctrl-C ends it at once."""
    if workers <= 1:
        yield from ((case, attempt(case)) for case in cases)
        return
    with ProcessPoolExecutor(workers) as pool:
        waiting = iter(cases)
        running = {pool.submit(attempt, case): case for case in islice(waiting, 2 * workers)}
        while running:
            done, _ = wait(running, return_when=FIRST_COMPLETED)
            for future in done:
                yield running.pop(future), future.result()
            running |= {pool.submit(attempt, case): case for case in islice(waiting, len(done))}


def wait_until(holds: Callable[[], bool], what: str) -> None:
    """Look again and again; a TimeoutError that says what does not hold after HANGS_AFTER seconds."""
    until = time.monotonic() + HANGS_AFTER
    while not holds():
        if time.monotonic() > until:
            raise TimeoutError(f"after {HANGS_AFTER} s it does not hold that {what}")
        time.sleep(0.1)


def read(file: Path) -> list[dict[str, object]]:
    """Lines of a ledger; a last one that was cut off by a kill is left out, and is tried again."""
    if not file.exists():
        return []
    lines = file.read_text(encoding="utf-8").splitlines(keepends=True)
    whole = [line for line in lines if line.endswith("\n")]
    if len(whole) < len(lines):
        file.write_text("".join(whole), encoding="utf-8")
    return [json.loads(line) for line in whole]


def summary(lines: Iterable[dict[str, object]]) -> str:
    """A table for people: how many of each kind were tried, and what did not hold."""
    tried: dict[str, int] = {}
    found: dict[str, int] = {}
    for line in lines:
        kind = str(line["kind"])
        tried[kind] = tried.get(kind, 0) + int(str(line["tried"]))
        found[kind] = found.get(kind, 0) + len(list(line["findings"]))  # type: ignore[call-overload]
    rows = [f"| {kind} | {tried[kind]:,} | {found[kind]:,} |" for kind in sorted(tried)]
    total = f"| all | {sum(tried.values()):,} | {sum(found.values()):,} |"
    head = [f"{date.today()}, {platform.machine()}, Python {platform.python_version()}", ""]
    return "\n".join([*head, "| | tried | findings |", "| --- | --- | --- |", *rows, total])
