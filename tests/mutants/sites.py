"""Where a mutant can be made: a number, an operator, a comparison, a condition or a choice that is another one then."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

OPERATORS: dict[type, tuple[str, str]] = {}
for _kinds, _words in (
    ((ast.Add, ast.Sub, ast.Mult, ast.Div, ast.BitAnd, ast.BitOr, ast.And, ast.Or), "+ - * / & | and or"),
    ((ast.Eq, ast.NotEq, ast.Is, ast.IsNot, ast.In, ast.NotIn), "== != is is_not in not_in"),
):
    _pairs = [word.replace("_", " ") for word in _words.split()]
    OPERATORS |= {kind: (_pairs[i], _pairs[i ^ 1]) for i, kind in enumerate(_kinds)}
OPERATORS |= {ast.Lt: ("<", ">"), ast.LtE: ("<=", ">"), ast.Gt: (">", "<"), ast.GtE: (">=", "<")}
CHOICES = {"min": "max", "minimum": "maximum", "argmin": "argmax", "any": "all", "median": "max"}
CHOICES |= {other: one for one, other in CHOICES.items() if one != "median"} | {"mean": "max"}


class Mutant(NamedTuple):
    """Bytes `start` to `end` of `file` become `new`; `line` and the line where its statement starts count from 1.

    name : file, text of the line, which of such lines, column and `new`: what it is known by when lines before it change
    """

    file: str
    line: int
    statement: int
    start: int
    end: int
    new: str
    name: str = ""

    def of(self, source: bytes) -> bytes:
        return source[: self.start] + self.new.encode() + source[self.end :]


def mutants(root: Path, file: str) -> Iterator[Mutant]:
    """All mutants of one file. Annotations, decorators, logs and the words of errors are left alone."""
    source = (root / file).read_bytes()
    lines, starts = source.splitlines(keepends=True), [0]
    for text in lines:
        starts.append(starts[-1] + len(text))

    def begin(node: ast.expr) -> int:
        return starts[node.lineno - 1] + node.col_offset

    def end(node: ast.expr) -> int:
        assert node.end_lineno is not None
        assert node.end_col_offset is not None
        return starts[node.end_lineno - 1] + node.end_col_offset

    def walk(node: ast.AST, statement: int) -> Iterator[tuple[ast.AST, int]]:
        if isinstance(node, ast.stmt):
            statement = node.lineno
        yield node, statement
        for child in _mutable(node):
            yield from walk(child, statement)

    for node, statement in walk(ast.parse(source), 1):
        for left, right, new in _changes(node, begin, end, source):
            line = source[:left].count(b"\n")
            alike = sum(text == lines[line] for text in lines[:line])
            name = f"{file}:{lines[line].decode().strip()}:{alike}:{left - starts[line]}-{right - starts[line]}:{new}"
            yield Mutant(file, line + 1, statement, left, right, new, name)


def _mutable(node: ast.AST) -> Iterator[ast.AST]:
    """The children whose change would change what the program does."""
    if isinstance(node, ast.JoinedStr | ast.Raise | ast.Assert | ast.Import | ast.ImportFrom):
        return
    if isinstance(node, ast.Call) and re.match(r"(cast$|_?log\.)", ast.unparse(node.func)):
        return
    for name, value in ast.iter_fields(node):
        if name in ("annotation", "returns", "decorator_list"):
            continue
        for child in value if isinstance(value, list) else [value]:
            if isinstance(child, ast.AST):
                yield child


def _changes(node: ast.AST, begin, end, source: bytes) -> Iterator[tuple[int, int, str]]:  # type: ignore[no-untyped-def]
    def between(left: ast.expr, right: ast.expr, operator: ast.AST, suffix: str = "") -> Iterator[tuple[int, int, str]]:
        old, new = (word + suffix for word in OPERATORS.get(type(operator), ("", "")))
        text = source[end(left) : begin(right)].decode()
        if old != suffix and text.count(old) == 1:
            at = end(left) + len(text[: text.index(old)].encode())
            yield at, at + len(old), new

    if isinstance(node, ast.Constant) and type(node.value) in (int, float):
        for new in _other_numbers(node.value):  # type: ignore[arg-type]
            yield begin(node), end(node), new
    elif isinstance(node, ast.BinOp):
        yield from between(node.left, node.right, node.op)
    elif isinstance(node, ast.AugAssign):
        yield from between(node.target, node.value, node.op, "=")
    elif isinstance(node, ast.Compare) and len(node.ops) == 1:
        yield from between(node.left, node.comparators[0], node.ops[0])
    elif isinstance(node, ast.BoolOp):
        yield from between(node.values[0], node.values[1], node.op)
    elif isinstance(node, ast.UnaryOp):
        yield begin(node), begin(node) + (3 if isinstance(node.op, ast.Not) else 1), ""
    elif isinstance(node, ast.Attribute | ast.Name) and isinstance(node.ctx, ast.Load):
        name = node.attr if isinstance(node, ast.Attribute) else node.id
        if name in CHOICES:
            yield end(node) - len(name), end(node), CHOICES[name]
    elif isinstance(node, ast.If | ast.IfExp | ast.While) and ast.unparse(node.test) != "TYPE_CHECKING":
        if isinstance(node, ast.IfExp):
            yield begin(node.test), end(node.test), f"not ({source[begin(node.test) : end(node.test)].decode()})"
        else:
            yield begin(node.test), end(node.test), "False"


def _other_numbers(value: float) -> list[str]:
    if isinstance(value, int):
        return [str(value + 1)] if abs(value) <= 4 else [str(value * 3), str(value // 3)]
    if value in (0.0, 1.0):
        return ["1.0"] if value == 0.0 else ["0.5", "2.0"]
    return [repr(value * 3), repr(value / 3)]
