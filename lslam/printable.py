"""Text that any file can hold, and names that any folder can have: what strangers or the system give may be neither."""

from __future__ import annotations

import hashlib
import re
from typing import Any

# Bytes of a name: a disk takes 255 with all that is put behind it.
_LONGEST = 120


def printable(text: str) -> str:
    r"""The text with a `\\u` sequence for what UTF-8 cannot hold.

    >>> print(printable("na\udcefve"))
    na\udcefve
    """
    return text.encode("utf-8", "backslashreplace").decode()


def file_safe(name: str) -> str:
    """A name that can be a folder's: it may come from `sequence.toml`, shall not lead elsewhere, and may be of any length.

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
    """Tables, lists and strings in one another, printable; as they come back from TOML."""
    if isinstance(value, str):
        return printable(value)
    if isinstance(value, dict):
        return {printable(key): printable_tree(item) for key, item in value.items()}
    return [printable_tree(item) for item in value] if isinstance(value, (list, tuple)) else value
