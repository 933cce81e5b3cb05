"""The outcome of locating one scan in an existing map."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

# held : by the map; changed : the map is there and disagrees; beyond : the map ends; unread : the scan has no points
FixStatus = Literal["held", "changed", "beyond", "unread"]


@dataclass(frozen=True)
class MapFix:
    """A scan against the map.

    T_map_lidar : (4, 4); covariance : (6, 6) of it, t' = t + d[:3], R' = exp(d[3:]) R, map axes, m2 and rad2
    status : `held` registered on the map; else odometry carries the pose on: the map has `changed`, ends (`beyond`), or the scan
        is `unread`
    overlap : share of the source points that find the map; inlier_share : of those, within the kernel
    innovation : correction of what odometry carried here, m and rad
    reason : why it is not held, empty where it is
    is_doubted : held, but by fewer of its points than elsewhere in the run: something there has changed
    """

    T_map_lidar: NDArray[np.float64]
    covariance: NDArray[np.float64]
    status: FixStatus = "held"
    overlap: float = 0.0
    inlier_share: float = 0.0
    innovation: tuple[float, float] = (0.0, 0.0)
    reason: str = ""
    is_doubted: bool = False

    @property
    def is_held(self) -> bool:
        """Whether the map holds the scan."""
        return self.status == "held"
