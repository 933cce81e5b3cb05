"""What the harness is made of: files by name, and the parsers that they are given to."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

# What lies in the folder that a parser is given, by relative path.
Files = dict[str, bytes]


@dataclass(frozen=True)
class Parser:
    """One thing that reads files.

    name : of the row in the table; read : reads what lies in a folder, all of it
    make : good files, and bad ones that no damage leads to; the first is good
    trees : names of the files that hold a JSON or TOML tree; tables : of those that hold lines of words
    """

    name: str
    read: Callable[[Path], object]
    make: Callable[[Path], list[Files]]
    trees: tuple[str, ...] = ()
    tables: tuple[str, ...] = ()

    @cached_property
    def _kept(self) -> list[Any]:
        return []

    def corpus(self, folder: Path) -> list[Files]:
        """The files it begins with; `folder` is for those that are written to disk first."""
        if not self._kept:
            folder.mkdir(parents=True, exist_ok=True)
            self._kept.extend(self.make(folder))
        found: list[Files] = self._kept
        return found


def files_in(folder: Path) -> Files:
    """All files below a folder."""
    return {p.relative_to(folder).as_posix(): p.read_bytes() for p in sorted(folder.rglob("*")) if p.is_file()}


def lay_out(folder: Path, files: Files) -> None:
    """Write the files into an empty folder."""
    for name, data in files.items():
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(data)
