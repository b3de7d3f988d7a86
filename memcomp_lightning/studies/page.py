"""One HTML page that opens offline: pictures and tables inside."""

import base64
from collections.abc import Sequence
from html import escape
from typing import NamedTuple

from memcomp_lightning.studies.verdicts import HOLDS, ONLY, RULE, Verdict

_STYLE = """
body { font: 15px/1.5 system-ui, sans-serif; max-width: 76rem; margin: 2rem auto; padding: 0 1rem; color: #222 }
img { max-width: min(100%, 56rem); height: auto; display: block; margin: 1rem 0 }
table { border-collapse: collapse; display: block; overflow-x: auto }
td, th { border-bottom: 1px solid #ddd; padding: .3rem .7rem; text-align: left; vertical-align: top }
td:last-child { min-width: 26rem; font-size: .9em }
td.fails { color: #a33 } td.only { color: #96690a } td.holds { color: #17703c }
pre, small { color: #555 }
"""


_HEADER = ("claim", "measured", "difference", "verdict", "controls that explain it")


class Section(NamedTuple):
    """One study: captions with their PNGs, rows of its table, lines below these, and how verdicts are made."""

    title: str
    pictures: Sequence[tuple[str, bytes]]
    verdicts: Sequence[Verdict]
    notes: Sequence[str]
    rule: str = RULE


def page(sections: Sequence[Section]) -> str:
    """Return the page."""
    body = "\n".join(_section(section) for section in sections)
    rules = "".join(f"<p>{escape(rule)}</p>" for rule in dict.fromkeys(section.rule for section in sections))
    return (
        '<!doctype html>\n<html lang="en"><head><meta charset="utf-8">'
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        f"<title>memcomp_lightning: report</title><style>{_STYLE}</style></head>\n"
        f"<body><h1>memcomp_lightning: report</h1>\n{body}\n<h2>How verdicts are made</h2>{rules}"
        "</body></html>\n"
    )


def markdown(verdicts: Sequence[Verdict]) -> str:
    """The table for a README."""
    lines = [f"| {' | '.join(_HEADER)} |", "| --- | --- | --- | --- | --- |"]
    for verdict in verdicts:
        cells = [*verdict[:-1], "; ".join(verdict.explained_by)]
        lines.append("| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |")
    return "\n".join(lines) + "\n"


def _section(section: Section) -> str:
    pictures = "\n".join(
        f'<img alt="{escape(caption)}" src="data:image/png;base64,{base64.b64encode(png).decode()}">'
        for caption, png in section.pictures
    )
    rows = "\n".join(map(_row, section.verdicts))
    table = f"<table><tr>{''.join(f'<th>{name}</th>' for name in _HEADER)}</tr>\n{rows}</table>" if rows else ""
    notes = "<br>".join(escape(note) for note in section.notes)
    return f"<h2>{escape(section.title)}</h2>\n{pictures}\n{table}\n<p><small>{notes}</small></p>"


def _row(verdict: Verdict) -> str:
    kind = {HOLDS: "holds", ONLY: "only"}.get(verdict.verdict, "fails")
    cells = "".join(f"<td>{escape(cell)}</td>" for cell in verdict[:3])
    controls = escape("; ".join(verdict.explained_by))
    return f'<tr>{cells}<td class="{kind}">{escape(verdict.verdict)}</td><td>{controls}</td></tr>'
