"""Shape of neighbourhoods in a cloud: entropy, and variance about the plane through them."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from lslam.core.arrays import Floats
from lslam.core.kernels.jit import inline, kernel
from lslam.core.kernels.linalg import eigen, extent
from lslam.core.kernels.voxel import pack

# Neighbourhoods thinner than 0.1 mm count as that thick: a perfect plane has an entropy, too.
_THIN = 1e-8


@inline
def _below(keys: NDArray[np.int64], key: int) -> int:
    """Number of sorted keys smaller than `key`."""
    low, high = 0, len(keys)
    while low < high:
        middle = (low + high) >> 1
        if keys[middle] < key:
            low = middle + 1
        else:
            high = middle
    return low


@inline
def moments(
    points: Floats,
    keys: NDArray[np.int64],
    query: Floats,
    low: Floats,
    radius: float,
    matrix: Floats,
) -> int:
    """Number of points within `radius`, m, of a query (3,); writes their scatter about their mean, m2, into `matrix` (3, 3).

    points : (N, 3) sorted by `keys`, their cells of edge `radius` from `cell_keys`
    """
    x, y, z = query[0], query[1], query[2]
    ix, iy, iz = int((x - low[0]) / radius), int((y - low[1]) / radius), int((z - low[2]) / radius)
    r2 = radius * radius
    n = 0
    sx, sy, sz = 0.0, 0.0, 0.0
    xx, xy, xz, yy, yz, zz = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    for a in range(-1, 2):
        for b in range(-1, 2):
            start = _below(keys, pack(ix + a, iy + b, iz - 1))
            stop = pack(ix + a, iy + b, iz + 1)
            j = start
            while j < len(keys) and keys[j] <= stop:
                dx, dy, dz = points[j, 0] - x, points[j, 1] - y, points[j, 2] - z
                j += 1
                if dx * dx + dy * dy + dz * dz > r2:
                    continue
                n += 1
                sx += dx
                sy += dy
                sz += dz
                xx += dx * dx
                xy += dx * dy
                xz += dx * dz
                yy += dy * dy
                yz += dy * dz
                zz += dz * dz
    if n > 0:
        matrix[0, 0] = xx - sx * sx / n
        matrix[1, 1] = yy - sy * sy / n
        matrix[2, 2] = zz - sz * sz / n
        matrix[0, 1] = matrix[1, 0] = xy - sx * sy / n
        matrix[0, 2] = matrix[2, 0] = xz - sx * sz / n
        matrix[1, 2] = matrix[2, 1] = yz - sy * sz / n
    return n


@kernel
def cell_keys(points: Floats, low: Floats, size: float) -> NDArray[np.int64]:
    """(N,) packed cell of each point, z fastest, cells of edge `size`, m, counted from `low` (3,), m, below all points."""
    keys = np.empty(len(points), np.int64)
    for i in range(len(points)):
        keys[i] = pack(
            int((points[i, 0] - low[0]) / size),
            int((points[i, 1] - low[1]) / size),
            int((points[i, 2] - low[2]) / size),
        )
    return keys


@kernel
def shapes(
    points: Floats,
    keys: NDArray[np.int64],
    queries: Floats,
    low: Floats,
    radius: float,
    least: int,
) -> Floats:
    """Entropy, nats, and plane variance, m2, (Q, 2) of the points within `radius`, m, of each query.

    NaN where they are fewer than `least`.

    points : (N, 3) sorted by `keys`, their cells of edge `radius` from `cell_keys`
    The plane variance is the residual sum of squares over n - 3, the unbiased estimate.
    """
    out = np.empty((len(queries), 2))
    out[:] = np.nan
    matrix = np.empty((3, 3))
    for q in range(len(queries)):
        n = moments(points, keys, queries[q], low, radius, matrix)
        if n < least:
            continue
        values, _ = eigen(matrix)
        logs = 0.0
        for k in range(3):
            logs += math.log(max(values[k] / (n - 1), _THIN))
        out[q, 0] = 0.5 * (3.0 * math.log(2.0 * math.pi * math.e) + logs)
        out[q, 1] = max(extent(values)[0], 0.0) / (n - 3)
    return out


@kernel
def normals(
    points: Floats,
    keys: NDArray[np.int64],
    queries: Floats,
    low: Floats,
    radius: float,
    least: int,
) -> Floats:
    """Unit normals (Q, 3) of the planes through the points within `radius`, m, of each query, of either sign.

    Zero where these are fewer than `least`; points as in `shapes`.
    """
    out = np.zeros((len(queries), 3))
    matrix = np.empty((3, 3))
    for q in range(len(queries)):
        if moments(points, keys, queries[q], low, radius, matrix) >= least:
            values, vectors = eigen(matrix)
            k = 0
            for j in range(1, 3):
                if values[j] < values[k]:
                    k = j
            for j in range(3):
                out[q, j] = vectors[j, k]
    return out
