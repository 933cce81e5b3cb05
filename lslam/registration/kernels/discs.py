"""Discs, Gaussians that are thin along a normal and wide in the plane, as G-ICP gives them to every point; matches of several.

A point may have several matches: what it may match stands first among its slots.
"""

from __future__ import annotations

from lslam.core.arrays import Floats, Ints, Longs
from lslam.core.kernels.gaussians import find
from lslam.core.kernels.jit import inline, kernel
from lslam.core.kernels.voxel import index_of, pack

# m2 in the plane of a disc. Segal et al. (2009) take 1 m2, and about 1e-3 m2, our sigma2, across.
EXTENT_M2 = 1.0


@inline
def disc(
    nx: float, ny: float, nz: float, thin: float, extent2: float
) -> tuple[float, float, float, float, float, float]:
    """Covariance xx, xy, xz, yy, yz, zz, m2, of a disc with unit normal n: variance `thin` along it, `extent2` across."""
    a = extent2 - thin
    return (
        extent2 - a * nx * nx,
        -a * nx * ny,
        -a * nx * nz,
        extent2 - a * ny * ny,
        -a * ny * nz,
        extent2 - a * nz * nz,
    )


@kernel
def source_discs(
    source: Floats, size: float, planes: Floats, keys: Longs, table: Ints, thin: float, out: Floats
) -> int:
    """Write the discs, covariances (S, 6), m2, of the source points in plane voxels of their own scan to `out`.

    Returns the number of such points. Rows of the other points are not changed.
    size : m, of a voxel; thin : m2, variance along the normal
    """
    inverse = 1.0 / size
    count = 0
    for i in range(len(source)):
        ix, iy, iz = index_of(source[i, 0], inverse), index_of(source[i, 1], inverse), index_of(source[i, 2], inverse)
        s = find(pack(ix, iy, iz), keys, table)
        if s < 0 or planes[s, 7] < 0.0:
            continue
        xx, xy, xz, yy, yz, zz = disc(planes[s, 3], planes[s, 4], planes[s, 5], thin, EXTENT_M2)
        out[i, 0], out[i, 1], out[i, 2] = xx, xy, xz
        out[i, 3], out[i, 4], out[i, 5] = yy, yz, zz
        count += 1
    return count


@inline
def keep(i: int, slots: Ints, rows: Floats, column: int, least: float) -> None:
    """Remove from the slots (8,) of point i those whose value in a `column` of `rows` (C, N) is not above `least`.

    The others move to the front; the rest are -1.
    """
    used = 0
    for k in range(8):
        s = slots[i, k]
        slots[i, k] = -1
        if s >= 0 and rows[s, column] > least:
            slots[i, used] = s
            used += 1
