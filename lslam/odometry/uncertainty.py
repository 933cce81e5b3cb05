"""Covariances of poses: from that of one registration, with the unknown motion within the sweep, to that in the world.

A sweep of T seconds is deskewed by one velocity, that between the scans before, and registration finds its middle. Under a
constant acceleration `a` the error at the start is a T^2 / 6 (half the sweep at a velocity error of a T / 2, less the curvature
of the true motion), and the same for the points (rms). The next scan observes the velocity error: it lies a T^2 / 2 from the
prediction. Vibration changes the velocity from scan to scan, so the covariance is the mean square over the last scans.

At a stamp half the `lead` L before the middle (L is T at the start, 0 in the middle) the error is
a (L^2 / 6 + (T^2 - L^2) / 24 + L (T - L) / 4), and that of the prediction of the next scan a (T^2 - L T / 2).
"""

from __future__ import annotations

from typing import ClassVar

import numpy as np

from lslam.core.arrays import Floats
from lslam.core.geometry import noise, se3
from lslam.core.types.motion_prior import MotionPrior
from lslam.core.types.state import Stateful
from lslam.odometry.inertial.constant_velocity import USUAL_ACCELERATION
from lslam.registration.result import RegistrationResult

# Scans over which the change of the motion is averaged: a second.
MEMORY_SCANS = 10


class DeskewUncertainty(Stateful):
    """Estimates the covariance of the deskewing motion's error from successive scans."""

    STATE = ("_mean", "scans", "_stamp_ns", "_pose", "_within", "_span_s", "_lead_s")

    def __init__(self) -> None:
        self.scans = 0  # observed, `MEMORY_SCANS` at most
        self._mean = np.zeros((6, 6))
        self._stamp_ns: int | None = None
        self._pose = np.eye(4)
        self._within = np.eye(4)
        self._span_s = self._lead_s = 0.0

    def observe(self, prior: MotionPrior, stamp_ns: int, pose: Floats, has_registration: bool) -> Floats:
        """(6, 6) covariance, world axes, of the registered pose (4, 4) at `stamp_ns` due to errors of the deskewing motion.

        Zero for scans of one instant. A pose without a registration is not used for the estimate, nor is the next one.
        """
        step_s = 0.0 if self._stamp_ns is None else 1e-9 * (stamp_ns - self._stamp_ns)
        if has_registration and self._span_s > 0 and step_s > 0:
            expected = se3.log(self._within) * step_s / self._span_s
            if prior.change is None:
                off = se3.log(se3.relative(se3.exp(expected), se3.relative(self._pose, pose)))
            else:
                off = se3.log(se3.relative(prior.poses[0], prior.poses[-1])) * step_s / prior.span_s - expected
            self._learn(off, step_s)
        # The first sweep was deskewed by the second scan's registration: their residual is zero by construction.
        self._span_s = prior.span_s if has_registration and self._stamp_ns is not None else 0.0
        self._lead_s = float(prior.times[0] + prior.times[-1])
        self._stamp_ns, self._pose = stamp_ns, pose.copy()
        self._within = se3.relative(prior.poses[0], prior.poses[-1])
        if len(prior.times) < 2:
            return np.zeros((6, 6))
        if self.scans == 0:
            T, L = prior.span_s, self._lead_s
            return np.diag(
                (USUAL_ACCELERATION * L**2 / 6.0 + USUAL_ACCELERATION * ((T**2 - L**2) / 24.0 + L * (T - L) / 4.0)) ** 2
            )
        alike = np.repeat([np.trace(self._mean[:3, :3]) / 3, np.trace(self._mean[3:, 3:]) / 3], 3)
        # The prior that the covariance is isotropic weighs as many scans as it has directions.
        share = self.scans / (self.scans + len(self._mean))
        return noise.rotate(share * self._mean + (1.0 - share) * np.diag(alike), pose[:3, :3])

    def _learn(self, change: Floats, step_s: float) -> None:
        """Update the estimate by the change (6,) of the motion over `step_s` seconds since the last scan."""
        share, lead = min(self._span_s / step_s, 1.0), min(self._lead_s / step_s, 1.0)
        # The ratio to the prediction error a dt^2 - a L dt / 2 of the error a (L dt / 4 - L^2 / 12 + (T^2 - L^2) / 24).
        part = lead * (3.0 - lead) / (12.0 - 6.0 * lead) + (share**2 - lead**2) / (24.0 - 12.0 * lead)
        off = part * change
        self.scans = min(self.scans + 1, MEMORY_SCANS)
        self._mean = self._mean + (np.outer(off, off) - self._mean) / self.scans


# Factor on the first sweep's variance: its velocity is that at its end, off by a T, twice the error of later ones.
FIRST_SWEEP_FACTOR = 4.0
# Scans after it from which the first sweep's covariance is estimated.
FIRST_SWEEP_SCANS = 2


class PoseUncertainty(Stateful):
    """Accumulates the covariance of scan-to-map odometry.

    A registration's covariance is relative to the local map, whose own error grows only as the map is renewed: after
    the sensor has moved by its lever arm (the rms distance of the matched points) the map consists of new scans, and one
    more independent registration error has entered it. In between, registrations against the same map share its
    error. So per scan the map's covariance grows by (step / lever arm) times the registration's, and a rotation error
    moves all later positions. A sensor at rest does not drift: its scans enter at one pose, and leave the map's error as it is.

    A young map is the mean of its scans: one part in k of the error of the k-th stays in all that follow. The first few err by
    more than their covariances say; `frontend.windows` registers the first again, to which all are relative.

    Scan-to-scan odometry has no such map: every registration's error enters in full.

    Deskewing errors are independent between scans and average out on the map: a scan contributes the share of the map that is
    renewed with it. That of the first scan, whose start is the world's origin, is common to all others.

    map_age : mean age, in scans, of the points of the map on which the next scan is registered
    """

    STATE: ClassVar[tuple[str, ...]] = ("_map", "_position", "_start", "_start_factor", "_sweep", "_scans", "map_age")

    def __init__(self, *, is_scan_to_scan: bool = False) -> None:
        self.is_scan_to_scan = is_scan_to_scan
        self._map = np.zeros((6, 6))
        self._position: Floats | None = None
        # The world's origin, until the first sweep's covariance is estimated.
        self._start: Floats | None = None
        # Factor on the deskewing covariance, of the first scan and those entered with it until then.
        self._start_factor = FIRST_SWEEP_FACTOR
        self._sweep = DeskewUncertainty()
        self._scans = 0
        self.map_age = 1.0

    def covariances(
        self, result: RegistrationResult, stamp_ns: int, prior: MotionPrior
    ) -> tuple[Floats | None, Floats | None]:
        """(6, 6) of the pose in the world, and on the local map, of a scan that `prior` deskewed."""
        sweep = self._sweep.observe(prior, stamp_ns, result.T_world_lidar, result.is_accepted)
        own = None if result.covariance is None else result.covariance + sweep
        return self.add(result, sweep), own

    def add(self, result: RegistrationResult, sweep: Floats | None = None) -> Floats | None:
        """(6, 6) covariance of the pose, t' = t + d[:3], R' = exp(d[3:]) R in world axes, m2 and rad2; None if it has none.

        sweep : (6, 6) part due to the motion within the sweep, None for zero
        A failed registration affects the covariance of its own pose only: the next good one is relative to the map again.
        """
        if result.covariance is None:
            return None
        sweep = np.zeros((6, 6)) if sweep is None else sweep
        own = result.covariance + sweep
        position = result.T_world_lidar[:3, 3]
        if self._position is None:
            self._position = self._start = position.copy()
        step = position - self._position
        self._position = position.copy()
        self._map = noise.transport(self._map, step)
        if result.is_stationary:
            self._scans += 1
            self.map_age += 1
        elif result.ok:
            renewed = 1.0 if self.is_scan_to_scan else float(np.linalg.norm(step)) / max(result.lever_arm, 1.0)
            self._scans += 1
            self._map += max(renewed, 1 / self._scans**2) * result.covariance
            if self._scans > 1:
                self._enter(max(min(renewed, 1.0), 1 / self._scans) ** 2, sweep)
            share = min(max(renewed, 1 / self._scans), 1.0)
            self.map_age = 1 + (1 - share) * self.map_age
        if self._start is None:
            return np.asarray(self._map + own)
        at_start = noise.transport(self._start_factor * sweep, position - self._start)
        if self._sweep.scans >= FIRST_SWEEP_SCANS:
            self._map, self._start = self._map + at_start, None
            return np.asarray(self._map + own)
        return np.asarray(self._map + at_start + own)

    def _enter(self, share: float, sweep: Floats) -> None:
        """Add a share of a scan's deskewing covariance (6, 6) to the map's."""
        if self._start is None:
            self._map += share * sweep
        else:
            self._start_factor += share
