"""Voxel averages of transformed scans: an open-addressing hash of packed voxel indices over rows of integer sums.

A row is (key, sum x, sum y, sum z, count), perhaps (three tags) and perhaps (sum of intensities), int64. The sums are offsets
from the voxel's centre in units of voxel / 2**24, and intensities in units of 2**-20. So they are exact for all coordinates and
equal for any order of the points, and rows of one voxel that were summed separately can be added. The tags are those of the
observation whose first tag is the smallest (`lslam.maps.observations`).
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from lslam.core.kernels.jit import inline, kernel
from lslam.core.kernels.voxel import AHEAD

AXIS_BITS = 21
HALF = 1 << (AXIS_BITS - 1)
_MIX = -7046029254386353131  # 0x9E3779B97F4A7C15 as int64: Fibonacci hashing
UNITS = float(2**24)  # 2**39 points fit into one voxel's sum
INTENSITY_UNITS = float(2**20)
_BRIGHTEST = float(2**24)  # of such points a voxel's sum holds 2**19
SUMS = 5  # columns before the tags
_NO_TAG = np.iinfo(np.int64).max


@inline
def pack(ix: int, iy: int, iz: int) -> int:
    """Key of cell indices relative to the origin; -1 when an index is outside the range of keys."""
    x, y, z = ix + HALF, iy + HALF, iz + HALF
    if (x | y | z) >> AXIS_BITS != 0:  # negative or too large on some axis
        return -1
    return (x << (2 * AXIS_BITS)) | (y << AXIS_BITS) | z


@inline
def slot_of(key: int, mask: int) -> int:
    """First slot to try for a key in a table of mask + 1 slots."""
    mixed = key * _MIX
    return (mixed ^ (mixed >> 29) ^ (mixed >> 43)) & mask


@inline
def row_of(key: int, slots: NDArray[np.int32], rows: NDArray[np.int64], used: int) -> int:
    """Row of a key.

    A new key is entered in `slots` and gets row number `used`, in which only the key is set.

    slots : (S,) row of each hash slot or -1, S a power of two above `used`; rows : (R, k), R > `used`
    """
    mask = slots.shape[0] - 1
    slot = slot_of(key, mask)
    row = slots[slot]
    while row >= 0 and rows[row, 0] != key:
        slot = (slot + 1) & mask
        row = slots[slot]
    if row < 0:
        row = used
        slots[slot] = row
        rows[row, 0] = key
    return int(row)


@kernel
def enter(slots: NDArray[np.int32], rows: NDArray[np.int64], used: int) -> None:
    """Enter the first `used` rows into `slots`, all -1 before; the number of slots is a power of two above `used`."""
    mask = slots.shape[0] - 1
    for row in range(used):
        slot = slot_of(rows[row, 0], mask)
        while slots[slot] >= 0:
            slot = (slot + 1) & mask
        slots[slot] = row


def unpack_cells(keys: NDArray[np.int64], origin: NDArray[np.int64]) -> NDArray[np.int64]:
    """(M, 3) cell indices of keys (M,)."""
    cells = np.empty((len(keys), 3), np.int64)
    for axis in range(3):
        cells[:, axis] = ((keys >> (AXIS_BITS * (2 - axis))) & ((1 << AXIS_BITS) - 1)) - HALF + origin[axis]
    return cells


@kernel
def accumulate(
    points: NDArray[np.float32],
    intensity: NDArray[np.float32],
    tags: NDArray[np.int64],
    T: NDArray[np.float64],
    range_min: float,
    range_max: float,
    voxel: float,
    crop: NDArray[np.float64],
    origin: NDArray[np.int64],
    slots: NDArray[np.int32],
    rows: NDArray[np.int64],
    used: int,
) -> tuple[int, int, int]:
    """Add one scan's points to the voxel sums.

    points : (N, 3) sensor frame, m; intensity : (N,) or (0,); tags : (N, 3) or (0, 3); T : (4, 4) world from sensor
    crop : (6,) x_min, x_max, y_min, y_max, z_min, z_max of the world, m: points outside count as gated
    origin : (3,) voxel index in the middle of the key range, which reaches 2**20 voxels to each side
    slots : (S,) row of each hash slot or -1, S a power of two above used + N
    rows : (R, 5), three columns more for `tags` and one more for `intensity` when they are given, with R >= used + N

    Returns the rows used now, the points refused by the range gate (NaN, Inf and zero points included) and the points
    outside the key range.
    """
    inverse = 1.0 / voxel
    near, far = range_min * range_min, range_max * range_max
    with_intensity, with_tags = intensity.shape[0] > 0, tags.shape[0] > 0
    brightnesses = rows.shape[1] - 1
    mask = slots.shape[0] - 1
    gated = 0
    outside = 0
    # Neighbouring points of a ring mostly share a voxel: they are added up as one run, which is looked up once.
    keys, sums, bright = np.empty(AHEAD, np.int64), np.empty((AHEAD, 4), np.int64), np.empty(AHEAD, np.int64)
    numbers, likely = np.empty(AHEAD, np.int64), np.empty(AHEAD, np.int64)
    for begin in range(0, points.shape[0], AHEAD):
        run, last_key = -1, -1
        for i in range(begin, min(begin + AHEAD, points.shape[0])):
            px, py, pz = np.float64(points[i, 0]), np.float64(points[i, 1]), np.float64(points[i, 2])
            r2 = px * px + py * py + pz * pz
            if not (r2 >= near and r2 <= far and r2 > 0.0):
                gated += 1
                continue
            x = T[0, 0] * px + T[0, 1] * py + T[0, 2] * pz + T[0, 3]
            y = T[1, 0] * px + T[1, 1] * py + T[1, 2] * pz + T[1, 3]
            z = T[2, 0] * px + T[2, 1] * py + T[2, 2] * pz + T[2, 3]
            if x < crop[0] or x > crop[1] or y < crop[2] or y > crop[3] or z < crop[4] or z > crop[5]:
                gated += 1
                continue
            x, y, z = x * inverse, y * inverse, z * inverse
            fx, fy, fz = np.floor(x), np.floor(y), np.floor(z)
            key = pack(np.int64(fx) - origin[0], np.int64(fy) - origin[1], np.int64(fz) - origin[2])
            if key < 0:
                outside += 1
                continue
            if key != last_key:
                run, last_key = run + 1, key
                keys[run], numbers[run], bright[run] = key, i, 0
                sums[run, 0], sums[run, 1], sums[run, 2], sums[run, 3] = 0, 0, 0, 0
            sums[run, 0] += np.int64(np.rint((x - fx - 0.5) * UNITS))
            sums[run, 1] += np.int64(np.rint((y - fy - 0.5) * UNITS))
            sums[run, 2] += np.int64(np.rint((z - fz - 0.5) * UNITS))
            sums[run, 3] += 1
            if with_intensity and np.isfinite(intensity[i]):
                brightness = min(max(np.float64(intensity[i]), -_BRIGHTEST), _BRIGHTEST)
                bright[run] += np.int64(np.rint(brightness * INTENSITY_UNITS))
            if with_tags and tags[i, 0] < tags[numbers[run], 0]:
                numbers[run] = i
        # Table and rows are far larger than the processor's caches: a batch of rows is fetched before a branch depends on one.
        for k in range(run + 1):
            likely[k] = slots[slot_of(keys[k], mask)]
        for k in range(run + 1):
            if rows[max(likely[k], 0), 0] != keys[k]:
                likely[k] = -1
        for k in range(run + 1):
            row = likely[k]
            if row < 0:
                row = row_of(keys[k], slots, rows, used)
                if row == used:
                    used += 1
                    rows[row, 1:] = 0
                    if with_tags:
                        rows[row, SUMS] = _NO_TAG
            for n in range(4):
                rows[row, 1 + n] += sums[k, n]
            if with_intensity:
                rows[row, brightnesses] += bright[k]
            if with_tags and tags[numbers[k], 0] < rows[row, SUMS]:
                for n in range(tags.shape[1]):
                    rows[row, SUMS + n] = tags[numbers[k], n]
    return used, gated, outside


def unpack(rows: NDArray[np.int64], origin: NDArray[np.int64], voxel: float) -> NDArray[Any]:
    """(M, 3) float64 mean positions, m, of finished rows (M, 5 or more)."""
    cells = unpack_cells(rows[:, 0], origin)
    points = (cells + 0.5 + rows[:, 1:4] / (rows[:, 4:5] * UNITS)) * voxel
    return np.asarray(points)
