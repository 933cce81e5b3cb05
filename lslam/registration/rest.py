"""Rest of the sensor: by the poses of its registered scans, and by what a scan shows.

From the spot on which it rests a scan shows it there or moved: which of both needs fewer things to move?
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from lslam.core.arrays import Bools, Floats, Longs
from lslam.core.config.input import PreprocessConfig
from lslam.core.geometry import noise, se3
from lslam.core.kernels.linearisation import OUTLIER_SIGMAS
from lslam.core.types.state import Stateful
from lslam.registration.alignment import upright_directions
from lslam.registration.gaussian_map import FLOOR_M2
from lslam.registration.local_map import COARSE_FACTOR, LEAST_BREADTH
from lslam.registration.preprocessing.ground import ground_of, up_of
from lslam.registration.result import RegistrationResult

# Rest lasts longer than the time that the last motion took to show, by this factor.
REST_RATIO = 2


class RestDetector(Stateful):
    """Compares registered poses with that of the reference, where the sensor was last seen to move.

    A scan is near the reference where both poses differ by less than they err, and no point moves by more than its noise. A slow
    sensor is near, too, but leaves one reference after another. So it is at rest once it has stayed near for more than twice as
    many scans as it took to leave the reference before.

    sigma : m, noise of a point
    """

    STATE = ("_reference", "_stayed", "_last_stay")

    def __init__(self, sigma: float) -> None:
        self.sigma = sigma
        self._same_pose_chi2 = noise.quantile(noise.RIGHT_PROBABILITY, 6)
        self._reference: Floats | None = None
        # Scans near the reference; scans that it took to leave the one before.
        self._stayed = self._last_stay = 0

    def judge(self, result: RegistrationResult) -> RegistrationResult:
        """The result with `is_stationary` set if the sensor is at rest; updates the reference. Failed results are ignored."""
        if not result.ok:
            return result
        if self._is_near(result):
            self._stayed += 1
            return replace(result, is_stationary=self._stayed > REST_RATIO * self._last_stay)
        self._last_stay = 0 if self._reference is None else self._stayed + 1
        self._stayed, self._reference = 0, result.T_world_lidar.copy()
        return result

    def _is_near(self, result: RegistrationResult) -> bool:
        """Whether the result's pose equals the reference's within the noise of a point and its covariance."""
        C, T, reference = result.covariance, result.T_world_lidar, self._reference
        if reference is None or C is None or not result.is_accepted:
            return False
        d = noise.changes(reference, T)
        if d[:3] @ d[:3] + result.lever_arm**2 * (d[3:] @ d[3:]) > self.sigma**2:
            return False
        # Once in a thousand scans two poses of one place differ by more.
        return float(d @ np.linalg.solve(2.0 * C, d)) < self._same_pose_chi2


# Squared sigmas beyond which a point is no inlier, so that two points at least make a vote.
INLIER_CHI2 = OUTLIER_SIGMAS**2
# Squared sigmas by which a point tells two poses apart.
TELLING_CHI2 = 0.5


@dataclass(frozen=True)
class Votes:
    """Objects that fit the sensor standing (`stay`) and its motion (`move`); all others do not count."""

    stay: int
    move: int

    @property
    def is_standing(self) -> bool:
        """Whether fewer things must have moved if the sensor stands."""
        return self.stay > 0 and self.stay >= self.move


class PlanWalls:
    """Vertical surfaces of a scan, as lines seen from above.

    A façade far away, seen by few rings, has no plane in a voxel, but a line here. A voxel has a wall where its points are thin
    seen from above, and lie across beams (`LEAST_BREADTH`): a ring on a slope is thin, too.

    cloud : (N, 3) m, LiDAR frame
    sigma : m, noise of a point
    voxel_size : m, length of wall that a line is fitted to
    """

    def __init__(
        self, cloud: NDArray[np.float32], preprocess: PreprocessConfig, sigma: float, voxel_size: float
    ) -> None:
        from scipy.spatial import cKDTree

        self._preprocess, self._sigma2, self._voxel_size = preprocess, sigma**2, voxel_size
        ground = ground_of(cloud, up_of(preprocess))
        self._R = ground.R
        high = cloud[ground.above(cloud)].astype(np.float64) @ self._R.T
        self._tree = cKDTree(high[:, :2])
        pairs = self._tree.query_pairs(voxel_size, output_type="ndarray")
        own = np.arange(len(high))
        at, of = np.concatenate([own, pairs[:, 0], pairs[:, 1]]), np.concatenate([own, pairs[:, 1], pairs[:, 0]])
        count = np.bincount(at, minlength=len(high))

        def mean(values: Floats) -> Floats:
            return np.asarray(np.bincount(at, values, len(high)) / count)

        self._mean = np.stack([mean(high[of, k]) for k in range(3)], axis=1)
        x, y, z = (high[of] - self._mean[at]).T
        xx, xy, yy, zz = mean(x * x), mean(x * y), mean(y * y), mean(z * z)
        spread, angle = np.hypot((xx - yy) / 2, xy), 0.5 * np.arctan2(2 * xy, xx - yy)
        self._normal = np.stack([-np.sin(angle), np.cos(angle)], axis=1)
        thick = np.maximum((xx + yy) / 2 - spread, 0.0) + FLOOR_M2
        self._variance = thick + self._sigma2
        self._is_wall = (thick < self._sigma2) & (np.minimum((xx + yy) / 2 + spread, zz) > LEAST_BREADTH * thick)

    def votes(self, cloud: NDArray[np.float32], motion: Floats) -> Votes:
        """Number of objects of a later scan (N, 3) that fit the walls better if the sensor stands, and if it moved.

        motion : (4, 4) pose of the later scan relative to the first
        """
        ground = ground_of(cloud, up_of(self._preprocess))
        points = cloud[ground.above(cloud)].astype(np.float64)
        if not len(self._mean) or not len(points):
            return Votes(0, 0)
        here, there = points @ self._R.T, se3.apply(motion, points) @ self._R.T
        (standing, is_here), (moved, is_there) = self._cost(here), self._cost(there)
        # Where one of them tells nothing there is nothing to compare.
        gain = np.where(np.isfinite(standing) & np.isfinite(moved) & (is_here | is_there), moved - standing, 0.0)
        telling = np.flatnonzero(np.abs(gain) > TELLING_CHI2)
        if not len(telling):
            return Votes(0, 0)
        things = _connect(here[telling, :2], COARSE_FACTOR * self._voxel_size)
        sums = np.bincount(things, gain[telling])
        return Votes(*(int(np.count_nonzero(sign * sums > INLIER_CHI2)) for sign in (1, -1)))

    def _cost(self, points: Floats) -> tuple[Floats, Bools]:
        """(N,) squared distances, in sigmas, of levelled points from the nearest wall, bounded; and whether a voxel is near.

        NaN where the near voxel is no wall.
        """
        away, near = self._tree.query(points[:, :2], distance_upper_bound=self._voxel_size)
        is_near = np.isfinite(away)
        near = np.where(is_near, near, 0)
        off = ((points - self._mean[near])[:, :2] * self._normal[near]).sum(1)
        cost = np.minimum(off**2 / self._variance[near], INLIER_CHI2)
        return np.where(is_near, np.where(self._is_wall[near], cost, np.nan), INLIER_CHI2), is_near


def _connect(points: Floats, apart_m: float) -> Longs:
    """(N,) number of the object of each of points (N, 2), seen from above; objects lie at least `apart_m` from one another."""
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components
    from scipy.spatial import cKDTree

    pairs = cKDTree(points).query_pairs(apart_m, output_type="ndarray")
    links = coo_matrix((np.ones(len(pairs)), pairs.T), shape=(len(points),) * 2)
    return np.asarray(connected_components(links, directed=False)[1], np.int64)


class Rest(Stateful):
    """The spot that the sensor has not left: its pose, the first scan there, and the number of scans since.

    Only motion in x, y and yaw counts, which walls observe: a car that is about to start pitches.

    sigma : m, noise of a point, by which two poses of one spot may differ
    voxel_size : m, as of `PlanWalls`
    """

    STATE = ("scans", "T_world_lidar", "_cloud", "_squares")
    TRANSIENT = ("_walls",)

    def __init__(self, preprocess: PreprocessConfig, sigma: float, voxel_size: float) -> None:
        self.preprocess, self.sigma, self.voxel_size, self.scans = preprocess, sigma, voxel_size, 0
        # Sum of the squared distances of these scans, m2.
        self._squares = 0.0
        self.T_world_lidar = np.eye(4)
        self._cloud: NDArray[np.float32] | None = None
        self._walls: PlanWalls | None = None

    def is_here(self, T_world_lidar: Floats, lever_arm: float) -> bool:
        """Whether a pose (4, 4) differs from the spot by no more than registrations there do: one to three sigma of a point.

        lever_arm : m, at which rotation counts
        """
        usual = float(np.sqrt(INLIER_CHI2 * self._squares / self.scans))
        return self._away(T_world_lidar, lever_arm) < min(max(usual, self.sigma), self._reach)

    @property
    def _reach(self) -> float:
        """m; beyond three sigma a single point would tell, and nearer a wall of the street may have no vote yet."""
        return float(np.sqrt(INLIER_CHI2)) * self.sigma

    def _away(self, T_world_lidar: Floats, lever_arm: float) -> float:
        """Distance, m, of a pose (4, 4) from the spot in x, y and yaw, at the `lever_arm`, m."""
        change = noise.changes(self.T_world_lidar, T_world_lidar)
        level = change - upright_directions(self.T_world_lidar, up_of(self.preprocess)) @ change
        return float(np.linalg.norm(level[:3]) + np.linalg.norm(level[3:]) * lever_arm)

    def enter(self, cloud: NDArray[np.float32], T_world_lidar: Floats, lever_arm: float) -> None:
        """Count one more scan at the spot, or begin a new spot with it: cloud (N, 3), m, LiDAR frame; lever_arm : m."""
        away = self._away(T_world_lidar, lever_arm)
        if self._cloud is not None and away < self._reach:
            self.scans, self._squares = self.scans + 1, self._squares + away**2
        else:
            self._cloud, self.T_world_lidar, self._walls = cloud, T_world_lidar.copy(), None
            self.scans, self._squares = 1, 0.0

    def votes(self, cloud: NDArray[np.float32], T_world_lidar: Floats) -> Votes:
        """Votes of a later scan (N, 3), m, LiDAR frame, on the walls at the spot: the sensor stands there, or at another pose.

        T_world_lidar : (4, 4), that other pose
        """
        assert self._cloud is not None
        if self._walls is None:
            self._walls = PlanWalls(self._cloud, self.preprocess, self.sigma, self.voxel_size)
        return self._walls.votes(cloud, se3.relative(self.T_world_lidar, T_world_lidar))
