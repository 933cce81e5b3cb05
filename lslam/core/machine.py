"""What the machine offers to this process: cores, and files that one process at a time holds."""

from __future__ import annotations

import contextlib
import gc
import logging
import os
import platform
from collections.abc import Iterator
from pathlib import Path
from typing import IO


def available_cores() -> int:
    """Cores that this process may use; `OMP_NUM_THREADS`, which batch systems and our own studies set, is the limit."""
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    limit = os.environ.get("OMP_NUM_THREADS", "")
    return max(1, min(cores, int(limit))) if limit.isdigit() else cores


def pin_blas() -> None:
    """Restrict OpenBLAS, before NumPy and SciPy load it, to one core and to code that every x86-64 processor runs.

    So sums have one order, and bytes are the same on each machine. Matrices of this program are small: more cores would wait for
    each other, a hundred times as long where others use them.
    """
    os.environ["OPENBLAS_NUM_THREADS"] = "1"
    if platform.machine().lower() in ("x86_64", "amd64"):
        os.environ["OPENBLAS_CORETYPE"] = "Nehalem"


log = logging.getLogger("lslam")


def lock(stream: IO[str], wait: bool = False) -> bool:
    """Lock an open file; returns whether we have the lock. True on systems without locks.

    wait : block until the present owner releases it; else return False at once
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
    """Lock the file `path`, made when missing, during the block; others wait. No lock if it cannot be made, or is None.

    doing : activity of its owner, for the message to those who wait: "compiles the kernels"
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


@contextlib.contextmanager
def rarely_collecting() -> Iterator[None]:
    """Collect garbage rarely inside the block: compiling and importing make millions of permanent objects."""
    before = gc.get_threshold()
    gc.set_threshold(100_000, *before[1:])
    try:
        yield
    finally:
        gc.set_threshold(*before)


@contextlib.contextmanager
def keeping_objects() -> Iterator[None]:
    """Collect no garbage inside the block, and never look at its objects again: modules are permanent."""
    gc.disable()
    try:
        yield
    finally:
        gc.freeze()
        gc.enable()
