"""The prior of a scan's motion before it is registered."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lslam.core.arrays import Floats, Longs
from lslam.core.geometry.se3 import poses_at
from lslam.core.types.imu import SweepLink


@dataclass(frozen=True)
class MotionPrior:
    """Poses sampled over one scan, so that it can be deskewed as well as predicted.

    times : (K,) float64 s from the scan's stamp, increasing, 0 within; poses : (K, 4, 4) float64 T_world_lidar at those times
    K is 1 when only the pose at the stamp is predicted.
    covariance : (6, 6) of the pose at the stamp, t' = t + d[:3], R' = exp(d[3:]) R in world axes, m2 and rad2; None where
        the motion model has none
    link : what joins the scan to the one before in a smoother; None where the motion model is for none
    has_imu_motion : an IMU measured the motion within the sweep
    change : (6, 6) covariance of the motion from begin to end, world axes, smoothed with later scans; None elsewhere
    """

    times: Floats
    poses: Floats
    covariance: Floats | None = None
    link: SweepLink | None = None
    has_imu_motion: bool = False
    change: Floats | None = None

    @classmethod
    def at_once(cls, pose: Floats) -> MotionPrior:
        """A prior of one instant: the pose (4, 4) at the stamp, without motion within the sweep."""
        return cls(np.zeros(1), pose[None])

    @property
    def pose(self) -> Floats:
        """(4, 4) predicted T_world_lidar at the stamp."""
        if self.times[0] == 0 or len(self.times) == 1:
            first: Floats = self.poses[0]
            return first
        at: Floats = poses_at(self.times_ns, self.poses, np.zeros(1, np.int64))[0]
        return at

    @property
    def is_bent(self) -> bool:
        """Whether the motion within the sweep is more than a line through both ends."""
        return self.has_imu_motion or self.change is not None

    @property
    def times_ns(self) -> Longs:
        """(K,) `times` in whole ns."""
        return np.round(1e9 * self.times).astype(np.int64)

    @property
    def span_s(self) -> float:
        """Seconds from the first pose to the last."""
        return float(self.times[-1] - self.times[0])
