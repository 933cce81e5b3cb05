"""Walls as line segments: points whose neighbourhood is a vertical plane, projected to the ground, and lines by RANSAC.

A row of `flat` (M, 5) float64 is one column of wall points: x, y, m, their horizontal unit normal, their number.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from lslam.core.arrays import Floats, Ints, Longs
from lslam.core.kernels.jit import inline, kernel
from lslam.core.kernels.linalg import plane_of
from lslam.core.kernels.voxel import index_of, pack, place_of, table_size


@inline
def upright_plane(
    ix: int, iy: int, iz: int, table: Ints, keys: Longs, sums: Floats, tilt: float, thickness: float, total: Floats
) -> tuple[float, float]:
    """Horizontal unit normal of the points in the eight cells about a corner of the lattice; 0, 0 where they are no wall.

    ix, iy, iz : of the corner; table, keys, sums : the cells' hash table, keys and moments
    tilt : largest vertical part of a wall's unit normal; thickness : largest standard deviation across it, m
    total : (10,) workspace for the sum of the moments
    """
    for i in range(10):
        total[i] = 0.0
    for a in range(2):
        for b in range(2):
            for c in range(2):
                h = place_of(pack(ix - a, iy - b, iz - c), keys, table)
                if table[h] >= 0:
                    for i in range(10):
                        total[i] += sums[table[h], i]
    if total[0] < 5.0:
        return 0.0, 0.0
    w = 1.0 / total[0]
    for i in range(1, 10):
        total[i] *= w
    mx, my, mz, xx, xy, xz = total[1], total[2], total[3], total[4], total[5], total[6]
    l0, l1, _, nx, ny, nz = plane_of(
        xx - mx * mx, xy - mx * my, xz - mx * mz, total[7] - my * my, total[8] - my * mz, total[9] - mz * mz
    )
    # The second eigenvalue decides how well the normal is known: points of one ring lie on a line on every surface.
    if abs(nz) > tilt or l0 > thickness * thickness or l1 < 6.0 * l0 or l1 < 4.0 * thickness * thickness:
        return 0.0, 0.0
    length = math.sqrt(nx * nx + ny * ny)
    return nx / length, ny / length


@kernel
def flat_walls(
    points: NDArray[np.float32], used_points: Longs, cell: float, tilt: float, thickness: float, thin: float
) -> tuple[Floats, Floats]:
    """Points on vertical planes, thinned: one row of (M, 5) per cell of `thin`, m: x, y, normal x, y, and number of points.

    points : (N, 3), m; used_points : (K,) their indices in `points`
    cell : m; the neighbourhood of a point is the eight cells about the nearest corner of their lattice
    tilt : largest vertical component of the unit normal; thickness : largest standard deviation across the plane, m

    The second result (L, 3) has x, y and number of all used points in each cell.
    """
    n = len(used_points)
    entries = table_size(n)
    table = np.full(entries, -1, np.int32)
    keys = np.empty(n, np.int64)
    sums = np.zeros((n, 10))
    inverse = 1.0 / cell
    count = 0
    for k in range(n):
        p = points[used_points[k]]
        x, y, z = float(p[0]), float(p[1]), float(p[2])
        key = pack(index_of(x, inverse), index_of(y, inverse), index_of(z, inverse))
        h = place_of(key, keys, table)
        if table[h] < 0:
            table[h] = count
            keys[count] = key
            count += 1
        moments = (np.float32(1.0), x, y, z, x * x, x * y, x * z, y * y, y * z, z * z)
        for i in range(10):
            sums[table[h], i] += moments[i]
    corner_table = np.full(entries, -1, np.int32)
    corner_keys = np.empty(n, np.int64)
    normals, total = np.empty((n, 2)), np.empty(10)
    corners = 0
    flat_table = np.full(entries, -1, np.int32)
    flat_keys = np.empty(n, np.int64)
    flat = np.zeros((n, 5))
    every = np.zeros((n, 3))
    rows = 0
    for k in range(n):
        p = points[used_points[k]]
        x, y, z = float(p[0]), float(p[1]), float(p[2])
        key = pack(index_of(x, 1.0 / thin), index_of(y, 1.0 / thin), 0)
        h = place_of(key, flat_keys, flat_table)
        if flat_table[h] < 0:
            flat_table[h] = rows
            flat_keys[rows] = key
            rows += 1
        row = flat_table[h]
        every[row, 0] += x
        every[row, 1] += y
        every[row, 2] += 1.0
        half = 0.5 * cell
        ix, iy, iz = index_of(x + half, inverse), index_of(y + half, inverse), index_of(z + half, inverse)
        key = pack(ix, iy, iz)
        h = place_of(key, corner_keys, corner_table)
        if corner_table[h] < 0:
            corner_table[h] = corners
            corner_keys[corners] = key
            nx, ny = upright_plane(ix, iy, iz, table, keys, sums, tilt, thickness, total)
            normals[corners, 0], normals[corners, 1] = nx, ny
            corners += 1
        nx, ny = normals[corner_table[h], 0], normals[corner_table[h], 1]
        if nx == 0.0 and ny == 0.0:
            continue
        f = flat[row]
        # Opposite normals describe one plane.
        sign = -1.0 if f[2] * nx + f[3] * ny < 0.0 else 1.0
        f[0] += x
        f[1] += y
        f[2] += sign * nx
        f[3] += sign * ny
        f[4] += 1.0
    m = 0
    for r in range(rows):
        every[r, 0] /= every[r, 2]
        every[r, 1] /= every[r, 2]
        f = flat[r]
        if f[4] > 0.0:
            length = max(math.sqrt(f[2] * f[2] + f[3] * f[3]), 1e-9)
            flat[m, 0], flat[m, 1], flat[m, 2], flat[m, 3] = f[0] / f[4], f[1] / f[4], f[2] / length, f[3] / length
            flat[m, 4] = f[4]
            m += 1
    return flat[:m], every[:rows]


@inline
def best_line(flat: Floats, tries: Longs, first: int, tolerance: float, agreement: float) -> int:
    """Row of `flat` (M, 5), one of `tries[first]`, whose line has most points.

    The line goes through the row's position, across its normal. A point lies on it within `tolerance`, m, and if the cosine
    between the normals is at least `agreement`.
    """
    best, best_score = -1, -1.0
    for t in range(tries.shape[1]):
        k = tries[first, t] % len(flat)
        x, y, nx, ny = flat[k, 0], flat[k, 1], flat[k, 2], flat[k, 3]
        score = 0.0
        for j in range(len(flat)):
            f = flat[j]
            if abs((f[0] - x) * nx + (f[1] - y) * ny) <= tolerance and abs(f[2] * nx + f[3] * ny) >= agreement:
                score += f[4]
        if score > best_score:
            best, best_score = k, score
    return best


@inline
def heaviest_run(
    flat: Floats, line: Floats, tolerance: float, agreement: float, gap: float, bins: Floats
) -> tuple[float, float, float]:
    """Begin and end, m along a line (x, y, nx, ny), of its stretch without a gap that has most points, and their number.

    bins : (B, 3) workspace: lowest and highest position, m, and number of points in each interval of `gap`, m; a sort would
        take longer to compile than the rest of this module
    """
    half = len(bins) // 2
    for i in range(len(bins)):
        bins[i, 2] = 0.0
    for j in range(len(flat)):
        f = flat[j]
        dx, dy = f[0] - line[0], f[1] - line[1]
        if abs(dx * line[2] + dy * line[3]) <= tolerance and abs(f[2] * line[2] + f[3] * line[3]) >= agreement:
            s = dy * line[2] - dx * line[3]
            b = bins[min(max(int(np.floor(s / gap)) + half, 0), len(bins) - 1)]
            b[0] = s if b[2] == 0.0 else min(b[0], s)
            b[1] = s if b[2] == 0.0 else max(b[1], s)
            b[2] += f[4]
    best_low = best_high = low = high = best = total = 0.0
    for i in range(len(bins)):
        b = bins[i]
        if b[2] == 0.0:
            continue
        if total == 0.0 or b[0] - high > gap:
            low, total = b[0], 0.0
        high = b[1]
        total += b[2]
        if total > best:
            best, best_low, best_high = total, low, high
    return best_low, best_high, best


@inline
def reach_out(
    every: Floats, line: Floats, low: float, high: float, tolerance: float, step: float, along: Floats
) -> tuple[float, float]:
    """Begin and end, m, of a stretch of a line, extended thrice by points of `every` (L, 3) at most `step`, m, beyond an end.

    Near a corner the neighbourhood of a point is two walls and no plane. Such points do not begin a segment, but extend it.
    low, high : m, of the stretch along the line; tolerance : largest distance of a point from the line, m
    along : (L,) workspace for the positions of the points near the line
    """
    count = 0
    for j in range(len(every)):
        dx, dy = every[j, 0] - line[0], every[j, 1] - line[1]
        if abs(dx * line[2] + dy * line[3]) <= tolerance:
            along[count] = dy * line[2] - dx * line[3]
            count += 1
    for _ in range(3):
        new_low, new_high = low, high
        for j in range(count):
            s = along[j]
            if low - step <= s < new_low:
                new_low = s
            elif new_high < s <= high + step:
                new_high = s
        low, high = new_low, new_high
    return low, high


@inline
def refit(flat: Floats, line: Floats, low: float, high: float, tolerance: float, agreement: float) -> float:
    """Replace `line` (4,) by the total least squares line of its points between `low` and `high`, m; returns their rms, m.

    Without points it stays, and the rms is 0.
    line : x, y, m, of a point on it, and its unit normal; tolerance, agreement : as in `best_line`
    """
    n = sx = sy = xx = xy = yy = 0.0
    for j in range(len(flat)):
        f = flat[j]
        dx, dy = f[0] - line[0], f[1] - line[1]
        s = dy * line[2] - dx * line[3]
        if low <= s <= high and abs(dx * line[2] + dy * line[3]) <= tolerance:
            if abs(f[2] * line[2] + f[3] * line[3]) < agreement:
                continue
            w = f[4]
            n += w
            sx += w * dx
            sy += w * dy
            xx += w * dx * dx
            xy += w * dx * dy
            yy += w * dy * dy
    if n <= 0.0:
        return 0.0
    mx, my = sx / n, sy / n
    xx, xy, yy = xx / n - mx * mx, xy / n - mx * my, yy / n - my * my
    # The normal is the short axis of the covariance.
    angle = 0.5 * math.atan2(2.0 * xy, xx - yy)
    nx, ny = -math.sin(angle), math.cos(angle)
    if nx * line[2] + ny * line[3] < 0.0:
        nx, ny = -nx, -ny
    line[0] += mx
    line[1] += my
    line[2], line[3] = nx, ny
    return math.sqrt(max(xx * nx * nx + 2.0 * xy * nx * ny + yy * ny * ny, 0.0))


@kernel
def find_segments(
    flat: Floats,
    every: Floats,
    tries: Longs,
    tolerance: float,
    agreement: float,
    gap: float,
    min_cluster: float,
    min_length: float,
    step: float,
) -> Floats:
    """Segments (S, 6) through `flat` (M, 5), those of most points first: x, y of both ends, number of points, their rms; m.

    Del Tufo, algorithm 3.1: RANSAC finds the best of a few lines, and the segment spans the largest cluster of its inliers,
    which is then removed. This repeats until fewer than `min_cluster` points or no row of random numbers `tries` (R, K) is
    left. A hypothesis is one point with its own normal, not two points.
    every : (L, 3) x, y, m, and number of all points; tolerance, agreement : as in `best_line`; gap : largest in a segment, m
    min_length : of a segment, m; step : largest gap to a point of `every` that extends it, m
    """
    flat = flat.copy()
    found = np.empty((len(tries), 6))
    count = 0
    line, along = np.empty(4), np.empty(len(every))
    widest = 0.0
    for j in range(len(flat)):
        widest = max(widest, 3.0 * abs(flat[j, 0]), 3.0 * abs(flat[j, 1]))
    bins = np.empty((2 * (int(widest / gap) + 2), 3))
    for r in range(len(tries)):
        total = 0.0
        for j in range(len(flat)):
            total += flat[j, 4]
        if len(flat) < 2 or total < min_cluster:
            break
        first = best_line(flat, tries, r, tolerance, agreement)
        line[:] = flat[first, :4]
        rms = 0.0
        for _ in range(3):
            low, high, _ = heaviest_run(flat, line, tolerance, agreement, gap, bins)
            rms = refit(flat, line, low, high, tolerance, agreement)
        low, high, weight = heaviest_run(flat, line, tolerance, agreement, gap, bins)
        low, high = reach_out(every, line, low, high, tolerance, step, along)
        px, py, nx, ny = line[0], line[1], line[2], line[3]
        if weight >= min_cluster and high - low >= min_length:
            found[count, 0], found[count, 1] = px - low * ny, py + low * nx
            found[count, 2], found[count, 3] = px - high * ny, py + high * nx
            found[count, 4], found[count, 5] = weight, rms
            count += 1
        kept = 0
        for j in range(len(flat)):
            dx, dy = flat[j, 0] - px, flat[j, 1] - py
            s = dy * nx - dx * ny
            if abs(dx * nx + dy * ny) > tolerance or s < low - tolerance or s > high + tolerance:
                flat[kept] = flat[j]
                kept += 1
        if kept == len(flat):
            kept -= 1  # no point is left on the line after the fit: remove one, so that the search ends
        flat = flat[:kept]
    return found[:count]
