"""Files that one process at a time holds."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from pathlib import Path
from typing import IO


def lock(stream: IO[str], wait: bool = False) -> bool:
    """Whether the lock of an open file is ours now; where the system or the file system has no locks, always.

    wait : until whoever holds it lets go
    """
    try:
        import fcntl

        fcntl.flock(stream, fcntl.LOCK_EX if wait else fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    except (ImportError, OSError):
        return True
    return True


@contextlib.contextmanager
def one_at_a_time(path: Path | None) -> Iterator[None]:
    """Hold `path`, made when it is missing, during the block: others wait. Where it cannot be made, or is None, nobody does."""
    if path is None:
        yield
        return
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        stream = path.open("a")
    except OSError:
        yield
        return
    with stream:
        lock(stream, wait=True)
        yield
