"""Bag files that were compressed as a whole: unpacked into the user's cache for as long as they are read."""

from __future__ import annotations

import lzma
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from importlib import import_module
from pathlib import Path
from typing import Any
from zlib import error as zlib_error

from lslam.core.errors import InputError, OutputError, UsageError, cause, input_errors
from lslam.core.kernels.cache import cache_folder
from lslam.io.formats.bag_chunks import zstd
from lslam.io.formats.bag_listing import packing_of
from lslam.io.remote import RemotePath

_MAGIC = {
    b"\x28\xb5\x2f\xfd": "zstd",
    b"\x04\x22\x4d\x18": "lz4",
    b"\x1f\x8b": "gz",
    b"BZh": "bz2",
    b"\xfd7zXZ\0": "xz",
}
_LIBRARIES = {"lz4": "lz4.frame", "gz": "gzip", "bz2": "bz2", "xz": "lzma"}
_BLOCK = 1 << 20
# Recordings shrink to a tenth at best; what grows further was made to fill a disk.
_MOST, _LEAST = 1000, 1 << 30


@contextmanager
def unpacked(path: Path) -> Iterator[tuple[Path, str]]:
    """A file with what `path` holds, and what it lacks, a sentence; `path` itself where it is not compressed.

    The file has no name any more after the `with`: whoever opened it meanwhile has it until it is closed.

    Raises InputError when nothing can be unpacked, OutputError for a full disk, UsageError for storage.
    """
    kind = _kind(path)
    if not kind:
        yield path, ""
        return
    if isinstance(path, RemotePath):
        raise UsageError(f"{path} is compressed as a whole and cannot be read in place from storage: copy it")
    folder = cache_folder("bags")
    if folder is None:
        raise OutputError(f"{path} needs a folder to be unpacked in: name a folder of your own in XDG_CACHE_HOME")
    with tempfile.NamedTemporaryFile(dir=folder, suffix=".unpacked") as target:
        loss = _unpack(path, kind, target)
        target.flush()
        yield Path(target.name), loss


def _kind(path: Path) -> str:
    """How it is compressed: by its first bytes, whatever its name; a name that they contradict is refused."""
    if isinstance(path, RemotePath):
        return packing_of(path)
    with input_errors(path), path.open("rb") as stream:
        head = stream.read(8)
    kind = next((kind for magic, kind in _MAGIC.items() if head.startswith(magic)), "")
    if not kind and (packing := packing_of(path)):
        fact = f"begins with {head!r}" if head else "has 0 bytes"
        raise InputError(f"{path} is not compressed by {packing} as its name says: it {fact}")
    return kind


def _unpack(path: Path, kind: str, target: Any) -> str:
    size, most = 0, max(_MOST * path.stat().st_size, _LEAST)
    library = zstd() if kind == "zstd" else import_module(_LIBRARIES[kind])
    try:
        with library.open(path, "rb") as source:
            while data := source.read1(_BLOCK):
                size += len(data)
                if size > most:
                    raise InputError(f"{path} unpacks to more than {_MOST} times its size: it is no recording")
                try:
                    target.write(data)
                except OSError as error:
                    raise OutputError(f"{path} cannot be unpacked into {target.name}: {cause(error)}") from None
    except (EOFError, ValueError, RuntimeError, OSError, lzma.LZMAError, zlib_error, zstd().ZstdError) as error:
        if not size:
            raise InputError(f"{path} cannot be unpacked: {error}") from None
        return f"{path} is damaged or cut off: {size} bytes before that are unpacked ({error})"
    return ""
