"""What strangers wrote, parsed without surprises: trees that are too deep, numbers no machine holds, names no disk takes.

The parsers of the standard library answer such text with RecursionError, OverflowError or a bare ValueError, here and there
only where the value is used. Everything of lslam that takes JSON or TOML takes it from here (a test holds it).
"""

from __future__ import annotations

import json
import tomllib
from decimal import Decimal
from pathlib import Path
from typing import Any

# More than any file of this field has; far below what Python's stack holds.
DEEPEST = 100
# What taking a tree apart ends in that has another shape than it should.
MISFIT = (ValueError, LookupError, TypeError, AttributeError, ArithmeticError)
_LARGEST = 2**63  # whole numbers of TOML and of OpenStreetMap have 64 bits
_DIGITS = 20
_TOO_DEEP = f"lists and tables stand in each other more than {DEEPEST} deep"


def parse_json(text: str | bytes) -> Any:
    """The tree of a JSON text. Raises ValueError saying what is wrong with it."""
    try:
        tree = json.loads(text, parse_int=_whole)
    except RecursionError:
        raise ValueError(_TOO_DEEP) from None
    _check(tree)
    return tree


def parse_toml(text: str) -> dict[str, Any]:
    """The tree of a TOML text. Raises tomllib.TOMLDecodeError saying what is wrong with it."""
    try:
        tree = tomllib.loads(text)
        _check(tree)
    except RecursionError:
        raise tomllib.TOMLDecodeError(_TOO_DEEP) from None
    except tomllib.TOMLDecodeError:
        raise
    except ValueError as error:
        said = "a whole number has thousands of digits" if "digits" in str(error) else str(error)
        raise tomllib.TOMLDecodeError(said) from None
    return tree


def whole_number(text: str) -> int | None:
    """The whole number from 0 that `text` spells out in digits, None when it is none or longer than 18 of them.

    >>> whole_number("07"), whole_number("²"), whole_number("-1"), whole_number("9" * 5000)
    (7, None, None, None)
    """
    return int(text) if text.isdecimal() and len(text) <= 18 else None


def decimal_number(text: str) -> Decimal:
    """A finite decimal number below 2^63 in size, exactly; ValueError when it is none."""
    try:
        value = Decimal(text)
        if value.is_finite() and abs(value) < _LARGEST:
            return value
    except ArithmeticError:  # 1e999999999 is a Decimal that cannot be reckoned with
        pass
    raise ValueError(f"no number below 2^63: {text[:40]!r}")


def is_file(path: str | Path) -> bool:
    """Whether there is such a file; False for what cannot be a name, being too long for the disk."""
    try:
        return Path(path).is_file()
    except (OSError, ValueError):
        return False


def _whole(digits: str) -> int:
    if len(digits) > _DIGITS or not -_LARGEST <= int(digits) < _LARGEST:
        raise ValueError(f"the whole number {digits[:_DIGITS]}{'...' * (len(digits) > _DIGITS)} has more than 64 bits")
    return int(digits)


def _check(tree: Any) -> None:
    """Raise ValueError for a tree that is too deep or holds whole numbers that are too large."""
    open_ones = [iter((tree,))]
    while open_ones:
        for node in open_ones[-1]:
            if isinstance(node, (dict, list)):
                if len(open_ones) >= DEEPEST:
                    raise ValueError(_TOO_DEEP)
                open_ones.append(iter(node.values() if isinstance(node, dict) else node))
                break
            if isinstance(node, int) and not -_LARGEST <= node < _LARGEST:
                raise ValueError(f"the whole number {str(node)[:_DIGITS]}... has more than 64 bits")
        else:
            open_ones.pop()
