"""Files that one process at a time holds."""

from __future__ import annotations

import contextlib
import logging
from collections.abc import Iterator
from pathlib import Path
from typing import IO

log = logging.getLogger("lslam")


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
def one_at_a_time(path: Path | None, doing: str) -> Iterator[None]:
    """Hold `path`, made when it is missing, during the block: others wait. Where it cannot be made, or is None, nobody does.

    doing : what whoever holds it does, for who waits: "compiles the kernels"
    """
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
        if not lock(stream):
            log.info("waiting for another process that %s", doing)
            lock(stream, wait=True)
        yield
