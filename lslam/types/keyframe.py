"""A scan that stands for its surroundings."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class Keyframe:
    """A node of the pose graph; its cloud lies in the keyframe store.

    number : 0, 1, 2, ... among the keyframes
    scan : position of its scan among the scans of the run (not the scan's number in the recording)
    T_world_lidar : (4, 4) odometry pose at the scan's stamp
    covariance : (6, 6) of the pose in the world, t' = t + d[:3], R' = exp(d[3:]) R in world axes, m2 and rad2, or None
    distance : m travelled since the start of the run
    """

    number: int
    scan: int
    stamp_ns: int
    T_world_lidar: NDArray[np.float64]
    covariance: NDArray[np.float64] | None = None
    distance: float = 0.0
