"""A smoother of poses and IMU as a motion model: its newest state predicts the next scan and deskews it (LIO-SAM)."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from itertools import pairwise
from typing import ClassVar

import numpy as np

from lslam.backend.graph.inertial_smoother import InertialSmoother
from lslam.core.arrays import Floats
from lslam.core.config import Config
from lslam.core.errors import GraphError
from lslam.core.geometry import noise, se3
from lslam.core.types.imu import InertialChain, InertialLink, InertialState, InertialStep, SmootherNoise
from lslam.core.types.motion_prior import MotionPrior
from lslam.core.types.scan import Span
from lslam.odometry.inertial.constant_velocity import middle_of
from lslam.odometry.inertial.filter import BEGIN_SIGMA
from lslam.odometry.inertial.fusion import InertialMotion
from lslam.odometry.inertial.gyroscope import ImuNoise
from lslam.odometry.inertial.imu_estimate import GRAVITY_WALK, ImuEstimate
from lslam.odometry.inertial.initialise import InertialStart
from lslam.odometry.inertial.integrate import Increments
from lslam.registration.result import RegistrationResult

log = logging.getLogger("lslam")

# Scans after which the smoother's graph begins anew, with what it knows as its prior.
RESET_SCANS = 100
# Velocity, gravity and accelerometer bias of an `ImuEstimate` among the 18 of an `InertialState`.
_ESTIMATE = np.r_[6:9, 15:18, 9:12]


def smoother_noise(noise: ImuNoise) -> SmootherNoise:
    """The noise densities of an IMU for the factors of the smoother."""
    return SmootherNoise(noise.force, noise.accel_walk, noise.gyro_walk, GRAVITY_WALK)


class SmootherMotion(InertialMotion):
    """Predicts with the newest state of a smoother, in which registered poses and the IMU are measurements.

    States are at the middles of the sweeps. The smoother has no gyroscope axes: these are calibrated as by `InertialMotion`,
    and readings are corrected by them and by the initial bias.
    """

    HAS_DEVICE: ClassVar[bool] = False
    STATE: ClassVar[tuple[str, ...]] = (*InertialMotion.STATE, "_is_begun", "smoother")
    TRANSIENT: ClassVar[tuple[str, ...]] = (*InertialMotion.TRANSIENT, "_added")

    def __init__(self, opening: InertialStart, config: Config) -> None:
        super().__init__(opening, config)
        gyroscope = opening.estimate.gyroscope
        self.smoother = InertialSmoother(smoother_noise(gyroscope.noise), RESET_SCANS)
        # Taken off the gyroscope's readings, so that what the smoother estimates does not change with the axes.
        self._usual_bias = gyroscope.bias
        # Whether the smoother's newest state is that of the newest sweep, `_instant_ns`.
        self._is_begun = False
        # The state that `fuse` added, ns and the state, for `correct`.
        self._added: tuple[int, InertialState] | None = None

    def refine(self, prior: MotionPrior, stamp_ns: int, pose: Floats) -> MotionPrior:
        """The prior itself: a sweep is deskewed once, by the state before."""
        return prior if self.is_inertial else super().refine(prior, stamp_ns, pose)

    def fuse(self, stamp_ns: int, result: RegistrationResult, prior: MotionPrior) -> RegistrationResult:
        """The result with the pose and covariance that the smoother estimates from registration and IMU."""
        self._withdraw()
        C = result.covariance
        middle, instant_ns = middle_of(prior, stamp_ns, result.T_world_lidar)
        step = self._increments_until(instant_ns)
        if C is None or not result.is_accepted or step is None:
            return result
        T_world_imu = middle @ self.T_lidar_imu
        there = noise.transport(C, T_world_imu[:3, 3] - result.T_world_lidar[:3, 3])
        begin = (self._pose @ self.T_lidar_imu)[:3, :3]
        self._taught = instant_ns, self.estimate.calibrate(step, begin, T_world_imu[:3, :3], C[3:, 3:]), C[:3, :3]
        try:
            state = self.smoother.add(self._measurement(step, T_world_imu, there))
        except GraphError as error:
            self._is_begun = False
            # The IMU's pose is as sure as the IMU, whatever registration said of its own.
            lever = prior.pose[:3, 3] - (prior.pose @ self.T_lidar_imu)[:3, 3]
            covariance = noise.transport(self._imu_motion(step)[1], lever)
            return result.reject(str(error), prior.pose, covariance)
        self._added = instant_ns, state
        within = se3.relative(result.T_world_lidar, middle)
        pose = se3.normalise(state.T_world_imu @ self.T_imu_lidar @ se3.inverse(within))
        covariance = noise.transport(state.covariance[:6, :6], pose[:3, 3] - state.T_world_imu[:3, 3])
        return result.with_pose(pose, covariance)

    def correct(
        self, stamp_ns: int, pose: Floats, prior: MotionPrior | None = None, has_registration: bool = True
    ) -> None:
        """Update as `InertialMotion.correct`; velocity, gravity and biases are the smoother's."""
        if not has_registration:
            self._withdraw()
        added, self._added = self._added, None
        before = self.estimate
        step = (
            None
            if has_registration
            else self._increments_until(stamp_ns if prior is None else middle_of(prior, stamp_ns, pose)[1])
        )
        super().correct(stamp_ns, pose, prior, has_registration)
        if self._instant_ns is None or self._has_gap or self.refusal:
            self._is_begun = False
            self.estimate = before if self.refusal else self.estimate
            return
        if added is not None and added[0] == self._instant_ns:
            state = added[1]
        else:
            propagated = None if step is None else self._propagated_by_smoother(step)
            if propagated is None:
                # The first scan, the first behind a gap or a graph without solution, or one that stood: at its pose, by what
                # the loose estimate knows.
                self.smoother.begin(self._beginning())
                self._is_begun = True
                return
            state = propagated
        self.estimate = self._as_estimate(state)

    def _propagated_by_smoother(self, step: Increments) -> InertialState | None:
        """The state at the end of `step` by the IMU alone; None where the graph has no solution."""
        try:
            return self.smoother.add(self._measurement(step))
        except GraphError as error:
            log.warning("%s: the graph begins anew", error)
            return None

    def chain(self, keyframes: Sequence[tuple[int, int]], imu_noise: SmootherNoise) -> InertialChain | None:
        """Preintegrated links between `keyframes` (number, stamp in ns), for the pose graph; None where the IMU covers none."""
        links = []
        for (a, begin_ns), (b, end_ns) in pairwise(keyframes):
            if end_ns > begin_ns and self._covers(begin_ns, end_ns):
                step = self._measurement(self.estimate.over(self.imu, np.array([begin_ns, end_ns])))
                links.append(InertialLink(a, b, self._at_lidar(step)))
        if not links:
            return None
        R = self.T_lidar_imu[:3, :3]
        opening = self._beginning()
        return InertialChain(links, R @ opening.accel_bias, R @ opening.gyro_bias, imu_noise)

    def _at_lidar(self, step: InertialStep) -> InertialStep:
        """The readings that an IMU in the position and axes of the LiDAR would give, with the same biases, rotated."""
        R, lever = self.T_lidar_imu[:3, :3], self.T_imu_lidar[:3, 3]
        rates = step.rates - self._beginning().gyro_bias
        middles = np.cumsum(step.seconds) - 0.5 * step.seconds
        turning = np.gradient(rates, middles, axis=0) if len(rates) > 1 else np.zeros_like(rates)
        forces = step.accel + np.cross(turning, lever) + np.cross(rates, np.cross(rates, lever))
        return InertialStep(
            step.seconds, forces @ R.T, step.rates @ R.T, R @ step.rate_noise @ R.T, clipping=step.clipping
        )

    def rewind(self, stamp_ns: int, pose: Floats, span: Span) -> MotionPrior:
        """Forget all scans but the first, as `InertialMotion.rewind`; the smoother begins again too."""
        self._is_begun, self._added = False, None
        return super().rewind(stamp_ns, pose, span)

    def _increments_until(self, instant_ns: int) -> Increments | None:
        """Motion measured by the IMU since the newest state; None without such a state, or in a gap of the IMU."""
        before = self._instant_ns
        has_increments = (
            self._is_begun and before is not None and instant_ns > before and self._covers(before, instant_ns)
        )
        return self._since_last(instant_ns) if has_increments and not self.refusal else None

    def _withdraw(self) -> None:
        """Remove the newest measurement from the smoother, if it is not confirmed yet."""
        if self._added is not None:
            self.smoother.withdraw()
            self._added = None

    def _measurement(
        self, step: Increments, T_world_imu: Floats | None = None, C: Floats | None = None
    ) -> InertialStep:
        """The readings of `step` at the midpoints between samples, and the registered pose with covariance C at its end."""
        begin_ns, end_ns = int(step.instants_ns[0]), int(step.instants_ns[-1])
        stamps = self.imu.stamps_ns
        inner = stamps[np.searchsorted(stamps, begin_ns, side="right") : np.searchsorted(stamps, end_ns)]
        knots = np.concatenate([[begin_ns], inner, [end_ns]])
        near = slice(max(int(np.searchsorted(stamps, begin_ns)) - 1, 0), int(np.searchsorted(stamps, end_ns)) + 1)
        at = 1e-9 * (knots - begin_ns)
        times = 1e-9 * (stamps[near] - begin_ns)

        def means(readings: Floats) -> Floats:
            values = np.stack([np.interp(at, times, column) for column in readings[near].T], axis=1)
            return np.asarray(0.5 * (values[1:] + values[:-1]))

        gyroscope = self.estimate.gyroscope
        return InertialStep(
            np.diff(at),
            means(self.imu.accel),
            (means(self.imu.gyro) - self._usual_bias) @ gyroscope.axes.T,
            gyroscope.turn_covariance(step) / step.duration,
            T_world_imu,
            C,
            step.hidden_density[0],
        )

    def _beginning(self) -> InertialState:
        """Initial state of a smoother: the newest pose and the present estimate, with wide sigmas of the pose."""
        e = self.estimate
        P = np.zeros((18, 18))
        P[:6, :6] = BEGIN_SIGMA**2 * np.eye(6)
        P[np.ix_(_ESTIMATE, _ESTIMATE)] = e.covariance
        axes = e.gyroscope.axes
        P[12:15, 12:15] = axes @ e.gyroscope.covariance[:3, :3] @ axes.T
        bias = axes @ (e.gyroscope.bias - self._usual_bias)
        return InertialState(self._pose @ self.T_lidar_imu, e.velocity, e.accel_bias, bias, e.gravity, P)

    def _as_estimate(self, state: InertialState) -> ImuEstimate:
        """The smoother's state as the estimate that predicts; the gyroscope's axes remain those of the calibration."""
        device = self.estimate.gyroscope
        unturned = np.linalg.inv(device.axes)
        gyroscope = device.with_bias(
            self._usual_bias + unturned @ state.gyro_bias, unturned @ state.covariance[12:15, 12:15] @ unturned.T
        )
        P = state.covariance[np.ix_(_ESTIMATE, _ESTIMATE)]
        return ImuEstimate(state.velocity, state.gravity, state.accel_bias, gyroscope, P)
