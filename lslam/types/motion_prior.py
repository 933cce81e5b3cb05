"""What is believed about the motion of a scan before it is registered."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class MotionPrior:
    """Poses sampled over one scan, so that it can be deskewed as well as predicted.

    times : (K,) float64 s since scan start, increasing; poses : (K, 4, 4) float64 T_world_lidar at those times
    The pose at scan start is `poses[0]`; K is 1 when only the start is predicted.
    """

    times: NDArray[np.float64]
    poses: NDArray[np.float64]

    @property
    def start(self) -> NDArray[np.float64]:
        """(4, 4) predicted T_world_lidar at scan start."""
        start: NDArray[np.float64] = self.poses[0]
        return start
