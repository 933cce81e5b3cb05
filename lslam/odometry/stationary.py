"""Stationary detection from scans, before any registration."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lslam.core.config.input import PreprocessConfig
from lslam.core.config.odometry import RegistrationConfig
from lslam.core.geometry import se3, so3
from lslam.core.types.arrays import Floats
from lslam.core.types.scan import Scan
from lslam.core.types.scan_result import ScanResult
from lslam.core.types.state import State, Stateful
from lslam.registration.acceptance import Acceptance
from lslam.registration.gaussian_map import GaussianMap
from lslam.registration.preprocessing.prepare import PreparedPoints, prepare_points
from lslam.registration.robust import Annealing
from lslam.registration.solver import RegistrationResult, solve

# Steps beyond these, m and deg, need no test of the next scan: it is not stationary.
SLOW_M, SLOW_DEG = 0.1, 1.0
# Least overlap and inlier share for a test.
MATCHED, AGREEING = 0.3, 0.7
LIMITS = Acceptance(MATCHED, AGREEING, needs_covariance=True, needs_all_directions=True)


@dataclass(frozen=True)
class ReferenceScan:
    """The reference scan: its planes, and the pose of its own points on them after one step."""

    planes: GaussianMap
    T_own: Floats


class StationaryDetector(Stateful):
    """Tests scans against the last registered one, the reference.

    Rao's score test of the null hypothesis "no motion": one Gauss-Newton step of point to plane against the reference, for the
    scan and for the reference itself, whose common bias cancels. The reference stays while the sensor is stationary, so slow
    motion adds up until it is detected, and the pose error is bounded by the limits. A scan with an uncertain step or few
    inliers is not stationary.
    """

    def __init__(self, preprocess: PreprocessConfig, registration: RegistrationConfig) -> None:
        self._preprocess = preprocess
        self._config = registration.model_copy(update={"blob_weight": 0.0})
        self._limit_m, self._limit_rad = preprocess.standing_m, float(np.deg2rad(preprocess.standing_deg))
        self._reference: ReferenceScan | None = None
        self._last: ScanResult | None = None

    def result_of(self, scan: Scan) -> ScanResult | None:
        """The result of a stationary scan: pose and covariance of the reference; None when the sensor has moved."""
        if self._reference is None or self._last is None or not self._is_stationary(scan, self._reference):
            return None
        return ScanResult(
            scan.index, scan.stamp_ns, self._last.T_world_lidar.copy(),
            reason=f"standing since scan {self._last.index}", is_stationary=True, is_repeated=True,
            covariance=self._last.covariance, registration_covariance=self._last.registration_covariance,
            points_covariance=self._last.points_covariance,
        )  # fmt: skip

    def observe(self, scan: Scan, result: ScanResult) -> None:
        """Take a registered scan as the reference if the sensor was slow."""
        if result.status != "ok":
            self._reference = None
            return
        before, self._last = self._last, result
        step = np.eye(4) if before is None else se3.relative(before.T_world_lidar, result.T_world_lidar)
        turn = float(np.rad2deg(so3.angle(step[:3, :3])))
        is_slow = float(np.linalg.norm(step[:3, 3])) < SLOW_M and turn < SLOW_DEG
        self._reference = self._reference_of(scan) if is_slow else None

    def state(self) -> State:
        """What `restore` needs to go on from here."""
        reference = self._reference
        of_it = None if reference is None else {"planes": reference.planes.state(), "T_own": reference.T_own}
        return {"reference": of_it, "last": self._last}

    def restore(self, state: State) -> None:
        """Go on where `state` was taken."""
        of_it, self._last = state["reference"], state["last"]
        self._reference = None
        if of_it is not None:
            self._reference = ReferenceScan(self._new_planes(), of_it["T_own"])
            self._reference.planes.restore(of_it["planes"])

    def warm_up(self) -> None:
        """Compile or load the kernels with a small room."""
        room = np.random.default_rng(0).uniform(-8, 8, (3000, 3)).astype(np.float32)
        room[:, 2] = np.where(room[:, 2] > 0, 8.0, -8.0)
        scan = Scan(room, 0, 0)
        self._is_stationary(scan, self._reference_of(scan))

    def _reference_of(self, scan: Scan) -> ReferenceScan:
        """Planes of one scan alone. Its voxels are coarse, as those of a map's first scans: a ring is no plane."""
        planes = self._new_planes()
        points = prepare_points(scan.points, self._preprocess, scan.index)
        planes.insert(points.map_points, np.eye(4))
        return ReferenceScan(planes, self._step(points, planes).T_world_lidar)

    def _new_planes(self) -> GaussianMap:
        c = self._config
        return GaussianMap(
            c.voxel_size * c.coarse_factor, min_points=c.min_points, planarity=c.planarity, count_cap=c.count_cap,
            reach=1.2 * self._preprocess.range_max,
        )  # fmt: skip

    def _step(self, points: PreparedPoints, planes: GaussianMap) -> RegistrationResult:
        c = self._config
        once = Annealing(c.kernel_max, c.kernel_max, c.kernel_decay, 1)
        return solve((planes,), points, np.eye(4), once, c)

    def _is_stationary(self, scan: Scan, reference: ReferenceScan) -> bool:
        found = self._step(prepare_points(scan.points, self._preprocess, scan.index), reference.planes)
        C = found.covariance
        if C is None or LIMITS.rejection(found) is not None:
            return False
        if np.trace(C[:3, :3]) > self._limit_m**2 or np.trace(C[3:, 3:]) > self._limit_rad**2:
            return False
        moved = se3.relative(reference.T_own, found.T_world_lidar)
        return float(np.linalg.norm(moved[:3, 3])) < self._limit_m and float(so3.angle(moved[:3, :3])) < self._limit_rad
