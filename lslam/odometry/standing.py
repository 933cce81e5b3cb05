"""Whether the sensor still stands where it stood, told from the scan and before any registration."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lslam.config.preprocess import PreprocessConfig
from lslam.config.registration import RegistrationConfig
from lslam.geometry import se3, so3
from lslam.preprocessing.prepare import PreparedPoints, prepare_points
from lslam.registration.gaussian_map import GaussianMap
from lslam.registration.robust import Annealing
from lslam.registration.solver import RegistrationResult, solve
from lslam.types.scan import Scan
from lslam.types.scan_result import ScanResult
from lslam.types.state import State, Stateful

Floats = NDArray[np.float64]

# Nothing is asked after a step beyond these, m and deg: what moves so fast between two scans does not stand in the next.
SLOW_M, SLOW_DEG = 0.1, 1.0
# Shares of the points that must find a surface, and lie on it, for the scan to have a say.
MATCHED, AGREEING = 0.3, 0.7


@dataclass(frozen=True)
class ReferenceScan:
    """The scan that others are compared with: its planes, and where one step puts its own points on them."""

    planes: GaussianMap
    T_own: Floats


class Standing(Stateful):
    """Compares scans with the last one that was registered, its reference.

    Rao's score test in the words of registration: one Gauss-Newton step of point to plane against the reference, from
    "nothing moved", is taken for the scan and was taken for the reference itself; while the sensor stands both have the
    same pattern and end in the same place. The reference stays while the sensor stands, so slow creeping adds up until it
    is seen, and a pose is wrong by the limits at most. A scan that cannot tell, because its step is uncertain or few of
    its points lie on surfaces, does not stand.
    """

    def __init__(self, preprocess: PreprocessConfig, registration: RegistrationConfig) -> None:
        self._preprocess, self._config = preprocess, registration
        self._limit_m, self._limit_rad = preprocess.standing_m, float(np.deg2rad(preprocess.standing_deg))
        self._reference: ReferenceScan | None = None
        self._last: ScanResult | None = None

    def result_of(self, scan: Scan) -> ScanResult | None:
        """The result of a scan whose sensor stands: pose and covariance of the reference; None when it has moved."""
        if self._reference is None or self._last is None or not self._stands(scan, self._reference):
            return None
        return ScanResult(
            scan.index, scan.stamp_ns, self._last.T_world_lidar.copy(),
            reason=f"standing since scan {self._last.index}", is_standing=True,
            covariance=self._last.covariance, registration_covariance=self._last.registration_covariance,
        )  # fmt: skip

    def observe(self, scan: Scan, result: ScanResult) -> None:
        """Take a scan that went through registration as the reference, if the sensor was slow enough to stand soon."""
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
        self._stands(scan, self._reference_of(scan))

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
        return solve(planes, points, np.eye(4), once, sigma=c.sigma, blob_weight=0.0, weak_share=c.weak_share)

    def _stands(self, scan: Scan, reference: ReferenceScan) -> bool:
        found = self._step(prepare_points(scan.points, self._preprocess, scan.index), reference.planes)
        C = found.covariance
        if C is None or found.overlap < MATCHED or found.inlier_share < AGREEING or len(found.degenerate):
            return False
        if np.trace(C[:3, :3]) > self._limit_m**2 or np.trace(C[3:, 3:]) > self._limit_rad**2:
            return False
        moved = se3.relative(reference.T_own, found.T_world_lidar)
        return float(np.linalg.norm(moved[:3, 3])) < self._limit_m and float(so3.angle(moved[:3, :3])) < self._limit_rad
