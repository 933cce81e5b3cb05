"""Features of one scan in the cells of a hashed grid, with the ring of each. The next scan's features are matched with them.

A grid is points (N, 3) float64 world, m, cell after cell and in a cell ring after ring; rings (N,) uint16;
starts (C + 1,) int32, the ranges of the cells;
keys (C,) int64, packed cells; table (E,) int32, open addressing.
"""

from __future__ import annotations

import math

import numpy as np

from lslam.core.arrays import Floats, Ints, Longs, Rings
from lslam.core.kernels.gaussians import find
from lslam.core.kernels.jit import inline, kernel
from lslam.core.kernels.voxel import OFFSET, index_of, pack, place_of, table_size

# Indices of the counterparts of each point (S, 3); for each where the point was, world, m, and the squared distance, m2, within
# which it stays the same (S, 3, 4).
Matches = tuple[Ints, Floats]

# Two rings up or down, as in LOAM. (Rings are unsigned, also after int() in a kernel: their difference would wrap.)
NEARBY_RINGS = 2


@kernel
def build(points: Floats, rings: Rings, R: Floats, t: Floats, size: float) -> tuple[Floats, Rings, Ints, Longs, Ints]:
    """Grid of points (N, 3), LiDAR frame, at pose R, t, cells of `size`, m; rings (N,) ascend. Too far points are left out."""
    n = len(points)
    table = np.full(table_size(n), -1, np.int32)
    keys = np.empty(n, np.int64)
    counts = np.zeros(n + 1, np.int32)
    cells = np.full(n, -1, np.int32)
    world = np.empty((n, 3))
    inverse = 1.0 / size
    limit = float(OFFSET - 2)
    used = 0
    for i in range(n):
        a, b, c = points[i, 0], points[i, 1], points[i, 2]
        x = R[0, 0] * a + R[0, 1] * b + R[0, 2] * c + t[0]
        y = R[1, 0] * a + R[1, 1] * b + R[1, 2] * c + t[1]
        z = R[2, 0] * a + R[2, 1] * b + R[2, 2] * c + t[2]
        world[i, 0], world[i, 1], world[i, 2] = x, y, z
        if not (abs(x) * inverse < limit and abs(y) * inverse < limit and abs(z) * inverse < limit):
            continue
        key = pack(index_of(x, inverse), index_of(y, inverse), index_of(z, inverse))
        h = place_of(key, keys, table)
        if table[h] < 0:
            table[h] = used
            keys[used] = key
            used += 1
        cells[i] = table[h]
        counts[table[h] + 1] += 1
    for k in range(used):
        counts[k + 1] += counts[k]
    kept = counts[used]
    starts = counts[: used + 1].copy()
    ordered, ordered_rings = np.empty((kept, 3)), np.empty(kept, np.uint16)
    for i in range(n):
        cell = cells[i]
        if cell >= 0:
            j = counts[cell]
            counts[cell] += 1
            ordered[j, 0], ordered[j, 1], ordered[j, 2] = world[i, 0], world[i, 1], world[i, 2]
            ordered_rings[j] = rings[i]
    return ordered, ordered_rings, starts, keys[:used].copy(), table


@inline
def _gap(low: float, size: float, v: float) -> float:
    """How far v lies outside [low, low + size]."""
    if v < low:
        return low - v
    if v > low + size:
        return v - low - size
    return 0.0


@inline
def nearest(
    x: float,
    y: float,
    z: float,
    size: float,
    limit: float,
    ring: int | np.int64,
    nearby: int,
    own: int,
    points: Floats,
    rings: Rings,
    starts: Ints,
    keys: Longs,
    table: Ints,
) -> tuple[int, float, float]:
    """Index of the point of the grid that is nearest to x, y, z and less than `limit`, m, away, and its squared distance, m2.

    The index is -1 when there is none. The third value is the squared distance, m2, of the second nearest, `limit`^2 at most.
    size : m, of a cell; own : index of a point that does not count
    nearby : -1 allows every ring, 0 only `ring`, without `own`, n > 0 other rings that differ by n at most
    """
    inverse = 1.0 / size
    best, best_d, next_d = -1, limit * limit, limit * limit
    if not (np.isfinite(x) and np.isfinite(y) and np.isfinite(z)):
        return -1, best_d, next_d
    ix, iy, iz = index_of(x, inverse), index_of(y, inverse), index_of(z, inverse)
    if max(abs(ix), abs(iy), abs(iz)) > OFFSET - 2 - limit * inverse:
        return -1, best_d, next_d
    fx, fy, fz = x - ix * size, y - iy * size, z - iz * size
    margin = min(fx, size - fx, fy, size - fy, fz, size - fz)
    # Shell after shell of cells: points that are found in a near shell are nearer than all points of the farther ones.
    for shell in range(int(np.ceil(limit * inverse)) + 1):
        least = margin + (shell - 1) * size
        if shell > 0 and least * least >= next_d:
            break
        for jx in range(ix - shell, ix + shell + 1):
            gx = _gap(jx * size, size, x)
            for jy in range(iy - shell, iy + shell + 1):
                gy = _gap(jy * size, size, y)
                gxy = gx * gx + gy * gy
                if gxy >= next_d:
                    continue
                is_side = abs(jx - ix) == shell or abs(jy - iy) == shell
                for jz in range(iz - shell, iz + shell + 1, 1 if is_side else max(2 * shell, 1)):
                    gz = _gap(jz * size, size, z)
                    if gxy + gz * gz >= next_d:
                        continue
                    cell = find(pack(jx, jy, jz), keys, table)
                    if cell < 0:
                        continue
                    for j in range(starts[cell], starts[cell + 1]):
                        if nearby >= 0:
                            above = np.int64(rings[j]) - ring
                            if above > nearby:
                                break
                            if above < -nearby or (j == own if nearby == 0 else above == 0):
                                continue
                        dx, dy, dz = points[j, 0] - x, points[j, 1] - y, points[j, 2] - z
                        d = dx * dx + dy * dy + dz * dz
                        if d < best_d:
                            next_d, best_d, best = best_d, d, j
                        elif d < next_d:
                            next_d = d
    return best, best_d, next_d


@inline
def counterparts(
    x: float,
    y: float,
    z: float,
    i: int,
    is_surface: bool,
    count: int,
    reach: tuple[float, float],
    grid: tuple[Floats, Rings, Ints, Longs, Ints],
    search: Matches,
) -> None:
    """Fill in the indices of the `count` counterparts of point i at x, y, z, world; -1 from the first missing one on.

    The nearest point; on a surface the next one of its ring; the nearest one of neighbouring rings. A result is reused while the
    point moves by less than half of the difference between the distances to the second nearest and to the nearest one.
    reach : size of a cell, and largest distance of a counterpart, m
    """
    chosen, asked = search
    size, limit = reach
    points, rings, starts, keys, table = grid
    ring, first, is_other = np.int64(0), -1, False
    for k in range(count):
        q = asked[i, k]
        found = int(chosen[i, k])
        if is_other or (x - q[0]) ** 2 + (y - q[1]) ** 2 + (z - q[2]) ** 2 >= q[3]:
            nearby = -1 if k == 0 else (0 if is_surface and k == 1 else NEARBY_RINGS)
            before = found
            found, d, next_d = nearest(x, y, z, size, limit, ring, nearby, first, points, rings, starts, keys, table)
            chosen[i, k] = found
            margin = math.sqrt(next_d) - math.sqrt(d)
            q[0], q[1], q[2], q[3] = x, y, z, 0.25 * margin * margin if found >= 0 else -1.0
            is_other = is_other or (k == 0 and found != before)
        if found < 0:
            for m in range(k + 1, count):
                chosen[i, m], asked[i, m, 3] = -1, -1.0
            break
        if k == 0:
            first, ring = found, np.int64(rings[found])
