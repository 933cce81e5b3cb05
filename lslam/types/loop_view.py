"""What a loop closure did to the map around it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class LoopSurroundings:
    """The surroundings of a loop as one trajectory has them.

    points : (N, 3) of the keyframes on both ways past it, m; older, newer : (A, 2), (B, 2) those ways; centre : (2,) of the
        older end
    """

    points: Floats
    older: Floats
    newer: Floats
    centre: Floats


@dataclass(frozen=True)
class LoopView:
    """The loop that the pose graph corrected most: between which scans, how far it moved one end against the other, m."""

    older_scan: int
    newer_scan: int
    correction: float
    before: LoopSurroundings
    after: LoopSurroundings
