"""What is said in comments: of some formats they carry what the numbers mean."""

import re
from collections.abc import Iterator

from memcomp_lightning.problems.files.numbers import NUMBER, fits, number
from memcomp_lightning.problems.files.source import Source, holds, is_comment, quoted


def comments(lines: list[str]) -> Iterator[tuple[int, str]]:
    """Number and text of what is said in comments, also of those at the end of a line."""
    for at, line in enumerate(lines, start=1):
        if is_comment(line):
            if text := _MARK.sub("", line).strip():
                yield at, text
        elif "#" in line:
            yield at, line.partition("#")[2].strip()


_MARK = re.compile(r"\A\s*(?:[#%]+|//|[cC](?=\s|$))")

_MEANING = re.compile(
    r"\b(offset|constant|vartype|scale|scaling|sense|direction|maximi[sz]e|minimi[sz]e)\b[\"']?\s*[:=]\s*\S+",
    re.IGNORECASE,
)


def unread(lines: list[str], counted: tuple[str, ...] = (), names: re.Pattern[str] = _MEANING) -> list[str]:
    """A remark on each comment that seems to change what the numbers mean; names in ``counted`` get none."""
    if not holds(lines, "=:"):
        return []
    return [
        f"Line {at}: {quoted(match[0])} stands in a comment and is not read."
        for at, text in comments(lines)
        for match in names.finditer(text)
        if match[1].lower() not in counted
    ]


IS = r"[\"']?\s*(?:[:=]|\bis\b)?\s*[<\"']*"
"""Between a name and its value."""

_CONSTANT = re.compile(
    rf"\b(?:offset|constant)\b{IS}(?P<value>{NUMBER.pattern})(?![^\s,;}})\"']|,\d)", re.IGNORECASE | re.ASCII
)
_NAMES_CONSTANT = re.compile(r"\boffset\b|\bconstant\b[\"']?\s*[:=]", re.IGNORECASE)


def constant(source: Source, lines: list[str]) -> tuple[str, list[str]]:
    """The number that comments give as offset or constant, and a remark on it; 0 and none if they name none.

    Raises:
        ProblemFileError: It is not understood, or two differ.
    """
    word = said(source, lines, _CONSTANT, _NAMES_CONSTANT, "'offset=NUMBER', or no such word")
    if word is None:
        return "0", []
    if not fits(word):
        raise source.fault(f"offset {quoted(word)}", "a number that float64 can hold")
    return word, [f"The offset {word} is counted."]


def said(
    source: Source, lines: list[str], value: re.Pattern[str], naming: re.Pattern[str], expected: str
) -> str | None:
    """What the comments say of one thing; None if they do not name it.

    Raises:
        ProblemFileError: A comment names it and is not understood, or two differ.
    """
    found: dict[object, tuple[str, int]] = {}
    for at, text in comments(lines):
        words = [match["value"] for match in value.finditer(text)]
        if not words and naming.search(text):
            raise source.fault(quoted(text), expected, at)
        for word in words:
            found.setdefault(number(word) if fits(word) else word.upper(), (word, at))
    if len(found) > 1:
        (first, at), (second, below) = list(found.values())[:2]
        raise source.fault(f"{second}, but {first} in line {at}", "one of them", below)
    return next(iter(found.values()))[0] if found else None
