"""Which files are bags, and which of them make one recording."""

from __future__ import annotations

import re
from pathlib import Path

from lslam.errors import InputError

SUFFIXES = (".bag", ".bag.active", ".mcap", ".db3")
# Captures of the packets of a sensor.
CAPTURES = (".pcap", ".pcapng")
_PART = re.compile(r"(.+)_\d+\.(bag|mcap|db3)(?:\.active)?$")


def list_bag_files(path: Path) -> list[Path]:
    """The file itself, or the bag files of a folder in natural order; empty when there are none.

    Raises InputError for a folder whose files are compressed as a whole.
    """
    if path.is_file():
        return [path] if suffix_of(path) else []
    if not path.is_dir():
        return []
    files = [p for p in path.iterdir() if p.is_file() and not p.name.startswith(".")]
    # The last part of a set whose recorder died is still called .bag.active.
    kinds = [k for p in files if (k := suffix_of(p).removesuffix(".active"))]
    packed = [p for p in files if p.name.endswith((".mcap.zstd", ".db3.zstd"))]
    if packed and not kinds:
        raise InputError(
            f"{packed[0]} is compressed as a whole: `zstd -d {packed[0].name}` in {path} makes it readable"
        )
    if not kinds:
        return []
    kind = max(sorted(set(kinds)), key=kinds.count)
    return sorted((p for p in files if suffix_of(p).removesuffix(".active") == kind), key=_natural)


def parts_beside(path: Path) -> list[Path]:
    """Files beside a bag that recorders name so when they split it: as `path` but for the number at the end of the name."""
    stem = _PART.match(path.name)
    if stem is None:
        return []
    beside = (p for p in path.parent.iterdir() if p.is_file() and p != path)
    return sorted((p for p in beside if (m := _PART.match(p.name)) and m.groups() == stem.groups()), key=_natural)


def suffix_of(path: Path) -> str:
    """The suffix that makes a file a bag, empty when it is none."""
    return next((s for s in SUFFIXES if path.name.lower().endswith(s)), "")


def _natural(path: Path) -> list[tuple[int, str]]:
    """Sort key with numbers compared as numbers: part_2 before part_10."""
    return [(int(p), "") if p.isdecimal() else (-1, p) for p in re.split(r"(\d+)", path.name)]
