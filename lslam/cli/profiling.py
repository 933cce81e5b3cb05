"""Profile of a run: the stacks of all threads, sampled every few milliseconds, as a file for speedscope."""

from __future__ import annotations

import json
import linecache
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import copy_context
from pathlib import Path
from types import FrameType
from typing import Any

from lslam.core import __version__
from lslam.io.formats.atomic import atomic_write

INTERVAL_S = 0.005
MAX_STACKS = 50_000  # changes of stack kept at one interval: a longer run is looked at half as often, again and again

Frame = tuple[str, str, int]


@contextmanager
def profiled(path: Path | None) -> Iterator[None]:
    """Write a profile of the block to `path`, also after an error; do nothing when it is None.

    Time in a kernel counts for the line of Python that calls it. Raises OutputError when `path` cannot be written.
    """
    if path is None:
        yield
        return
    profile = StackProfile()
    profile.start()
    try:
        yield
    finally:
        profile.stop()
        with atomic_write(path) as stream:
            stream.write(json.dumps(profile.speedscope(path.stem)).encode())


class StackProfile:
    """Stacks of all other threads, with the seconds spent in each."""

    def __init__(self) -> None:
        self._thread = threading.Thread(target=copy_context().run, args=(self._look,), name="profile", daemon=True)
        self._is_over = threading.Event()
        self._began = self._ended = 0.0
        self._interval_s, self._changes = INTERVAL_S, 0
        self._stacks: dict[tuple[Frame, ...], int] = {}
        self._names: dict[int, str] = {}
        # For each thread: its stacks one after the other, as [number, second it began, second it was last seen].
        self._seen: dict[int, list[list[Any]]] = {}

    def start(self) -> None:
        """Start sampling."""
        self._began = time.perf_counter()
        self._thread.start()

    def stop(self) -> None:
        """Stop sampling."""
        self._is_over.set()
        self._thread.join()
        self._ended = time.perf_counter()

    def _look(self) -> None:
        own = threading.get_ident()
        before = self._began
        while not self._is_over.wait(self._interval_s):
            now = time.perf_counter()
            self._names |= {t.ident: t.name for t in threading.enumerate() if t.ident is not None}
            for ident, frame in sys._current_frames().items():
                if ident != own:
                    self._add(ident, stack_of(frame), before, now)
            before = now
            if self._changes > MAX_STACKS:
                self._interval_s, self._changes = 2 * self._interval_s, 0

    def _add(self, ident: int, stack: tuple[Frame, ...], before: float, now: float) -> None:
        number = self._stacks.setdefault(stack, len(self._stacks))
        seen = self._seen.setdefault(ident, [])
        if seen and seen[-1][0] == number and seen[-1][2] == before:
            seen[-1][2] = now
            return
        self._changes += 1
        seen.append([number, before, now])

    def speedscope(self, name: str) -> dict[str, Any]:
        """Content of a file for https://www.speedscope.app, a profile for each thread, the busiest first."""
        frames: dict[Frame, int] = {}
        stacks = [[frames.setdefault(f, len(frames)) for f in stack] for stack in self._stacks]
        length = self._ended - self._began
        profiles = [
            {
                "type": "sampled",
                "name": self._names.get(ident, str(ident)),
                "unit": "seconds",
                "startValue": 0,
                "endValue": round(length, 6),
                **self._samples(seen, stacks),
            }
            for ident, seen in sorted(
                self._seen.items(), key=lambda item: -sum(end - begin for _, begin, end in item[1])
            )
        ]
        return {
            "$schema": "https://www.speedscope.app/file-format-schema.json",
            "exporter": f"lslam {__version__}",
            "name": name,
            "activeProfileIndex": 0,
            "shared": {"frames": [{"name": n, "file": file, "line": line} for n, file, line in frames]},
            "profiles": profiles,
        }

    def _samples(self, seen: list[list[Any]], stacks: list[list[int]]) -> dict[str, Any]:
        """Stacks and weights of a thread; an empty stack while it did not exist."""
        samples: list[list[int]] = []
        weights: list[float] = []
        at = self._began
        for number, begin, end in [*seen, [None, self._ended, self._ended]]:
            if begin > at:
                samples.append([])
                weights.append(round(begin - at, 6))
            if number is not None:
                samples.append(stacks[number])
                weights.append(round(end - begin, 6))
            at = end
        return {"samples": samples, "weights": weights}


def stack_of(frame: FrameType | None) -> tuple[Frame, ...]:
    """(name, file, line) of each frame, the outermost first; last comes the source line of the innermost."""
    stack: list[Frame] = []
    if frame is not None:
        # Between two lines a frame has no number.
        code, line = frame.f_code, frame.f_lineno or frame.f_code.co_firstlineno
        stack.append((linecache.getline(code.co_filename, line).strip() or f"line {line}", code.co_filename, line))
    while frame is not None:
        code = frame.f_code
        stack.append((code.co_qualname, code.co_filename, code.co_firstlineno))
        frame = frame.f_back
    return tuple(reversed(stack))
