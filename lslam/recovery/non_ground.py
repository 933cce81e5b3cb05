"""Non-ground points: posts, trees and the ends of walls repeat nowhere at once, though they make few planes or none."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray

from lslam.config.preprocess import PreprocessConfig
from lslam.preprocessing.ground import ground_of
from lslam.preprocessing.prepare import PreparedPoints, subset
from lslam.registration.gaussian_map import GaussianMap
from lslam.registration.residuals import MEANS
from lslam.registration.robust import Annealing
from lslam.registration.solver import RegistrationResult, solve

Floats = NDArray[np.float64]
Points = NDArray[np.float32]

# m; points this near belong together. Poles and leaves make no planes: their voxels are as large, one point is enough,
# and none of them passes for a plane.
NEAR, NO_PLANES = 0.4, 2.0
# m, from which they find each other.
REACH = 1.0
# m above the ground: crash barriers are lower, along which a sensor's rings match best where nothing moved.
HIGH = 1.2


class NonGroundPoints:
    """What stands on the ground in a few scans: points (N, 3), LiDAR frame, and pose (4, 4) of each.

    Bare ground, guard rails and walls look alike metres further on, and a sensor's own rings match best where nothing
    moved. Posts, trees, signs and the ends of walls repeat nowhere at once, though they make few planes or none.
    """

    def __init__(self, scans: Iterable[tuple[Points, Floats]], preprocess: PreprocessConfig) -> None:
        self._preprocess = preprocess
        self._cells = GaussianMap(NEAR, min_points=1, planarity=NO_PLANES, reach=np.inf, capacity=1 << 12)
        for points, T_world_lidar in scans:
            self._cells.insert(non_ground_points(points, preprocess)[0], T_world_lidar)

    def share(self, seen: PreparedPoints, T_world_lidar: Floats) -> float:
        """Part of them that have one of these points near by when seen from `T_world_lidar` (4, 4)."""
        return self._solve(seen, T_world_lidar, Annealing(NEAR, NEAR, 0.5, 1)).inliers / max(len(seen.source), 1)

    def align(self, seen: PreparedPoints, T_start: Floats) -> RegistrationResult:
        """Lay them on these points, point to point, from less than `REACH` away."""
        return self._solve(seen, T_start, Annealing(REACH, NEAR / 2, 0.7, 20))

    def _solve(self, seen: PreparedPoints, T_start: Floats, annealing: Annealing) -> RegistrationResult:
        return solve(self._cells, seen, T_start, annealing, sigma=NEAR, blob_weight=1.0, weak_share=0.0, residual=MEANS)


def sought(points: Points, preprocess: PreprocessConfig) -> PreparedPoints:
    """What to look for among `NonGroundPoints` at some pose: the non-ground points of another scan (N, 3), LiDAR frame."""
    wanted = non_ground_points(points, preprocess)[1]
    return PreparedPoints(wanted, wanted.astype(np.float64), np.zeros((len(wanted), 6)), len(wanted))


def non_ground_points(points: Points, preprocess: PreprocessConfig) -> tuple[Points, Points]:
    """Those of the points (N, 3), LiDAR frame, that do not lie on the ground; and what to look for among others' of them."""
    ground = ground_of(points, preprocess.ground_slope, preprocess.ground_tolerance)
    standing, high = (points[ground.above(points, height)] for height in (preprocess.ground_tolerance, HIGH))
    return standing, high


def on_ground(points: PreparedPoints, preprocess: PreprocessConfig) -> PreparedPoints:
    """The source points on the ground."""
    ground = ground_of(points.map_points, preprocess.ground_slope, preprocess.ground_tolerance)
    is_ground = np.ones(len(points.source), bool)
    is_ground[ground.above(points.source.astype(np.float32), preprocess.ground_tolerance)] = False
    return subset(points, is_ground)
