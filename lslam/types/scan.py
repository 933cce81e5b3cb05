"""One output of the sensor."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class Scan:
    """One revolution, or one message, of a LiDAR.

    points : (N, 3) float32, m, LiDAR frame (x forward, y left, z up)
    stamp_ns : instant the scan starts (or is compensated to), ns
    index : position in the recording, counted from 0 before any --start or --skip-frames
    intensity : (N,) float32 or None
    times : (N,) float32 seconds since scan start or None; None means compensated or unknown
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

    def select(self, mask: NDArray[Any]) -> Scan:
        """The points that `mask` (bool or indices) keeps, together with their intensity, time and ring."""
        return replace(
            self,
            points=self.points[mask],
            intensity=None if self.intensity is None else self.intensity[mask],
            times=None if self.times is None else self.times[mask],
            rings=None if self.rings is None else self.rings[mask],
        )
