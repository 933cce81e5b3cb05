"""Constant velocity: the motion prior of a method that has no IMU."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from lslam.geometry import se3

Floats = NDArray[np.float64]


class ConstantVelocity:
    """Predicts the next pose from the last two, scaled to the time between scans."""

    # A longer pause says nothing about the speed at its end; the last step is not stretched beyond this factor.
    MAX_STRETCH = 5.0

    def __init__(self) -> None:
        self._stamp_ns: int | None = None
        self._pose = np.eye(4)
        self._twist = np.zeros(6)
        self._step_s = 0.0

    def predict(self, stamp_ns: int) -> Floats:
        """(4, 4) T_world_lidar expected at `stamp_ns`; the identity before the first scan."""
        if self._stamp_ns is None or self._step_s <= 0:
            return self._pose.copy()
        stretch = min(max((stamp_ns - self._stamp_ns) * 1e-9 / self._step_s, 0.0), self.MAX_STRETCH)
        return se3.normalise(self._pose @ se3.exp(stretch * self._twist))

    def correct(self, stamp_ns: int, pose: Floats) -> None:
        """Take the pose (4, 4) found at `stamp_ns` as the newest."""
        if self._stamp_ns is not None:
            step = (stamp_ns - self._stamp_ns) * 1e-9
            if step > 0:
                self._twist, self._step_s = se3.log(se3.relative(self._pose, pose)), step
        self._stamp_ns, self._pose = stamp_ns, pose.copy()
