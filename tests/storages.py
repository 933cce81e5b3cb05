"""Storage in memory that counts what is asked of it, refuses when it is told to, and remembers what was put in which order."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, ClassVar

import fsspec
from fsspec.implementations.memory import MemoryFileSystem

from lslam.io.remote import RemotePath


class Counted(MemoryFileSystem):
    """`counted://`: requests of one round go together; `refuse` may raise, told the verb and the name."""

    protocol = "counted"
    store: ClassVar[dict[str, Any]] = {}
    pseudo_dirs: ClassVar[list[str]] = [""]
    got: ClassVar[list[tuple[str, int]]] = []
    rounds: ClassVar[list[int]] = []
    put: ClassVar[list[str]] = []
    refuse: ClassVar[Callable[[str, str], None]] = staticmethod(lambda verb, name: None)

    @classmethod
    def _strip_protocol(cls, path: str) -> str:
        return str(super()._strip_protocol(path.removeprefix("counted://")))

    def cat_file(self, path: str, start: int | None = None, end: int | None = None, **more: Any) -> bytes:
        Counted.refuse("get", path)
        data = bytes(super().cat_file(path, start, end, **more))
        Counted.got.append((path, len(data)))
        Counted.rounds.append(1)
        return data

    def cat_ranges(self, paths: list[str], starts: list[int], ends: list[int], **more: Any) -> list[bytes]:
        before = len(Counted.rounds)
        found = [self.cat_file(path, a, b) for path, a, b in zip(paths, starts, ends, strict=True)]
        Counted.rounds[before:] = [len(found)]
        return found

    def put_file(self, lpath: str, rpath: str, **more: Any) -> None:
        Counted.refuse("put", rpath)
        super().put_file(lpath, rpath, **more)
        Counted.put.append(rpath)


@contextmanager
def counted() -> Iterator[RemotePath]:
    """An empty storage, and its root."""
    fsspec.register_implementation("counted", Counted, clobber=True)
    for kept in (Counted.store, Counted.got, Counted.rounds, Counted.put):
        kept.clear()  # type: ignore[attr-defined]
    Counted.pseudo_dirs[:] = [""]
    Counted.refuse = staticmethod(lambda verb, name: None)
    yield RemotePath("counted://bucket")
    Counted.refuse = staticmethod(lambda verb, name: None)


def stored(folder: Path, place: RemotePath) -> RemotePath:
    """What lies in a folder, or a file, put to `place`."""
    for path in [folder] if folder.is_file() else sorted(folder.rglob("*")):
        if path.is_file():
            (place / path.relative_to(folder) if path != folder else place).write_bytes(path.read_bytes())
    return place
