"""Where a first step may have led, and what tells the true one: what stands on the ground stays where it is."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from lslam.config.preprocess import PreprocessConfig
from lslam.preprocessing.ground import above_ground
from lslam.preprocessing.prepare import PreparedPoints
from lslam.registration.gaussian_map import GaussianMap
from lslam.registration.robust import Annealing
from lslam.registration.solver import RegistrationResult, solve

Floats = NDArray[np.float64]
Points = NDArray[np.float32]

# m; starts this far apart leave no gap between their capture ranges, not even between piers of a facade.
START_STEP = 1.0
# Every so many-th source point is enough to tell a good start from a bad one; so many of the best are looked at closely.
SEARCH_SHARE, LOOKED_AT = 4, 3
# Along a bare wall the rings repeat best where nothing moved, by four percent: a start elsewhere must have more.
CLEARLY = 1.05
# m; points this near belong together. Poles and leaves make no planes: their voxels are as large, one point is enough,
# and none of them passes for a plane.
NEAR, NO_PLANES = 0.4, 2.0


class StandingPoints:
    """The points of one scan (M, 3) at its pose (4, 4) that do not lie on the ground.

    Bare ground, guard rails and walls look alike metres further on, and a sensor's own rings match best where nothing
    moved. Posts, trees, signs and the ends of walls repeat nowhere at once, though they make few planes or none.
    """

    def __init__(self, points: Points, T_world_lidar: Floats, preprocess: PreprocessConfig) -> None:
        self._preprocess = preprocess
        standing = self._standing(points)
        self._cells = GaussianMap(NEAR, min_points=1, planarity=NO_PLANES, reach=np.inf, capacity=_room_for(standing))
        self._cells.insert(standing, T_world_lidar)

    def seen_in(self, points: Points) -> PreparedPoints:
        """What to look for at some pose: the standing points of another scan (N, 3), LiDAR frame."""
        standing = self._standing(points)
        return PreparedPoints(standing, standing.astype(np.float64), np.zeros((len(standing), 6)), len(standing))

    def share(self, seen: PreparedPoints, T_world_lidar: Floats) -> float:
        """Part of them that have one of these points near by when seen from `T_world_lidar` (4, 4)."""
        as_is = Annealing(NEAR, NEAR, 0.5, 1)
        found = solve(self._cells, seen, T_world_lidar, as_is, sigma=NEAR, blob_weight=1.0, weak_share=0.0)
        return found.inliers / max(len(seen.source), 1)

    def _standing(self, points: Points) -> Points:
        p = self._preprocess
        return points[above_ground(points, p.ground_slope, p.ground_tolerance)]


def _room_for(points: Points) -> int:
    return 1 << max(8, int(np.ceil(np.log2(len(points) + 1))))


def distinct(results: list[RegistrationResult], known: Floats) -> list[RegistrationResult]:
    """The first `LOOKED_AT` places that lie at least half a step from the known pose (4, 4) and from each other."""
    places, chosen = [known[:3, 3]], []
    for result in results:
        place = result.T_world_lidar[:3, 3]
        if min(float(np.linalg.norm(place - other)) for other in places) > START_STEP / 2:
            places.append(place)
            chosen.append(result)
    return chosen[:LOOKED_AT]


def start_offsets(reach: float, step: float) -> Floats:
    """(N, 3) m in the LiDAR frame, nearest first: ahead and back up to `reach`, sideways one step at most."""
    count = int(np.ceil(reach / step - 1e-9))
    ahead = [sign * min(k * step, reach) for k in range(1, count + 1) for sign in (1, -1)]
    sideways = [sign * min(step, reach) for sign in (1, -1)] if count else []
    offsets = np.array([(x, 0.0, 0.0) for x in ahead] + [(0.0, y, 0.0) for y in sideways]).reshape(-1, 3)
    return offsets[np.argsort(np.linalg.norm(offsets, axis=1), kind="stable")]
