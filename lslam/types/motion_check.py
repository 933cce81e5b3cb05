"""The motion between two scans, registered from these two alone, beside that of their poses."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lslam.geometry import portable, so3

# What explains less than this part of what is usual, or less than a share of the points, is rejected, as is what
# leaves the turn open, rad.
USUAL, FEWEST, UNTURNED = 0.7, 0.15, float(np.deg2rad(1.0))
# m; a check with a larger sigma of the position confirms nothing.
OPEN_M = 0.5
# m and rad; two motions of a pair of scans that differ by less are one.
SAME_M, SAME_RAD = 0.2, float(np.deg2rad(1.0))


@dataclass(frozen=True)
class MotionCheck:
    """One comparison of a claimed motion with the scans at its ends; m and rad, axes of the sensor at its begin.

    first, last : positions of the scans in the run; seconds : between them
    claimed, found : (4, 4) poses of the last scan seen from the first
    sigma : (6,) standard deviation of what was found, about a metre along directions that the scans do not hold
    agreement : share of the points that lie on surfaces of the first scan as found; claimed_agreement : as claimed
    usual : what the agreement lately was; is_after_break : whether scans are missing or failed just before the last
    rival : (4, 4) another motion that explains the last scan about as well as the one found
    emptied : share of the directions that held points since the poses stand, and hold none now
    """

    first: int
    last: int
    seconds: float
    claimed: NDArray[np.float64]
    found: NDArray[np.float64]
    sigma: NDArray[np.float64]
    agreement: float
    claimed_agreement: float
    usual: float
    is_after_break: bool = False
    rival: NDArray[np.float64] | None = None
    emptied: float = 0.0

    @property
    def is_conclusive(self) -> bool:
        """Whether enough points are inliers, and the rotation is constrained well enough, to accept it."""
        return self.agreement >= max(USUAL * self.usual, FEWEST) and float(np.max(self.sigma[3:])) < UNTURNED

    @property
    def is_open(self) -> bool:
        """Whether the scans do not tell the motion, or tell it only along some directions."""
        return not self.is_conclusive or float(np.max(self.sigma[:3])) > OPEN_M

    @property
    def apart(self) -> NDArray[np.float64]:
        """(6,) by how much the scans say the motion was more than claimed."""
        return motion_apart(self.claimed, self.found)


def motion_apart(a: NDArray[np.float64], b: NDArray[np.float64]) -> NDArray[np.float64]:
    """(6,) by how much a motion `b` (4, 4) is more than another, `a`: m, then rad, in the axes of where both begin."""
    turn = so3.log(portable.product(b[:3, :3], a[:3, :3].T))
    return np.concatenate([b[:3, 3] - a[:3, 3], turn])
