"""One input, one verdict: what a parser did with it, and whether that is allowed."""

from __future__ import annotations

import os
import resource
import shutil
import signal
import sys
import time
import traceback
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from fuzz.cases import Files, Parser, lay_out

from lslam.core.errors import LslamError

SECONDS = 5.0
BYTES = 10**9
LONGEST = 4000  # characters of a sentence
# Verdicts; the first two are allowed.
READ, REFUSED, RAISED, HUNG, GREW, WROTE, MUTE, DIED = (
    "read", "refused", "raised", "hung", "over 1 GB", "wrote", "no sentence", "died",
)  # fmt: skip
ALLOWED = (READ, REFUSED)
KINDS = (READ, REFUSED, RAISED, HUNG, GREW, WROTE, MUTE, DIED)


@dataclass(frozen=True)
class Verdict:
    """kind : one of `KINDS`; where : the innermost line of lslam, and the error in words; seconds : it took."""

    kind: str
    where: str = ""
    seconds: float = 0.0

    @property
    def is_allowed(self) -> bool:
        """Whether it was read, or refused with a sentence."""
        return self.kind in ALLOWED


class _TooLongError(BaseException):
    """Raised by the clock; no parser catches it."""


_CHANGES = ("open", "os.mkdir", "os.rename", "os.remove", "os.rmdir", "os.link", "os.symlink", "os.truncate")


class Watch:
    """Changes of files while it `is_on`, as Python's audit events tell them; caches of kernels and of Python are none."""

    def __init__(self) -> None:
        self.is_on = False
        self.found: list[str] = []
        self.allowed = os.environ.get("XDG_CACHE_HOME", os.path.expanduser("~/.cache"))
        sys.addaudithook(self._hear)

    def _hear(self, event: str, args: tuple[Any, ...]) -> None:
        if not self.is_on or event not in _CHANGES:
            return
        if event == "open" and not (isinstance(args[2], int) and args[2] & (os.O_WRONLY | os.O_RDWR | os.O_CREAT)):
            return
        # Of `open` the second is the mode.
        named = args[:1] if event == "open" else args[:2]
        paths = [os.fsdecode(a) for a in named if isinstance(a, (str, bytes, os.PathLike))]
        if any(not p.startswith((self.allowed, os.devnull)) and "__pycache__" not in p for p in paths):
            self.found.append(f"{event} {paths}")


_watch: Watch | None = None


@contextmanager
def little_memory(more: int = BYTES) -> Iterator[None]:
    """No more than `more` bytes of address space beside what the process has."""
    size = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    before = resource.getrlimit(resource.RLIMIT_AS)
    resource.setrlimit(resource.RLIMIT_AS, (size + more, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_AS, before)


def attempt(parser: Parser, files: Files, folder: Path, seconds: float | None = None) -> Verdict:
    """Lay `files` out in `folder`, which is emptied first, and let the parser read them."""
    global _watch
    _watch = _watch or Watch()
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    lay_out(folder, files)
    before = signal.signal(signal.SIGALRM, _ring)
    began = time.perf_counter()
    _watch.found.clear()
    try:
        signal.setitimer(signal.ITIMER_REAL, seconds or SECONDS)
        _watch.is_on = True
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            kind, where = _outcome(parser, folder)
    except _TooLongError as error:
        kind, where = HUNG, place_of(error)
    finally:
        _watch.is_on = False
        signal.setitimer(signal.ITIMER_REAL, 0)
        signal.signal(signal.SIGALRM, before)
    if kind in ALLOWED and _watch.found:
        kind, where = WROTE, _watch.found[0]
    return Verdict(kind, where, time.perf_counter() - began)


def _outcome(parser: Parser, folder: Path) -> tuple[str, str]:
    try:
        parser.read(folder)
    except LslamError as error:
        said = str(error)
        if not said.strip() or len(said) > LONGEST:
            return MUTE, f"{place_of(error)} {said[:200]!r}"
        return REFUSED, ""
    except MemoryError as error:
        return GREW, place_of(error)
    except Exception as error:
        return RAISED, f"{place_of(error)} {type(error).__name__}: {str(error)[:120]}"
    return READ, ""


def place_of(error: BaseException) -> str:
    """File, line and function of the innermost line of lslam that the error came through."""
    frames = traceback.extract_tb(error.__traceback__)
    ours = [f for f in frames if "/lslam/" in f.filename] or frames
    last = ours[-1]
    return f"{last.filename.rsplit('/lslam/', 1)[-1]}:{last.lineno} {last.name}"


def _ring(number: int, frame: Any) -> None:
    raise _TooLongError
