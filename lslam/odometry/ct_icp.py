"""Method `ct-icp`: elastic sweeps, registered in continuous time (Dellenbach et al. 2022)."""

from __future__ import annotations

import time
from dataclasses import replace

from lslam.config.config import Config
from lslam.odometry.elastic import SweepPoints, register_elastic
from lslam.odometry.elastic_constraints import LastSweep
from lslam.odometry.icp import Icp, registration_of
from lslam.preprocessing.deskew import deskew
from lslam.preprocessing.prepare import PreparedPoints
from lslam.registration.registration import Registration
from lslam.registration.robust import Annealing
from lslam.registration.solver import RegistrationResult, result_of
from lslam.registration.voxel_target import MIN_SOURCE_POINTS
from lslam.types.motion_prior import MotionPrior
from lslam.types.scan import Scan
from lslam.types.scan_result import ScanResult


def create(config: Config) -> CtIcp:
    """The method as the configuration wants it: point to plane, on the local map of `icp`."""
    return CtIcp(registration_of(config))


class CtIcp(Icp):
    """Two poses per scan; one where its points have no times, or as long as the speed is unknown.

    Where an IMU felt the motion within the sweep the constraints hold to that, and its bend stays.
    """

    deskew = "within the registration, between a pose at the sweep's begin and one at its end"
    STATE = (*Icp.STATE, "_last")

    def __init__(self, registration: Registration) -> None:
        super().__init__(registration)
        self._last = LastSweep()

    def register(
        self, scan: Scan, prepared: PreparedPoints, prior: MotionPrior, is_near: bool = False
    ) -> RegistrationResult:
        """Both poses of the sweep."""
        is_one_pose = prepared.source_times is None or len(prior.times) < 2
        if is_one_pose or len(self.registration.map) == 0 or len(prepared.source) < MIN_SOURCE_POINTS:
            return super().register(scan, prepared, prior, is_near)
        began, registration = time.perf_counter(), self.registration
        attempt, c = registration.attempt(prepared, prior.pose, is_near), registration.config
        constraints = self._last.constraints(scan.stamp_ns, prior)
        points = SweepPoints(prepared, registration.map.levels, c.sigma, c.blob_weight)
        width = max(attempt.annealing.start, c.kernel_min)
        annealing = Annealing(width, c.kernel_min, c.kernel_decay, c.max_iterations)
        elastic = register_elastic(points, constraints.expected, constraints, annealing, c.weak_share)
        result = attempt.judged(result_of(elastic.found, prior.pose, len(prepared.source)))
        sweep = elastic.sweep.prior if result.ok else None
        return replace(
            result, points=deskew(prepared, sweep or prior), detail=(prior, elastic), sweep=sweep, map_age=self.map_age,
            stages={"register": time.perf_counter() - began},
        )  # fmt: skip

    def update(self, scan: Scan, prior: MotionPrior, result: RegistrationResult) -> ScanResult:
        """Enter the scan into the local map, and its sweep as the last one."""
        record = super().update(scan, prior, result)
        if result.sweep is None or not result.is_accepted:
            self._last.forget()
        else:
            expected, elastic = result.detail
            # Its mean age is half the number of scans that the map is made of.
            facts = elastic.skew, elastic.covariance, 0.5 / self._uncertainty.map_age
            self._last.follow(scan.stamp_ns, result.T_world_lidar, result.sweep, expected, *facts)
        return record

    def restart(self) -> None:
        """An empty map, and no sweep before."""
        super().restart()
        self._last = LastSweep()
