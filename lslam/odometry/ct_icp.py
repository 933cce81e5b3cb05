"""Method `ct-icp`: elastic sweeps, registered in continuous time (Dellenbach et al. 2022)."""

from __future__ import annotations

import time
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from lslam.config.config import Config
from lslam.geometry import se3
from lslam.odometry.base import Registered
from lslam.odometry.icp import Icp
from lslam.odometry.scan_outcome import of_registration
from lslam.preprocessing.deskew import deskew
from lslam.preprocessing.prepare import PreparedPoints
from lslam.recovery.policies import policies_of
from lslam.registration.elastic import ElasticSweep, SweepPoints, register_elastic
from lslam.registration.registration import MIN_SOURCE_POINTS, NEAR_KERNEL, Registration
from lslam.registration.robust import Annealing
from lslam.registration.solver import RegistrationResult, result_of
from lslam.types.motion_prior import MotionPrior
from lslam.types.scan import Scan
from lslam.types.scan_result import ScanResult

Floats = NDArray[np.float64]


def create(config: Config) -> CtIcp:
    """The method as the configuration wants it: point to plane, on the local map of `icp`."""
    section = config.registration.model_copy(update={"residual": "plane"})
    return CtIcp(Registration(section, config.preprocess, policies_of(config.recovery)), is_felt=config.imu.use)


class CtIcp(Icp):
    """Two poses per scan; one where its points have no times, or as long as the speed is unknown.

    is_felt : an IMU predicts the motion within a sweep, which the constraints hold to and whose bend stays
    """

    deskew = "within the registration, between a pose at the sweep's begin and one at its end"
    STATE = (*Icp.STATE, "_last_ns", "_last")

    def __init__(self, registration: Registration, *, is_felt: bool = False) -> None:
        super().__init__(registration)
        self.is_felt = is_felt
        # Begin and end of the last sweep, ns, and the poses (2, 4, 4) there.
        self._last_ns = (0, 0)
        self._last: Floats | None = None

    def _align(self, scan: Scan, prepared: PreparedPoints, prior: MotionPrior, is_near: bool = False) -> Registered:
        registration = self.registration
        is_one_pose = prepared.source_times is None or len(prior.times) < 2
        if is_one_pose or len(registration.map) == 0 or len(prepared.source) < MIN_SOURCE_POINTS:
            return super()._align(scan, prepared, prior, is_near)
        began = time.perf_counter()
        expected = self._expected(scan.stamp_ns, prior)
        sweep, located = self._elastic(prepared, prior, expected, expected, is_near)
        if (registration.starting > 0 or not located.ok) and not is_near:
            sweep, located = self._recovered(scan, prepared, prior, expected, sweep, located)
        stages = {"register": time.perf_counter() - began}
        points = deskew(prepared, sweep.prior if located.ok else prior)
        result = of_registration(scan, located, self._uncertainty.map_age, stages)
        return Registered(result, (points, located), sweep.prior if located.ok else None)

    def _elastic(
        self, prepared: PreparedPoints, prior: MotionPrior, start: ElasticSweep, expected: ElasticSweep, is_near: bool
    ) -> tuple[ElasticSweep, RegistrationResult]:
        registration, c = self.registration, self.registration.config
        levels = registration.map.levels
        points = SweepPoints(prepared, levels, c.sigma, c.blob_weight)
        width = NEAR_KERNEL * c.kernel_min if is_near else registration.threshold.width
        annealing = Annealing(max(width, c.kernel_min), c.kernel_min, c.kernel_decay, c.max_iterations)
        found = register_elastic(points, start, expected, annealing, c.weak_share)
        result = result_of(found.found, prior.pose, len(prepared.source))
        return found.sweep, registration.judged(result, prior.pose)

    def _recovered(
        self, scan: Scan, prepared: PreparedPoints, prior: MotionPrior, expected: ElasticSweep, sweep: ElasticSweep,
        failed: RegistrationResult,
    ) -> tuple[ElasticSweep, RegistrationResult]:  # fmt: skip
        """The sweep from where the recovery policies find it as a whole, while the speed is unknown and after a failure."""
        found = self.registration.locate(deskew(prepared, prior), prior.pose)
        if not found.ok:
            return sweep, failed
        change = found.T_world_lidar @ se3.inverse(prior.pose)
        start = ElasticSweep.of(MotionPrior(prior.times, change @ prior.poses), is_bent=self.is_felt)
        sweep, located = self._elastic(prepared, prior, start, start, is_near=False)
        return sweep, replace(located, posed_by=found.posed_by, iterations=found.iterations + located.iterations)

    def _expected(self, stamp_ns: int, prior: MotionPrior) -> ElasticSweep:
        """Where the sweep lies if it follows the last one at the same velocity; by the prior where there is a better one.

        That is with an IMU, and where scans between are missing.
        """
        begin_ns, end_ns = (stamp_ns + round(1e9 * float(seconds)) for seconds in prior.times[[0, -1]])
        length, gap = self._last_ns[1] - self._last_ns[0], begin_ns - self._last_ns[1]
        if self.is_felt or self._last is None or abs(gap) > length / 2:
            return ElasticSweep.of(prior, is_bent=self.is_felt)
        twist = se3.log(se3.relative(*self._last)) / length
        begin, end = (self._last[1] @ se3.exp((ns - self._last_ns[1]) * twist) for ns in (begin_ns, end_ns))
        return ElasticSweep(se3.normalise(begin), se3.normalise(end), prior.times)

    def update(self, prior: MotionPrior, found: Registered) -> ScanResult:
        """Enter the scan into the local map, and its sweep as the last one."""
        result = super().update(prior, found)
        self._last = None
        if len(prior.times) > 1:
            change = result.T_world_lidar @ se3.inverse(prior.pose)
            self._last = np.asarray(change @ prior.poses[[0, -1]])
            begin_ns, end_ns = (result.stamp_ns + round(1e9 * float(seconds)) for seconds in prior.times[[0, -1]])
            self._last_ns = (begin_ns, end_ns)
        return result

    def restart(self) -> None:
        """An empty map, and no sweep before."""
        super().restart()
        self._last = None
