"""Points that have several matches each: what they may match stands first among their slots, and the matrices of their matches
are summed before the point's lever arm enters."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from lslam.core.kernels.jit import inline

Floats = NDArray[np.float64]
Ints = NDArray[np.int32]


@inline
def keep(i: int, slots: Ints, rows: Floats, column: int, least: float) -> None:
    """Of the slots (8,) of point i leave those whose entry in a `column` of `rows` (C, N) is above `least`, before all -1."""
    used = 0
    for k in range(8):
        s = slots[i, k]
        slots[i, k] = -1
        if s >= 0 and rows[s, column] > least:
            slots[i, used] = s
            used += 1


@inline
def add_matrix(
    H: Floats, xx: float, xy: float, xz: float, yy: float, yz: float, zz: float, rx: float, ry: float, rz: float
) -> None:
    """Upper triangle of H += J^T M J, with J = [I, -hat(r)] and M the symmetric matrix xx..zz."""
    H[0, 0] += xx
    H[0, 1] += xy
    H[0, 2] += xz
    H[1, 1] += yy
    H[1, 2] += yz
    H[2, 2] += zz
    # B = -M hat(r), the block between translation and rotation.
    b00, b01, b02 = xz * ry - xy * rz, xx * rz - xz * rx, xy * rx - xx * ry
    b10, b11, b12 = yz * ry - yy * rz, xy * rz - yz * rx, yy * rx - xy * ry
    b20, b21, b22 = zz * ry - yz * rz, xz * rz - zz * rx, yz * rx - xz * ry
    H[0, 3] += b00
    H[0, 4] += b01
    H[0, 5] += b02
    H[1, 3] += b10
    H[1, 4] += b11
    H[1, 5] += b12
    H[2, 3] += b20
    H[2, 4] += b21
    H[2, 5] += b22
    # hat(r) B
    H[3, 3] += ry * b20 - rz * b10
    H[3, 4] += ry * b21 - rz * b11
    H[3, 5] += ry * b22 - rz * b12
    H[4, 4] += rz * b01 - rx * b21
    H[4, 5] += rz * b02 - rx * b22
    H[5, 5] += rx * b12 - ry * b02


@inline
def add_gradient(g: Floats, px: float, py: float, pz: float, rx: float, ry: float, rz: float) -> None:
    """g += J^T p, with J as above and p = M e summed over the matches."""
    g[0] += px
    g[1] += py
    g[2] += pz
    g[3] += ry * pz - rz * py
    g[4] += rz * px - rx * pz
    g[5] += rx * py - ry * px
