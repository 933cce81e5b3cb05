"""Occupancy by rays: the cell in which a beam ends is hit, cells that it crosses are missed; a hash of packed cell indices.

A row is (key, a, low, high, stamp), int64. The updates of a cell are the function x -> clamp(x + a, low, high) of its previous
log-odds x. Clamped updates, those of OctoMap (Hornung et al. 2013), are closed under composition, so parts of a recording that
were summed separately can be joined in their order without loss.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from lslam.core.kernels.jit import inline, kernel
from lslam.maps.kernels.voxel_average import pack, row_of

COLUMNS = 5


@inline
def _seen_row(key: int, slots: NDArray[np.int32], rows: NDArray[np.int64], used: int) -> int:
    """Row of a key; for a new key the new row number `used`, without any update."""
    row = row_of(key, slots, rows, used)
    if row == used:
        rows[row, 1] = 0
        rows[row, 2] = -(1 << 40)
        rows[row, 3] = 1 << 40
        rows[row, 4] = -1
    return row


@inline
def _update(rows: NDArray[np.int64], row: int, change: int, low: int, high: int) -> None:
    rows[row, 1] += change
    rows[row, 2] = min(max(rows[row, 2] + change, low), high)
    rows[row, 3] = min(max(rows[row, 3] + change, low), high)


@kernel
def mark_ends(
    points: NDArray[np.float32],
    T: NDArray[np.float64],
    range_min: float,
    range_max: float,
    voxel: float,
    origin: NDArray[np.int64],
    slots: NDArray[np.int32],
    rows: NDArray[np.int64],
    used: int,
    stamp: int,
    model: NDArray[np.int64],
) -> tuple[int, NDArray[np.float64]]:
    """Update the cells in which beams end, once each; returns the rows used now, and the ends (E, 3) of the beams, in cells.

    points : (N, 3) sensor frame, m; T : (4, 4) world from sensor; origin : (3,) cell in the middle of the key range
    stamp : number of the scan; model : log-odds of a hit and of a miss, and their lower and upper bound
    Beams longer than `range_max`, m, end there without a hit. Only one beam per end cell is returned.
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
            row = _seen_row(key, slots, rows, used)
            used += row == used
            if rows[row, 4] == stamp:
                continue
            rows[row, 4] = stamp
            _update(rows, row, model[1] if far else model[0], model[2], model[3])
            ends[count, 0], ends[count, 1], ends[count, 2] = cx, cy, cz
            count += 1
    return used, ends[:count]


@kernel
def carve(
    ends: NDArray[np.float64],
    begin: int,
    start: NDArray[np.float64],
    longest: int,
    origin: NDArray[np.int64],
    slots: NDArray[np.int32],
    rows: NDArray[np.int64],
    used: int,
    stamp: int,
    model: NDArray[np.int64],
) -> tuple[int, int]:
    """Update the cells that the beams cross before their ends with a miss, once each (Amanatides and Woo 1987).

    start : (3,) common start of the beams, in cells; ends : (E, 3), in cells; longest : most cells that a beam crosses
    Returns the rows used now, and the index of the first beam that was not cast because `rows` was full, else len(ends).
    """
    cell = np.empty(3, np.int64)
    last = np.empty(3, np.int64)
    step = np.empty(3, np.int64)
    due = np.empty(3)
    each = np.empty(3)
    for i in range(begin, len(ends)):
        if used + longest > rows.shape[0]:
            return used, i
        for k in range(3):
            d = ends[i, k] - start[k]
            cell[k] = np.int64(np.floor(start[k]))
            last[k] = np.int64(np.floor(ends[i, k]))
            step[k] = 1 if d > 0 else -1
            each[k] = abs(1.0 / d) if d != 0.0 else np.inf
            edge = cell[k] + 1.0 - start[k] if d > 0 else start[k] - cell[k]
            due[k] = edge * each[k] if d != 0.0 else np.inf
        for _ in range(longest):
            if cell[0] == last[0] and cell[1] == last[1] and cell[2] == last[2]:
                break
            key = pack(cell[0] - origin[0], cell[1] - origin[1], cell[2] - origin[2])
            if key >= 0:
                row = _seen_row(key, slots, rows, used)
                used += row == used
                if rows[row, 4] != stamp:
                    rows[row, 4] = stamp
                    _update(rows, row, model[1], model[2], model[3])
            k = 0 if due[0] <= due[1] and due[0] <= due[2] else 1 if due[1] <= due[2] else 2
            if due[k] > 1.0:
                break
            cell[k] += step[k]
            due[k] += each[k]
    return used, len(ends)


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
