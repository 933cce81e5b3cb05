"""What `lslam info` shows of a bag."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import PurePath
from typing import Any

_SHOWN = 8  # names of files


def lines(bag: dict[str, Any]) -> Iterator[tuple[str, str]]:
    """Label and value of the bag as a whole."""
    files = len(bag["files"])
    parts = [f"{files} file{'s' if files > 1 else ''}", _size(bag["size_bytes"]), f"{bag['messages']} messages"]
    if bag["duration_s"] is not None:
        begin = bag["start_utc"] or f"{bag['start_ns'] * 1e-9:.3f} s"
        parts.append(f"{bag['duration_s']:.2f} s from {begin}")
    yield "bag", ", ".join(parts)
    if files > 1:
        names = [PurePath(file).name for file in bag["files"]]
        yield "parts", ", ".join(names if files <= _SHOWN else [*names[: _SHOWN - 2], "...", names[-1]])


def table(bag: dict[str, Any]) -> Iterator[str]:
    """A line per topic: name, type, messages, rate, and what it is used for."""
    topics = bag["topics"]
    if not topics:
        yield "none"
        return
    name = max(len(topic["name"]) for topic in topics)
    kind = max(len(topic["type"] or "unknown type") for topic in topics)
    count = max(len(str(topic["messages"])) for topic in topics)
    for topic in topics:
        rate = "" if topic["rate_hz"] is None else f"{topic['rate_hz']:.1f} Hz"
        yield (
            f"{topic['name']:<{name}}  {topic['type'] or 'unknown type':<{kind}}  {topic['messages']:>{count}}  {rate:>10}  "
            f"{topic['used_for'] or '-'}"
        )


def _size(count: int) -> str:
    """Bytes for people.

    >>> _size(999), _size(1_250_000)
    ('999 bytes', '1.2 MB')
    """
    for unit, size in (("GB", 1e9), ("MB", 1e6), ("kB", 1e3)):
        if count >= size:
            return f"{count / size:.1f} {unit}"
    return f"{count} bytes"
