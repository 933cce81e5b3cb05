"""What strangers wrote, parsed without surprises: trees that are too deep, numbers no machine holds, names no disk takes.

The parsers of the standard library answer such text with RecursionError, OverflowError or a bare ValueError, here and there
only where the value is used. Everything of lslam that takes JSON or TOML takes it from here (a test holds it).
"""

from __future__ import annotations

import codecs
import json
import re
import tomllib
from collections.abc import Iterator
from pathlib import Path
from typing import IO, Any

# More than any file of this field has; far below what Python's stack holds.
DEEPEST = 100
# What taking a tree apart ends in that has another shape than it should.
MISFIT = (ValueError, LookupError, TypeError, AttributeError, ArithmeticError)
_LARGEST = 2**63  # whole numbers of TOML and of OpenStreetMap have 64 bits
_DIGITS, _MANY_BITS = 20, 10_000
_BLOCK = 1 << 16  # bytes that are read at a time
_BLANK = re.compile(r"[ \t\n\r]*")
_BEHIND = frozenset(" \t\n\r,]}:")  # what may stand behind a value
_TOO_DEEP = f"lists and tables stand in each other more than {DEEPEST} deep"
_TOO_LONG = "a whole number has thousands of digits"


def parse_json(text: str | bytes) -> Any:
    """The tree of a JSON text. Raises ValueError for a malformed, too deep or too large one."""
    try:
        tree = json.loads(text, parse_int=_whole)
    except RecursionError:
        raise ValueError(_TOO_DEEP) from None
    _check(tree)
    return tree


def parse_toml(text: str) -> dict[str, Any]:
    """The tree of a TOML text. Raises tomllib.TOMLDecodeError for a malformed, too deep or too large one."""
    try:
        tree = tomllib.loads(text)
    except RecursionError:
        raise tomllib.TOMLDecodeError(_TOO_DEEP) from None
    except tomllib.TOMLDecodeError:
        raise
    except ValueError:  # of `int`, which refuses so many: all else is TOML's own error
        raise tomllib.TOMLDecodeError(_TOO_LONG) from None
    try:
        _check(tree)
    except ValueError as error:
        raise tomllib.TOMLDecodeError(str(error)) from None
    return tree


def whole_number(text: str) -> int | None:
    """The whole number from 0 that `text` spells out in digits, None when it is none or longer than 18 of them.

    >>> whole_number("07"), whole_number("²"), whole_number("-1"), whole_number("9" * 5000)
    (7, None, None, None)
    """
    return int(text) if text.isdecimal() and len(text) <= 18 else None


def is_file(path: str | Path) -> bool:
    """Whether there is such a file; False for what cannot be a name, being too long for the disk."""
    try:
        return Path(path).is_file()
    except (OSError, ValueError):
        return False


def _whole(digits: str) -> int:
    """The integer of these digits; raises ValueError beyond 64 bits."""
    if len(digits) > _DIGITS or not -_LARGEST <= int(digits) < _LARGEST:
        raise ValueError(f"the whole number {digits[:_DIGITS]}{'...' * (len(digits) > _DIGITS)} has more than 64 bits")
    return int(digits)


def _check(tree: Any) -> None:
    """Raise ValueError for a tree that is too deep or has integers of more than 64 bits."""
    open_ones = [iter((tree,))]
    while open_ones:
        for node in open_ones[-1]:
            if isinstance(node, (dict, list)):
                if len(open_ones) >= DEEPEST:
                    raise ValueError(_TOO_DEEP)
                open_ones.append(iter(node.values() if isinstance(node, dict) else node))
                break
            if isinstance(node, int) and not -_LARGEST <= node < _LARGEST:
                if node.bit_length() > _MANY_BITS:  # Python does not write so many digits
                    raise ValueError(_TOO_LONG)
                raise ValueError(f"the whole number {str(node)[:_DIGITS]}... has more than 64 bits")
        else:
            open_ones.pop()


class JsonItems:
    """Iterates over one list of a JSON object, one item at a time: the whole text or tree is never in memory.

    stream : of the text; key : of the list, at the top of the object. Iterate once; then `rest` has all else of the object,
    and `has_list` says whether there was such a list. For a text that is no object, `rest` is empty.

    Raises ValueError as `parse_json`; json.JSONDecodeError or UnicodeDecodeError, its subclasses, when it is no JSON.
    """

    def __init__(self, stream: IO[bytes], key: str) -> None:
        self._stream, self._key = stream, key
        self.rest: dict[str, Any] = {}
        self.has_list = False

    def __iter__(self) -> Iterator[Any]:
        """Items of the list `key`; the other members go to `rest`."""
        text = _Window(self._stream)
        if text.peek() == "{":
            yield from self._members(text)
        else:
            text.value()
        if text.peek():
            raise text.error("Extra data")

    def _members(self, text: _Window) -> Iterator[Any]:
        """Read the members of the object, yield the items of the list, store the others."""
        text.take("{")
        if text.peek() == "}":
            text.take("}")
            return
        while True:
            if text.peek() != '"':
                raise text.error("Expecting property name enclosed in double quotes")
            name = text.value()
            text.take(":")
            if text.peek() != "[":
                self.rest[name] = text.value()
            elif name != self._key:
                self.rest[name] = list(text.items())
            elif self.has_list:
                raise ValueError(f"it holds {self._key!r} twice")
            else:
                self.has_list = True
                yield from text.items()
            if text.take(",}") == "}":
                return


class _Window:
    """The buffered part of a JSON text."""

    def __init__(self, stream: IO[bytes]) -> None:
        self._stream = stream
        first = stream.read(max(_BLOCK, 4))  # which tell UTF-8 from others
        self._decoder = codecs.getincrementaldecoder(json.detect_encoding(first))("surrogatepass")
        self._text, self._at, self._is_over = self._decoder.decode(first), 0, not first
        self._passed = self._lines = 0
        self._column = 0

    def peek(self) -> str:
        """The next character that is not blank, without consuming it; empty at the end."""
        while True:
            found = _BLANK.match(self._text, self._at)
            assert found is not None
            self._at = found.end()
            if self._at < len(self._text):
                return self._text[self._at]
            if not self._more():
                return ""

    def take(self, characters: str) -> str:
        """Consume and return the next character that is not blank; raises an error unless it is one of `characters`."""
        found = self.peek()
        if not found or found not in characters:
            raise self.error(f"Expecting {' or '.join(repr(one) for one in characters)}")
        self._at += 1
        return found

    def value(self) -> Any:
        """Read the next complete value. Raises ValueError or json.JSONDecodeError."""
        self.peek()
        while True:
            try:
                value, end = _DECODER.raw_decode(self._text, self._at)
                # A number may go on behind the window.
                if self._text[end : end + 1] in _BEHIND or self._is_over:
                    break
            except RecursionError:
                raise ValueError(_TOO_DEEP) from None
            except json.JSONDecodeError as error:
                if self._is_over:
                    self._at = error.pos
                    raise self.error(error.msg) from None
            self._more()
        self._at = end
        _check(value)
        return value

    def items(self) -> Iterator[Any]:
        """The items of the list that comes next, read one at a time."""
        self.take("[")
        if self.peek() == "]":
            self.take("]")
            return
        while True:
            yield self.value()
            if self.take(",]") == "]":
                return

    def error(self, why: str) -> json.JSONDecodeError:
        """A JSON error with message `why`, at the present position in the whole text."""
        line, column = self._place()
        error = json.JSONDecodeError(why, "", 0)
        error.args = (f"{why}: line {line + 1} column {column + 1} (char {self._passed + self._at})",)
        return error

    def _place(self) -> tuple[int, int]:
        """Present position: number of lines before it, and of characters before it on its line."""
        ends = self._text.count("\n", 0, self._at)
        column = self._at - self._text.rindex("\n", 0, self._at) - 1 if ends else self._column + self._at
        return self._lines + ends, column

    def _more(self) -> bool:
        """Read the next block, at least as long as the unread rest, so that long values restart rarely; False at the end."""
        if self._is_over:
            return False
        self._lines, self._column = self._place()
        self._passed += self._at
        left = self._text[self._at :]
        block = self._stream.read(max(_BLOCK, len(left)))
        self._is_over = not block
        self._text, self._at = left + self._decoder.decode(block, not block), 0
        return True


_DECODER = json.JSONDecoder(parse_int=_whole)
