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
    """(rows, columns, 3) of the nearest point (N, 3) of the sensor's frame in each pixel: range, height, and what is clear, m.

    The range is inf where there is no point; the height, along the sensor's z, is NaN unless the point is ground. Clear is
    the way to the nearest point in the pixel and the eight around it, and 0 where the row below is empty.
    stands : (N,) whether it is not ground; low : elevation of the lowest row's lower edge, rad; inverse : rows per rad
    """
    image = np.full((rows, columns, 3), np.float32(np.inf))
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
    for row in range(rows):
        for column in range(columns):
            image[row, column, 2] = _clear(image, row, column)
    return image


@inline
def _clear(image: NDArray[np.float32], row: int, column: int) -> np.float32:
    """The nearest range in a pixel and those around it; 0 where the row below is empty."""
    rows, columns = image.shape[:2]
    left = column - 1 if column > 0 else columns - 1
    right = column + 1 if column + 1 < columns else 0
    nearest = np.float32(np.inf)
    for a in range(max(row - 1, 0), min(row + 2, rows)):
        nearest = min(nearest, image[a, left, 0], image[a, column, 0], image[a, right, 0])
        if a < row and not np.isfinite(nearest):
            return np.float32(0.0)
    return nearest if row > 0 else np.float32(0.0)


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
    left: int,
    free: NDArray[np.int16],
    hit: NDArray[np.int16],
) -> None:
    """Count for each point whether the scan behind `image` looked through where it is, or saw something there.

    points : (N, 3) in their own frame, T : (4, 4) into the frame of the image
    It is free when all that was measured in its pixel and the eight around it lies `margin` + `slope` r, m, behind it, and
    the row below is not empty: neither the edge of a thing nor ground met at a grazing angle is taken for free then. Ground
    as far away as the point is says that something was there only within `step` of that in height: a foot is not what it
    stands on.
    left : images still to come, this one included; a point that more than so many of those before saw than looked through
        is not asked again, as more of them saw it whatever the rest say
    """
    rows, columns = image.shape[:2]
    for i in range(len(points)):
        if hit[i] - free[i] > left:
            continue
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
        if abs(image[row, column, 0] - r) <= reach:
            if not abs(image[row, column, 1] - z) > step * reach:
                hit[i] += 1
        elif image[row, column, 2] > r + reach:
            free[i] += 1
