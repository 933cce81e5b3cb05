"""Rows found by packed cell indices: an open-addressing hash of int64 keys into dense rows, whose first column is the key.

A cell's three indices are packed into 63 bits, 21 per axis and relative to an origin, so they reach `HALF` cells to each
side of it.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from lslam.kernels.jit import inline, kernel

AXIS_BITS = 21
HALF = 1 << (AXIS_BITS - 1)
_MIX = -7046029254386353131  # 0x9E3779B97F4A7C15 as int64: Fibonacci hashing


@inline
def pack(ix: int, iy: int, iz: int) -> int:
    """Key of cell indices relative to the origin; -1 when one lies outside what has a key."""
    x, y, z = ix + HALF, iy + HALF, iz + HALF
    if (x | y | z) >> AXIS_BITS != 0:  # negative or too large on some axis
        return -1
    return (x << (2 * AXIS_BITS)) | (y << AXIS_BITS) | z


@inline
def slot_of(key: int, mask: int) -> int:
    """Home of a key in a table of mask + 1 slots."""
    mixed = key * _MIX
    return (mixed ^ (mixed >> 29) ^ (mixed >> 43)) & mask


@inline
def row_of(key: int, slots: NDArray[np.int32], rows: NDArray[np.int64], used: int) -> int:
    """Row of a key; `used` when it has none yet: entered in `slots` then, the key written, the other columns not.

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
    """Enter the first `used` rows into `slots`, which are all -1 and a power of two above `used`."""
    mask = slots.shape[0] - 1
    for row in range(used):
        slot = slot_of(rows[row, 0], mask)
        while slots[slot] >= 0:
            slot = (slot + 1) & mask
        slots[slot] = row


def unpack(keys: NDArray[np.int64], origin: NDArray[np.int64]) -> NDArray[np.int64]:
    """(M, 3) cell indices of keys (M,)."""
    cells = np.empty((len(keys), 3), np.int64)
    for axis in range(3):
        cells[:, axis] = ((keys >> (AXIS_BITS * (2 - axis))) & ((1 << AXIS_BITS) - 1)) - HALF + origin[axis]
    return cells
