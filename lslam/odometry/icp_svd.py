"""Method `icp-svd`: the classic ICP of Besl and McKay (1992), point to point, scan to scan, in closed form."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from lslam.core.arrays import Floats, Longs
from lslam.core.config.config import Config
from lslam.core.config.input import PreprocessConfig
from lslam.core.config.odometry import RegistrationConfig
from lslam.core.geometry import se3
from lslam.core.types.scan import Scan
from lslam.core.types.scan_result import ScanResult
from lslam.core.types.state import Stateful
from lslam.odometry.base import AligningMethod
from lslam.registration.optimiser import STEP_M, STEP_RAD
from lslam.registration.preprocessing.prepare import PreparedPoints, prepare_points, small_room
from lslam.registration.result import RegistrationResult
from lslam.registration.voxel_target import MIN_SOURCE_POINTS

if TYPE_CHECKING:
    from scipy.spatial import cKDTree

# Distances beyond the median plus this many median deviations are outliers (the X84 rule, Hampel et al. 1986).
X84 = 5.2


@dataclass(frozen=True)
class Partners:
    """The last scan that was registered: its points (M, 3), m, in its own LiDAR frame, and its pose."""

    points: Floats
    T_world_lidar: Floats

    @cached_property
    def tree(self) -> cKDTree:
        """Search tree of the points."""
        from scipy.spatial import cKDTree

        return cKDTree(self.points, balanced_tree=False, compact_nodes=False)


def create(config: Config) -> IcpSvd:
    """Create the method from the configuration."""
    return IcpSvd(config.preprocess, config.registration)


class IcpSvd(AligningMethod, Stateful):
    """Nearest neighbours, trimmed, then the best-fitting transform, iterated until it no longer changes.

    It uses `registration.inlier_ratio`, `inlier_distance`, `max_iterations` and the acceptance limits; it gives no covariance.
    It follows the sensor's start only when that is slow, and lags with sparse rings, since a ring's nearest neighbour is the
    same ring of the scan before. Trimming makes that worse.
    """

    STATE = ("_last", "_failed")

    def __init__(self, preprocess: PreprocessConfig, registration: RegistrationConfig) -> None:
        self._preprocess, self.limits = preprocess, registration
        self._last: Partners | None = None
        self._failed = 0

    def prepare(self, scan: Scan) -> PreparedPoints:
        """Range gate and down-sampling."""
        return prepare_points(scan.points, self._preprocess, scan.index)

    def align(self, prepared: PreparedPoints, T_prior: Floats) -> RegistrationResult:
        """Align with the last registered scan."""
        c = self.limits
        count = len(prepared.source)
        if self._last is None or count < MIN_SOURCE_POINTS:
            return RegistrationResult(T_prior, source_points=count, inliers=count)
        return align_closed_form(
            prepared.source,
            self._last,
            T_prior,
            inlier_ratio=c.inlier_ratio,
            inlier_distance=c.inlier_distance,
            max_iterations=c.max_iterations,
        )

    def enter(self, prepared: PreparedPoints, result: ScanResult) -> None:
        """Make a registered scan the last one; after two failures in a row the scan that failed."""
        self._failed = 0 if result.status == "ok" else self._failed + 1
        if len(prepared.source) >= MIN_SOURCE_POINTS and self._failed in (0, 2):
            is_sampled = self.limits.target == "sample" and self._last is not None
            points = prepared.source if is_sampled else prepared.map_points.astype(np.float64)
            self._last = Partners(points, result.T_world_lidar)

    def warm_up(self) -> None:
        """Compile or load the kernels of preprocessing."""
        self.prepare(Scan(small_room(), 0, 0))


def align_closed_form(
    source: Floats,
    last: Partners,
    T_prior: Floats,
    *,
    inlier_ratio: float = 1.0,
    inlier_distance: float | None = None,
    max_iterations: int = 50,
) -> RegistrationResult:
    """Pose of the source points (S, 3), m, LiDAR frame, by equations 2.17 to 2.20 of Girolimetto, from `T_prior` (4, 4).

    Each round pairs every point with its nearest in the last scan, keeps the pairs within `inlier_distance`, m (None: the
    inliers of the X84 rule), of these the closest `inlier_ratio`, and computes the least-squares transform:
    centroids removed (2.18, 2.19), rotation by SVD of the covariance (2.20). Where the pairs do not determine it, the result is
    the prior, not converged.
    """
    T = se3.relative(last.T_world_lidar, T_prior)
    converged, rounds, near = False, 0, np.zeros(0, np.int64)
    distance = np.zeros(len(source))
    for rounds in range(1, max_iterations + 1):
        moved = se3.apply(T, source)
        reach = np.inf if inlier_distance is None else inlier_distance
        distance, partner = (np.asarray(a) for a in last.tree.query(moved, distance_upper_bound=reach))
        near = keep_pairs(distance, inlier_ratio, inlier_distance)
        step, _, is_determined = se3.umeyama(moved[near], last.points[partner[near]]) if len(near) else (T, 1.0, False)
        if not is_determined:
            return RegistrationResult(T_prior, source_points=len(source), converged=False, iterations=rounds)
        T = step @ T
        move, turn = se3.magnitude(step)
        if move < STEP_M and turn < STEP_RAD:
            converged = True
            break
    rmse = float(np.sqrt(np.mean(distance[near] ** 2))) if len(near) else 0.0
    return RegistrationResult(
        last.T_world_lidar @ se3.normalise(T),
        source_points=len(source),
        inliers=len(near),
        converged=converged,
        iterations=rounds,
        rmse=rmse,
    )


def keep_pairs(distance: Floats, inlier_ratio: float, inlier_distance: float | None) -> Longs:
    """Indices (ascending) of the inlier pairs by their distances (S,), m, infinite where a point has no partner."""
    near = np.flatnonzero(np.isfinite(distance))
    if inlier_distance is None and len(near):
        middle = float(np.median(distance[near]))
        spread = float(np.median(np.abs(distance[near] - middle)))
        near = near[distance[near] <= middle + X84 * max(spread, 1e-6)]
    count = int(np.ceil(inlier_ratio * len(near)))
    order = np.argsort(distance[near], kind="stable")[:count]
    return np.sort(near[order])
