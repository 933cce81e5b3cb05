"""Atomic file writing: a file appears whole or not at all."""

from __future__ import annotations

import io
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import BinaryIO

from lslam.core.errors import OutputError, cause
from lslam.io.remote import RemotePath


@contextmanager
def atomic_write(path: Path) -> Iterator[BinaryIO]:
    """Open a binary stream on `<name>.part`.

    It is renamed to `path` when the block ends without an error, and removed otherwise. A path in storage is uploaded at that
    moment. Raises OutputError naming the file when it cannot be written (permissions, a full disk), StorageError likewise.
    """
    if isinstance(path, RemotePath):
        held = io.BytesIO()
        yield held
        path.write_bytes(held.getbuffer())
        return
    part = path.with_name(path.name + ".part")
    try:
        with part.open("wb") as stream:
            yield stream
        os.replace(part, path)
    except OSError as error:
        _remove(part)
        raise OutputError(f"{path} cannot be written: {cause(error)}") from None
    except BaseException:
        _remove(part)
        raise


def write_text(path: Path, text: str) -> None:
    """Write text as UTF-8, atomically; bytes of a path that are no UTF-8 are written as JSON does, `\\udcef`."""
    with atomic_write(path) as stream:
        stream.write(text.encode("utf-8", "backslashreplace"))


def _remove(part: Path) -> None:
    """Delete a file, if it is there."""
    try:
        part.unlink(missing_ok=True)
    except OSError:
        # The folder itself is gone or closed to us: nothing is left behind that we could remove.
        return
