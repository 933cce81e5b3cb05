"""Which way is down, as an IMU and registration agree on it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class GravityDirection:
    """Measured direction of gravity at the start of a scan.

    direction : (3,) float64, unit, downwards, in LiDAR axes at the scan's stamp
    sigma : rad, one standard deviation of either of the two tilts that it fixes (it says nothing of yaw)

    Errors of scans that follow each other are nearly the same error: the filter behind it forgets over some twenty seconds. A
    graph with a factor per keyframe should count those of one such stretch as one measurement.
    """

    direction: NDArray[np.float64]
    sigma: float
