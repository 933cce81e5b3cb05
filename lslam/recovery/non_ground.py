"""Non-ground points: posts, trees and the ends of walls disambiguate places, though they make few planes or none."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray

from lslam.config.preprocess import PreprocessConfig
from lslam.preprocessing.ground import Ground, above_ground, ground_of
from lslam.preprocessing.prepare import PreparedPoints, subset
from lslam.registration.alignment import upright_directions
from lslam.registration.gaussian_map import GaussianMap
from lslam.registration.optimiser import Correspondences, Limits, optimise
from lslam.registration.residuals import MEANS
from lslam.registration.robust import Annealing
from lslam.registration.solver import RegistrationResult, solve, voxel_terms

Floats = NDArray[np.float64]
Points = NDArray[np.float32]
Flags = NDArray[np.bool_]

# m; points this near belong together. Poles and leaves make no planes: their voxels are as large, one point is enough,
# and none of them passes for a plane.
NEAR, NO_PLANES = 0.4, 2.0
# m, from which they find each other.
REACH = 1.0
# m above the ground: crash barriers are lower, along which a sensor's rings match best where nothing moved.
HIGH = 1.2


class NonGroundPoints:
    """Non-ground points of a few scans: points (N, 3), LiDAR frame, and pose (4, 4) of each.

    Ground, guard rails and walls are self-similar, and a sensor's own rings match best at zero motion. The pattern of posts,
    trees, signs and ends of walls is unique.
    """

    def __init__(self, scans: Iterable[tuple[Points, Floats]], preprocess: PreprocessConfig) -> None:
        self._cells = GaussianMap(NEAR, min_points=1, planarity=NO_PLANES, reach=np.inf, capacity=1 << 12)
        for points, T_world_lidar in scans:
            index = above_ground(points, preprocess.ground_slope, preprocess.ground_tolerance)
            self._cells.insert(points[index], T_world_lidar)

    def agreeing(self, seen: PreparedPoints, T_world_lidar: Floats) -> Flags:
        """(S,) which of them have one of these points near by when seen from `T_world_lidar` (4, 4)."""
        matches = Correspondences(len(seen.source))
        terms = voxel_terms(MEANS, MEANS.points(seen, NEAR), (self._cells,), matches, NEAR, 1.0)
        optimise(terms, T_world_lidar, Annealing(NEAR, NEAR, 0.5, 1), Limits(0.0), matches)
        return (matches.away2 >= 0) & (matches.away2 < NEAR**2)

    def share(self, seen: PreparedPoints, T_world_lidar: Floats) -> float:
        """Which part of them does."""
        return np.count_nonzero(self.agreeing(seen, T_world_lidar)) / max(len(seen.source), 1)

    def align(self, seen: PreparedPoints, T_start: Floats) -> RegistrationResult:
        """Lay them on these points, point to point, from less than `REACH` away, with height and tilt as they are.

        At the wrong height, or tilted by a degree, rings agree with those of another scan that hit something else.
        """
        return solve(
            self._cells, seen, T_start, Annealing(REACH, NEAR / 2, 0.7, 20), sigma=NEAR, blob_weight=1.0, weak_share=0.0,
            residual=MEANS, allowed=np.eye(6) - upright_directions(T_start),
        )  # fmt: skip


def ground_under(points: PreparedPoints, preprocess: PreprocessConfig) -> Ground:
    """The ground under a scan."""
    return ground_of(points.map_points, preprocess.ground_slope, preprocess.ground_tolerance)


def sought(points: PreparedPoints, ground: Ground) -> PreparedPoints:
    """What to look for among `NonGroundPoints` at some pose: the points of another scan that are high above its ground."""
    wanted = points.map_points[ground.above(points.map_points, HIGH)]
    return PreparedPoints(wanted, wanted.astype(np.float64), np.zeros((len(wanted), 6)), len(wanted))


def on_ground(points: PreparedPoints, ground: Ground, tolerance: float) -> PreparedPoints:
    """The source points no higher above the ground than `tolerance`, m."""
    is_ground = np.ones(len(points.source), bool)
    is_ground[ground.above(points.source.astype(np.float32), tolerance)] = False
    return subset(points, is_ground)
