"""Method `lio-mapping`: a sliding window of scans and IMU states in one joint estimate (Ye, Chen and Liu 2019)."""

from __future__ import annotations

from collections.abc import Mapping

from lslam.core.arrays import Floats
from lslam.core.config.config import Config
from lslam.core.config.odometry import rest_alone
from lslam.core.types.motion_prior import MotionPrior
from lslam.core.types.scan_result import ScanEquations
from lslam.odometry.fast_lio import FastLio2
from lslam.odometry.icp import registration_of
from lslam.odometry.inertial.filter import warm_up_solver
from lslam.odometry.inertial.window import WINDOW_SCANS, WindowMotion
from lslam.registration.optimiser import KERNEL_MIN_M, normal_equations
from lslam.registration.preprocessing.prepare import PreparedPoints
from lslam.registration.registration import Registration
from lslam.registration.result import RegistrationResult


def create(config: Config) -> LioMapping:
    """Create the method from the configuration: point to plane, without recovery policies."""
    return LioMapping(registration_of(config, recovery=rest_alone(config.recovery)), WINDOW_SCANS - 1)


create_motion = WindowMotion


class LioMapping(FastLio2):
    """Registers a scan with the window's prediction in one estimate, and linearises its points at the result.

    The joint estimate is the motion model's (`lslam.odometry.inertial.window`), the map is of the scans that left it: each enters
    when it is `lag` scans old, at the last pose of the window, and is never compared with a map that contains it.
    """

    deskew = "by the prediction of the window"
    STATE = (*FastLio2.STATE, "pending")

    def __init__(self, registration: Registration, lag: int) -> None:
        super().__init__(registration)
        self.lag = lag
        # Scans that are not in the map yet, the earliest first: stamp, points, pose, and whether the sensor was at rest.
        self.pending: tuple[tuple[int, PreparedPoints, Floats, bool], ...] = ()
        # The scan that is being registered.
        self._offered: dict[int, PreparedPoints] = {}

    @property
    def map_age(self) -> float:
        """Mean age, in scans, of the points of the map, which begins where the window ends."""
        return super().map_age + len(self.pending)

    def equations(self, stamp_ns: int, result: RegistrationResult) -> tuple[ScanEquations, ...]:
        """Normal equations of a scan that was just registered; empty where that failed."""
        self._offered = {}
        if not result.ok or len(self.registration.map) == 0:
            return ()
        self._offered = {stamp_ns: result.points}
        return (self._at(stamp_ns, result.points, result.T_world_lidar),)

    def equations_at(self, poses: Mapping[int, Floats]) -> tuple[ScanEquations, ...]:
        """Normal equations of the queued scans at other poses (4, 4), by stamp; scans that are in the map already have none."""
        by_stamp = self._offered | {stamp_ns: points for stamp_ns, points, *_ in self.pending}
        return tuple(self._at(stamp_ns, by_stamp[stamp_ns], T) for stamp_ns, T in poses.items() if stamp_ns in by_stamp)

    def _at(self, stamp_ns: int, points: PreparedPoints, T: Floats) -> ScanEquations:
        """Normal equations of the points of a scan at its pose T (4, 4), weighted as in the last step of registration."""
        target, width = self.registration.target, KERNEL_MIN_M
        problem = target.problem(points, T, width, 1)
        return ScanEquations(stamp_ns, T, *normal_equations(problem.terms, T, width, problem.matches))

    def insert(self, stamp_ns: int, prior: MotionPrior, result: RegistrationResult) -> RegistrationResult:
        """Queue the scan for the map; it enters at once while the map has few scans or the window is not running."""
        if not result.ok or prior.covariance is None or self.registration.history.is_young:
            return self.registration.update(result)
        result = self.registration.rest_detector.judge(result)
        self.registration.history.observe(result)
        self.pending = (*self.pending, (stamp_ns, result.points, result.T_world_lidar, result.is_stationary))
        return result

    def finalise(self, poses: Mapping[int, Floats]) -> None:
        """Set the queued scans to the window's poses (4, 4), by stamp; those old enough, or no longer in it, enter the map."""
        waiting = [(stamp_ns, points, poses.get(stamp_ns, T), rests) for stamp_ns, points, T, rests in self.pending]
        due = [k < len(waiting) - self.lag or one[0] not in poses for k, one in enumerate(waiting)]
        for (_, points, T, rests), is_due in zip(waiting, due, strict=True):
            if is_due:
                self.registration.enter(RegistrationResult(T, points=points, is_stationary=rests))
        self.pending = tuple(one for one, is_due in zip(waiting, due, strict=True) if not is_due)

    def warm_up(self) -> None:
        """Compile kernels as `icp` does, and those of a small window, which the motion model solves."""
        super().warm_up()
        warm_up_solver()

    def restart(self) -> None:
        """Begin again with an empty map and no queued scans."""
        super().restart()
        self.pending, self._offered = (), {}
