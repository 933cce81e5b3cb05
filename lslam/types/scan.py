"""One output of the sensor."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray


class Span(NamedTuple):
    """When a sweep begins and ends, s from the stamp of its scan; both 0 where all its points belong to one instant."""

    begin_s: float = 0.0
    end_s: float = 0.0

    @property
    def seconds(self) -> float:
        """How long the sensor took."""
        return self.end_s - self.begin_s

    @property
    def passed(self) -> float:
        """Share of the sweep, 0 to 1, that is over at the stamp."""
        return -self.begin_s / self.seconds if self.seconds > 0 else 0.0

    @property
    def instant(self) -> str:
        """Where in the sweep the stamp lies: scan_start, scan_middle or scan_end, whichever is nearest."""
        return "scan_start" if self.passed < 0.25 else "scan_middle" if self.passed < 0.75 else "scan_end"


@dataclass(frozen=True)
class Scan:
    """One revolution, or one message, of a LiDAR.

    points : (N, 3) float32, m, LiDAR frame (x forward, y left, z up)
    stamp_ns : instant to which its pose belongs, ns: where the sweep starts, its middle, or what it is compensated to
    index : position in the recording, counted from 0 before any --start or --skip-frames
    intensity : (N,) float32 or None
    times : (N,) float32 seconds from the stamp, negative before it, or None; None means compensated or unknown
    rings : (N,) uint16 or None
    """

    points: NDArray[np.float32]
    stamp_ns: int
    index: int
    intensity: NDArray[np.float32] | None = None
    times: NDArray[np.float32] | None = None
    rings: NDArray[np.uint16] | None = None

    def __len__(self) -> int:
        return len(self.points)

    @cached_property
    def span(self) -> Span:
        """When the sweep begins and ends; the stamp itself is always within."""
        if self.times is None:
            return Span()
        return Span(float(np.fmin.reduce(self.times, initial=0.0)), float(np.fmax.reduce(self.times, initial=0.0)))

    def select(self, mask: NDArray[Any]) -> Scan:
        """The points that `mask` (bool or indices) keeps, together with their intensity, time and ring."""
        return replace(
            self,
            points=self.points[mask],
            intensity=None if self.intensity is None else self.intensity[mask],
            times=None if self.times is None else self.times[mask],
            rings=None if self.rings is None else self.rings[mask],
        )
