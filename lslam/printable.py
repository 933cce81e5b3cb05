"""Text that any file can hold: a path that is not UTF-8 comes from the system with surrogates, which no encoding takes."""

from __future__ import annotations

from typing import Any


def printable(text: str) -> str:
    r"""The text with a `\\u` sequence for what UTF-8 cannot hold.

    >>> print(printable("na\udcefve"))
    na\udcefve
    """
    return text.encode("utf-8", "backslashreplace").decode()


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
