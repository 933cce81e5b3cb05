"""Ground by height: the lowest points of a grid, a plane through most of them, and a cone filter over the grid.

`R` (3, 3) rotates LiDAR coordinates to level ones. The grid has `2 * half` cells to a side and the sensor in its middle.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from lslam.core.arrays import Floats
from lslam.core.kernels.jit import inline, kernel

NO_HEIGHT = 1e30


@inline
def cell_of(x: float, y: float, inverse: float, half: int) -> int:
    """Flat index, or -1, of the cell of a point x, y, m, in a grid of (2 half)^2 cells round the origin.

    inverse : 1/m, of a cell's size
    """
    i, j = int(np.floor(x * inverse)) + half, int(np.floor(y * inverse)) + half
    return i * 2 * half + j if 0 <= i < 2 * half and 0 <= j < 2 * half else -1


@kernel
def lowest(points: NDArray[np.float32], R: Floats, cell: float, half: int) -> NDArray[np.int64]:
    """Index (4 half^2,) of the lowest point, after rotation by R, in each cell of `cell` m; -1 for empty cells."""
    found, height = np.empty(4 * half * half, np.int64), np.empty(4 * half * half)
    found[:] = -1
    height[:] = NO_HEIGHT
    inverse = 1.0 / cell
    for k in range(len(points)):
        px, py, pz = float(points[k, 0]), float(points[k, 1]), float(points[k, 2])
        x = R[0, 0] * px + R[0, 1] * py + R[0, 2] * pz
        y = R[1, 0] * px + R[1, 1] * py + R[1, 2] * pz
        z = R[2, 0] * px + R[2, 1] * py + R[2, 2] * pz
        c = cell_of(x, y, inverse, half)
        if c >= 0 and z < height[c]:
            height[c] = z
            found[c] = k
    return found


@kernel
def best_plane(points: Floats, triples: NDArray[np.int64], tolerance: float, upright: float) -> Floats:
    """Plane n x, n y, n z, d (n p + d = 0, n upwards) through one of the triples (K, 3), or zeros when none is valid.

    The best has the highest number of points (N, 3) within `tolerance`, minus those below it: nothing lies under the
    ground. Planes with n z under `upright` are excluded.
    """
    x, y, z = points[:, 0].copy(), points[:, 1].copy(), points[:, 2].copy()
    best = np.zeros(4)
    best_score = 2
    for k in range(len(triples)):
        a, b, c = points[triples[k, 0]], points[triples[k, 1]], points[triples[k, 2]]
        ux, uy, uz = b[0] - a[0], b[1] - a[1], b[2] - a[2]
        vx, vy, vz = c[0] - a[0], c[1] - a[1], c[2] - a[2]
        nx, ny, nz = uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx
        length = np.sqrt(nx * nx + ny * ny + nz * nz)
        if length < 1e-9:
            continue
        scale = (1.0 if nz > 0 else -1.0) / length
        nx, ny, nz = nx * scale, ny * scale, nz * scale
        if nz < upright:
            continue
        d = -(nx * a[0] + ny * a[1] + nz * a[2])
        score = 0
        for i in range(len(x)):
            e = nx * x[i] + ny * y[i] + nz * z[i] + d
            score += (e <= tolerance) - 2 * (e < -tolerance)
        if score > best_score:
            best_score = score
            best[0], best[1], best[2], best[3] = nx, ny, nz, d
    return best


@kernel
def envelope(height: Floats, rise: float, tolerance: float) -> Floats:
    """Highest possible ground in each cell of `height` (n, n): the lowest cone, rising `rise` m per cell, over any cell.

    A cell supports a cone when at least a quarter of the cells within two of it, one or more, are as low, up to `tolerance`, m,
    and the rise: reflections from under the road have few neighbours. The distance is that of steps to the eight neighbours:
    two sweeps, at most 8 % longer than the straight line. `NO_HEIGHT` : no point, or no ground.
    """
    n = len(height)
    top = np.empty((n, n))
    top[:] = NO_HEIGHT
    for i in range(n):
        for j in range(n):
            h = height[i, j]
            if h >= NO_HEIGHT:
                continue
            seen = low = 0
            for a in range(max(i - 2, 0), min(i + 3, n)):
                for b in range(max(j - 2, 0), min(j + 3, n)):
                    if (a != i or b != j) and height[a, b] < NO_HEIGHT:
                        seen += 1
                        if height[a, b] < h + tolerance + 2.0 * rise:
                            low += 1
            if low > 0 and 4 * low >= seen:
                top[i, j] = h
    diagonal = rise * np.sqrt(2.0)
    for i in range(n):
        for j in range(n):
            t = top[i, j]
            if j > 0:
                t = min(t, top[i, j - 1] + rise)
            if i > 0:
                t = min(t, top[i - 1, j] + rise)
                if j > 0:
                    t = min(t, top[i - 1, j - 1] + diagonal)
                if j < n - 1:
                    t = min(t, top[i - 1, j + 1] + diagonal)
            top[i, j] = t
    for i in range(n - 1, -1, -1):
        for j in range(n - 1, -1, -1):
            t = top[i, j]
            if j < n - 1:
                t = min(t, top[i, j + 1] + rise)
            if i < n - 1:
                t = min(t, top[i + 1, j] + rise)
                if j < n - 1:
                    t = min(t, top[i + 1, j + 1] + diagonal)
                if j > 0:
                    t = min(t, top[i + 1, j - 1] + diagonal)
            top[i, j] = t
    return top


@kernel
def above(
    points: NDArray[np.float32],
    R: Floats,
    cell: float,
    half: int,
    top: Floats,
    tolerance: float,
) -> NDArray[np.int64]:
    """Indices of the points more than `tolerance`, m, over the ground `top` (2 half, 2 half), and of all outside of the grid.

    points : (N, 3) m; R : (3, 3) into the level axes of the grid; cell : edge, m; half : cells from the middle to a side
    """
    kept = np.empty(len(points), np.int64)
    count = 0
    inverse = 1.0 / cell
    for k in range(len(points)):
        px, py, pz = float(points[k, 0]), float(points[k, 1]), float(points[k, 2])
        x = R[0, 0] * px + R[0, 1] * py + R[0, 2] * pz
        y = R[1, 0] * px + R[1, 1] * py + R[1, 2] * pz
        z = R[2, 0] * px + R[2, 1] * py + R[2, 2] * pz
        c = cell_of(x, y, inverse, half)
        if c < 0 or z > top[c // (2 * half), c % (2 * half)] + tolerance:
            kept[count] = k
            count += 1
    return kept[:count]
