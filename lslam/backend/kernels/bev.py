"""Cells of a bird's-eye view that the points of a cloud fall into, counted or marked."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from lslam.core.kernels.jit import inline, kernel

Floats = NDArray[np.float64]
OUTSIDE = -1


@inline
def cell_of(x: float, y: float, R: Floats, size: int, edge: float) -> tuple[int, int]:
    """Row and column of the position x, y, m, rotated by R (2, 2), among size x size cells of `edge` m about the origin.

    Both are OUTSIDE for a position beyond the cells."""
    row = math.floor((R[0, 0] * x + R[0, 1] * y) / edge) + size // 2
    column = math.floor((R[1, 0] * x + R[1, 1] * y) / edge) + size // 2
    if 0 <= row < size and 0 <= column < size:
        return row, column
    return OUTSIDE, OUTSIDE


@kernel
def count(points: Floats, R: Floats, edge: float, most: float, counts: NDArray[np.float32]) -> None:
    """Add the points (N, k), rotated by R (2, 2), to the counts (S, S) of cells of `edge` m, up to `most` each."""
    for i in range(len(points)):
        row, column = cell_of(points[i, 0], points[i, 1], R, len(counts), edge)
        if row != OUTSIDE and counts[row, column] < most:
            counts[row, column] += np.float32(1.0)


@kernel
def mark(points: Floats, R: Floats, edge: float, seen: NDArray[np.float32]) -> None:
    """Set the cells (S, S), of `edge` m, of the points (N, k) rotated by R (2, 2), and those round them, to 1."""
    size = len(seen)
    for i in range(len(points)):
        row, column = cell_of(points[i, 0], points[i, 1], R, size, edge)
        if row == OUTSIDE:
            continue
        for r in range(max(row - 1, 0), min(row + 2, size)):
            for c in range(max(column - 1, 0), min(column + 2, size)):
                seen[r, c] = np.float32(1.0)
