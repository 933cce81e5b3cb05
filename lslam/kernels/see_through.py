"""Which points of one scan another scan sees through: range images and votes."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from lslam.kernels.jit import inline, kernel


@inline
def _pixel(x: float, y: float, z: float, low: float, inverse: float, columns: int) -> tuple[int, int]:
    """Row (elevation above `low`, rad) and column (azimuth) of a direction; the row may lie outside the image."""
    row = math.floor((math.atan2(z, math.sqrt(x * x + y * y)) - low) * inverse)
    column = int((math.atan2(y, x) + math.pi) / (2.0 * math.pi) * columns)
    return row, column - columns if column >= columns else column


@kernel
def nearest_ranges(
    points: NDArray[np.float32], stands: NDArray[np.bool_], rows: int, columns: int, low: float, inverse: float
) -> NDArray[np.float32]:
    """(rows, columns, 2) of the nearest point (N, 3) of the sensor's frame in each pixel: its range and its height, m.

    The range is inf where there is no point; the height, along the sensor's z, is NaN unless the point is ground.
    stands : (N,) whether it is not ground; low : elevation of the lowest row's lower edge, rad; inverse : rows per rad
    """
    image = np.full((rows, columns, 2), np.float32(np.inf))
    image[:, :, 1] = np.nan
    for i in range(len(points)):
        x, y, z = float(points[i, 0]), float(points[i, 1]), float(points[i, 2])
        r2 = x * x + y * y + z * z
        if not (r2 > 1e-6 and np.isfinite(r2)):
            continue
        row, column = _pixel(x, y, z, low, inverse, columns)
        if 0 <= row < rows:
            r = np.float32(math.sqrt(r2))
            if r < image[row, column, 0]:
                image[row, column, 0] = r
                image[row, column, 1] = np.nan if stands[i] else z
    return image


@kernel
def vote(
    points: NDArray[np.float32],
    T: NDArray[np.float64],
    image: NDArray[np.float32],
    low: float,
    inverse: float,
    margin: float,
    slope: float,
    step: float,
    free: NDArray[np.int16],
    hit: NDArray[np.int16],
) -> None:
    """Count for each point whether the scan behind `image` looked through where it is, or saw something there.

    points : (N, 3) in their own frame, T : (4, 4) into the frame of the image
    It is free when all that was measured in its pixel and the eight around it lies `margin` + `slope` r, m, behind it, and
    the row below is not empty: neither the edge of a thing nor ground met at a grazing angle is taken for free then. Ground
    as far away as the point is says that something was there only within `step` of that in height: a foot is not what it
    stands on.
    """
    rows, columns = image.shape[:2]
    for i in range(len(points)):
        px, py, pz = float(points[i, 0]), float(points[i, 1]), float(points[i, 2])
        x = T[0, 0] * px + T[0, 1] * py + T[0, 2] * pz + T[0, 3]
        y = T[1, 0] * px + T[1, 1] * py + T[1, 2] * pz + T[1, 3]
        z = T[2, 0] * px + T[2, 1] * py + T[2, 2] * pz + T[2, 3]
        r = math.sqrt(x * x + y * y + z * z)
        if not (r > 0.5 and np.isfinite(r)):
            continue
        row, column = _pixel(x, y, z, low, inverse, columns)
        if row < 1 or row >= rows or not np.isfinite(image[row, column, 0]):
            continue
        reach = margin + slope * r
        nearest = np.float32(np.inf)
        below = False
        for a in range(-1, 2):
            if row + a >= rows:
                continue
            for b in range(-1, 2):
                c = column + b
                c = c + columns if c < 0 else c - columns if c >= columns else c
                seen = image[row + a, c, 0]
                nearest = min(nearest, seen)
                below |= a < 0 and np.isfinite(seen)
        if abs(image[row, column, 0] - r) <= reach:
            if not abs(image[row, column, 1] - z) > step * reach:
                hit[i] += 1
        elif below and nearest > r + reach:
            free[i] += 1
