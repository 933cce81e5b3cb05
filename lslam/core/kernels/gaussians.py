"""The local map's voxels, each a running Gaussian.

Layout, one row per slot of the pool:
    moments (C, 15) float64 : n, sum x y z, sum xx xy xz yy yz zz, sum of the sensor's x y z when the points were measured,
        all m and relative to the voxel centre; sums of the sines of the beams' elevations, sensor's frame, and their squares
    planes (C, 8) float64 : mean x y z, m, world; unit normal x y z; variance along the normal, m2; tilt, the variance of the
        normal's direction, rad2, or BLOB or EMPTY. One cache line, all that a residual needs.
    keys (C,) int64 : packed voxel, FREE when the slot is unused
    refreshed (C,) float64 : n when `planes` was computed last
    table (E,) int32 : open addressing, slot or -1
    state (4,) int64 : slots ever used, free-list length, clock hand, live voxels
    free (C,) int32 : slots given back

Numbers of all voxels of a map:
    size : edge, m; min_points : fewer points make no plane and no blob; blob : a voxel of points that are no plane
    planarity : least (l1 - l0) / l2 of a plane, by the eigenvalues of the covariance of its points, the least first
    floor : m2, added to every variance; common : m2, error that the points of a scan share, for the tilt of a normal
    breadth : least variance across the beams in variances of the surface; 0 disables the test
    ring_variance : rad2, variance of the beams' elevations above which they are of several rings; 0 where rings are unknown
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from lslam.core.arrays import Floats, Ints, Longs
from lslam.core.kernels.jit import inline, kernel
from lslam.core.kernels.linalg import plane_of
from lslam.core.kernels.voxel import BLOCK, MASK, OFFSET, hash_key, index_of, pack, place_of

FREE = -1
EMPTY, BLOB = -2.0, -1.0
# Least variance of a blob across the beams, as a part of its largest variance. A bush is as deep as it is wide; a single ring
# that bends in its voxel is a strip.
SOLID_SHARE = 0.1
# Least variance across the beams of a plane that several rings have seen, in variances of the surface: what the plane's slope
# to the beams adds is as much as its thickness.
RINGS_BREADTH = 2.0
USED, FREED, HAND, LIVE = 0, 1, 2, 3


@inline
def find(key: int, keys: Longs, table: Ints) -> int:
    """Slot of the voxel `key`, or -1 if the map has none."""
    return int(table[place_of(key, keys, table)])


@inline
def _claim(
    key: int, moments: Floats, planes: Floats, keys: Longs, counts: Floats, table: Ints, state: Longs, free: Ints
) -> int:
    """Slot of the voxel `key`, a new one if it is not in the map; -1 when the pool is full."""
    h = place_of(key, keys, table)
    if table[h] >= 0:
        return int(table[h])
    if state[FREED] > 0:
        state[FREED] -= 1
        slot = int(free[state[FREED]])
    elif state[USED] < len(keys):
        slot = int(state[USED])
        state[USED] += 1
    else:
        return -1
    table[h] = slot
    keys[slot] = key
    moments[slot] = 0.0
    planes[slot, 7] = EMPTY
    counts[slot] = 0.0
    state[LIVE] += 1
    return slot


@inline
def _release(slot: int, keys: Longs, table: Ints, state: Longs, free: Ints, planes: Floats) -> None:
    """Free a slot; the entries that follow it in the hash table move up, so that no tombstones accumulate."""
    mask = len(table) - 1
    h = hash_key(keys[slot], mask)
    while table[h] != slot:
        h = (h + 1) & mask
    hole = h
    h = (h + 1) & mask
    while table[h] >= 0:
        home = hash_key(keys[table[h]], mask)
        if ((h - home) & mask) >= ((h - hole) & mask):
            table[hole] = table[h]
            hole = h
        h = (h + 1) & mask
    table[hole] = -1
    keys[slot] = FREE
    planes[slot, 7] = EMPTY
    free[state[FREED]] = slot
    state[FREED] += 1
    state[LIVE] -= 1


@inline
def _refresh(
    slot: int,
    size: float,
    moments: Floats,
    planes: Floats,
    keys: Longs,
    min_points: float,
    planarity: float,
    floor: float,
    common: float,
    breadth: float,
    ring_variance: float,
) -> None:
    """Recompute the row of `planes` of one voxel from its moments: mean, normal, variance, and kind.

    The points of one ring of one scan lie on the cone of its beams, and those of the next scan lie on the same cone wherever
    the sensor has moved: they reflect the scan pattern, not a surface. A voxel of such points is `EMPTY`. A voxel is valid when
    the variance of its points across the beams is at least `breadth` times that of the surface and the floor. Beams of several
    rings differ in elevation: then `RINGS_BREADTH` times the variance of the surface is enough.
    size : m; the rest as in the module's header
    """
    s = moments[slot]
    n = s[0]
    w = 1.0 / n
    mx, my, mz = s[1] * w, s[2] * w, s[3] * w
    key = keys[slot]
    p = planes[slot]
    p[0] = mx + ((key >> 42) - OFFSET + 0.5) * size
    p[1] = my + (((key >> 21) & MASK) - OFFSET + 0.5) * size
    p[2] = mz + ((key & MASK) - OFFSET + 0.5) * size
    if n < min_points:
        p[7] = EMPTY
        return
    xx, xy, xz = s[4] * w - mx * mx, s[5] * w - mx * my, s[6] * w - mx * mz
    yy, yz, zz = s[7] * w - my * my, s[8] * w - my * mz, s[9] * w - mz * mz
    l0, l1, l2, nx, ny, nz = plane_of(xx, xy, xz, yy, yz, zz)
    # Planarity (l1 - l0) / l2 is 1 on a disc, 0 on a line or a ball.
    is_plane = l1 - l0 >= planarity * max(l2, 1e-12)
    if breadth > 0.0:
        across = breadth_of(xx, xy, xz, yy, yz, zz, mx - s[10] * w, my - s[11] * w, mz - s[12] * w)
        least = breadth * (max(l0, 0.0) + floor) if is_plane else SOLID_SHARE * l2
        sine = s[13] * w
        if is_plane and ring_variance > 0.0 and s[14] * w - sine * sine > ring_variance * (1.0 - sine * sine):
            least = RINGS_BREADTH * max(l0, 0.0)
        if across < least:
            p[7] = EMPTY
            return
    if is_plane:
        p[3], p[4], p[5] = nx, ny, nz
        p[6] = max(l0, 0.0) + floor
        # The normal of a narrow strip is uncertain about the strip's axis. The scatter of points averages out, what those of a
        # scan share does not.
        p[7] = (p[6] / n + common) / max(l1, 1e-12)
    else:
        p[6] = max((l0 + l1 + l2) / 3.0, 0.0) + floor
        p[7] = BLOB


@inline
def breadth_of(
    xx: float, xy: float, xz: float, yy: float, yz: float, zz: float, dx: float, dy: float, dz: float
) -> float:
    """Smaller of the two variances, m2, across the direction d of the beams, of points with covariance xx..zz.

    It is the smaller eigenvalue of the covariance projected along d: the variance about the best plane that contains d. d has
    any length; 0 for none.
    """
    d2 = dx * dx + dy * dy + dz * dz
    if d2 < 1e-12:
        return 0.0
    along = (xx * dx * dx + yy * dy * dy + zz * dz * dz + 2.0 * (xy * dx * dy + xz * dx * dz + yz * dy * dz)) / d2
    total = xx + yy + zz - along
    product = (
        (yy * zz - yz * yz) * dx * dx
        + (xx * zz - xz * xz) * dy * dy
        + (xx * yy - xy * xy) * dz * dz
        + 2.0 * ((xz * yz - xy * zz) * dx * dy + (xy * yz - xz * yy) * dx * dz + (xy * xz - xx * yz) * dy * dz)
    ) / d2
    return 0.5 * (total - math.sqrt(max(total * total - 4.0 * product, 0.0)))


@kernel
def insert(
    points: NDArray[np.float32],
    R: Floats,
    t: Floats,
    size: float,
    cap: float,
    min_points: float,
    planarity: float,
    floor: float,
    common: float,
    breadth: float,
    ring_variance: float,
    reach: float,
    moments: Floats,
    planes: Floats,
    keys: Longs,
    counts: Floats,
    table: Ints,
    state: Longs,
    free: Ints,
) -> int:
    """Add points (N, 3), LiDAR frame, m, measured from the pose R (3, 3), t (3,); returns the number that found no slot.

    Moments of a voxel with more than `cap` points are scaled down, so that new points keep their weight. A voxel's plane is
    recomputed when its count has grown by a tenth. For every inserted point, the clock hand examines two slots and frees
    those farther than `reach`, m, from t.
    """
    n = len(points)
    inverse = 1.0 / size
    touched = np.empty(n, np.int32)
    count = 0
    lost = 0
    last_key = -2
    slot = -1
    limit = float(OFFSET - 2)
    mask = len(table) - 1
    ahead, likely, offsets = np.empty(BLOCK, np.int64), np.empty(BLOCK, np.int64), np.empty((BLOCK, 3))
    views = np.empty((BLOCK, 4))
    for begin in range(0, n, BLOCK):
        some = 0
        for i in range(begin, min(begin + BLOCK, n)):
            a, b, c = float(points[i, 0]), float(points[i, 1]), float(points[i, 2])
            x = R[0, 0] * a + R[0, 1] * b + R[0, 2] * c + t[0]
            y = R[1, 0] * a + R[1, 1] * b + R[1, 2] * c + t[1]
            z = R[2, 0] * a + R[2, 1] * b + R[2, 2] * c + t[2]
            if not (abs(x) * inverse < limit and abs(y) * inverse < limit and abs(z) * inverse < limit):
                lost += 1
                continue
            ix, iy, iz = index_of(x, inverse), index_of(y, inverse), index_of(z, inverse)
            ahead[some] = pack(ix, iy, iz)
            offsets[some, 0], offsets[some, 1], offsets[some, 2] = (
                x - (ix + 0.5) * size,
                y - (iy + 0.5) * size,
                z - (iz + 0.5) * size,
            )
            views[some, 0], views[some, 1], views[some, 2] = x, y, z
            away = math.sqrt(a * a + b * b + c * c)
            views[some, 3] = c / away if away > 0.0 else 0.0
            some += 1
        # The map is larger than the processor's caches: a batch of voxels is fetched before any branch depends on one.
        for k in range(some):
            likely[k] = table[hash_key(ahead[k], mask)]
        for k in range(some):
            if keys[max(likely[k], 0)] != ahead[k]:
                likely[k] = -1
        for k in range(some):
            key = ahead[k]
            if key != last_key:
                slot = int(likely[k])
                if slot < 0:
                    slot = _claim(key, moments, planes, keys, counts, table, state, free)
                last_key = key
                if slot >= 0:
                    touched[count] = slot
                    count += 1
            if slot < 0:
                lost += 1
                continue
            dx, dy, dz = offsets[k, 0], offsets[k, 1], offsets[k, 2]
            s = moments[slot]
            s[0] += 1.0
            s[1] += dx
            s[2] += dy
            s[3] += dz
            s[4] += dx * dx
            s[5] += dx * dy
            s[6] += dx * dz
            s[7] += dy * dy
            s[8] += dy * dz
            s[9] += dz * dz
            s[10] += t[0] - views[k, 0] + dx
            s[11] += t[1] - views[k, 1] + dy
            s[12] += t[2] - views[k, 2] + dz
            s[13] += views[k, 3]
            s[14] += views[k, 3] * views[k, 3]
    for j in range(count):
        slot = int(np.int64(touched[j]))  # of one type wherever `_refresh` is called: it is compiled once
        s = moments[slot]
        if s[0] >= 1.1 * counts[slot]:
            if s[0] > cap:
                w = cap / s[0]
                for k in range(15):
                    s[k] *= w
            _refresh(slot, size, moments, planes, keys, min_points, planarity, floor, common, breadth, ring_variance)
            counts[slot] = s[0]
    _evict(2 * count, t, size, reach, keys, table, state, free, planes)
    return lost


@inline
def _evict(
    steps: int, t: Floats, size: float, reach: float, keys: Longs, table: Ints, state: Longs, free: Ints, planes: Floats
) -> None:
    """Advance the clock hand by `steps` slots and free those farther than `reach`, m, from t (3,)."""
    if state[USED] == 0:
        return
    far = reach * reach
    for _ in range(min(steps, state[USED])):
        state[HAND] += 1
        if state[HAND] >= state[USED]:
            state[HAND] = 0
        slot = int(state[HAND])
        key = keys[slot]
        if key == FREE:
            continue
        dx = ((key >> 42) - OFFSET + 0.5) * size - t[0]
        dy = (((key >> 21) & MASK) - OFFSET + 0.5) * size - t[1]
        dz = ((key & MASK) - OFFSET + 0.5) * size - t[2]
        if dx * dx + dy * dy + dz * dz > far:
            _release(slot, keys, table, state, free, planes)


@kernel
def rehash(keys: Longs, table: Ints, size: int) -> None:
    """Fill an empty table with the keys of a grown pool; size : its slots ever used."""
    mask = len(table) - 1
    for slot in range(size):
        if keys[slot] != FREE:
            h = hash_key(keys[slot], mask)
            while table[h] >= 0:
                h = (h + 1) & mask
            table[h] = slot


@kernel
def coarsen(
    factor: int,
    size: float,
    min_points: float,
    planarity: float,
    floor: float,
    common: float,
    breadth: float,
    ring_variance: float,
    fine_moments: Floats,
    fine_keys: Longs,
    pool_size: int,
    moments: Floats,
    planes: Floats,
    keys: Longs,
    counts: Floats,
    table: Ints,
    state: Longs,
    free: Ints,
) -> None:
    """Fill an empty map of voxels of `size`, m, = factor * fine size with the moments of a finer map, which add up exactly.

    pool_size : slots of the finer map; voxels without room in the pool of the new one are left out
    """
    fine = size / factor
    for j in range(pool_size):
        key = fine_keys[j]
        if key == FREE:
            continue
        ix, iy, iz = (key >> 42) - OFFSET, ((key >> 21) & MASK) - OFFSET, (key & MASK) - OFFSET
        cx, cy, cz = ix // factor, iy // factor, iz // factor
        slot = _claim(pack(cx, cy, cz), moments, planes, keys, counts, table, state, free)
        if slot < 0:
            continue
        ox, oy, oz = (
            (ix + 0.5) * fine - (cx + 0.5) * size,
            (iy + 0.5) * fine - (cy + 0.5) * size,
            (iz + 0.5) * fine - (cz + 0.5) * size,
        )
        m = fine_moments[j]
        s = moments[slot]
        n = m[0]
        s[0] += n
        s[1] += m[1] + n * ox
        s[2] += m[2] + n * oy
        s[3] += m[3] + n * oz
        s[4] += m[4] + 2.0 * ox * m[1] + n * ox * ox
        s[5] += m[5] + ox * m[2] + oy * m[1] + n * ox * oy
        s[6] += m[6] + ox * m[3] + oz * m[1] + n * ox * oz
        s[7] += m[7] + 2.0 * oy * m[2] + n * oy * oy
        s[8] += m[8] + oy * m[3] + oz * m[2] + n * oy * oz
        s[9] += m[9] + 2.0 * oz * m[3] + n * oz * oz
        s[10] += m[10] + n * ox
        s[11] += m[11] + n * oy
        s[12] += m[12] + n * oz
        s[13] += m[13]
        s[14] += m[14]
    for slot in range(state[USED]):
        _refresh(slot, size, moments, planes, keys, min_points, planarity, floor, common, breadth, ring_variance)
        counts[slot] = moments[slot, 0]
