"""One output of the sensor."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from lslam.core.arrays import Bools

# m along each axis: no LiDAR that is carried along the ground or a little above sees as far.
FARTHEST_M = 10_000.0
# m; half the points of a scan are nearer: where a turn is counted in metres.
LEVER_M = 10.0
# In `Scan.rings`: the recording gives this point no ring. Methods that need rings leave it out.
NO_RING = 65535


def has_return(points: NDArray[Any]) -> Bools:
    """(N,) whether points (N, 3), m, are returns: NaN, zeros and unreasonably large numbers are none."""
    with np.errstate(invalid="ignore"):
        return np.asarray((np.abs(points) < FARTHEST_M).all(axis=1) & (points != 0).any(axis=1))


class Span(NamedTuple):
    """When a sweep begins and ends, s from the stamp of its scan; both 0 where all its points belong to one instant."""

    begin_s: float = 0.0
    end_s: float = 0.0

    @property
    def seconds(self) -> float:
        """How long the sensor took."""
        return self.end_s - self.begin_s

    @property
    def stamp_share(self) -> float:
        """Share of the sweep, 0 to 1, that is over at the stamp."""
        return -self.begin_s / self.seconds if self.seconds > 0 else 0.0

    @property
    def instant(self) -> str:
        """Where in the sweep the stamp lies: scan_start, scan_middle or scan_end, whichever is nearest."""
        return "scan_start" if self.stamp_share < 0.25 else "scan_middle" if self.stamp_share < 0.75 else "scan_end"


@dataclass(frozen=True)
class Scan:
    """One revolution, or one message, of a LiDAR.

    points : (N, 3) float32, m, LiDAR frame (x forward, y left, z up)
    stamp_ns : instant to which its pose belongs, ns: where the sweep starts, its middle, or what it is compensated to
    index : position in the recording, counted from 0 before any --start or --skip-frames
    intensity : (N,) float32 or None
    times : (N,) float32 seconds from the stamp, negative before it, or None; None means compensated or unknown
    rings : (N,) uint16, `NO_RING` where a point has none, or None
    fault : what is wrong with the scan though it is of use, a sentence without its number; empty: nothing
    labels : (N,) uint16, class of each point, see `lslam.core.labels`; None where the recording has none
    lidars : (N,) uint8, which LiDAR of several measured each point, 0 for the leading one; None where there is but one
    """

    points: NDArray[np.float32]
    stamp_ns: int
    index: int
    intensity: NDArray[np.float32] | None = None
    times: NDArray[np.float32] | None = None
    rings: NDArray[np.uint16] | None = None
    fault: str = ""
    labels: NDArray[np.uint16] | None = None
    lidars: NDArray[np.uint8] | None = None

    def __len__(self) -> int:
        return len(self.points)

    @cached_property
    def span(self) -> Span:
        """When the sweep begins and ends; the stamp itself is always within."""
        if self.times is None:
            return Span()
        return Span(float(np.fmin.reduce(self.times, initial=0.0)), float(np.fmax.reduce(self.times, initial=0.0)))

    def select(self, mask: NDArray[Any]) -> Scan:
        """The points selected by `mask` (bool or indices), with all their attributes."""
        return replace(
            self,
            points=self.points[mask],
            intensity=None if self.intensity is None else self.intensity[mask],
            times=None if self.times is None else self.times[mask],
            rings=None if self.rings is None else self.rings[mask],
            labels=None if self.labels is None else self.labels[mask],
            lidars=None if self.lidars is None else self.lidars[mask],
        )

    def of_leading(self) -> Scan | None:
        """The points of the leading LiDAR alone; None where there are no others, or none of its own."""
        if self.lidars is None or not self.lidars.any() or self.lidars.all():
            return None
        return replace(self.select(self.lidars == 0), lidars=None)
