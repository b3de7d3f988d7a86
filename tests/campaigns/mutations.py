"""Mutants of source text: all that the operators of cosmic-ray make of it, but for what cannot change behaviour.

Left out is what lies in annotations, in docstrings, below ``if TYPE_CHECKING``, in ``__repr__`` and ``__str__``,
in the texts of messages (f-strings of what is raised, warned or given to ``require``) and in types that ``cast``
names.
"""

import ast
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache

from cosmic_ray.ast import ast_nodes, get_ast
from cosmic_ray.mutating import mutate_code
from cosmic_ray.plugins import get_operator, operator_names

Place = tuple[int, int]
"""Line, from 1, and column, from 0."""

TELL = ("require", "warn")
"""How functions begin whose f-strings are texts for people."""


@dataclass(frozen=True)
class Mutant:
    """A change of a text.

    Attributes:
        operator: Its name in cosmic-ray.
        occurrence: Which one of the changes that the operator makes of this text.
        line: Where it begins.
    """

    operator: str
    occurrence: int
    line: int

    def of(self, source: str) -> str:
        """The changed text."""
        changed = mutate_code(source, get_operator(self.operator)(), self.occurrence)
        if changed is None:
            raise ValueError(f"{self} is no mutant of this text")
        return str(changed)


@cache
def _operators() -> list[str]:
    """All but those that need the names of variables, and the one that changes nothing."""
    return sorted(name for name in operator_names() if not get_operator(name).arguments())


def mutants(source: str) -> Iterator[Mutant]:
    """All mutants of a text that can change what it does."""
    without, nodes = list(left_out(source)), list(ast_nodes(get_ast(source)))
    for name in _operators():
        operator, occurrence = get_operator(name)(), 0
        for node in nodes:
            for begin, _ in operator.mutation_positions(node):
                if not any(first <= begin < end for first, end in without):
                    yield Mutant(name, occurrence, begin[0])
                occurrence += 1


def is_python(source: str) -> bool:
    """Whether a text can be read as a module."""
    try:
        ast.parse(source)
    except SyntaxError:
        return False
    return True


def left_out(source: str) -> Iterator[tuple[Place, Place]]:
    """Where a change cannot change behaviour: begin and end."""
    lines = source.encode().splitlines()

    def column(line: int, byte: int) -> int:
        return len(lines[line - 1][:byte].decode())

    for node in _left_out(ast.parse(source)):
        assert node.end_lineno is not None
        assert node.end_col_offset is not None
        begin = (node.lineno, column(node.lineno, node.col_offset))
        yield begin, (node.end_lineno, column(node.end_lineno, node.end_col_offset))


def _left_out(tree: ast.AST) -> Iterator[ast.expr | ast.stmt]:
    for node in ast.walk(tree):
        match node:
            case ast.arg(annotation=ast.expr() as annotation) | ast.AnnAssign(annotation=annotation):
                yield annotation
            case ast.FunctionDef(name="__repr__" | "__str__"):
                yield node
            case ast.If(test=ast.Name(id="TYPE_CHECKING")):
                yield node
            case ast.Raise():
                yield from _texts(node)
            case ast.Call(func=ast.Name(id="cast"), args=[first, *_]):
                yield first
            case ast.Call(func=ast.Name(id=name) | ast.Attribute(attr=name)) if name.startswith(
                ("require", "warn")
            ):
                yield from _texts(node)
        if isinstance(node, ast.FunctionDef) and node.returns is not None:
            yield node.returns


def _texts(node: ast.AST) -> Iterator[ast.expr]:
    return (inner for inner in ast.walk(node) if isinstance(inner, ast.JoinedStr))


def statement(source: str, line: int) -> range:
    """The lines of the smallest statement that holds a line; of one with a body, those before its body."""
    found = range(line, line + 1)
    smallest = None
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.stmt) and node.end_lineno is not None:
            body = getattr(node, "body", None)
            begin = min([node.lineno, *(d.lineno for d in getattr(node, "decorator_list", []))])
            end = max(node.lineno, body[0].lineno - 1) if body else node.end_lineno
            if begin <= line <= end and (smallest is None or end - begin < smallest):
                found, smallest = range(begin, end + 1), end - begin
    return found
