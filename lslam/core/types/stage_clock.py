"""How long each stage of a scan, or of a keyframe, takes."""

from __future__ import annotations

import time
from collections import defaultdict
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager


class StageClock:
    """Seconds per stage of one scan, by name, in the order they ran; a stage that runs twice adds up."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        """Measure the block."""
        began = time.perf_counter()
        try:
            yield
        finally:
            self.seconds[name] = self.seconds.get(name, 0.0) + time.perf_counter() - began


def summed(rows: Iterable[Mapping[str, float]]) -> dict[str, float]:
    """Seconds per stage of several scans, in the order in which the stages come first."""
    found: dict[str, float] = {}
    for row in rows:
        for name, seconds in row.items():
            found[name] = found.get(name, 0.0) + seconds
    return found


class KeyframeClocks(defaultdict[int, StageClock]):
    """A clock for each keyframe, by number: of what is done after odometry."""

    def __init__(self) -> None:
        super().__init__(StageClock)

    def totals(self) -> dict[str, float]:
        """Seconds per stage of all keyframes."""
        return summed(self[number].seconds for number in sorted(self))
