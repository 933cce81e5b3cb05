"""Method `ct-icp`: elastic sweeps, registered in continuous time (Dellenbach et al. 2022)."""

from __future__ import annotations

import math

import numpy as np

from lslam.core.arrays import Floats
from lslam.core.config.config import Config
from lslam.core.geometry import noise, se3
from lslam.core.types.motion_prior import MotionPrior
from lslam.core.types.scan import Scan
from lslam.core.types.scan_result import ScanResult
from lslam.core.types.state import Stateful
from lslam.odometry.elastic import LEAST_SKEW, NOTHING, ElasticConstraints, ElasticSweep, inverse
from lslam.odometry.icp import Icp, registration_of
from lslam.odometry.inertial.constant_velocity import USUAL_ACCELERATION, middle_of
from lslam.registration.preprocessing.prepare import PreparedPoints
from lslam.registration.registration import Registration
from lslam.registration.result import RegistrationResult

# Of the covariance of a change of motion, what stays from scan to scan: a memory of five.
FORGETTING_FACTOR = 0.8
# m and rad, a change that registration cannot tell from none.
LEAST_CHANGE = 1e-3
# With an acceleration a of its own in each sweep of T seconds, lines fitted to neighbouring ones miss each other by
# (a2 - a1) T^2 / 12, the velocity of a line is ahead of that between their middles by (a1 + 2 a2) T^2 / 6, and the change of
# motion that is measured is (a0 + 4 a1 + a2) T^2 / 6: rms of the first two by that of the third.
MISS_RATIO = 1.0 / 6.0
LAG_RATIO = math.sqrt(10.0) / 6.0


def create(config: Config) -> CtIcp:
    """Create the method from the configuration: point to plane, on the local map of `icp`."""
    return CtIcp(registration_of(config))


class CtIcp(Icp):
    """Two poses per scan; one where its points have no times, or as long as the speed is unknown.

    Where an IMU measured the motion within the sweep, the constraints refer to that, so that its curvature remains.
    """

    deskew = "within the registration, between a pose at the sweep's begin and one at its end"
    STATE = (*Icp.STATE, "_last")

    def __init__(self, registration: Registration) -> None:
        super().__init__(registration)
        self._last = LastSweep()

    def register(
        self, scan: Scan, prepared: PreparedPoints, prior: MotionPrior, is_near: bool = False
    ) -> RegistrationResult:
        """Register the scan with the poses at the begin and the end of its sweep as unknowns.

        With one pose instead while the speed is unknown, and for points without times. `is_near` as for `Registration.locate`.
        """
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
        """Begin again with an empty map and without an earlier sweep."""
        super().restart()
        self._last = LastSweep()


class LastSweep(Stateful):
    """Stores the last sweep, its covariance, and how much the motion recently changed from scan to scan."""

    STATE = ("_ends_ns", "_ends", "_covariance", "_change", "_skew", "_skewed")

    def __init__(self) -> None:
        # Begin and end, ns, the poses (2, 4, 4) there, and their covariance (12, 12), world axes.
        self._ends_ns = (0, 0)
        self._ends: Floats | None = None
        self._covariance: Floats | None = None
        # (6, 6) mean square of what registration corrected the prior by at the middle of a sweep, LiDAR axes.
        self._change: Floats | None = None
        # (6,) and covariance (6, 6), world axes, of the map's skew.
        self._skew = np.zeros(6)
        self._skewed: Floats | None = None

    def constraints(self, stamp_ns: int, prior: MotionPrior) -> ElasticConstraints:
        """Constraints on the sweep of the scan at `stamp_ns`: it continues the last at its velocity, or as an IMU measured.

        Where scans are missing in between, the prior defines its begin.
        """
        begin_ns, end_ns = _ends_ns(stamp_ns, prior)
        Q = noise.rotate(self._change_over(prior.span_s), prior.pose[:3, :3])
        # The first sweep has the velocity at its end.
        M = Q if self._skewed is None else self._skewed
        expected, P = ElasticSweep.of(prior), self._covariance
        length = self._ends_ns[1] - self._ends_ns[0]
        location, since = NOTHING, 0.0
        if self._ends is not None and P is not None and abs(begin_ns - self._ends_ns[1]) < length / 2:
            location, since = inverse(MISS_RATIO**2 * Q + P[6:, 6:]), 1.0
            if not prior.is_bent:
                twist = se3.log(se3.relative(*self._ends)) / length
                begin, end = (self._ends[1] @ se3.exp((ns - self._ends_ns[1]) * twist) for ns in (begin_ns, end_ns))
                expected = ElasticSweep(se3.normalise(begin), se3.normalise(end), prior.times)
        velocity, skew_information = inverse(LAG_RATIO**2 * Q), inverse(M + LEAST_SKEW**2 * np.eye(6))
        return ElasticConstraints(expected, location, velocity, since, self._skew, skew_information)

    def follow(
        self,
        stamp_ns: int,
        pose: Floats,
        sweep: MotionPrior,
        prior: MotionPrior,
        skew: Floats,
        covariance: Floats,
        share: float,
    ) -> None:
        """Store the registered `sweep`, its `prior`, and its pose (4, 4) at the stamp.

        skew, covariance : of `ElasticResult`; share : of the map that this scan contributes
        """
        self._ends_ns = _ends_ns(stamp_ns, sweep)
        self._ends = np.asarray(pose @ se3.relative(sweep.pose, sweep.poses[[0, -1]]))
        self._covariance = covariance[:12, :12]
        L = np.kron((-share, share, 1.0 - share), np.eye(6))
        self._skew, self._skewed = (1.0 - share) * skew, L @ covariance @ L.T
        middle, expected = middle_of(sweep, stamp_ns, pose)[0], middle_of(prior, stamp_ns, prior.pose)[0]
        change = se3.log(se3.relative(expected, middle))
        Q = self._change_over(prior.span_s)
        self._change = FORGETTING_FACTOR * Q + (1.0 - FORGETTING_FACTOR) * np.outer(change, change)

    def forget(self) -> None:
        """Drop the last sweep: its scan has none, or a wrong one."""
        self._ends = self._covariance = None

    def _change_over(self, span_s: float) -> Floats:
        """(6, 6) covariance, LiDAR axes, of the change of motion from one sweep to the next."""
        usual = np.diag((USUAL_ACCELERATION * span_s**2) ** 2) if self._change is None else self._change
        return np.asarray(usual + LEAST_CHANGE**2 * np.eye(6))


def _ends_ns(stamp_ns: int, sweep: MotionPrior) -> tuple[int, int]:
    """Begin and end of a sweep, ns."""
    return stamp_ns + round(1e9 * float(sweep.times[0])), stamp_ns + round(1e9 * float(sweep.times[-1]))
