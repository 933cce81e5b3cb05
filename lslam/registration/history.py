"""What earlier scans taught about the next one: errors of the prior, the usual inlier share, the last poses.

They give the width of the robust kernel, and tell a drop in a scan's inlier share.
"""

from __future__ import annotations

import math
from typing import Any

from numpy.typing import NDArray

from lslam.core.arrays import Floats
from lslam.core.config.input import PreprocessConfig
from lslam.core.config.odometry import RegistrationConfig
from lslam.core.kernels.linearisation import OUTLIER_SIGMAS, SIGNIFICANT_SIGMAS
from lslam.core.types.state import Stateful
from lslam.registration.optimiser import KERNEL_MIN_M
from lslam.registration.rest import Rest
from lslam.registration.result import RegistrationResult

# Of what was lately, what stays from scan to scan: a memory of five.
FORGETTING_FACTOR = 0.8


class AdaptiveThreshold(Stateful):
    """Kernel width by the recent errors of the motion prior, between `low` and `high`, m.

    The prediction error of a scan is its correction in metres at the rms lever arm (KISS-ICP, section III-C, measures
    the same at the far end of the scan). Three times the rms of recent errors covers nearly all of the next ones.

    mean_square : of the recent prediction errors, m2
    """

    STATE = ("mean_square",)

    def __init__(self, low: float, high: float) -> None:
        self.low, self.high = low, high
        self.mean_square = (high / OUTLIER_SIGMAS) ** 2

    @property
    def width(self) -> float:
        """Kernel width for the next scan, m."""
        return min(max(OUTLIER_SIGMAS * math.sqrt(self.mean_square), self.low), self.high)

    def observe(self, error: float) -> None:
        """Learn from one registered scan's prediction error, m."""
        self.mean_square = FORGETTING_FACTOR * self.mean_square + (1 - FORGETTING_FACTOR) * error**2

    def widen(self) -> None:
        """Reset to the widest after a failed scan."""
        self.mean_square = (self.high / OUTLIER_SIGMAS) ** 2


class UsualAgreement(Stateful):
    """Recent inlier share of accepted scans.

    A sensor carried elsewhere still matches ground and walls: half the points are inliers of some plane, and no fixed threshold
    separates that from a sparse sensor's good scan. The drop from one scan to the next does.
    """

    # Scans in a row differ by an eighth at most, unless something has happened.
    LESS = 0.8
    STATE = ("usual",)

    def __init__(self, drop: float) -> None:
        self.drop = drop
        self.usual = 0.0

    def is_less(self, share: float) -> bool:
        """Whether `share` is so far below the usual one that the scan may lie in the wrong place."""
        return share < self.LESS * self.usual

    @property
    def least(self) -> float:
        """`drop` times the usual share: what is below has collapsed."""
        return self.drop * self.usual

    def is_collapse(self, share: float) -> bool:
        """Whether `share` is below `drop` times the usual one."""
        return share < self.least

    def observe(self, share: float) -> None:
        """Update the usual share by a good scan: at once by a larger share, gradually by a smaller one.

        Each scan fills the voxels of a young map, and the next one finds more of them: a mean over the last few lags behind.
        """
        self.usual = max(share, FORGETTING_FACTOR * self.usual + (1 - FORGETTING_FACTOR) * share)

    def relax(self) -> None:
        """Lower the usual share after a bad scan, so that a place that has changed for good is accepted after a few."""
        self.usual *= FORGETTING_FACTOR


def is_more(count: int, other: int) -> bool:
    """Whether one count is larger than another by more than `SIGNIFICANT_SIGMAS` of both, as those of independent events."""
    return count - other > SIGNIFICANT_SIGMAS * math.sqrt(count + other)


class History(Stateful):
    """Adapts to registrations, scan after scan.

    threshold : kernel width by the recent errors of the motion prior
    agreement, matches : recent inlier shares, of all source points and of those with a match
    starting : initialisation scans that remain; inserted : scans in the map
    rest : the spot that the sensor has not left
    recent : points (N, 3), LiDAR frame, and pose (4, 4) of the last scans in the map
    """

    STATE = ("threshold", "agreement", "matches", "starting", "inserted", "recent", "rest")

    def __init__(self, config: RegistrationConfig, preprocess: PreprocessConfig | None = None) -> None:
        self.start_scans = config.start_scans
        self.threshold = AdaptiveThreshold(KERNEL_MIN_M, config.kernel_max)
        self.agreement, self.matches = (UsualAgreement(config.min_agreement) for _ in range(2))
        self.starting, self.inserted = config.start_scans, 0
        self.recent: tuple[tuple[NDArray[Any], Floats], ...] = ()
        self.rest = Rest(preprocess or PreprocessConfig(), config.sigma, config.voxel_size)

    @property
    def is_young(self) -> bool:
        """Whether the map is made of the first scans alone."""
        return self.inserted <= self.start_scans

    def enter(self, points: NDArray[Any], T_world_lidar: Floats, lever_arm: float = 1.0) -> None:
        """Count a scan that entered the map, points (N, 3), LiDAR frame, at its pose (4, 4), as a recent one and for rest.

        lever_arm : m, at which its rotation counts
        """
        self.inserted += 1
        self.rest.enter(points, T_world_lidar, lever_arm)
        self.recent = (*self.recent, (points, T_world_lidar))[-self.start_scans :]

    def observe(self, result: RegistrationResult) -> None:
        """Adapt to a registration, unless its pose was rejected."""
        if not result.ok:
            self.starting = max(self.starting, 1)
            self.threshold.widen()
            self.agreement.relax()
        elif not result.is_rejected:
            self.starting = max(self.starting - 1, 0)
            # All points agree less with their map than features do with theirs.
            own = result if result.feature_result is None else result.feature_result
            if own.ok:
                self.agreement.observe(own.agreement)
                self.matches.observe(own.inlier_share)
            move, turn = result.prior_error
            self.threshold.observe(move + turn * result.lever_arm)
