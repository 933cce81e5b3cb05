"""Text that any file can hold, names that any folder can have, and numbers as text."""

from __future__ import annotations

import hashlib
import math
import re
from collections.abc import Sequence
from typing import Any

# Bytes of a name: a disk takes 255 with all that is put behind it.
_LONGEST = 120
_MOST_NAMES = 8  # names in a sentence


def printable(text: str) -> str:
    r"""The text with a `\\u` sequence for what UTF-8 cannot hold.

    >>> print(printable("na\udcefve"))
    na\udcefve
    """
    return text.encode("utf-8", "backslashreplace").decode()


def file_safe(name: str) -> str:
    """A valid folder name made of `name`, which may contain separators or be of any length.

    >>> file_safe("../street 0"), len(file_safe("x" * 400))
    ('_street_0', 120)
    """
    safe = re.sub(r"[^\w.+-]+", "_", name).lstrip(".") or "sequence"
    data = safe.encode()
    if len(data) <= _LONGEST:
        return safe
    # What begins alike stays apart.
    digest = hashlib.sha256(data).hexdigest()[:8]
    return f"{data[: _LONGEST - 9].decode(errors='ignore')}-{digest}"


def toml_text(tree: dict[str, Any]) -> str:
    """The tree as TOML, its strings printable."""
    import tomli_w

    return tomli_w.dumps(printable_tree(tree))


def printable_tree(value: Any) -> Any:
    """Nested tables, lists and strings with all strings `printable`, and with TOML's types."""
    if isinstance(value, str):
        return printable(value)
    if isinstance(value, dict):
        return {printable(key): printable_tree(item) for key, item in value.items()}
    return [printable_tree(item) for item in value] if isinstance(value, (list, tuple)) else value


def metres(value: float) -> str:
    """A length with a millimetre's resolution, finer when it is small.

    >>> metres(1.23456), metres(0.00123456), metres(float("nan"))
    ('1.235', '0.0012', 'n/a')
    """
    if not math.isfinite(value):
        return "n/a"
    return f"{value:.3f}" if abs(value) >= 0.01 or value == 0 else f"{value:.4f}"


def with_decimals(value: float, decimals: int) -> str:
    """A number with fixed decimals, `n/a` when it is not finite."""
    return f"{value:.{decimals}f}" if math.isfinite(value) else "n/a"


def significant(value: float | None) -> str:
    """Four significant digits; an exponent only below 0.0001; `n/a` for None and NaN.

    >>> significant(0.123456), significant(12345.67), significant(None)
    ('0.1235', '12345.7', 'n/a')
    """
    if value is None or value != value:
        return "n/a"
    return f"{value:.4g}" if abs(value) < 1000 else f"{value:.1f}"


def lasting(seconds: float) -> str:
    """A duration in h, min or s, rounded.

    >>> lasting(5400), lasting(200), lasting(8.2)
    ('1.5 h', '3.3 min', '8 s')
    """
    if seconds >= 3600:
        return f"{seconds / 3600:.1f} h"
    return f"{seconds / 60:.1f} min" if seconds >= 90 else f"{seconds:.0f} s"


def count_of(number: int, noun: str) -> str:
    """A number with its noun, in the plural unless the number is one."""
    return f"{number} {noun}" if number == 1 else f"{number} {noun}s"


def first_of(names: Sequence[object]) -> str:
    """The first few names with commas between them, and the number of the others.

    >>> first_of([1, 2]), first_of(range(20))
    ('1, 2', '0, 1, 2, 3, 4, 5, 6, 7 and 12 more')
    """
    return ", ".join(map(str, names[:_MOST_NAMES])) + (
        f" and {len(names) - _MOST_NAMES} more" if len(names) > _MOST_NAMES else ""
    )
