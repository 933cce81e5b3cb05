"""The iterated error-state Kalman filter of FAST-LIO2 as a motion model: its prior joins the points in one estimate."""

from __future__ import annotations

from dataclasses import replace
from typing import ClassVar

import numpy as np

from lslam.core.config.odometry import ImuConfig
from lslam.core.geometry import noise
from lslam.core.types.arrays import Floats
from lslam.core.types.imu import ImuStream
from lslam.core.types.motion_prior import MotionPrior
from lslam.core.types.scan import Span
from lslam.odometry.inertial.constant_velocity import middle_of
from lslam.odometry.inertial.fusion import InertialMotion
from lslam.odometry.inertial.imu_estimate import PLACE_SIGMA, TURN_SIGMA, ImuEstimate
from lslam.odometry.inertial.navigation_state import POSE, NavigationState
from lslam.registration.result import RegistrationResult


class FilterMotion(InertialMotion):
    """Predicts a scan with its covariance, and takes what registration made of both as the update of all states.

    An iterated update of a Kalman filter is a Gauss-Newton estimate with the prior as one more measurement (Bell and Cathey
    1993). The points tell of the pose alone, so registration estimates that, and the other states follow by their
    covariance with it.
    """

    STATE: ClassVar[tuple[str, ...]] = (*InertialMotion.STATE, "_now")

    def __init__(self, imu: ImuStream, T_lidar_imu: Floats, estimate: ImuEstimate, config: ImuConfig) -> None:
        super().__init__(imu, T_lidar_imu, estimate, config)
        # At the middle of the newest sweep, `_instant_ns`; and at that of the next one, before and after its registration.
        self._now: NavigationState | None = None
        self._next: tuple[int, NavigationState] | None = None
        self._posterior: tuple[int, NavigationState] | None = None

    def sweep(self, stamp_ns: int, span: Span) -> MotionPrior:
        """As of any IMU, with the covariance of the pose at the stamp."""
        prior = super().sweep(stamp_ns, span)
        self._next = self._posterior = None
        if not self.is_inertial or self._now is None or self._instant_ns is None:
            return prior
        middle, instant_ns = middle_of(prior, stamp_ns, prior.pose)
        if instant_ns <= self._instant_ns:
            return prior
        state = self._now.propagated(self._since_last(instant_ns))
        self._next = instant_ns, state
        back = prior.pose[:3, 3] - middle[:3, 3]
        return replace(prior, covariance=noise.transport(self._of_lidar(state), back))

    def refine(self, prior: MotionPrior, stamp_ns: int, pose: Floats) -> MotionPrior:
        """The prior itself: a sweep is deskewed once, by back propagation.

        But where the range of the IMU cut readings, the states that the registered `pose` implies deskew it again: the speed
        in the middle of the sweep is then off by all that the force lacked since the last one. The prior joins in with the
        same covariance, which there is far wider than what it is registered with.
        """
        if prior.covariance is None or self._next is None:
            return super().refine(prior, stamp_ns, pose)
        instant_ns, state = self._next
        hidden = self._since_last(instant_ns).hidden
        if hidden is None:
            return prior
        middle, _ = middle_of(prior, stamp_ns, pose)
        T_world_imu = middle @ self.T_lidar_imu
        registration_noise = np.diag(np.repeat([PLACE_SIGMA**2, TURN_SIGMA**2], 3))
        estimate = state.moved_to(T_world_imu, registration_noise).estimate
        swept = self._prior(estimate, instant_ns, middle, stamp_ns, prior.times)
        return replace(swept, covariance=prior.covariance)

    def fuse(self, stamp_ns: int, result: RegistrationResult, prior: MotionPrior) -> RegistrationResult:
        """The result as it is: its registration weighed points and prior already. The other states follow its pose."""
        C = result.covariance
        if C is None or not result.is_accepted or prior.covariance is None or self._next is None:
            return result
        instant_ns, state = self._next
        middle, _ = middle_of(prior, stamp_ns, result.T_world_lidar)
        T_world_imu = middle @ self.T_lidar_imu
        covariance = noise.transport(C, T_world_imu[:3, 3] - result.T_world_lidar[:3, 3])
        self._posterior = instant_ns, state.moved_to(T_world_imu, covariance)
        return result

    def correct(
        self, stamp_ns: int, pose: Floats, prior: MotionPrior | None = None, is_registered: bool = True
    ) -> None:
        """As of any IMU; the states are those that the filter found."""
        predicted, posterior = self._next, self._posterior
        self._next = self._posterior = None
        before = self.estimate
        super().correct(stamp_ns, pose, prior, is_registered)
        if self._instant_ns is None or self._has_gap:
            self._now = None
            return
        if is_registered and posterior is not None and posterior[0] == self._instant_ns:
            self._now = posterior[1]
        elif predicted is not None and predicted[0] == self._instant_ns and not is_registered:
            self._now = predicted[1]
        else:
            # The first scan, the first behind a gap, or one that stood: at its pose, by what the loose estimate knows.
            self._now = NavigationState.begin(self._pose @ self.T_lidar_imu, self.estimate)
            return
        self.estimate = self._now.estimate if not self.refusal else before

    def _of_lidar(self, state: NavigationState) -> Floats:
        """(6, 6) covariance of the LiDAR's pose, world axes."""
        lever = (state.T_world_imu @ self.T_imu_lidar)[:3, 3] - state.T_world_imu[:3, 3]
        return noise.transport(state.covariance[POSE, POSE], lever)
