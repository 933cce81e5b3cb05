"""The IMU as a motion model: an error-state Kalman filter that predicts scans and sweeps, and is updated by registration."""

from __future__ import annotations

import logging
from dataclasses import replace
from typing import ClassVar

import numpy as np

from lslam.core.arrays import Floats
from lslam.core.config import Config
from lslam.core.geometry import se3
from lslam.core.kernels.linearisation import RARE_SIGMAS
from lslam.core.types.imu import GRAVITY, GravityDirection, ImuState, ImuStream
from lslam.core.types.motion_prior import MotionPrior
from lslam.core.types.scan import LEVER_M, Span
from lslam.core.types.state import Stateful
from lslam.odometry.inertial.constant_velocity import ConstantVelocity, middle_of
from lslam.odometry.inertial.gyroscope import Gyroscope
from lslam.odometry.inertial.imu_cleaning import IMU_GAP_S, covers, gaps
from lslam.odometry.inertial.imu_estimate import ImuEstimate, PredictionErrors
from lslam.odometry.inertial.initialise import InertialStart
from lslam.odometry.inertial.integrate import Increments
from lslam.odometry.kernels import kalman
from lslam.odometry.kernels.rotation import apart, vector_between
from lslam.registration.preprocessing.deskew import knots_over
from lslam.registration.result import RegistrationResult

log = logging.getLogger("lslam")


class InertialMotion(Stateful):
    """Predicts with the IMU where it has samples, and with constant velocity where it has none.

    opening : the initialised IMU: cleaned, on the clock of the scans, and the estimate at the first scan, in the LiDAR
        frame there
    """

    # One scan in so many is registered from constant velocity too, to tell what the IMU saves.
    COMPARISON_INTERVAL_SCANS = 20
    # Whether it has states for the device, the rotation of its extrinsics and its clock.
    HAS_DEVICE: ClassVar[bool] = True
    STATE: ClassVar[tuple[str, ...]] = (
        "estimate",
        "coasting",
        "refusal",
        "gap_scans",
        "_scans",
        "_has_gap",
        "_was_bridged",
        "_instant_ns",
        "_pose",
        "errors",
    )
    TRANSIENT: ClassVar[tuple[str, ...]] = ("_taught", "_increments", "_expected")

    def __init__(self, opening: InertialStart, config: Config) -> None:
        self.imu, self.T_lidar_imu, self.config = opening.imu, opening.T_lidar_imu, config.imu
        self.T_imu_lidar = se3.inverse(self.T_lidar_imu)
        self.estimate = self._opening = opening.estimate
        self.coasting = ConstantVelocity()
        self.refusal = ""
        self.gap_scans = 0
        self._scans = 0
        self._has_gap = False
        # Whether the IMU predicted the newest sweep.
        self.is_inertial = False
        # Whether the newest pose has no registration.
        self._was_bridged = False
        self._gaps = gaps(self.imu, IMU_GAP_S)
        self._instant_ns: int | None = None
        self._pose = np.eye(4)
        # From `weigh` at an instant, ns, for `correct`: the gyroscope, and the variance of the registered position, m2.
        self._taught: tuple[int, Gyroscope, Floats] | None = None
        # Until the next `correct`: what the IMU felt since the last scan, and where it expects the LiDAR at a stamp, ns.
        self._increments: Increments | None = None
        self._expected: tuple[int, Floats] | None = None
        self.errors = PredictionErrors()

    @property
    def _is_filter(self) -> bool:
        """Whether it estimates at all: the rules of Girolimetto take what they are given."""
        return self.config.velocity == "registration"

    @property
    def is_known(self) -> bool:
        """Whether there is a velocity: from the start on, unless the IMU is silent there."""
        return self.coasting.is_known or self.is_inertial

    def needs_comparison(self, stamp_ns: int, span: Span) -> bool:
        """Whether the scan to come is one of the sample that shows what constant velocity would have cost.

        Where constant velocity predicts it anyway, over a gap of the IMU, there is nothing to compare.
        """
        is_due = (
            self.coasting.is_known
            and self._scans % self.COMPARISON_INTERVAL_SCANS == self.COMPARISON_INTERVAL_SCANS - 1
        )
        return is_due and self._has_samples(stamp_ns, span)

    def sweep(self, stamp_ns: int, span: Span) -> MotionPrior:
        """Predicted poses over the `span` (s) of the sweep at `stamp_ns`, by the IMU, or constant velocity where it has a gap."""
        self.is_inertial = self._has_samples(stamp_ns, span)
        if not self.is_inertial:
            return self.coasting.sweep(stamp_ns, span)
        anchor_ns = stamp_ns if self._instant_ns is None else self._instant_ns
        prior = self._prior(self.estimate, anchor_ns, self._pose, stamp_ns, knots_over(span))
        self._expected = stamp_ns, prior.pose
        return prior

    def refine(self, prior: MotionPrior, stamp_ns: int, pose: Floats) -> MotionPrior:
        """Motion in the sweep again, by the state that `pose` (4, 4) implies, or constant velocity; if integrated, the prior."""
        middle, instant_ns = middle_of(prior, stamp_ns, pose)
        end_ns = stamp_ns + round(1e9 * float(prior.times[-1]))
        is_swept = len(prior.times) > 1
        if self.refusal or not is_swept or self._instant_ns is None or not self._covers(self._instant_ns, end_ns):
            return self.coasting.refine(prior, stamp_ns, pose)
        # A scan that begins a new map was taken by the one before already: it teaches nothing a second time.
        if self.config.velocity == "integrated" or instant_ns <= self._instant_ns:
            return prior
        return self._prior(self._correct_estimate(instant_ns, middle), instant_ns, middle, stamp_ns, prior.times)

    def fuse(self, stamp_ns: int, result: RegistrationResult, prior: MotionPrior) -> RegistrationResult:
        """Fuse the registered motion since the last scan with the IMU's, each weighted by its covariance.

        Where they contradict each other, the registration is kept, or the scan is bridged: `_reject`. After a gap nothing is
        fused: the scan before was deskewed without the IMU, and its error exceeds its covariance. prior : of the registration,
        the motion within the sweep
        """
        C, is_off = result.covariance, not (self.config.weigh and self._is_filter)
        if C is None or not result.is_accepted or is_off or self._has_gap:
            return result
        middle, instant_ns = middle_of(prior, stamp_ns, result.T_world_lidar)
        before = self._instant_ns
        if self.refusal or before is None or instant_ns <= before or not self._covers(before, instant_ns):
            return result
        e = self.estimate
        step = self._since_last(instant_ns)
        begin, end = self._pose @ self.T_lidar_imu, middle @ self.T_lidar_imu
        R_imu = begin[:3, :3] @ step.rotations[-1]
        moved, P = self._imu_motion(step)
        rest = np.concatenate([end[:3, 3] - begin[:3, 3] - moved, R_imu @ vector_between(R_imu, end[:3, :3])])
        gyroscope = e.calibrate(step, begin[:3, :3], end[:3, :3], C[3:, 3:])
        self._taught = instant_ns, gyroscope, C[:3, :3]
        if float(kalman.square(rest, P + 2 * C)) / (len(rest) * RARE_SIGMAS**2) > 1:
            return self._reject(stamp_ns, result, rest, P)
        # A pose that is wrong moves the map by one part in its age only, the scans before hold it: random errors of both
        # then add up to the least drift when those of the IMU count as many times.
        pose, covariance = kalman.fuse_poses(result.T_world_lidar, rest, C, P, result.map_age)
        return result.with_pose(pose, covariance)

    def _imu_motion(self, step: Increments) -> tuple[Floats, Floats]:
        """Displacement (3,), m, over `step` from the newest pose, and its covariance (6, 6) with the rotation, world axes."""
        R = (self._pose @ self.T_lidar_imu)[:3, :3]
        R_imu = R @ step.rotations[-1]
        moved, spread = self.estimate.displacement(step, R)
        P = np.zeros((6, 6))
        P[:3, :3], P[3:, 3:] = spread, R_imu @ self.estimate.gyroscope.turn_covariance(step) @ R_imu.T
        return moved, P

    def _reject(
        self, stamp_ns: int, result: RegistrationResult, rest: Floats, covariance: Floats
    ) -> RegistrationResult:
        """The outcome for a registration that contradicts the IMU by `rest` (6,), m and rad: constant velocity decides.

        If constant velocity is closer to the IMU's prediction, the scan is bridged: it enters the map at the IMU's pose with
        `covariance` (6, 6). Else the result is unchanged. Two scans in a row are never bridged, since a registration that repeats
        itself is right: the IMU may have been hit.
        """
        if self._was_bridged or not self.coasting.is_known or self._expected is None:
            return result
        steady, (expected_ns, expected) = self.coasting.predict(stamp_ns), self._expected
        if expected_ns != stamp_ns or apart(steady, expected, LEVER_M) >= apart(steady, result.T_world_lidar, LEVER_M):
            return result
        metres, degrees = float(np.linalg.norm(rest[:3])), float(np.rad2deg(np.linalg.norm(rest[3:])))
        reason = f"registration is {metres:.2f} m and {degrees:.1f} deg from what the IMU felt"
        return result.reject(reason, expected, covariance)

    def correct(
        self, stamp_ns: int, pose: Floats, prior: MotionPrior | None = None, has_registration: bool = True
    ) -> None:
        """Update the estimate by the pose (4, 4) at `stamp_ns`; `prior` is the motion within its sweep.

        Without a registration (`has_registration`) the state is only propagated; the world begins with the first registered scan.
        """
        if self._instant_ns is None and not has_registration:
            return
        middle, instant_ns = (pose, stamp_ns) if prior is None else middle_of(prior, stamp_ns, pose)
        if not self.refusal:
            is_behind_gap = self._has_gap
            self._has_gap = self._instant_ns is not None and not self._covers(self._instant_ns, instant_ns)
            self.gap_scans += self._has_gap
            if self._has_gap or is_behind_gap:
                self._restart(instant_ns, middle)
            elif self._instant_ns is not None and instant_ns > self._instant_ns:
                if has_registration:
                    self._judge(stamp_ns, pose)
                    self.estimate = self._correct_estimate(instant_ns, middle)
                else:
                    self.estimate = self._propagate(instant_ns)
            elif self._instant_ns is None:
                self.estimate = self._estimate_at(stamp_ns, instant_ns)
        self.coasting.correct(instant_ns, middle)
        self._instant_ns, self._pose = instant_ns, middle.copy()
        self._was_bridged = not has_registration
        self._taught = self._increments = self._expected = None
        self._scans += 1

    def gravity_at(self, pose: Floats) -> GravityDirection | None:
        """Direction of gravity in the axes of a LiDAR at `pose` (4, 4), as of the last scan; None where it is unknown.

        The filter knows gravity in a world that registration lets drift; a LiDAR that turned with it sees the true one.
        """
        if self.refusal or self._has_gap or self._instant_ns is None or not self._is_filter:
            return None
        direction, sigma = self.estimate.down
        return GravityDirection(pose[:3, :3].T @ direction, sigma)

    def imu_state(self) -> ImuState | None:
        """Errors of the IMU as the filter estimates them after the last scan; None once the IMU is refused."""
        return None if self.refusal else self.estimate.summary

    def rewind(self, stamp_ns: int, pose: Floats, span: Span) -> MotionPrior:
        """Forget all scans but the first, taken at `stamp_ns` and `pose` (4, 4); returns its motion within the sweep.

        It is needed only for an IMU that begins after the first scan: otherwise the speed is known from the start.
        """
        prior = self.coasting.rewind(stamp_ns, pose, span)
        self._pose, self._instant_ns = middle_of(prior, stamp_ns, pose)
        # What the second scan taught, it teaches again when it is registered on the first as that is now.
        self.estimate = self._opening
        self.estimate = self._estimate_at(stamp_ns, self._instant_ns)
        self.gap_scans, self._scans, self._has_gap = 0, 1, False
        return prior

    def turn(self, begin_ns: int, end_ns: int) -> Floats | None:
        """Rotation (3, 3) of the LiDAR from one instant to the other by the gyroscope; None over a gap or when refused."""
        if self.refusal or not self._covers(begin_ns, end_ns):
            return None
        R_lidar_imu = self.T_lidar_imu[:3, :3]
        rotation = self.estimate.over(self.imu, np.array([begin_ns, end_ns])).rotations[-1]
        return np.asarray(R_lidar_imu @ rotation @ R_lidar_imu.T)

    def _prior(
        self, estimate: ImuEstimate, anchor_ns: int, anchor: Floats, stamp_ns: int, times: Floats
    ) -> MotionPrior:
        """Poses of the LiDAR at `times` (K,), s from the stamp, by the IMU from its pose `anchor` (4, 4) at `anchor_ns`."""
        instants = stamp_ns + np.round(1e9 * times).astype(np.int64)
        k = int(np.searchsorted(instants, anchor_ns))
        step = estimate.over(self.imu, np.concatenate([instants[:k], [anchor_ns], instants[k:]]))
        poses = step.poses(k, anchor @ self.T_lidar_imu, estimate.velocity, estimate.gravity, self.T_imu_lidar)
        return MotionPrior(times, np.concatenate([poses[:k], poses[k + 1 :]]), has_imu_motion=True)

    def _correct_estimate(self, instant_ns: int, middle: Floats) -> ImuEstimate:
        """The estimate at `instant_ns`, where the registered pose of the LiDAR is `middle` (4, 4)."""
        if self.config.velocity == "integrated":
            return self._propagate(instant_ns)
        if self.config.velocity == "along-x":
            return self._level_along_x(instant_ns, middle)
        a, b = self._pose @ self.T_lidar_imu, middle @ self.T_lidar_imu
        step = self._since_last(instant_ns)
        if self._taught is not None and self._taught[0] == instant_ns:
            _, gyroscope, noise = self._taught
        else:
            gyroscope, noise = self.estimate.calibrate(step, a[:3, :3], b[:3, :3]), None
        return self.estimate.correct(self.imu, step, a[:3, :3], b[:3, :3], b[:3, 3] - a[:3, 3], gyroscope, noise)

    def _level_along_x(self, instant_ns: int, middle: Floats) -> ImuEstimate:
        """The estimate with the velocity along the LiDAR's x axis, and gravity along its z axis, for a start without motion.

        The speed is the distance from the last scan's pose to `middle` (4, 4) over the time between.
        """
        assert self._instant_ns is not None
        way = float(np.linalg.norm(middle[:3, 3] - self._pose[:3, 3]))
        speed = way / (1e-9 * (instant_ns - self._instant_ns))
        return replace(self.estimate, velocity=speed * middle[:3, 0], gravity=-GRAVITY * middle[:3, 2])

    def _propagate(self, instant_ns: int) -> ImuEstimate:
        """The estimate at `instant_ns`, by the IMU alone since the last scan."""
        return self.estimate.propagate(self._since_last(instant_ns), (self._pose @ self.T_lidar_imu)[:3, :3])

    def _since_last(self, instant_ns: int) -> Increments:
        """Motion measured by the IMU since the last scan, integrated once until the next `correct`."""
        assert self._instant_ns is not None
        if self._increments is None or self._increments.instants_ns[-1] != instant_ns:
            self._increments = self.estimate.over(self.imu, np.array([self._instant_ns, instant_ns]))
        return self._increments

    def _estimate_at(self, stamp_ns: int, instant_ns: int) -> ImuEstimate:
        """The estimate at the first scan's stamp at the middle of its sweep."""
        if instant_ns <= stamp_ns or not self._covers(stamp_ns, instant_ns):
            return self.estimate
        step = self.estimate.over(self.imu, np.array([stamp_ns, instant_ns]))
        return self.estimate.propagate(step, self.T_lidar_imu[:3, :3])

    def _restart(self, instant_ns: int, middle: Floats) -> None:
        """Reset the velocity, after a gap and one scan later, to that of registration, with a large covariance."""
        assert self._instant_ns is not None
        moved = (middle @ self.T_lidar_imu)[:3, 3] - (self._pose @ self.T_lidar_imu)[:3, 3]
        covariance = self.estimate.covariance.copy()
        covariance[:3, :] = covariance[:, :3] = 0.0
        covariance[:3, :3] = np.eye(3)
        e = self.estimate
        seconds = max(1e-9 * (instant_ns - self._instant_ns), 1e-3)
        self.estimate = ImuEstimate(moved / seconds, e.gravity, e.accel_bias, e.gyroscope, covariance)

    def _judge(self, stamp_ns: int, pose: Floats) -> None:
        """Refuse the IMU (`refusal`) if it predicts scans clearly worse than constant velocity does."""
        assert self._instant_ns is not None
        if not self.coasting.is_known:
            return
        if self._expected is not None and self._expected[0] == stamp_ns:
            mine = self._expected[1]
        else:
            mine = self._prior(self.estimate, self._instant_ns, self._pose, stamp_ns, np.zeros(1)).pose
        steady = self.coasting.predict(stamp_ns)
        worse = self.errors.observe(float(apart(mine, pose, LEVER_M)), float(apart(steady, pose, LEVER_M)))
        if worse is not None and self._is_filter:
            self.refusal = (
                f"it predicts scans {worse[0]:.3f} m wrong where constant velocity is {worse[1]:.3f} m wrong (turns counted at "
                f"{LEVER_M:.0f} m): check its axes, T_lidar_imu and its stamps"
            )
            log.warning("the IMU is refused from here on: %s", self.refusal)

    def _has_samples(self, stamp_ns: int, span: Span) -> bool:
        """Whether the IMU, unless rejected, has samples from the newest pose, or the sweep's begin, to the sweep's end."""
        begin_ns, end_ns = (stamp_ns + round(1e9 * seconds) for seconds in span)
        if self._instant_ns is not None:
            begin_ns = min(begin_ns, self._instant_ns)
        return not self.refusal and self._covers(begin_ns, end_ns)

    def _covers(self, begin_ns: int, end_ns: int) -> bool:
        """Whether there are samples without a gap from one instant to the other."""
        return covers(self._gaps, begin_ns, end_ns)


def warm_up() -> None:
    """Compile or load the kernels of `InertialMotion` by three scans of a stationary sensor."""
    none = np.zeros(3)
    imu = ImuStream(
        np.arange(60, dtype=np.int64) * 10_000_000, np.tile([0.0, 0.0, GRAVITY], (60, 1)), np.zeros((60, 3))
    )
    estimate = ImuEstimate(none, np.array([0.0, 0.0, -GRAVITY]), none, Gyroscope.of_bias(none, 0.01), 1e-2 * np.eye(9))
    motion = InertialMotion(InertialStart(imu, np.eye(4), estimate), Config())
    for k in range(3):
        stamp_ns = 100_000_000 * k
        prior = motion.sweep(stamp_ns, Span(0.0, 0.1))
        prior = motion.refine(prior, stamp_ns, prior.pose)
        result = RegistrationResult(prior.pose, covariance=1e-4 * np.eye(6))
        motion.correct(stamp_ns, motion.fuse(stamp_ns, result, prior).T_world_lidar, prior)
