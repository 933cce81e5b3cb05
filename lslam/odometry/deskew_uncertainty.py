"""Uncertainty of a scan's pose due to the unknown motion within its sweep.

A sweep of T seconds is deskewed by one velocity, that between the scans before, and registration finds its middle. Under a
constant acceleration `a` the error at the start is a T^2 / 6 (half the sweep at a velocity error of a T / 2, less the curvature
of the true motion), and the same for the points (rms). The next scan observes the velocity error: it lies a T^2 / 2 from the
prediction. Vibration changes the velocity from scan to scan, so the covariance is the mean square over the last scans.

At a stamp half the `lead` L before the middle (L is T at the start, 0 in the middle) the error is
a (L^2 / 6 + (T^2 - L^2) / 24 + L (T - L) / 4), and that of the prediction of the next scan a (T^2 - L T / 2).
"""

from __future__ import annotations

import numpy as np

from lslam.core.geometry import noise, se3
from lslam.core.types.arrays import Floats
from lslam.core.types.motion_prior import MotionPrior
from lslam.core.types.state import Stateful

# Scans over which the change of the motion is averaged: a second.
MEMORY = 10
# m/s2 and rad/s2, prior sigmas of the acceleration: a car brakes, a hand turns.
USUAL = np.repeat([3.0, 1.0], 3)


class DeskewUncertainty(Stateful):
    """Estimates the covariance of the deskewing motion's error from successive scans."""

    STATE = ("_mean", "scans", "_stamp_ns", "_pose", "_within", "_span_s", "_lead_s")

    def __init__(self) -> None:
        self.scans = 0  # observed, `MEMORY` at most
        self._mean = np.zeros((6, 6))
        self._stamp_ns: int | None = None
        self._pose = np.eye(4)
        self._within = np.eye(4)
        self._span_s = self._lead_s = 0.0

    def observe(self, prior: MotionPrior, stamp_ns: int, pose: Floats, is_registered: bool) -> Floats:
        """(6, 6) covariance, world axes, of the pose (4, 4) found at `stamp_ns` for the scan that `prior` deskewed.

        Zero for scans of one instant. A pose without a registration is not learnt from, nor is the one after it.
        """
        step_s = 0.0 if self._stamp_ns is None else 1e-9 * (stamp_ns - self._stamp_ns)
        if is_registered and self._span_s > 0 and step_s > 0:
            expected = se3.log(self._within) * step_s / self._span_s
            if prior.change is None:
                off = se3.log(se3.relative(se3.exp(expected), se3.relative(self._pose, pose)))
            else:
                off = se3.log(se3.relative(prior.poses[0], prior.poses[-1])) * step_s / prior.span_s - expected
            self._learn(off, step_s)
        # The first sweep was deskewed by the second scan's registration: their residual is zero by construction.
        self._span_s = prior.span_s if is_registered and self._stamp_ns is not None else 0.0
        self._lead_s = float(prior.times[0] + prior.times[-1])
        self._stamp_ns, self._pose = stamp_ns, pose.copy()
        self._within = se3.relative(prior.poses[0], prior.poses[-1])
        if len(prior.times) < 2:
            return np.zeros((6, 6))
        if self.scans == 0:
            T, L = prior.span_s, self._lead_s
            return np.diag((USUAL * L**2 / 6.0 + USUAL * ((T**2 - L**2) / 24.0 + L * (T - L) / 4.0)) ** 2)
        alike = np.repeat([np.trace(self._mean[:3, :3]) / 3, np.trace(self._mean[3:, 3:]) / 3], 3)
        # The prior that the covariance is isotropic weighs as many scans as it has directions.
        share = self.scans / (self.scans + len(self._mean))
        return noise.rotated(share * self._mean + (1.0 - share) * np.diag(alike), pose[:3, :3])

    def _learn(self, change: Floats, step_s: float) -> None:
        """From the change (6,) of the motion over `step_s` seconds since the last scan."""
        share, lead = min(self._span_s / step_s, 1.0), min(self._lead_s / step_s, 1.0)
        # The ratio to the prediction error a dt^2 - a L dt / 2 of the error a (L dt / 4 - L^2 / 12 + (T^2 - L^2) / 24).
        part = lead * (3.0 - lead) / (12.0 - 6.0 * lead) + (share**2 - lead**2) / (24.0 - 12.0 * lead)
        off = part * change
        self.scans = min(self.scans + 1, MEMORY)
        self._mean = self._mean + (np.outer(off, off) - self._mean) / self.scans
