"""Stationary detection from scans, before any registration."""

from __future__ import annotations

import numpy as np

from lslam.core.arrays import Floats
from lslam.core.config.input import PreprocessConfig
from lslam.core.config.odometry import RegistrationConfig
from lslam.core.geometry import se3
from lslam.core.types.scan import Scan
from lslam.core.types.scan_result import ScanResult
from lslam.core.types.state import Stateful
from lslam.registration.acceptance import Acceptance
from lslam.registration.alignment import solve
from lslam.registration.gaussian_map import GaussianMap
from lslam.registration.local_map import COARSE_FACTOR
from lslam.registration.optimiser import Annealing
from lslam.registration.preprocessing.prepare import PreparedPoints, prepare_points, small_room
from lslam.registration.residuals import PLANES_ALONE
from lslam.registration.result import RegistrationResult

# A scan that moved by less since the last registered one is stationary: several times the noise of a registration.
STANDING_M, STANDING_DEG = 0.02, 0.1
# Steps beyond these, m and deg, need no test of the next scan: it is not stationary.
SLOW_M, SLOW_DEG = 0.1, 1.0
# Least overlap and inlier share for a test.
MATCHED, AGREEING = 0.3, 0.7
LIMITS = Acceptance(MATCHED, AGREEING, needs_covariance=True, needs_all_directions=True)


class StationaryDetector(Stateful):
    """Tests scans against the last registered one, the reference.

    Rao's score test of the null hypothesis "no motion": one Gauss-Newton step of point to plane against the reference, for the
    scan and for the reference itself, whose common bias cancels. The reference stays while the sensor is stationary, so slow
    motion adds up until it is detected, and the pose error is bounded by the limits. A scan with an uncertain step or few
    inliers is not stationary.
    """

    STATE = ("_planes", "_T_own", "_last")

    def __init__(self, preprocess: PreprocessConfig, registration: RegistrationConfig) -> None:
        self._preprocess = preprocess
        self._config = registration
        self._limit_m, self._limit_rad = STANDING_M, float(np.deg2rad(STANDING_DEG))
        c = self._config
        # Of the reference, in voxels as coarse as those of a map's first scans: a ring is no plane.
        self._planes = GaussianMap(c.voxel_size * COARSE_FACTOR, reach=1.2 * preprocess.range_max)
        # The pose of its own points on them after one step; None: there is no reference.
        self._T_own: Floats | None = None
        self._last: ScanResult | None = None

    def result_of(self, scan: Scan) -> ScanResult | None:
        """The result of a stationary scan: pose and covariance of the reference; None when the sensor has moved."""
        if self._last is None or not self._is_stationary(scan):
            return None
        return ScanResult(
            scan.index,
            scan.stamp_ns,
            self._last.T_world_lidar.copy(),
            reason=f"standing since scan {self._last.index}",
            is_stationary=True,
            repeats_pose=True,
            covariance=self._last.covariance,
            registration_covariance=self._last.registration_covariance,
            points_covariance=self._last.points_covariance,
        )

    def observe(self, scan: Scan, result: ScanResult) -> None:
        """Make a registered scan the new reference if the sensor was slow; else there is none."""
        self._T_own = None
        if result.status != "ok":
            return
        before, self._last = self._last, result
        step = np.eye(4) if before is None else se3.relative(before.T_world_lidar, result.T_world_lidar)
        move, turn = se3.magnitude(step)
        if move < SLOW_M and np.rad2deg(turn) < SLOW_DEG:
            self._refer_to(scan)

    def warm_up(self) -> None:
        """Compile or load the kernels with a small room."""
        trial, scan = StationaryDetector(self._preprocess, self._config), Scan(small_room(), 0, 0)
        trial._refer_to(scan)
        trial._is_stationary(scan)

    def _refer_to(self, scan: Scan) -> None:
        """Make the scan the reference: planes of its points alone, and the pose at which it fits them itself."""
        points = prepare_points(scan.points, self._preprocess, scan.index)
        self._planes.clear()
        self._planes.insert(points.map_points, np.eye(4))
        self._T_own = self._step(points).T_world_lidar

    def _step(self, points: PreparedPoints) -> RegistrationResult:
        """One Gauss-Newton step of the points against the reference's planes, from the identity."""
        c = self._config
        once = Annealing.once(c.kernel_max)
        return solve((self._planes,), points, np.eye(4), once, c, residual=PLANES_ALONE)

    def _is_stationary(self, scan: Scan) -> bool:
        """Whether the scan lies on the reference within the limits, by one point-to-plane step with small covariance."""
        if self._T_own is None:
            return False
        result = self._step(prepare_points(scan.points, self._preprocess, scan.index))
        C = result.covariance
        if C is None or LIMITS.rejection(result) is not None:
            return False
        if np.trace(C[:3, :3]) > self._limit_m**2 or np.trace(C[3:, 3:]) > self._limit_rad**2:
            return False
        move, turn = se3.magnitude(se3.relative(self._T_own, result.T_world_lidar))
        return move < self._limit_m and turn < self._limit_rad
