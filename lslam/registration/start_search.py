"""Where a first step may have led, and what tells the true one: what stands on the ground stays where it is."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray

from lslam.config.preprocess import PreprocessConfig
from lslam.geometry import se3, so3
from lslam.preprocessing.ground import CELL, ground_of, levelling
from lslam.preprocessing.prepare import PreparedPoints
from lslam.registration.gaussian_map import GaussianMap
from lslam.registration.robust import Annealing
from lslam.registration.solver import RegistrationResult, solve

Floats = NDArray[np.float64]
Points = NDArray[np.float32]

# m; starts this far apart leave no gap between their capture ranges, not even between piers of a facade.
START_STEP = 1.0
# A hand-held sensor turns at 100 deg/s, by 30 deg at every third scan; so far apart that 20 m away a step is left.
START_TURNS_DEG = np.delete(np.arange(-30.0, 31.0, 3.0), 10)
# Less than the rings of most sensors are apart.
AT_REST_DEG = 3.0
# Every so many-th source point is enough to tell a good start from a bad one; so many of the best are looked at closely.
SEARCH_SHARE, LOOKED_AT = 4, 3
# Along a bare wall the rings repeat best where nothing moved, by up to five percent: a start elsewhere must have more, and
# twice as much where planes, the prior or both say otherwise.
CLEARLY, MUCH = 1.05, 1.1
# m; points this near belong together. Poles and leaves make no planes: their voxels are as large, one point is enough,
# and none of them passes for a plane.
NEAR, NO_PLANES = 0.4, 2.0
# m above the ground: crash barriers are lower, along which a sensor's rings match best where nothing moved; ...
HIGH = 1.2
# ... where fewer points than this are higher, the lower ones are asked, too.
FEW = 60


class StandingPoints:
    """What stands on the ground in a few scans: (`standing_points` (M, 3), pose (4, 4)) of each.

    Bare ground, guard rails and walls look alike metres further on, and a sensor's own rings match best where nothing
    moved. Posts, trees, signs and the ends of walls repeat nowhere at once, though they make few planes or none.
    """

    def __init__(self, scans: Iterable[tuple[Points, Floats]], preprocess: PreprocessConfig) -> None:
        self._preprocess = preprocess
        self._cells = GaussianMap(NEAR, min_points=1, planarity=NO_PLANES, reach=np.inf, capacity=1 << 12)
        for points, T_world_lidar in scans:
            self._cells.insert(points, T_world_lidar)

    def share(self, seen: PreparedPoints, T_world_lidar: Floats) -> float:
        """Part of them that have one of these points near by when seen from `T_world_lidar` (4, 4)."""
        return self._solve(seen, T_world_lidar, Annealing(NEAR, NEAR, 0.5, 1)).inliers / max(len(seen.source), 1)

    def align(self, seen: PreparedPoints, T_start: Floats) -> RegistrationResult:
        """Lay them on these points, point to point, from less than a step away."""
        return self._solve(seen, T_start, Annealing(START_STEP, NEAR / 2, 0.7, 20))

    def likeliest(self, seen: PreparedPoints, T_prior: Floats, reach: float) -> Floats:
        """(4, 4) pose up to `reach`, m, from the prior, or turned about its z, at which most have a point near by."""
        moved = [T_prior @ se3.make(np.eye(3), offset) for offset in start_offsets(reach, NEAR)]
        turned = [
            T_prior @ se3.make(so3.exp(np.array([0, 0, turn])), np.zeros(3)) for turn in np.deg2rad(START_TURNS_DEG)
        ]
        return max([*moved, *turned], key=lambda start: self.share(seen, start))

    def place_on_ground(self, stood: Floats, planes: Floats, points: Points) -> Floats:
        """(4, 4) pose with place and heading of `stood`, height and tilt of `planes`, both of the scan of `points`.

        Two steps as in LeGO-LOAM (Shan and Englot 2018): few rings on a post say nothing of tilt, the ground does. But where
        planes would lift the scan so far that nothing of what stands had its like near by, they do not hold its height: from
        above the roofs few rings make any.
        """
        p = self._preprocess
        R, _ = levelling(points, p.ground_tolerance, int(p.range_max / CELL) + 1)
        between = se3.log(se3.relative(stood, planes)).reshape(2, 3) @ R.T
        between[0, :2] = between[1, 2] = 0.0
        if abs(between[0, 2]) > NEAR:
            between[0, 2] = 0.0
        return se3.normalise(stood @ se3.exp((between @ R).ravel()))

    def _solve(self, seen: PreparedPoints, T_start: Floats, annealing: Annealing) -> RegistrationResult:
        return solve(self._cells, seen, T_start, annealing, sigma=NEAR, blob_weight=1.0, weak_share=0.0)


def standing_points(points: Points, preprocess: PreprocessConfig) -> tuple[Points, Points]:
    """Those of the points (N, 3), LiDAR frame, that do not lie on the ground; and what to look for among others' of them.

    Which is those that rise `HIGH`, unless they are too `FEW`.
    """
    ground = ground_of(points, preprocess.ground_slope, preprocess.ground_tolerance)
    standing, high = (points[ground.above(points, height)] for height in (preprocess.ground_tolerance, HIGH))
    return standing, high if len(high) >= FEW else standing


def is_at_rest(pose: Floats, last: Floats) -> bool:
    """Whether the pose (4, 4) is so near to the last scan's that the sensor's own rings, on roofs or walls, explain it."""
    move, turn = se3.relative(last, pose)[:3, 3], so3.angle(se3.relative(last, pose)[:3, :3])
    return bool(np.linalg.norm(move) < 2 * NEAR and turn < np.deg2rad(AT_REST_DEG))


def is_much_more(share: float, other: float, count: int) -> bool:
    """Whether of `count` points a much larger share agrees at one pose than at the `other`, and not by chance.

    McNemar's test of paired shares at two sigma. How many points the poses dispute is not known: every one that fails to
    agree at either pose is taken for one, which none in dispute escapes.
    """
    in_dispute = count * (2 - share - other)
    return share > MUCH * other and count * (share - other) > 2 * np.sqrt(in_dispute)


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
