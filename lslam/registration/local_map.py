"""The local map in two resolutions: fine voxels where a scan's beams lie close together, coarse ones where they do not."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from lslam.preprocessing.prepare import PreparedPoints
from lslam.registration.gaussian_map import GaussianMap
from lslam.types.state import Stateful

# A plane must have been seen across its beams by twice the standard deviation that it is thick: below that, a plane
# through the sensor explains its points as well, which is where the beams of one ring lie whatever they hit.
BREADTH = 4.0


class LocalMap(Stateful):
    """Gaussian voxels of two sizes around the sensor.

    Parameters
    ----------
    size : m, edge of a fine voxel; coarse_factor : how many times larger a coarse one is
    min_points, planarity, count_cap, reach : as in `GaussianMap`
    """

    STATE = ("fine", "coarse")

    def __init__(
        self, size: float, *, coarse_factor: int, min_points: int, planarity: float, count_cap: float, reach: float
    ) -> None:
        self.fine, self.coarse = (
            GaussianMap(
                edge, min_points=min_points, planarity=planarity, count_cap=count_cap, reach=reach, breadth=BREADTH
            )
            for edge in (size, size * coarse_factor)
        )

    def __len__(self) -> int:
        """Fine voxels that hold points."""
        return len(self.fine)

    def insert(self, points: PreparedPoints, T_world_lidar: NDArray[np.float64]) -> None:
        """Enter a scan: its small centroids into fine voxels, its source points into coarse ones."""
        self.fine.insert(points.map_points, T_world_lidar)
        self.coarse.insert(points.source.astype(np.float32), T_world_lidar)

    def clear(self) -> None:
        """Forget everything; the room is kept."""
        self.fine.clear()
        self.coarse.clear()
