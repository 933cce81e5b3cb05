"""Hashed voxels: packed keys, range gate and centroid down-sampling.

A voxel is floor(p / size); its three indices are packed into 64 bits, 21 per axis, so coordinates up to a million voxels
from the origin have a key. Tables are open addressing with linear probing and hold slots into dense arrays.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from lslam.core.arrays import Floats, Ints
from lslam.core.kernels.jit import inline, kernel
from lslam.core.kernels.linalg import extent

OFFSET = 1 << 20
MASK = (1 << 21) - 1
# Number of points whose cells are computed, and looked up in a table larger than the caches, together: as many questions as
# memory answers side by side, in arrays that stay in the nearest cache.
BLOCK = 64


@inline
def pack(ix: int, iy: int, iz: int) -> int:
    """64-bit key of voxel indices in [-2**20, 2**20)."""
    return ((ix + OFFSET) << 42) | ((iy + OFFSET) << 21) | (iz + OFFSET)


@inline
def hash_key(key: int, mask: int) -> int:
    """Home position of a key in a table of mask + 1 entries (multiply by the golden ratio, fold the high bits down)."""
    h = key * -7046029254386353131
    return ((h >> 32) ^ h) & mask


@inline
def index_of(x: float, inverse_size: float) -> int:
    """Voxel index of one coordinate."""
    return int(np.floor(x * inverse_size))


@inline
def fill_keys(coordinates: NDArray[np.float32], inverse_size: float, keys: NDArray[np.int64]) -> None:
    """Write the keys of points into `keys` (n or more,); coordinates : (3 n,) x, y, z, x, y, ..., m.

    In a row, since of a table (n, 3) LLVM does not know how far one point is from the next: so it takes several at once.
    """
    for j in range(len(coordinates) // 3):
        x, y, z = float(coordinates[3 * j]), float(coordinates[3 * j + 1]), float(coordinates[3 * j + 2])
        keys[j] = pack(index_of(x, inverse_size), index_of(y, inverse_size), index_of(z, inverse_size))


@inline
def _passes(
    a: np.float32,
    b: np.float32,
    c: np.float32,
    range_min: float,
    range_max: float,
    is_cylinder: bool,
    box: Floats,
) -> bool:
    """Whether a point a, b, c, m, is finite, not zero, inside the range gate and outside the ego box; the rest as in `gate`."""
    x, y, z = float(a), float(b), float(c)
    d = x * x + y * y
    full = d + z * z
    if not is_cylinder:
        d = full
    # The comparison is false for NaN and the upper bound stops Inf; zero points fail even with range_min = 0.
    if not (d >= range_min * range_min and d <= range_max * range_max and full > 1e-12 and np.isfinite(full)):
        return False
    return not (len(box) == 6 and box[0] <= x <= box[1] and box[2] <= y <= box[3] and box[4] <= z <= box[5])


@kernel
def gate(
    points: NDArray[np.float32], range_min: float, range_max: float, is_cylinder: bool, box: Floats
) -> NDArray[np.int64]:
    """Indices of the points (N, 3), m, that are finite, not zero, inside the range gate and outside the ego box.

    range_min, range_max : m, both still inside; is_cylinder : ranges are horizontal
    box : x_min, x_max, y_min, y_max, z_min, z_max, m, or empty
    """
    kept = np.empty(len(points), np.int64)
    count = 0
    for i in range(len(points)):
        if _passes(points[i, 0], points[i, 1], points[i, 2], range_min, range_max, is_cylinder, box):
            kept[count] = i
            count += 1
    return kept[:count]


@kernel
def select_in_gate(
    points: NDArray[np.float32],
    times: NDArray[np.float32],
    range_min: float,
    range_max: float,
    is_cylinder: bool,
    box: Floats,
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """The points (K, 3) that `gate` keeps with the same arguments, and their times (K,); `times` is (N,) or empty."""
    n = len(points)
    is_timed = len(times) == n
    kept, when = np.empty((n, 3), np.float32), np.empty(n if is_timed else 0, np.float32)
    count = 0
    for i in range(n):
        x, y, z = points[i, 0], points[i, 1], points[i, 2]
        if _passes(x, y, z, range_min, range_max, is_cylinder, box):
            kept[count, 0], kept[count, 1], kept[count, 2] = x, y, z
            if is_timed:
                when[count] = times[i]
            count += 1
    return kept[:count], when[:count] if is_timed else when


@kernel
def count_within(points: NDArray[np.float32], limit: float) -> int:
    """Number of points (N, 3) whose three coordinates are finite and smaller than `limit` in magnitude."""
    count, coordinates = 0, np.ascontiguousarray(points).reshape(-1)
    for i in range(len(points)):
        x, y, z = coordinates[3 * i], coordinates[3 * i + 1], coordinates[3 * i + 2]
        count += (abs(x) < limit) & (abs(y) < limit) & (abs(z) < limit)  # NaN is not smaller
    return count


@kernel
def take(points: NDArray[np.float32], index: NDArray[np.int64]) -> NDArray[np.float32]:
    """points[index], (K, 3), in a tenth of the time of NumPy."""
    out = np.empty((len(index), 3), np.float32)
    for k in range(len(index)):
        i = index[k]
        out[k, 0], out[k, 1], out[k, 2] = points[i, 0], points[i, 1], points[i, 2]
    return out


@inline
def place_of(key: int, keys: NDArray[np.int64], table: Ints) -> int:
    """Position of a key in an open-addressed table of slots, or the free position for it."""
    mask = len(table) - 1
    h = hash_key(key, mask)
    while table[h] >= 0 and keys[table[h]] != key:
        h = (h + 1) & mask
    return h


@inline
def table_size(n: int) -> int:
    """Power of two that keeps a table of n keys at most half full."""
    size = 64
    while size < 2 * n:
        size *= 2
    return size


@kernel
def centroids(
    points: NDArray[np.float32], times: NDArray[np.float32], size: float
) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.float32], Ints]:
    """One centroid per voxel in order of first appearance: (M, 3) float32, mean time (M,), scatter (M, 6), count (M,).

    The scatter is the covariance xx, xy, xz, yy, yz, zz of the voxel's points, m2. Sums run relative to the first point
    of the voxel, so float32 input keeps its digits. `times` (N,) may be empty, and the mean times are empty then. Points of
    the first and of the second half of the sweep never share a centroid: they meet where the sweep closes, and the sensor has
    moved in between.
    """
    n, coordinates = len(points), np.ascontiguousarray(points).reshape(-1)
    table = np.empty(table_size(n), np.int32)
    table[:] = -1
    keys, ahead = np.empty(n, np.int64), np.empty(BLOCK, np.int64)
    first = np.empty(n, np.int32)
    sums = np.empty((n, 10))
    is_timed = len(times) == n
    half = np.float32(0.0)
    if is_timed and n > 0:
        early, late = extent(times)
        half = np.float32(0.5) * (early + late)
    time_sums = np.zeros(n if is_timed else 0)
    inverse = 1.0 / size
    count = 0
    last_key = -1
    slot = 0
    for i in range(n):
        if i % BLOCK == 0:
            fill_keys(coordinates[3 * i : 3 * (i + BLOCK)], inverse, ahead)
        x, y, z = float(points[i, 0]), float(points[i, 1]), float(points[i, 2])
        key = ahead[i % BLOCK]
        if is_timed and times[i] > half:
            key = ~key
        # A coordinate beyond all voxels can give any key, the initial one too.
        if count == 0 or key != last_key:
            h = place_of(key, keys, table)
            if table[h] < 0:
                table[h] = count
                keys[count] = key
                first[count] = i
                # Zeroed when it is opened: most of the room is never touched.
                sums[count] = 0.0
                count += 1
            slot = int(table[h])
            last_key = key
        f = first[slot]
        dx, dy, dz = x - float(points[f, 0]), y - float(points[f, 1]), z - float(points[f, 2])
        s = sums[slot]
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
        if is_timed:
            time_sums[slot] += times[i]
    out = np.empty((count, 3), np.float32)
    mean_times = np.empty(count if is_timed else 0, np.float32)
    scatter = np.empty((count, 6), np.float32)
    counts = np.empty(count, np.int32)
    for j in range(count):
        s = sums[j]
        counts[j] = int(s[0])
        f = first[j]
        w = 1.0 / s[0]
        mx, my, mz = s[1] * w, s[2] * w, s[3] * w
        out[j, 0] = float(points[f, 0]) + mx
        out[j, 1] = float(points[f, 1]) + my
        out[j, 2] = float(points[f, 2]) + mz
        scatter[j, 0] = s[4] * w - mx * mx
        scatter[j, 1] = s[5] * w - mx * my
        scatter[j, 2] = s[6] * w - mx * mz
        scatter[j, 3] = s[7] * w - my * my
        scatter[j, 4] = s[8] * w - my * mz
        scatter[j, 5] = s[9] * w - mz * mz
        if is_timed:
            mean_times[j] = time_sums[j] * w
    return out, mean_times, scatter, counts


@kernel
def means(
    points: NDArray[np.float32], times: NDArray[np.float32], size: float
) -> tuple[NDArray[np.float32], NDArray[np.float32], Ints]:
    """Centroids in voxels of `size`, m, like `centroids`: (M, 3) float32, mean time (M,), count (M,), with the same bits."""
    n, coordinates = len(points), np.ascontiguousarray(points).reshape(-1)
    table = np.empty(table_size(n), np.int32)
    table[:] = -1
    keys, ahead = np.empty(n, np.int64), np.empty(BLOCK, np.int64)
    # The first point of each voxel; sums relative to it, count, and sum of times.
    first, sums = np.empty((n, 3), np.float32), np.empty((n, 5))
    is_timed = len(times) == n
    half = np.float32(0.0)
    if is_timed and n > 0:
        early, late = extent(times)
        half = np.float32(0.5) * (early + late)
    inverse = 1.0 / size
    count = 0
    last_key = -1
    slot = 0
    # Those of the voxel at hand, which most points share with the one before: in registers while it stays the same.
    ax = ay = az = float(np.float32(0.0))
    sx, sy, sz, sn, st = 0.0, 0.0, 0.0, 0.0, 0.0
    for i in range(n):
        if i % BLOCK == 0:
            fill_keys(coordinates[3 * i : 3 * (i + BLOCK)], inverse, ahead)
        x, y, z = float(points[i, 0]), float(points[i, 1]), float(points[i, 2])
        key = ahead[i % BLOCK]
        if is_timed and times[i] > half:
            key = ~key
        # A coordinate beyond all voxels can give any key, the initial one too.
        if count == 0 or key != last_key:
            last_key = key
            if count > 0:
                sums[slot, 0], sums[slot, 1], sums[slot, 2], sums[slot, 3], sums[slot, 4] = sx, sy, sz, sn, st
            h = place_of(key, keys, table)
            slot = int(table[h])
            if slot < 0:
                slot = count
                table[h] = slot
                keys[slot] = key
                first[slot, 0], first[slot, 1], first[slot, 2] = x, y, z
                sx, sy, sz, sn, st = 0.0, 0.0, 0.0, 0.0, 0.0
                count += 1
            else:
                sx, sy, sz, sn, st = sums[slot, 0], sums[slot, 1], sums[slot, 2], sums[slot, 3], sums[slot, 4]
            ax, ay, az = float(first[slot, 0]), float(first[slot, 1]), float(first[slot, 2])
        sx += x - ax
        sy += y - ay
        sz += z - az
        sn += 1.0
        if is_timed:
            st += times[i]
    if count > 0:
        sums[slot, 0], sums[slot, 1], sums[slot, 2], sums[slot, 3], sums[slot, 4] = sx, sy, sz, sn, st
    out = np.empty((count, 3), np.float32)
    mean_times = np.empty(count if is_timed else 0, np.float32)
    counts = np.empty(count, np.int32)
    for j in range(count):
        counts[j] = int(sums[j, 3])
        w = 1.0 / sums[j, 3]
        out[j, 0] = first[j, 0] + sums[j, 0] * w
        out[j, 1] = first[j, 1] + sums[j, 1] * w
        out[j, 2] = first[j, 2] + sums[j, 2] * w
        if is_timed:
            mean_times[j] = sums[j, 4] * w
    return out, mean_times, counts


@kernel
def find_neighboured_cells(
    points: NDArray[np.float32], counts: Ints, least: float, size: float, least_around: float
) -> NDArray[np.int64]:
    """Indices of the points (N, 3) whose count times range reaches `least`, and whose voxel's count reaches `least_around`.

    counts : (N,) number of returns that each point averages; a voxel's count is the sum over its points that reach `least`
    least, least_around : m, counts times the range of the point; size : edge of the voxels, m
    """
    n = len(points)
    table = np.empty(table_size(n), np.int32)
    table[:] = -1
    keys, sums = np.empty(n, np.int64), np.zeros(n, np.int32)
    slots, chosen = np.empty(n, np.int32), np.empty(n, np.int64)
    inverse = 1.0 / size
    least2, around2 = least * least, least_around * least_around
    last_key, slot = -1, 0
    count = filled = 0
    for i in range(n):
        x, y, z = float(points[i, 0]), float(points[i, 1]), float(points[i, 2])
        if float(counts[i]) * counts[i] * (x * x + y * y + z * z) < least2:
            continue
        key = pack(index_of(x, inverse), index_of(y, inverse), index_of(z, inverse))
        if count == 0 or key != last_key:
            last_key = key
            h = place_of(key, keys, table)
            if table[h] < 0:
                table[h] = count
                keys[count] = key
                count += 1
            slot = int(table[h])
        sums[slot] += counts[i]
        slots[filled] = slot
        chosen[filled] = i
        filled += 1
    kept = 0
    for j in range(filled):
        i = chosen[j]
        around = float(sums[slots[j]])
        x, y, z = float(points[i, 0]), float(points[i, 1]), float(points[i, 2])
        if around * around * (x * x + y * y + z * z) >= around2:
            chosen[kept] = i
            kept += 1
    return chosen[:kept]


@kernel
def first_points(points: NDArray[np.float32], size: float) -> NDArray[np.int64]:
    """Indices, ascending, of the first point in each voxel of `size` m."""
    n = len(points)
    table = np.empty(table_size(n), np.int32)
    table[:] = -1
    keys = np.empty(n, np.int64)
    first = np.empty(n, np.int64)
    inverse = 1.0 / size
    count = 0
    for i in range(n):
        key = pack(
            index_of(float(points[i, 0]), inverse),
            index_of(float(points[i, 1]), inverse),
            index_of(float(points[i, 2]), inverse),
        )
        h = place_of(key, keys, table)
        if table[h] < 0:
            table[h] = count
            keys[count] = key
            first[count] = i
            count += 1
    return first[:count]
