"""What the two formats of clauses share."""

import re
from collections.abc import Iterator

from memcomp_lightning.problems.files.source import MOST_VARIABLES, Source, quoted

_LITERAL = re.compile(r"[+-]?\d{1,18}", re.ASCII)


def rows(lines: list[str]) -> Iterator[tuple[int, list[str]]]:
    """Line number and words of what is no comment; the % of SATLIB's files ends them."""
    for number, line in enumerate(lines, start=1):
        words = line.split()
        if words and words[0] == "%":
            break
        if words and words[0][0] not in "c#":
            yield number, words


def literals(source: Source, line: int, words: list[str], n: int | None) -> list[int]:
    """Literals and zeros of a line; ``n`` is the largest variable, None if the file does not say it."""
    limit = MOST_VARIABLES if n is None else n
    if not all(map(_LITERAL.fullmatch, words)):
        raise source.fault(quoted(" ".join(words)), "literals, integers that end in 0", line)
    found = list(map(int, words))
    for literal in found:
        if abs(literal) > limit:
            allowed = f"variables from 1 to {limit}" if limit else "no variables"
            raise source.fault(f"literal {literal}", allowed, line)
    return found
