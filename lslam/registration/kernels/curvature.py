"""LOAM's features: points in ring order, the curvature along each ring (Girolimetto, equation 2.21), edges and planes.

A ring is walked in the order its beams were fired. `order` (K,) holds indices of points, ring after ring; ring k owns
`order[starts[k]:starts[k + 1]]`.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from lslam.core.arrays import Bools, Floats
from lslam.core.kernels.jit import kernel

SIDE_POINTS = 5  # neighbours on each side
EDGE, LESS_EDGE, NEITHER, LESS_PLANE, PLANE = 2, 1, 0, -1, -2

# Coarser than any spinning LiDAR: neighbours farther apart do not lie on one surface.
WIDEST_STEP = np.radians(2.0)
# A histogram of steps reaches twice as far.
_BIN = np.radians(0.01)
_BINS = round(2 * WIDEST_STEP / _BIN)


@kernel
def into_rings(
    rings: NDArray[np.uint16], chosen_points: NDArray[np.int64]
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Order (K,) of the `chosen_points` by ring, in their own order within each, and where each ring starts in it.

    The starts (max ring + 2,) end with K.
    """
    count = np.int64(0)
    for i in chosen_points:
        ring = np.int64(rings[i])
        if ring >= count:
            count = ring + 1
    starts = np.zeros(count + 1, np.int64)
    for i in chosen_points:
        starts[rings[i] + 1] += 1
    for k in range(count):
        starts[k + 1] += starts[k]
    fill = starts.copy()
    order = np.empty(chosen_points.shape[0], np.int64)
    for i in chosen_points:
        k = rings[i]
        order[fill[k]] = i
        fill[k] += 1
    return order, starts


@kernel
def walk(
    points: NDArray[np.float32], order: NDArray[np.int64], starts: NDArray[np.int64]
) -> tuple[Floats, Floats, Floats, float, float, float]:
    """Walk along every ring: points `order[starts[k]:starts[k + 1]]` are those of ring k.

    Returns the points in order (K, 3), their ranges (K,), m, and the angle to the next point of the ring (K,), rad, inf
    after the last; the median of that angle in steps of 0.01 deg (inf beyond 4 deg); the share of points at which
    the walk turns back; and the share of its way about the z axis that is progress: 1 for a laser that spins.
    """
    total = order.shape[0]
    xyz = np.empty((total, 3))
    ranges = np.empty(total)
    steps = np.full(total, np.inf)
    counts = np.zeros(_BINS + 1, np.int64)
    turns = 0
    inner = 0
    way, progress = 0.0, 0.0
    for k in range(starts.shape[0] - 1):
        ux, uy, uz = 0.0, 0.0, 0.0
        dx, dy, dz = 0.0, 0.0, 0.0
        along = 0.0
        for j in range(starts[k], starts[k + 1]):
            i = order[j]
            x, y, z = np.float64(points[i, 0]), np.float64(points[i, 1]), np.float64(points[i, 2])
            r = np.sqrt(x * x + y * y + z * z)
            xyz[j, 0], xyz[j, 1], xyz[j, 2] = x, y, z
            ranges[j] = r
            vx, vy, vz = x / r, y / r, z / r
            if j > starts[k]:
                ex, ey, ez = vx - ux, vy - uy, vz - uz
                chord = np.sqrt(ex * ex + ey * ey + ez * ez)
                steps[j - 1] = chord
                turn = ux * vy - uy * vx
                along += turn
                way += abs(turn)
                counts[np.int64(min(chord / _BIN, _BINS))] += 1
                if j > starts[k] + 1:
                    inner += 1
                    turns += ex * dx + ey * dy + ez * dz < 0.0
                dx, dy, dz = ex, ey, ez
            ux, uy, uz = vx, vy, vz
        progress += abs(along)
    whole = counts.sum()
    half = 0
    median = np.inf
    for b in range(_BINS):
        half += counts[b]
        if 2 * half >= whole and whole > 0:
            median = (b + 0.5) * _BIN
            break
    return xyz, ranges, steps, median, turns / max(inner, 1), progress / max(way, 1e-9)


@kernel
def curvatures(
    xyz: Floats,
    ranges: Floats,
    steps: Floats,
    starts: NDArray[np.int64],
    gap: float,
    jump: float,
    jump_slope: float,
    parallel_slope: float,
) -> tuple[Floats, Floats, Bools]:
    """Curvature (K,) of equation 2.21, the part of it that is a bend (K,), and the breaks of the rings (K,).

    The curvature is NaN where a ring ends or has a gap within `SIDE_POINTS` points. It is NaN as well on the far side of an
    occlusion boundary and where a surface is nearly parallel to the beam: such points are no features (Zhang and Singh
    2014, section V.A).

    gap : rad, angle between neighbours above which returns are missing
    jump, jump_slope : neighbours whose ranges differ by more than `jump` m and `jump_slope` * range are an occlusion
    parallel_slope : change of range over distance across, above which on both sides a surface is parallel to the beam
    On a plane that is sampled unevenly the vector of equation 2.21 is not zero, but lies in the plane. The bend is its part
    across the line from the first to the last neighbour, or all of it where a jump is among the neighbours.
    A ring breaks at a point when a gap or a jump lies between the point and the next one.
    """
    total = xyz.shape[0]
    curvature = np.full(total, np.nan)
    bend = np.zeros(total)
    breaks = np.zeros(total, np.bool_)
    hidden = np.zeros(total, np.bool_)
    for k in range(starts.shape[0] - 1):
        first, last = starts[k], starts[k + 1]
        for j in range(first, last - 1):
            near, far = ranges[j], ranges[j + 1]
            if steps[j] > gap:
                breaks[j] = True
            elif abs(far - near) > max(jump, jump_slope * min(near, far)):
                breaks[j] = True
                if far > near:
                    hidden[j + 1 : min(j + 2 + SIDE_POINTS, last)] = True
                else:
                    hidden[max(j - SIDE_POINTS, first) : j + 1] = True
        whole = 0  # points since the last gap, this one included
        for j in range(first, last):
            whole = 1 if j == first or steps[j - 1] > gap else whole + 1
            c = j - SIDE_POINTS
            if whole < 2 * SIDE_POINTS + 1 or hidden[c]:
                continue
            r = ranges[c]
            before, after = r - ranges[c - 1], ranges[c + 1] - r
            if (
                abs(before) > parallel_slope * r * steps[c - 1]
                and abs(after) > parallel_slope * r * steps[c]
                and before * after > 0
            ):
                continue
            sx, sy, sz = 0.0, 0.0, 0.0
            for n in range(c - SIDE_POINTS, c + SIDE_POINTS + 1):
                sx += xyz[c, 0] - xyz[n, 0]
                sy += xyz[c, 1] - xyz[n, 1]
                sz += xyz[c, 2] - xyz[n, 2]
            square = sx * sx + sy * sy + sz * sz
            scale = (2 * SIDE_POINTS + 1) * r
            curvature[c] = np.sqrt(square) / scale
            jumps = False
            for n in range(c - SIDE_POINTS, c + SIDE_POINTS):
                jumps |= breaks[n]
            if not jumps:
                dx = xyz[c + SIDE_POINTS, 0] - xyz[c - SIDE_POINTS, 0]
                dy = xyz[c + SIDE_POINTS, 1] - xyz[c - SIDE_POINTS, 1]
                dz = xyz[c + SIDE_POINTS, 2] - xyz[c - SIDE_POINTS, 2]
                along = sx * dx + sy * dy + sz * dz
                square -= along * along / max(dx * dx + dy * dy + dz * dz, 1e-12)
            bend[c] = np.sqrt(max(square, 0.0)) / scale
    return curvature, bend, breaks


@kernel
def pick(
    curvature: Floats,
    bend: Floats,
    ranges: Floats,
    breaks: Bools,
    may_be: NDArray[np.uint8],
    starts: NDArray[np.int64],
    regions: int,
    limits: tuple[int, int, int],
    edge_curvature: float,
    plane_curvature: float,
    edge_noise: float,
    plane_noise: float,
) -> NDArray[np.int8]:
    """Label (K,) every point `EDGE`, `LESS_EDGE`, `NEITHER`, `LESS_PLANE` or `PLANE`.

    A ring is divided into `regions` parts of equally many points. In each part the points of largest curvature are edges,
    those of smallest curvature planes. The `SIDE_POINTS` neighbours on either side of a picked point, up to a
    break, are not picked.

    may_be : (K,) bit 0: may be an edge, bit 1: less planar, bit 2: planar
    limits : largest number of edges, of edges and less sharp edges together, and of planes in a part
    edge_curvature, edge_noise : an edge's bend exceeds `edge_curvature`, and its bend times range, m, exceeds `edge_noise`
    plane_curvature, plane_noise : a plane's curvature is below `plane_curvature`, or times its range, m, below `plane_noise`
    """
    total = curvature.shape[0]
    labels = np.zeros(total, np.int8)
    taken = np.zeros(total, np.bool_)
    candidates = np.empty(total, np.int64)
    for k in range(starts.shape[0] - 1):
        size = starts[k + 1] - starts[k]
        for region in range(regions):
            low = starts[k] + size * region // regions
            high = starts[k] + size * (region + 1) // regions
            for sign in (1, -1):
                used = 0
                for j in range(low, high):
                    c = curvature[j]
                    if sign > 0:
                        fits = bend[j] > edge_curvature and bend[j] * ranges[j] > edge_noise and may_be[j] & 1
                    else:
                        fits = (c < plane_curvature or c * ranges[j] < plane_noise) and may_be[j] & 2 and labels[j] == 0
                        if fits:
                            labels[j] = LESS_PLANE
                            fits = may_be[j] & 4 != 0
                    if fits and not taken[j]:
                        candidates[used] = j
                        used += 1
                for rank in range(limits[1] if sign > 0 else limits[2]):
                    best = -1
                    for n in range(used):
                        j = candidates[n]
                        if not taken[j] and (best < 0 or sign * curvature[j] > sign * curvature[best]):
                            best = j
                    if best < 0:
                        break
                    if sign > 0:
                        labels[best] = EDGE if rank < limits[0] else LESS_EDGE
                    else:
                        labels[best] = PLANE
                    taken[best] = True
                    for n in range(best, min(best + SIDE_POINTS, starts[k + 1] - 1)):
                        if breaks[n]:
                            break
                        taken[n + 1] = True
                    for n in range(best - 1, max(best - 1 - SIDE_POINTS, starts[k] - 1), -1):
                        if breaks[n]:
                            break
                        taken[n] = True
    return labels


@kernel
def thin(
    xyz: Floats,
    at: NDArray[np.int64],
    rings: NDArray[np.uint16],
    times: NDArray[np.float32],
    size: float,
) -> tuple[Floats, NDArray[np.int64], NDArray[np.float32]]:
    """One centroid for each run of points `at` (M,), of `xyz` (K, 3), along a ring within one cell of a grid of `size` m.

    Returns the centroids (C, 3), the first point of each run (C,) and the mean times (C,), or (0,) where `times` is (0,).
    """
    total = at.shape[0]
    centroids = np.empty((total, 3))
    first = np.empty(total, np.int64)
    with_times = times.shape[0] > 0
    mean_times = np.zeros(total if with_times else 0, np.float32)
    cell = np.zeros(3)
    inverse = 1.0 / size
    used = 0
    n = 0
    while n < total:
        start = n
        x, y, z, t = 0.0, 0.0, 0.0, 0.0
        for axis in range(3):
            cell[axis] = np.floor(xyz[at[start], axis] * inverse)
        while n < total:
            j = at[n]
            if (
                rings[j] != rings[at[start]]
                or np.floor(xyz[j, 0] * inverse) != cell[0]
                or np.floor(xyz[j, 1] * inverse) != cell[1]
                or np.floor(xyz[j, 2] * inverse) != cell[2]
            ):
                break
            x += xyz[j, 0]
            y += xyz[j, 1]
            z += xyz[j, 2]
            if with_times:
                t += times[j]
            n += 1
        count = n - start
        centroids[used, 0], centroids[used, 1], centroids[used, 2] = x / count, y / count, z / count
        first[used] = at[start]
        if with_times:
            mean_times[used] = np.float32(t / count)
        used += 1
    return centroids[:used], first[:used], mean_times[:used]
