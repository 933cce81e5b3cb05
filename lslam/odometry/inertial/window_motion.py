"""The sliding window of LIO-mapping as a motion model: scans and IMU in one estimate of all that is not long past."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from typing import ClassVar

import numpy as np

from lslam.core.config.odometry import ImuConfig
from lslam.core.geometry import noise, se3
from lslam.core.types.arrays import Floats
from lslam.core.types.imu import ImuStream
from lslam.core.types.motion_prior import MotionPrior
from lslam.core.types.scan import LEVER_M, Span
from lslam.core.types.scan_result import ScanEquations
from lslam.odometry.inertial.constant_velocity import middle_of
from lslam.odometry.inertial.filter import FilterMotion
from lslam.odometry.inertial.imu_estimate import ImuEstimate
from lslam.odometry.inertial.navigation_state import POSE
from lslam.odometry.inertial.window import Window, moment_of, off_by
from lslam.registration.result import RegistrationResult

# m, of a point at `LEVER_M`: a scan whose pose moved farther from where its points were linearised is linearised again.
STALE_M = 0.005


class WindowMotion(FilterMotion):
    """Predicts as the filter does, from the newest state; a scan is taken by the joint estimate of the whole window.

    size : moments in the window between two scans
    """

    HAS_DEVICE: ClassVar[bool] = False
    STATE: ClassVar[tuple[str, ...]] = (*FilterMotion.STATE, "window")

    def __init__(
        self, imu: ImuStream, T_lidar_imu: Floats, estimate: ImuEstimate, config: ImuConfig, size: int
    ) -> None:
        super().__init__(imu, T_lidar_imu, estimate, config)
        self.size = size
        self.window: Window | None = None
        # Of the scan that is being registered: equations that were taken, and the window with it.
        self._equations: dict[int, ScanEquations] = {}
        self._joint: Window | None = None

    def sweep(self, stamp_ns: int, span: Span) -> MotionPrior:
        """As of the filter."""
        self._equations, self._joint = {}, None
        return super().sweep(stamp_ns, span)

    def take(self, equations: Iterable[ScanEquations]) -> None:
        """What the points of some scans say of their poses, for the estimates to come."""
        self._equations |= {one.stamp_ns: one for one in equations}

    def fuse(self, stamp_ns: int, result: RegistrationResult, prior: MotionPrior) -> RegistrationResult:
        """The result at the pose and with the covariance that the joint estimate gives it."""
        self._joint = self._posterior = None
        if not result.is_accepted or prior.covariance is None or self._next is None or self.window is None:
            return result
        instant_ns, state = self._next
        middle, _ = middle_of(prior, stamp_ns, result.T_world_lidar)
        T_world_imu = middle @ self.T_lidar_imu
        T_imu_scan = se3.relative(T_world_imu, result.T_world_lidar)
        moment = moment_of(replace(state, T_world_imu=T_world_imu), instant_ns, stamp_ns, T_imu_scan)
        window, H = self.window.extended(moment).with_equations(self._equations).solved(self.imu)
        newest = window.newest(H, state)
        pose = se3.normalise(newest.T_world_imu @ T_imu_scan)
        if not (np.isfinite(pose).all() and np.isfinite(newest.covariance).all()):
            return result
        self._joint, self._posterior = window, (instant_ns, newest)
        lever = pose[:3, 3] - newest.T_world_imu[:3, 3]
        covariance = noise.transport(newest.covariance[POSE, POSE], lever)
        return result.moved(pose, covariance)

    def stale(self) -> dict[int, Floats]:
        """Poses (4, 4), by stamps, of the scans that the joint estimate moved away from where they were linearised."""
        moved = {}
        for m in () if self._joint is None else self._joint.moments:
            if m.equations is not None:
                off = off_by(m.equations.T_world_lidar, m.T_world_lidar)
                if np.linalg.norm(off[:3]) + LEVER_M * np.linalg.norm(off[3:]) > STALE_M:
                    moved[m.stamp_ns] = m.T_world_lidar
        return moved

    def poses(self) -> dict[int, Floats]:
        """Poses (4, 4), by stamps, of the scans in the window as they are estimated now."""
        return {} if self.window is None else {m.stamp_ns: se3.normalise(m.T_world_lidar) for m in self.window.moments}

    def correct(
        self, stamp_ns: int, pose: Floats, prior: MotionPrior | None = None, is_registered: bool = True
    ) -> None:
        """As of the filter; the window goes on, or begins anew where the filter does."""
        joint, posterior, predicted = self._joint, self._posterior, self._next
        super().correct(stamp_ns, pose, prior, is_registered)
        self._joint, self._equations = None, {}
        if self._now is None or self._instant_ns is None:
            self.window = None
            return
        T_imu_scan = se3.relative(self._pose @ self.T_lidar_imu, pose)
        if posterior is not None and self._now is posterior[1]:
            self.window = joint
        elif predicted is not None and self._now is predicted[1] and self.window is not None:
            self.window = self.window.extended(moment_of(self._now, self._instant_ns, stamp_ns, T_imu_scan))
        else:
            self.window = Window.begin(self._now, self._instant_ns, stamp_ns, T_imu_scan)
        while self.window is not None and len(self.window.moments) > self.size:
            self.window = self.window.without_first(self.imu)
