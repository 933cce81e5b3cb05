"""The polar image of a cloud that Scan Context compares: greatest height per ring and sector round the sensor."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from lslam.core.kernels.jit import kernel

EMPTY = -np.inf


@kernel
def polar_image(points: NDArray[np.float32], rings: int, sectors: int, reach: float) -> NDArray[np.float32]:
    """Greatest z of the points (N, 3), m, in each of `rings` x `sectors` cells within `reach` m; -inf where none lies.

    Sector 0 begins at +x and sectors count counter-clockwise (equations 2.34 and 2.35 of Girolimetto).
    """
    image = np.empty((rings, sectors), np.float32)
    image[:] = EMPTY
    per_metre = rings / reach
    per_radian = sectors / (2.0 * math.pi)
    for i in range(len(points)):
        x, y, z = float(points[i, 0]), float(points[i, 1]), points[i, 2]
        ring = math.sqrt(x * x + y * y) * per_metre
        # Also false for NaN.
        if not (ring < rings and np.isfinite(z)):
            continue
        angle = math.atan2(y, x)
        if angle < 0.0:
            angle += 2.0 * math.pi
        # Just below the x axis the sum can round to a whole turn.
        sector = min(int(angle * per_radian), sectors - 1)
        if z > image[int(ring), sector]:
            image[int(ring), sector] = z
    return image
