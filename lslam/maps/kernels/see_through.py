"""Points of one scan that beams of another scan pass through: range images and votes."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from lslam.core.kernels.jit import inline, kernel


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
    """Range image (rows, columns, 3) of points (N, 3), sensor frame: range, height and clear range of each pixel, m.

    The range is that of the nearest point, inf without one. The height, along the sensor's z, is that of the same point, NaN
    unless it is ground. The clear range is the least range in the pixel and the eight around it, 0 where the row below is
    empty.
    stands : (N,) whether a point is off the ground; low : elevation of the lowest row's lower edge, rad; inverse : rows per rad
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
    """Least range in a pixel and the eight around it, m; 0 where the row below is empty."""
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
    """Count for each point whether the scan of `image` passed through its place or measured a surface there.

    It passed through, counted in `free` (N,), when all ranges in the point's pixel and the eight around it are larger than the
    point's by the tolerance, and the row below is not empty. So edges of objects and ground at grazing angles are not free.
    It measured a surface, counted in `hit` (N,), when the range of the pixel differs by the tolerance at most. Ground does so
    only when its height differs by `step` times the tolerance at most: it does not confirm the foot of an object.

    points : (N, 3), m, in their own frame; T : (4, 4) from there to the frame of the image
    margin, slope : the tolerance is `margin` + `slope` r, m, for a point at range r
    left : number of images still to come, this one included; a point with more hits than that above its free counts is
        skipped, since its majority is decided
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
