"""Deskewing: points fired while the sensor moved, brought to one instant."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from lslam.kernels.jit import kernel


@kernel
def deskew(
    points: Any, times: NDArray[np.float32], start: float, step: float, knots: NDArray[np.float64], moved: Any
) -> None:
    """Write points (N, 3) at `times` (N,), s, into `moved` (N, 3) as the pose `knots` carries them.

    knots : (K, 3, 4) transforms at start, start + step, ...; between two of them the matrices are blended, before the
    first and after the last the outer pair is continued.
    """
    last = len(knots) - 2
    for i in range(len(points)):
        s = (times[i] - start) / step
        if not np.isfinite(s):
            s = -start / step
        k = min(max(int(np.floor(s)), 0), last)
        b = s - k
        a = 1.0 - b
        p, q = knots[k], knots[k + 1]
        x, y, z = points[i, 0], points[i, 1], points[i, 2]
        for j in range(3):
            moved[i, j] = (
                (a * p[j, 0] + b * q[j, 0]) * x
                + (a * p[j, 1] + b * q[j, 1]) * y
                + (a * p[j, 2] + b * q[j, 2]) * z
                + a * p[j, 3]
                + b * q[j, 3]
            )
