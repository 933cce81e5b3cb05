"""Method `ct-icp`: elastic sweeps, registered in continuous time (Dellenbach et al. 2022)."""

from __future__ import annotations

import time

from lslam.config.config import Config
from lslam.odometry.base import Registered
from lslam.odometry.elastic import ElasticResult, SweepPoints, register_elastic
from lslam.odometry.elastic_constraints import ElasticConstraints, LastSweep
from lslam.odometry.icp import Icp
from lslam.odometry.scan_outcome import of_registration
from lslam.preprocessing.deskew import deskew
from lslam.preprocessing.prepare import PreparedPoints
from lslam.recovery.policies import policies_of
from lslam.registration.registration import MIN_SOURCE_POINTS, NEAR_KERNEL, Registration
from lslam.registration.robust import Annealing
from lslam.registration.solver import RegistrationResult, result_of
from lslam.types.motion_prior import MotionPrior
from lslam.types.scan import Scan
from lslam.types.scan_result import ScanResult


def create(config: Config) -> CtIcp:
    """The method as the configuration wants it: point to plane, on the local map of `icp`."""
    section = config.registration.model_copy(update={"residual": "plane"})
    return CtIcp(Registration(section, config.preprocess, policies_of(config.recovery)))


class CtIcp(Icp):
    """Two poses per scan; one where its points have no times, or as long as the speed is unknown.

    Where an IMU felt the motion within the sweep the constraints hold to that, and its bend stays.
    """

    deskew = "within the registration, between a pose at the sweep's begin and one at its end"
    STATE = (*Icp.STATE, "_last")

    def __init__(self, registration: Registration) -> None:
        super().__init__(registration)
        self._last = LastSweep()

    def _align(self, scan: Scan, prepared: PreparedPoints, prior: MotionPrior, is_near: bool = False) -> Registered:
        registration = self.registration
        is_one_pose = prepared.source_times is None or len(prior.times) < 2
        if is_one_pose or len(registration.map) == 0 or len(prepared.source) < MIN_SOURCE_POINTS:
            return super()._align(scan, prepared, prior, is_near)
        began = time.perf_counter()
        constraints = self._last.constraints(scan.stamp_ns, prior)
        found, located = self._elastic(prepared, prior, constraints, is_near)
        sweep = found.sweep.prior if located.ok else None
        points = deskew(prepared, sweep or prior)
        stages = {"register": time.perf_counter() - began}
        result = of_registration(scan, located, self._uncertainty.map_age, stages)
        return Registered(result, (points, located, prior, found), sweep)

    def _elastic(
        self, prepared: PreparedPoints, prior: MotionPrior, constraints: ElasticConstraints, is_near: bool
    ) -> tuple[ElasticResult, RegistrationResult]:
        registration, c = self.registration, self.registration.config
        width = NEAR_KERNEL * c.kernel_min if is_near else registration.threshold.width
        points = SweepPoints(prepared, registration.map.levels, c.sigma, c.blob_weight)
        annealing = Annealing(max(width, c.kernel_min), c.kernel_min, c.kernel_decay, c.max_iterations)
        found = register_elastic(points, constraints.expected, constraints, annealing, c.weak_share)
        return found, registration.judged(result_of(found.found, prior.pose, len(prepared.source)), prior.pose)

    def update(self, prior: MotionPrior, found: Registered) -> ScanResult:
        """Enter the scan into the local map, and its sweep as the last one."""
        result = super().update(prior, found)
        if found.sweep is None or result.status != "ok":
            self._last.forget()
        else:
            _, _, expected, elastic = found.detail
            # Its mean age is half the number of scans that the map is made of.
            share = 0.5 / self._uncertainty.map_age
            pose, facts = result.T_world_lidar, (elastic.skew, elastic.covariance, share)
            self._last.follow(result.stamp_ns, pose, found.sweep, expected, *facts)
        return result

    def restart(self) -> None:
        """An empty map, and no sweep before."""
        super().restart()
        self._last = LastSweep()
