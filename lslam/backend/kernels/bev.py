"""Images of a cloud from above.

Bird's-eye views: cells that its points fall into, counted and marked, and scores of their correlations. The polar image that Scan
Context compares: greatest height per ring and sector round the sensor.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from lslam.core.arrays import Floats, Longs
from lslam.core.kernels.jit import inline, kernel

Image = NDArray[np.float32]
Row = NDArray[np.float32]
OUTSIDE = -1


@inline
def cell_of(x: float, y: float, R: Floats, size: int, edge: float) -> tuple[int, int]:
    """Row and column of the position x, y, m, rotated by R (2, 2), among size x size cells of `edge` m about the origin.

    Both are OUTSIDE for a position beyond the cells.
    """
    row = math.floor((R[0, 0] * x + R[0, 1] * y) / edge) + size // 2
    column = math.floor((R[1, 0] * x + R[1, 1] * y) / edge) + size // 2
    if 0 <= row < size and 0 <= column < size:
        return row, column
    return OUTSIDE, OUTSIDE


@inline
def mark(points: Floats, R: Floats, edge: float, visible: Image) -> None:
    """Set cells (S, S) of `edge` m at the points (N, k), rotated by R (2, 2), and those round them, to 1."""
    size = len(visible)
    for i in range(len(points)):
        row, column = cell_of(points[i, 0], points[i, 1], R, size, edge)
        if row == OUTSIDE:
            continue
        for r in range(max(row - 1, 0), min(row + 2, size)):
            for c in range(max(column - 1, 0), min(column + 2, size)):
                visible[r, c] = np.float32(1.0)


@kernel
def view(points: Floats, ground: Floats, R: Floats, edge: float, most: float, images: Image) -> None:
    """Fill three zero images (3, S, S) of cells of `edge` m with points rotated by R (2, 2).

    First the points (N, k) per cell, up to `most`; second its square; third 1 in the cells of both clouds and round them.
    """
    size = images.shape[1]
    for i in range(len(points)):
        row, column = cell_of(points[i, 0], points[i, 1], R, size, edge)
        if row != OUTSIDE and images[0, row, column] < most:
            images[0, row, column] += np.float32(1.0)
            images[1, row, column] = images[0, row, column] * images[0, row, column]
    mark(points, R, edge, images[2])
    mark(ground, R, edge, images[2])


@kernel
def improve(sums: Image, cells: Longs, least: np.float32, yaw: np.float32, best: Row, turn: Row) -> None:
    """Where sums (3, C) at the cells (K,) give a better score than `best` (K,), store it there, and `yaw` in `turn` (K,).

    The score is the first sum by the root of the product of the others, 0 where the second is below `least`.
    """
    for k in range(len(cells)):
        cell = cells[k]
        match, own = sums[0, cell], sums[1, cell]
        if not (match > np.float32(0.0) and own >= least):
            continue
        product = max(own * sums[2, cell], np.float32(1.0))
        # Most cells have had a better score: the root is taken where rounding might tell.
        if match * match < np.float32(0.999) * best[k] * best[k] * product:
            continue
        score = match / np.sqrt(product)
        if score > best[k]:
            best[k], turn[k] = score, yaw


@kernel
def fit(
    image: Image, cells: Longs, structure: Row, least: float, row: int, column: int, reach: int
) -> tuple[float, int, int]:
    """The best score of structure (K,) in cells (K, 2) shifted onto an image (S, S), NaN where not observed, and its shift.

    row, column : of the first cell; shifts of up to `reach` cells more or less are tried. The score is normalised over the
    cells that both observed, and 0 where the sum of the squares of the structure there is below `least`.
    """
    best, best_row, best_column = 0.0, 0, 0
    for r in range(row - reach, row + reach + 1):
        for c in range(column - reach, column + reach + 1):
            match = own = other = 0.0
            for k in range(len(cells)):
                i, j = cells[k, 0] + r, cells[k, 1] + c
                if not (0 <= i < len(image) and 0 <= j < len(image)):
                    continue
                here, there = structure[k], image[i, j]
                if there == there:
                    match += here * there
                    own += here * here
                    other += there * there
            if own >= least and match > best * math.sqrt(own * other):
                best, best_row, best_column = match / math.sqrt(own * other), r - row, c - column
    return best, best_row, best_column


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
