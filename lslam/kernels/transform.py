"""One rigid transform of a cloud of float32 points, in one pass without intermediate arrays."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from lslam.kernels.jit import kernel


@kernel
def transform(points: NDArray[np.float32], T: NDArray[np.float64], moved: NDArray[np.float32]) -> None:
    """Write T (4, 4) applied to points (N, 3), m, into `moved` (N, 3); computed in float64."""
    for i in range(len(points)):
        x, y, z = float(points[i, 0]), float(points[i, 1]), float(points[i, 2])
        for j in range(3):
            moved[i, j] = T[j, 0] * x + T[j, 1] * y + T[j, 2] * z + T[j, 3]
