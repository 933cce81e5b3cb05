"""Width of the robust kernel, and detection of a drop in a scan's inlier share."""

from __future__ import annotations

import math
from dataclasses import dataclass

from lslam.core.kernels.linearisation import OUTLIER_SIGMAS, SIGNIFICANT_SIGMAS
from lslam.core.types.state import Stateful

# Of what was lately, what stays from scan to scan: a memory of five.
FORGETTING_FACTOR = 0.8
# m; the kernel's width at the end, five sigma of a point, and its factor from step to step.
KERNEL_MIN_M, KERNEL_DECAY = 0.15, 0.5
# Coarse planes: the kernel's width at the start, m, which is the capture range, and its factor.
COARSE_KERNEL_M, COARSE_DECAY = 5.0, 0.85
# Steps of each stage while starting or recovering.
START_ITERATIONS = 40


@dataclass(frozen=True)
class Annealing:
    """Widths of the Geman-McClure kernel, m: from `start` times `decay` per step down to `end`, `steps` at most."""

    start: float
    end: float
    decay: float
    steps: int


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
        """Learn from a good scan: at once what is more than usual, by and by what is less.

        Each scan fills the voxels of a young map, and the next one finds more of them: a mean over the last few lags behind.
        """
        self.usual = max(share, FORGETTING_FACTOR * self.usual + (1 - FORGETTING_FACTOR) * share)

    def relax(self) -> None:
        """Expect less after a bad scan, as if nothing had agreed: a place that has changed for good is accepted after a few."""
        self.usual *= FORGETTING_FACTOR


def is_more(count: int, other: int) -> bool:
    """Whether one count is larger than another by more than `SIGNIFICANT_SIGMAS` of both, as those of independent events."""
    return count - other > SIGNIFICANT_SIGMAS * math.sqrt(count + other)
