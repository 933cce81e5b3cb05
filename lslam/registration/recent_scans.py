"""The scans that entered the map last, and what stands on the ground in them."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from lslam.config.preprocess import PreprocessConfig
from lslam.preprocessing.prepare import PreparedPoints
from lslam.registration.start_search import StandingPoints, standing_points
from lslam.types.state import Stateful

Points = NDArray[np.float32]


class RecentScans(Stateful):
    """Points, LiDAR frame, and poses of the last `count` scans; what stands in one is sought once, and only when asked for."""

    STATE = ("scans",)

    def __init__(self, count: int, preprocess: PreprocessConfig) -> None:
        self._count, self._preprocess = count, preprocess
        self.scans: tuple[tuple[Points, NDArray[np.float64]], ...] = ()
        # What was found to stand in scans, beside their points: it follows from these, so it is no part of the state.
        self._known: list[tuple[Points, tuple[Points, Points]]] = []

    def enter(self, points: Points, T_world_lidar: NDArray[np.float64]) -> None:
        """The points (N, 3), LiDAR frame, of the next scan, taken at a pose (4, 4)."""
        self.scans = (*self.scans, (points, T_world_lidar))[-self._count :]

    def standing(self) -> StandingPoints:
        """What stands in the scans."""
        return StandingPoints([(self._stands(points)[0], pose) for points, pose in self.scans], self._preprocess)

    def seen_in(self, points: Points) -> PreparedPoints:
        """What to look for among `standing` at some pose: what stands in another scan (N, 3), LiDAR frame."""
        wanted = self._stands(points)[1]
        return PreparedPoints(wanted, wanted.astype(np.float64), np.zeros((len(wanted), 6)), len(wanted))

    def _stands(self, points: Points) -> tuple[Points, Points]:
        for other, found in self._known:
            if other is points:
                return found
        found = standing_points(points, self._preprocess)
        # The scans, and the one that may become the next of them.
        self._known = [*self._known, (points, found)][-(self._count + 1) :]
        return found
