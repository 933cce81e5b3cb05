"""Cells of space in rows of integers, found by an open-addressing hash of their packed indices: averages, and occupancy by rays.

An average's row is (key, sum x, sum y, sum z, count), perhaps (three tags) and perhaps (sum of intensities), int64. The sums are
offsets from the voxel's centre in units of voxel / 2**24, and intensities in units of 2**-20. So they are exact for all
coordinates and equal for any order of the points, and rows of one voxel that were summed separately can be added. The tags are
those of the observation whose first tag is the smallest (`lslam.maps.observations`).

Of occupancy the cell in which a beam ends is hit, cells that it crosses are missed. A row is (key, a, low, high, stamp), int64.
The updates of a cell are the function x -> clamp(x + a, low, high) of its previous log-odds x. Clamped updates, those of OctoMap
(Hornung et al. 2013), are closed under composition, so parts of a recording that were summed separately can be joined in their
order without loss.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from lslam.core.arrays import Floats, Ints
from lslam.core.kernels.jit import inline, kernel
from lslam.core.kernels.voxel import BLOCK

AXIS_BITS = 21
HALF = 1 << (AXIS_BITS - 1)
_MIX = -7046029254386353131  # 0x9E3779B97F4A7C15 as int64: Fibonacci hashing
_IN_BLOCK = (1 << 2 * AXIS_BITS) | (1 << AXIS_BITS) | 3  # bits of a key that tell the 2 x 2 x 4 cells of a block apart
_STEP = 17  # slots from one that is taken to the next to try: odd, and past those of the block
UNITS = float(2**24)  # 2**39 points fit into one voxel's sum
INTENSITY_UNITS = float(2**20)
_BRIGHTEST = float(2**24)  # of such points a voxel's sum holds 2**19
SUMS = 5  # columns before the tags
_NO_TAG = np.iinfo(np.int64).max
_NO_KEY = -2  # of a point that is refused


@inline
def pack(ix: int, iy: int, iz: int) -> int:
    """Key of cell indices relative to the origin; -1 when an index is outside the range of keys."""
    x, y, z = ix + HALF, iy + HALF, iz + HALF
    if (x | y | z) >> AXIS_BITS != 0:  # negative or too large on some axis
        return -1
    return (x << (2 * AXIS_BITS)) | (y << AXIS_BITS) | z


@inline
def slot_of(key: int, mask: int) -> int:
    """First slot to try for a key in a table of mask + 1 slots; 2 x 2 x 4 cells share a line of the cache."""
    mixed = (key & ~_IN_BLOCK) * _MIX
    within = ((key >> 39) & 8) | ((key >> 19) & 4) | (key & 3)
    return (mixed ^ (mixed >> 29) ^ (mixed >> 43) ^ within) & mask


@inline
def row_of(key: int, slots: Ints, rows: NDArray[np.int64], row_count: int) -> int:
    """Row of a key.

    A new key is entered in `slots` and gets row number `row_count`, in which only the key is set.

    slots : (S,) row of each hash slot or -1, S a power of two above `row_count`; rows : (R, k), R > `row_count`
    """
    mask = slots.shape[0] - 1
    slot = slot_of(key, mask)
    row = slots[slot]
    while row >= 0 and rows[row, 0] != key:
        slot = (slot + _STEP) & mask
        row = slots[slot]
    if row < 0:
        row = row_count
        slots[slot] = row
        rows[row, 0] = key
    return int(row)


@kernel
def enter(slots: Ints, rows: NDArray[np.int64], row_count: int) -> None:
    """Enter the first `row_count` rows into `slots`, all -1 before; the number of slots is a power of two above `row_count`."""
    mask = slots.shape[0] - 1
    for row in range(row_count):
        slot = slot_of(rows[row, 0], mask)
        while slots[slot] >= 0:
            slot = (slot + _STEP) & mask
        slots[slot] = row


def unpack_cells(keys: NDArray[np.int64], origin: NDArray[np.int64]) -> NDArray[np.int64]:
    """(M, 3) cell indices of keys (M,)."""
    cells = np.empty((len(keys), 3), np.int64)
    for axis in range(3):
        cells[:, axis] = ((keys >> (AXIS_BITS * (2 - axis))) & ((1 << AXIS_BITS) - 1)) - HALF + origin[axis]
    return cells


@kernel
def sum_up(
    points: NDArray[np.float32],
    intensity: NDArray[np.float32],
    tags: NDArray[np.int64],
    T: Floats,
    range_min: float,
    range_max: float,
    voxel: float,
    crop: Floats,
    origin: NDArray[np.int64],
    rows: NDArray[np.int64],
) -> tuple[int, int, int]:
    """Write rows of one scan's points, one for each run of points in one voxel, whose sums are those of the run.

    points : (N, 3) sensor frame, m; intensity : (N,) or (0,); tags : (N, 3) or (0, 3); T : (4, 4) world from sensor
    crop : (6,) x_min, x_max, y_min, y_max, z_min, z_max of the world, m: points outside count as gated
    origin : (3,) voxel index in the middle of the key range, which reaches 2**20 voxels to each side
    rows : (R, 5), three columns more for `tags` and one more for `intensity` when they are given, with R >= N

    Returns the number of rows, the points refused by the range gate (NaN, Inf and zero points included) and the points
    outside the key range.
    """
    inverse = 1.0 / voxel
    near, far = range_min * range_min, range_max * range_max
    n = points.shape[0]
    with_intensity, with_tags = intensity.shape[0] > 0, tags.shape[0] > 0
    brightnesses = rows.shape[1] - 1
    # What the loop over a block reads is local, its points are numbered through, and it does not branch: so it works on
    # several points at once.
    xx, xy, xz, xt = T[0, 0], T[0, 1], T[0, 2], T[0, 3]
    yx, yy, yz, yt = T[1, 0], T[1, 1], T[1, 2], T[1, 3]
    zx, zy, zz, zt = T[2, 0], T[2, 1], T[2, 2], T[2, 3]
    left, right, front, back, low, high = crop[0], crop[1], crop[2], crop[3], crop[4], crop[5]
    ox, oy, oz = origin[0], origin[1], origin[2]
    coordinates = points.reshape(-1)
    keys, bright = np.empty(BLOCK, np.int64), np.empty(BLOCK, np.int64)
    xs, ys, zs = np.empty(BLOCK, np.int64), np.empty(BLOCK, np.int64), np.empty(BLOCK, np.int64)
    gated, outside, run, last_key = 0, 0, -1, -1
    for begin in range(0, n, BLOCK):
        count = min(BLOCK, n - begin)
        part = coordinates[3 * begin : 3 * (begin + count)]
        for j in range(count):
            px, py, pz = np.float64(part[3 * j]), np.float64(part[3 * j + 1]), np.float64(part[3 * j + 2])
            r2 = px * px + py * py + pz * pz
            x = xx * px + xy * py + xz * pz + xt
            y = yx * px + yy * py + yz * pz + yt
            z = zx * px + zy * py + zz * pz + zt
            is_in = (r2 >= near) & (r2 <= far) & (r2 > 0.0)
            is_in = is_in & (x >= left) & (x <= right) & (y >= front) & (y <= back) & (z >= low) & (z <= high)
            x, y, z = x * inverse, y * inverse, z * inverse
            fx, fy, fz = np.floor(x), np.floor(y), np.floor(z)
            key = pack(np.int64(fx) - ox, np.int64(fy) - oy, np.int64(fz) - oz)
            keys[j] = key if is_in else _NO_KEY
            xs[j] = np.int64(np.rint((x - fx - 0.5) * UNITS))
            ys[j] = np.int64(np.rint((y - fy - 0.5) * UNITS))
            zs[j] = np.int64(np.rint((z - fz - 0.5) * UNITS))
        if with_intensity:
            shine = intensity[begin : begin + count]
            for j in range(count):
                value = float(shine[j])
                brightness = min(max(value, -_BRIGHTEST), _BRIGHTEST) if np.isfinite(value) else 0.0
                bright[j] = np.int64(np.rint(brightness * INTENSITY_UNITS))
        for j in range(count):
            key = keys[j]
            if key < 0:
                gated += key == _NO_KEY
                outside += key != _NO_KEY
                continue
            i = begin + j
            # Neighbouring points of a ring mostly share a voxel.
            if key != last_key:
                run, last_key = run + 1, key
                rows[run, 0] = key
                rows[run, 1:] = 0
                if with_tags:
                    rows[run, SUMS] = _NO_TAG
            rows[run, 1] += xs[j]
            rows[run, 2] += ys[j]
            rows[run, 3] += zs[j]
            rows[run, 4] += 1
            if with_intensity:
                rows[run, brightnesses] += bright[j]
            if with_tags and tags[i, 0] < rows[run, SUMS]:
                for k in range(tags.shape[1]):
                    rows[run, SUMS + k] = tags[i, k]
    return run + 1, gated, outside


@kernel
def add_rows(more: NDArray[np.int64], has_tags: bool, slots: Ints, rows: NDArray[np.int64], row_count: int) -> int:
    """Add rows (M, k) to those of the same voxels; returns the rows used now.

    slots : (S,) row of each hash slot or -1, S a power of two above used + M; rows : (R, k), R >= used + M
    has_tags : whether three columns are tags
    """
    mask = slots.shape[0] - 1
    likely = np.empty(BLOCK, np.int64)
    for begin in range(0, more.shape[0], BLOCK):
        part = more[begin : begin + BLOCK]
        # Table and rows are far larger than the processor's caches: a batch of rows is fetched before a branch depends on one.
        for k in range(part.shape[0]):
            likely[k] = slots[slot_of(part[k, 0], mask)]
        for k in range(part.shape[0]):
            if rows[max(likely[k], 0), 0] != part[k, 0]:
                likely[k] = -1
        for k in range(part.shape[0]):
            row = likely[k]
            if row < 0:
                row = row_of(part[k, 0], slots, rows, row_count)
                if row == row_count:
                    row_count += 1
                    rows[row, 1:] = 0
                    if has_tags:
                        rows[row, SUMS] = _NO_TAG
            for n in range(1, SUMS):
                rows[row, n] += part[k, n]
            if has_tags and part[k, SUMS] < rows[row, SUMS]:
                for n in range(SUMS, SUMS + 3):
                    rows[row, n] = part[k, n]
            for n in range(SUMS + 3 * has_tags, rows.shape[1]):
                rows[row, n] += part[k, n]
    return row_count


@kernel
def unpack(rows: NDArray[np.int64], origin: NDArray[np.int64], voxel: float) -> Floats:
    """(M, 3) float64 mean positions, m, of finished rows (M, 5 or more).

    origin : (3,) cell in the middle of the key range; voxel : edge of a cell, m
    """
    points = np.empty((len(rows), 3))
    for i in range(len(rows)):
        key, count = rows[i, 0], rows[i, 4] * UNITS
        for axis in range(3):
            cell = ((key >> (AXIS_BITS * (2 - axis))) & ((1 << AXIS_BITS) - 1)) - HALF + origin[axis]
            points[i, axis] = (cell + 0.5 + rows[i, 1 + axis] / count) * voxel
    return points


@inline
def _seen_row(key: int, slots: Ints, rows: NDArray[np.int64], row_count: int) -> int:
    """Row of a key; for a new key the new row number `row_count`, without any update."""
    row = row_of(key, slots, rows, row_count)
    if row == row_count:
        rows[row, 1] = 0
        rows[row, 2] = -(1 << 40)
        rows[row, 3] = 1 << 40
        rows[row, 4] = -1
    return row


@inline
def _update(rows: NDArray[np.int64], row: int, change: int, low: int, high: int) -> None:
    """Add the log-odds `change` to a row: to its sum, and to both clamped values."""
    rows[row, 1] += change
    rows[row, 2] = min(max(rows[row, 2] + change, low), high)
    rows[row, 3] = min(max(rows[row, 3] + change, low), high)


@kernel
def mark_ends(
    points: NDArray[np.float32],
    T: Floats,
    range_min: float,
    range_max: float,
    voxel: float,
    origin: NDArray[np.int64],
    slots: Ints,
    rows: NDArray[np.int64],
    row_count: int,
    stamp: int,
    model: NDArray[np.int64],
) -> tuple[int, Floats]:
    """Update the cells in which beams end, once each; returns the rows used now, and the ends (E, 3) of the beams, in cells.

    points : (N, 3) sensor frame, m; T : (4, 4) world from sensor; origin : (3,) cell in the middle of the key range
    stamp : number of the scan; model : log-odds of a hit and of a miss, and their lower and upper bound
    voxel : edge of a cell, m
    Beams longer than `range_max`, m, end there without a hit, those shorter than `range_min` are left out. Only one beam per
    end cell is returned.
    """
    ends = np.empty((len(points), 3))
    count = 0
    inverse = 1.0 / voxel
    near = range_min * range_min
    for far in range(2):  # hits first: a cell that a scan hits is not missed by the same scan
        for i in range(len(points)):
            x, y, z = float(points[i, 0]), float(points[i, 1]), float(points[i, 2])
            r2 = x * x + y * y + z * z
            if not (r2 >= near and r2 > 0.0 and np.isfinite(r2)):
                continue
            r = math.sqrt(r2)
            if (r > range_max) != (far == 1):
                continue
            if far:
                s = range_max / r
                x, y, z = x * s, y * s, z * s
            cx = (T[0, 0] * x + T[0, 1] * y + T[0, 2] * z + T[0, 3]) * inverse
            cy = (T[1, 0] * x + T[1, 1] * y + T[1, 2] * z + T[1, 3]) * inverse
            cz = (T[2, 0] * x + T[2, 1] * y + T[2, 2] * z + T[2, 3]) * inverse
            ix, iy, iz = np.int64(np.floor(cx)), np.int64(np.floor(cy)), np.int64(np.floor(cz))
            key = pack(ix - origin[0], iy - origin[1], iz - origin[2])
            if key < 0:
                continue
            row = _seen_row(key, slots, rows, row_count)
            row_count += row == row_count
            if rows[row, 4] == stamp:
                continue
            rows[row, 4] = stamp
            _update(rows, row, model[1] if far else model[0], model[2], model[3])
            ends[count, 0], ends[count, 1], ends[count, 2] = cx, cy, cz
            count += 1
    return row_count, ends[:count]


@kernel
def cells_on_beams(
    ends: Floats, start: Floats, low: NDArray[np.int64], size: NDArray[np.int64], origin: NDArray[np.int64]
) -> NDArray[np.int64]:
    """Keys of the cells of a box that beams cross before their ends, rising (Amanatides and Woo 1987).

    start : (3,) common start of the beams; ends : (E, 3); both in cells; origin : as in `mark_ends`
    low : (3,) first cell of the box; size : (3,) cells along its edges; beams leave it along x only
    """
    # Near the sensor many beams cross a cell: it is looked up once, and neighbours one after the other.
    is_on_beam = np.zeros(size[0] * size[1] * size[2], np.bool_)
    strides = np.array([size[1] * size[2], size[2], 1])
    step = np.empty(3, np.int64)
    due = np.empty(3)
    each = np.empty(3)
    for i in range(len(ends)):
        at, last = np.int64(0), np.int64(0)
        for k in range(3):
            d = ends[i, k] - start[k]
            cell = np.floor(start[k])
            at += (np.int64(cell) - low[k]) * strides[k]
            last += (np.int64(np.floor(ends[i, k])) - low[k]) * strides[k]
            step[k] = strides[k] if d > 0 else -strides[k]
            each[k] = abs(1.0 / d) if d != 0.0 else np.inf
            edge = cell + 1.0 - start[k] if d > 0 else start[k] - cell
            due[k] = edge * each[k] if d != 0.0 else np.inf
        due_x, due_y, due_z = due
        while at != last:
            if 0 <= at < len(is_on_beam):
                is_on_beam[at] = True
            first = min(due_x, due_y, due_z)
            if first > 1.0:
                break
            if due_x == first:
                at, due_x = at + step[0], due_x + each[0]
            elif due_y == first:
                at, due_y = at + step[1], due_y + each[1]
            else:
                at, due_z = at + step[2], due_z + each[2]
    keys = np.empty(np.count_nonzero(is_on_beam), np.int64)
    count, at = 0, np.int64(0)
    for x in range(size[0]):
        for y in range(size[1]):
            for z in range(size[2]):
                if is_on_beam[at]:
                    keys[count] = pack(x + low[0] - origin[0], y + low[1] - origin[1], z + low[2] - origin[2])
                    count += 1
                at += 1
    return keys


@kernel
def mark_misses(
    keys: NDArray[np.int64], slots: Ints, rows: NDArray[np.int64], row_count: int, stamp: int, model: NDArray[np.int64]
) -> int:
    """Update cells with a miss, unless the scan has updated them before; returns the rows used now.

    keys : of the cells, -1 for none; the rest as in `mark_ends`
    """
    for key in keys:
        if key < 0:
            continue
        row = _seen_row(key, slots, rows, row_count)
        row_count += row == row_count
        if rows[row, 4] != stamp:
            rows[row, 4] = stamp
            _update(rows, row, model[1], model[2], model[3])
    return row_count


@kernel
def compose(rows: NDArray[np.int64]) -> NDArray[np.int64]:
    """Composition of rows (N, 5), one row per key (K, 5). They are sorted by key, and those of one key by time."""
    out = np.empty_like(rows)
    count = 0
    for i in range(len(rows)):
        if count and out[count - 1, 0] == rows[i, 0]:
            a, low, high = rows[i, 1], rows[i, 2], rows[i, 3]
            out[count - 1, 1] += a
            out[count - 1, 2] = min(max(out[count - 1, 2] + a, low), high)
            out[count - 1, 3] = min(max(out[count - 1, 3] + a, low), high)
        else:
            out[count] = rows[i]
            count += 1
    return out[:count]
