"""What the points of a scan say of its pose, as a quadratic about where it was linearised."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class ScanEquations:
    """Normal equations of a scan on a map: the cost grows by g d + d H d / 2 as its pose moves by d.

    T_world_lidar : (4, 4) at the scan's stamp, where H (6, 6) and g (6,) hold; t' = t + d[:3], R' = exp(d[3:]) R in world
        axes, 1/m2 and 1/rad2
    """

    stamp_ns: int
    T_world_lidar: NDArray[np.float64]
    H: NDArray[np.float64]
    g: NDArray[np.float64]
