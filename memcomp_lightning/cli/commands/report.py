"""``memcomp-report``: figures, tables and verdicts from run folders of ``experiment=figure4`` and the like."""

import argparse
import shlex
import sys
from collections.abc import Sequence
from pathlib import Path

from memcomp_lightning.cli.output import refuse, say
from memcomp_lightning.configuration.errors import in_words
from memcomp_lightning.errors import SettingError, UserError, lost
from memcomp_lightning.files import write_text
from memcomp_lightning.runs.addresses import fetched, is_address
from memcomp_lightning.runs.table import aligned, short_path
from memcomp_lightning.runs.trust import require_no_links
from memcomp_lightning.studies.page import page
from memcomp_lightning.studies.report import write_report
from memcomp_lightning.studies.verdicts import Verdict

COMMAND = "memcomp-report"


def verdict_table(judged: Sequence[Verdict]) -> str:
    """Verdicts for the screen."""
    rows = [["claim", "measured", "difference", "verdict"]]
    for claim, measured, test, verdict, controls in judged:
        rows.append([claim, measured, test, verdict + (f" ({len(controls)})" if controls else "")])
    return aligned(rows)


def main(arguments: Sequence[str] | None = None) -> None:
    """Entry point."""
    parser = argparse.ArgumentParser(
        prog=COMMAND,
        description="Write figures, tables and verdicts of runs like memcomp-train experiment=figure4.",
    )
    parser.add_argument("folders", nargs="+", metavar="FOLDER", help="folder of a run of a figure, or its address")
    parser.add_argument("--output", type=Path, help="the page; default: report.html in the first folder, or here")
    parser.error = lambda message: refuse(COMMAND, UserError(f"{message}. {COMMAND} --help shows how."))  # type: ignore[method-assign]
    given = parser.parse_args(arguments)
    try:
        folders = [fetched(folder) if is_address(folder) else Path(folder) for folder in given.folders]
        beside = Path() if is_address(given.folders[0]) else folders[0]
        write(folders, given.output or beside / "report.html")
    except (UserError, SettingError, OSError) as error:
        again = shlex.join([COMMAND, *(sys.argv[1:] if arguments is None else arguments)])
        said = lost(error)
        refuse(COMMAND, UserError(in_words(error) if said is None else f"{said} Go on with: {again}"))


def write(folders: Sequence[Path], output: Path) -> None:
    """Write the figures of run folders, and the page that has them all.

    Raises:
        UserError, SettingError: A folder is none of a figure, or holds what cannot be read.
        OSError: Something cannot be written.
    """
    for folder in folders:
        require_no_links(folder)
    sections = [write_report(folder) for folder in folders]
    write_text(output, page(sections))
    for section in sections:
        if section.verdicts:
            say(f"\n{section.title}\n{verdict_table(section.verdicts)}")
    say(f"\nReport:  {short_path(output.absolute())}")
