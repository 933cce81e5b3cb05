"""The motion model of a smoother: it hands over what the IMU felt between two scans, and takes the states that come back."""

from __future__ import annotations

from dataclasses import replace
from typing import ClassVar

import numpy as np

from lslam.core.geometry import se3
from lslam.core.types.arrays import Floats
from lslam.core.types.imu import MotionState, PreintegratedStep, SweepLink
from lslam.core.types.motion_prior import MotionPrior
from lslam.core.types.scan import Span
from lslam.odometry.inertial.constant_velocity import middle_of
from lslam.odometry.inertial.filter import (
    GYRO,
    OWN,
    REST,
    FilterMotion,
    NavigationState,
    cut_noise,
    process_noise,
    transition,
)
from lslam.odometry.inertial.gyroscope import Gyroscope
from lslam.odometry.inertial.imu_estimate import ImuEstimate
from lslam.odometry.inertial.integrate import Increments
from lslam.registration.acceptance import PRIOR_COVARIANCE
from lslam.registration.result import RegistrationResult

# m/s2, change of velocity over a gap of the IMU, one sigma: a car brakes.
BRAKING_M_S2 = 3.0


class LinkedMotion(FilterMotion):
    """Predicts and deskews as the filter does; the estimate itself is the smoother's, of all states it holds."""

    HAS_DEVICE: ClassVar[bool] = False
    STATE: ClassVar[tuple[str, ...]] = (*FilterMotion.STATE, "_last_link")
    # Instant, ns, and pose of the LiDAR of the newest state in the smoother: a scan that nobody could read has none.
    _last_link: tuple[int, Floats] | None = None

    def sweep(self, stamp_ns: int, span: Span) -> MotionPrior:
        """The motion, with what joins it to the last scan."""
        prior = super().sweep(stamp_ns, span)
        return replace(prior, link=self._link(prior, stamp_ns))

    def refine(self, prior: MotionPrior, stamp_ns: int, pose: Floats) -> MotionPrior:
        """As of the filter, with what joins it to the last scan: the middle of the sweep is seen from the refined stamp."""
        refined = super().refine(prior, stamp_ns, pose)
        if refined is prior or prior.link is None:
            return prior
        within = se3.relative(refined.pose, middle_of(refined, stamp_ns, refined.pose)[0])
        return replace(refined, link=replace(prior.link, within=within))

    def needs_comparison(self, stamp_ns: int, span: Span) -> bool:
        """Never: without the IMU there is nothing to estimate the states from."""
        return False

    def fuse(self, stamp_ns: int, result: RegistrationResult, prior: MotionPrior) -> RegistrationResult:
        """The result as it is; the states of the smoother are kept for `correct`."""
        self._posterior = None
        if result.inertial is not None and prior.link is not None:
            middle, instant_ns = middle_of(prior, stamp_ns, result.T_world_lidar)
            self._posterior = instant_ns, self._state_of(result.inertial)
            self._last_link = instant_ns, middle
        return replace(result, inertial=None)

    def correct(
        self, stamp_ns: int, pose: Floats, prior: MotionPrior | None = None, has_registration: bool = True
    ) -> None:
        """As of the filter; a scan that was denied has its state in the smoother where it was put in the end."""
        super().correct(stamp_ns, pose, prior, has_registration)
        if self._last_link is not None and self._last_link[0] == self._instant_ns:
            self._last_link = self._last_link[0], self._pose.copy()

    def rewind(self, stamp_ns: int, pose: Floats, span: Span) -> MotionPrior:
        """As of any IMU; the smoother begins anew, too."""
        self._now = self._next = self._posterior = None
        prior = super().rewind(stamp_ns, pose, span)
        assert self._instant_ns is not None
        self._last_link = self._instant_ns, self._pose.copy()
        state = NavigationState.begin(self._pose @ self.T_lidar_imu, self.estimate)
        return replace(prior, link=SweepLink(self.T_lidar_imu, se3.relative(pose, self._pose), _plain(state)))

    def _link(self, prior: MotionPrior, stamp_ns: int) -> SweepLink:
        middle, instant_ns = middle_of(prior, stamp_ns, prior.pose)
        T_world_imu = middle @ self.T_lidar_imu
        # Where a smoother begins; no filter had a state there.
        state = NavigationState.begin(T_world_imu, self.estimate) if self._next is None else self._next[1]
        link = SweepLink(self.T_lidar_imu, se3.relative(prior.pose, middle), _plain(state))
        if self._last_link is None or self._instant_ns is None or self._last_link[0] >= instant_ns:
            return link
        before_ns, before = self._last_link
        # Since then it stood, in no state of the smoother: its pose is known, forces over minutes lead anywhere.
        has_stood = self._instant_ns != before_ns and not self._was_bridged
        if not self.refusal and not has_stood and self._covers(before_ns, instant_ns):
            increments = self.estimate.over(self.imu, np.array([before_ns, instant_ns]))
            return replace(link, step=_from_imu(self.estimate, increments, (before @ self.T_lidar_imu)[:3, :3]))
        motion = se3.relative(before @ self.T_lidar_imu, T_world_imu)
        return replace(link, step=_coast(self.estimate, motion, 1e-9 * (instant_ns - before_ns)))

    def _state_of(self, state: MotionState) -> NavigationState:
        P, before = state.covariance, self.estimate.gyroscope
        gyroscope = Gyroscope(state.gyro_bias, state.gyro_axes, P[GYRO, GYRO], before.rate_variance, before.noise)
        estimate = ImuEstimate(state.velocity, state.gravity, state.accel_bias, gyroscope, P[REST, REST])
        return NavigationState(state.T_world_imu, estimate, P)


def _plain(state: NavigationState) -> MotionState:
    e = state.estimate
    return MotionState(
        state.T_world_imu, e.velocity, e.gravity, e.accel_bias, e.gyroscope.bias, e.gyroscope.axes, state.covariance
    )


def _from_imu(e: ImuEstimate, step: Increments, R: Floats) -> PreintegratedStep:
    """What the IMU felt, as the estimate integrated it; R : (3, 3) of the IMU in the world at the first instant."""
    t = step.duration
    C = process_noise(t, e.gyroscope.rate_variance, e.gyroscope.noise)
    if step.hidden is not None:
        C += cut_noise(step.hidden, transition(step, R, R @ step.rotations[-1], e.gyroscope))
    return PreintegratedStep(
        t,
        step.rotations[-1],
        step.velocities[-1],
        step.positions[-1],
        step.velocity_arms[-1],
        step.position_arms[-1],
        e.gyroscope.columns(step),
        e.accel_bias,
        e.gyroscope.bias,
        e.gyroscope.axes,
        C[np.ix_(OWN, OWN)],
    )


def _coast(e: ImuEstimate, motion: Floats, seconds: float) -> PreintegratedStep:
    """The motion (4, 4) of the IMU that is expected over a gap, after it stood, or after the IMU was refused."""
    walk = e.gyroscope.noise
    sigmas = BRAKING_M_S2 * seconds, walk.accel_walk * seconds**0.5, walk.gyro_walk * seconds**0.5
    C = np.diag(np.repeat([0.0, 0.0, *np.square(sigmas)], 3))
    C[:6, :6] = PRIOR_COVARIANCE
    none = np.zeros((3, 3))
    return PreintegratedStep(
        0.0,
        motion[:3, :3],
        np.zeros(3),
        motion[:3, 3],
        none,
        none,
        np.zeros((3, 12)),
        e.accel_bias,
        e.gyroscope.bias,
        e.gyroscope.axes,
        C,
    )
