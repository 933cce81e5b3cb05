"""The information of the surfaces' normals alone, for residuals with full information matrices.

The Gaussian of a plane voxel also has information within the plane, about the positions of the voxel's points. It is small, but
it is the only information along a corridor, and it pulls the pose towards where the map was measured. So degenerate directions
are found without it, and the pose keeps the motion prior along them.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from lslam.core.kernels.jit import inline, inline_with_arrays
from lslam.core.kernels.linalg import eigen
from lslam.core.kernels.linearisation import INFORMATION, LEVER
from lslam.core.kernels.residuals import add_information

Floats = NDArray[np.float64]


@inline
def add_surface(S: Floats, unused: Floats, w: float, nx: float, ny: float, nz: float, rx: float, ry: float,
                rz: float) -> None:  # fmt: skip
    """Upper triangle of S (6, 6) += w j j^T with j = [n, r x n]; `unused` (6,) takes no gradient."""
    add_information(S, unused, w, nx * nx, nx * ny, nx * nz, ny * ny, ny * nz, nz * nz, 0.0, 0.0, 0.0, rx, ry, rz)


@inline
def thin_information(p: Floats, xx: float, xy: float, xz: float, yy: float, yz: float, zz: float) -> float:
    """n^T M n along the normal of a plane voxel, a row of `planes`."""
    nx, ny, nz = p[3], p[4], p[5]
    along: float = xx * nx * nx + yy * ny * ny + zz * nz * nz + 2.0 * (xy * nx * ny + xz * nx * nz + yz * ny * nz)
    return along


@inline_with_arrays
def solve_on_surfaces(H: Floats, S: Floats, g: Floats, facts: Floats, weak_share: float, least: float, d: Floats,
                      weak: Floats) -> int:  # fmt: skip
    """As `gauss_newton.solve_observed`, with the observed directions by the share of S; d solves H in them.

    `least` applies to H. Both matrices are full, not triangles.
    """
    lever = math.sqrt(max(facts[LEVER] / max(facts[INFORMATION], 1e-300), 1e-6))
    needed = weak_share * (S[0, 0] + S[1, 1] + S[2, 2])
    D = np.ones(6)
    D[3:] = 1.0 / lever
    A, B, P = np.empty((6, 6)), np.empty((6, 6)), np.zeros((6, 6))
    for i in range(6):
        for j in range(6):
            A[i, j] = S[i, j] * D[i] * D[j]
            B[i, j] = H[i, j] * D[i] * D[j]
    values, vectors = eigen(A)
    count = 0
    for k in range(6):
        held = 0.0
        for i in range(6):
            for j in range(6):
                held += vectors[i, k] * B[i, j] * vectors[j, k]
        if values[k] <= needed or held <= least or values[k] <= 0.0:
            for i in range(6):
                weak[count, i] = vectors[i, k]
            count += 1
            continue
        for i in range(6):
            for j in range(6):
                P[i, j] += vectors[i, k] * vectors[j, k]
    for i in range(6):
        for j in range(6):
            A[i, j] = 0.0
            for k in range(6):
                for m in range(6):
                    A[i, j] += P[i, k] * B[k, m] * P[m, j]
    values, vectors = eigen(A)
    largest = 0.0
    for k in range(6):
        largest = max(largest, values[k])
    d[:] = 0.0
    for k in range(6):
        if values[k] <= 1e-12 * largest:
            continue
        dot = 0.0
        for i in range(6):
            for j in range(6):
                dot += vectors[i, k] * P[i, j] * g[j] * D[j]
        for i in range(6):
            d[i] -= vectors[i, k] * dot / values[k] * D[i]
    return count
