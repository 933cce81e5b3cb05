"""Method `ct-icp`: elastic sweeps, registered in continuous time (Dellenbach et al. 2022)."""

from __future__ import annotations

from lslam.core.config.config import Config
from lslam.core.types.motion_prior import MotionPrior
from lslam.core.types.scan import Scan
from lslam.core.types.scan_result import ScanResult
from lslam.odometry.elastic_constraints import LastSweep
from lslam.odometry.icp import Icp, registration_of
from lslam.registration.preprocessing.prepare import PreparedPoints
from lslam.registration.registration import Registration
from lslam.registration.result import RegistrationResult


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
        if not self.is_elastic(prepared, prior):
            return super().register(scan, prepared, prior, is_near)
        return self.register_sweep(prepared, self._last.constraints(scan.stamp_ns, prior), prior, is_near)

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
