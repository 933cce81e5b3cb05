"""Plane adjustment: normal equations of all poses for planes seen by many scans, whose parameters are eliminated.

A sighting is what one scan saw of one plane between two of the poses: mean and covariance of its points in the world, and the
share of the way from the first pose to the second at which it was seen. The points move by a like share of both corrections.
Pose corrections are x = (t, r), 6: t in m, r in rad about the sensor, world axes.
"""

from __future__ import annotations

import numpy as np

from lslam.core.arrays import Floats, Longs
from lslam.core.kernels.jit import inline, inline_with_arrays, kernel
from lslam.core.kernels.linalg import eigen, inverse
from lslam.core.kernels.voxel import index_of, pack, place_of, table_size


@kernel
def number_cells(points: Floats, poses: Longs, edge: float) -> tuple[Longs, Longs]:
    """Voxel index (N,) of each point (N, 3), in order of first appearance; and the number (V,) of poses that saw each voxel.

    poses : (N,) ascending pose number of each point; edge : m, of the voxels
    """
    numbers, count = np.empty(len(points), np.int64), 0
    table = np.empty(table_size(len(points)), np.int32)
    table[:] = -1
    keys, views, latest = (
        np.empty(len(points), np.int64),
        np.zeros(len(points), np.int64),
        np.empty(len(points), np.int64),
    )
    inverse_edge = 1.0 / edge
    for i in range(len(points)):
        x, y, z = points[i]
        key = pack(index_of(x, inverse_edge), index_of(y, inverse_edge), index_of(z, inverse_edge))
        h = place_of(key, keys, table)
        if table[h] < 0:
            table[h], keys[count], latest[count] = count, key, -1
            count += 1
        cell = table[h]
        if latest[cell] != poses[i]:
            views[cell], latest[cell] = views[cell] + 1, poses[i]
        numbers[i] = cell
    return numbers, views[:count].copy()


@kernel
def place_between(places: Floats, nodes: Floats) -> tuple[Longs, Floats]:
    """Index (N,) of the last of the ascending `nodes` (M,) before each place (N,), and the place's share of the way to the next.

    Shares (N,) are 0..1. Places before the first node are at it, those behind the last at the last.
    """
    numbers, shares = np.empty(len(places), np.int64), np.zeros(len(places))
    for i in range(len(places)):
        at = max(np.searchsorted(nodes, places[i], side="right") - 1, 0)
        numbers[i] = at
        if at + 1 < len(nodes):
            shares[i] = min(max((places[i] - nodes[at]) / (nodes[at + 1] - nodes[at]), 0.0), 1.0)
    return numbers, shares


@kernel
def move(points: Floats, poses: Longs, shares: Floats, origins: Floats, turns: Floats, shifts: Floats) -> None:
    """Move the points (N, 3), in place, by the corrections of the two poses before and after each, interpolated.

    poses : (N,) index of the earlier pose; shares : (N,) 0..1 of the way from it to the later
    origins : (K, 3) m, of the sensor; turns : (K, 3, 3) about these; shifts : (K, 3) m
    """
    out = np.empty(3)
    last = len(origins) - 1
    for i in range(len(points)):
        out[:] = 0.0
        for side in range(2):
            k = min(poses[i] + side, last)
            share = shares[i] if side else 1.0 - shares[i]
            x, y, z = points[i, 0] - origins[k, 0], points[i, 1] - origins[k, 1], points[i, 2] - origins[k, 2]
            for a in range(3):
                turned = turns[k, a, 0] * x + turns[k, a, 1] * y + turns[k, a, 2] * z
                out[a] += share * (turned + origins[k, a] + shifts[k, a])
        for a in range(3):
            points[i, a] = out[a]


@kernel
def sums(cells: Longs, count: int, points: Floats) -> tuple[Longs, Floats, Floats]:
    """Number (V,), mean (V, 3) and covariance (V, 3, 3) of the points (N, 3) in each of `count` cells.

    cells : (N,) index of the cell of each point, -1 for none
    """
    numbers, means, covariances = np.zeros(count, np.int64), np.zeros((count, 3)), np.zeros((count, 3, 3))
    for i in range(len(cells)):
        v = cells[i]
        if v < 0:
            continue
        numbers[v] += 1
        for a in range(3):
            means[v, a] += points[i, a]
    for v in range(count):
        for a in range(3):
            means[v, a] /= max(numbers[v], 1)
    for i in range(len(cells)):
        v = cells[i]
        if v < 0:
            continue
        for a in range(3):
            for b in range(3):
                covariances[v, a, b] += (points[i, a] - means[v, a]) * (points[i, b] - means[v, b])
    for v in range(count):
        for a in range(3):
            for b in range(3):
                covariances[v, a, b] /= max(numbers[v], 1)
    return numbers, means, covariances


@kernel
def spectra(covariances: Floats) -> Floats:
    """Eigenvalues (V, 3) of symmetric matrices (V, 3, 3), smallest first."""
    out = np.empty((len(covariances), 3))
    for v in range(len(covariances)):
        out[v] = np.sort(eigen(covariances[v])[0])
    return out


@inline_with_arrays
def across(n: Floats, C: Floats, out: Floats) -> None:
    """X C into `out` (3, 3), where X e = e x n."""
    for k in range(3):
        out[0, k] = n[2] * C[1, k] - n[1] * C[2, k]
        out[1, k] = n[0] * C[2, k] - n[2] * C[0, k]
        out[2, k] = n[1] * C[0, k] - n[0] * C[1, k]


@inline
def lever(n: Floats, means: Floats, c: int, origins: Floats, k: int) -> tuple[float, float, float]:
    """Change of the distance of a point from a plane of normal `n`, m per rad of pose `k` about each axis.

    The point is the mean of sighting `c`.
    """
    x, y, z = means[c, 0] - origins[k, 0], means[c, 1] - origins[k, 1], means[c, 2] - origins[k, 2]
    return y * n[2] - z * n[1], z * n[0] - x * n[2], x * n[1] - y * n[0]


@inline
def couple(
    shares: Floats,
    poses: Longs,
    means: Floats,
    origins: Floats,
    slopes: Floats,
    n: Floats,
    c: int,
    x: Floats,
    z: Floats,
) -> None:
    """Add to the residual changes `z` (3,) of a plane of normal `n` the effect of the pose corrections x (K, 6) by sighting `c`.

    z : offset, m, and both slopes of the plane. The sighting counts with weight 1; arguments as of `equations`.
    """
    for side in range(2):
        share = shares[c] if side else 1.0 - shares[c]
        if share == 0.0:
            continue
        k = poses[c] + side
        roll, pitch, yaw = lever(n, means, c, origins, k)
        a, b, d = x[k, 3], x[k, 4], x[k, 5]
        r = n[0] * x[k, 0] + n[1] * x[k, 1] + n[2] * x[k, 2]
        r += roll * a + pitch * b + yaw * d
        z[0] += share * r
        z[1] += share * (r * slopes[c, 0] + slopes[c, 2] * a + slopes[c, 3] * b + slopes[c, 4] * d)
        z[2] += share * (r * slopes[c, 1] + slopes[c, 5] * a + slopes[c, 6] * b + slopes[c, 7] * d)


@inline
def couple_back(
    shares: Floats,
    poses: Longs,
    means: Floats,
    origins: Floats,
    slopes: Floats,
    n: Floats,
    c: int,
    y: Floats,
    out: Floats,
) -> None:
    """Subtract from `out` (K, 6) the effect of the plane correction y (3,) on the poses of sighting `c`: `couple` transposed."""
    force = y[0] + slopes[c, 0] * y[1] + slopes[c, 1] * y[2]
    for side in range(2):
        share = shares[c] if side else 1.0 - shares[c]
        if share == 0.0:
            continue
        k = poses[c] + side
        arms, f = lever(n, means, c, origins, k), share * force
        for a in range(3):
            out[k, a] -= f * n[a]
            out[k, 3 + a] -= f * arms[a] + share * (slopes[c, 2 + a] * y[1] + slopes[c, 5 + a] * y[2])


@kernel
def equations(
    starts: Longs, poses: Longs, shares: Floats, means: Floats, covariances: Floats, origins: Floats, floor: float
) -> tuple[Floats, Floats, Floats, Floats, Floats, Floats]:
    """Normal equations of the poses, and their coupling with the planes, which are eliminated.

    starts : (V + 1,) first sighting of each plane; poses : (C,) the first of both poses of a sighting
    shares : (C,) 0..1; means : (C, 3), covariances : (C, 3, 3) of the sightings, m and m2, world
    origins : (K, 3) m, of the sensor; floor : m2, added to the variance about a plane

    Every sighting is one measurement of the variance about its plane: its points have errors in common.
    Returns blocks (K, 6, 6) on the diagonal and (K, 6, 6) beside it, gradient (K, 6), normals (V, 3) of the planes, inverse
    (V, 3, 3) of the planes' own blocks times their squared weights, and `slopes` (C, 8): two coordinates in its plane, m, of
    each sighting, and two moments (3,) of its points about their mean, m2. Coupling blocks, of 36 numbers, are made of these.
    """
    count = len(origins)
    H, beside, g = np.zeros((count, 6, 6)), np.zeros((count, 6, 6)), np.zeros((count, 6))
    slopes = np.empty((len(poses), 8))
    normals, planes = np.empty((len(starts) - 1, 3)), np.empty((len(starts) - 1, 3, 3))
    A, Q, own = np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 3))
    d, J = np.empty(3), np.empty((2, 6))
    K, pull, Cn, turned = np.empty(3), np.empty(3), np.empty(3), np.empty(3)
    for v in range(len(starts) - 1):
        first, last = starts[v], starts[v + 1]
        size = float(last - first)
        middle = np.zeros(3)
        for c in range(first, last):
            for a in range(3):
                middle[a] += means[c, a] / size
        A[:] = 0.0
        for c in range(first, last):
            for a in range(3):
                for b in range(3):
                    spread = (means[c, a] - middle[a]) * (means[c, b] - middle[b])
                    A[a, b] += (covariances[c, a, b] + spread) / size
        values, axes = eigen(A)
        order = np.argsort(values)
        n, u, w = axes[:, order[0]].copy(), axes[:, order[1]].copy(), axes[:, order[2]].copy()
        normals[v] = n
        weight = 1.0 / (max(values[order[0]], 0.0) + floor)
        own[:] = 0.0
        pull[:] = 0.0
        for c in range(first, last):
            C = covariances[c]
            for a in range(3):
                d[a] = means[c, a] - middle[a]
            r = n[0] * d[0] + n[1] * d[1] + n[2] * d[2]
            K[0], K[1], K[2] = 1.0, u @ d, w @ d
            for a in range(3):
                Cn[a] = C[a, 0] * n[0] + C[a, 1] * n[1] + C[a, 2] * n[2]
            across(n, C, Q)
            slopes[c, 0], slopes[c, 1] = K[1], K[2]
            for a in range(3):
                slopes[c, 2 + a] = Q[a, 0] * u[0] + Q[a, 1] * u[1] + Q[a, 2] * u[2]
                slopes[c, 5 + a] = Q[a, 0] * w[0] + Q[a, 1] * w[1] + Q[a, 2] * w[2]
                turned[a] = Q[a, 0] * n[0] + Q[a, 1] * n[1] + Q[a, 2] * n[2]
            # Errors of the plane: offset, and slopes along u and w.
            uu = uw = ww = 0.0
            for a in range(3):
                for b in range(3):
                    uu += u[a] * C[a, b] * u[b]
                    uw += u[a] * C[a, b] * w[b]
                    ww += w[a] * C[a, b] * w[b]
            for i in range(3):
                pull[i] += weight * K[i] * r
                for j in range(3):
                    own[i, j] += weight * K[i] * K[j]
            own[1, 1] += weight * uu
            own[1, 2] += weight * uw
            own[2, 1] += weight * uw
            own[2, 2] += weight * ww
            pull[1] += weight * (u @ Cn)
            pull[2] += weight * (w @ Cn)
            for side in range(2):
                share = shares[c] if side else 1.0 - shares[c]
                k = poses[c] + side
                if share == 0.0:
                    continue
                J[side, 0], J[side, 1], J[side, 2] = n[0], n[1], n[2]
                J[side, 3], J[side, 4], J[side, 5] = lever(n, means, c, origins, k)
                f = weight * share
                for i in range(6):
                    g[k, i] += f * J[side, i] * r
                for a in range(3):
                    g[k, 3 + a] += f * turned[a]
            for side in range(2):
                for other in range(side, 2):
                    a_share = shares[c] if side else 1.0 - shares[c]
                    b_share = shares[c] if other else 1.0 - shares[c]
                    f = weight * a_share * b_share
                    if f == 0.0:
                        continue
                    block = H[poses[c] + side] if side == other else beside[poses[c]]
                    for i in range(6):
                        for j in range(6):
                            block[i, j] += f * J[side, i] * J[other, j]
                    # X C X^T is that of the rows of X C once more.
                    for a in range(3):
                        block[3 + a, 3] += f * (n[2] * Q[a, 1] - n[1] * Q[a, 2])
                        block[3 + a, 4] += f * (n[0] * Q[a, 2] - n[2] * Q[a, 0])
                        block[3 + a, 5] += f * (n[1] * Q[a, 0] - n[0] * Q[a, 1])
        planes[v] = inverse(own)
        for i in range(3):
            Cn[i] = weight * (planes[v, i, 0] * pull[0] + planes[v, i, 1] * pull[1] + planes[v, i, 2] * pull[2])
        for i in range(3):
            for j in range(3):
                planes[v, i, j] *= weight * weight
        for c in range(first, last):
            couple_back(shares, poses, means, origins, slopes, n, c, Cn, g)
    return H, beside, g, normals, planes, slopes


@kernel
def product(
    x: Floats,
    H: Floats,
    beside: Floats,
    starts: Longs,
    poses: Longs,
    shares: Floats,
    means: Floats,
    origins: Floats,
    normals: Floats,
    planes: Floats,
    slopes: Floats,
    stiffness: Floats,
    out: Floats,
) -> None:
    """Product of the reduced normal matrix with x (K, 6), into `out` (K, 6): the planes are eliminated.

    stiffness : (K - 1, 6) of the difference of two successive corrections, 1/m2 and 1/rad2; others as of `equations`
    """
    count = len(x)
    for k in range(count):
        for i in range(6):
            total = 0.0
            for j in range(6):
                total += H[k, i, j] * x[k, j]
            out[k, i] = total
    for k in range(count - 1):
        for i in range(6):
            force = stiffness[k, i] * (x[k + 1, i] - x[k, i])
            out[k + 1, i] += force
            out[k, i] -= force
            for j in range(6):
                out[k, i] += beside[k, i, j] * x[k + 1, j]
                out[k + 1, j] += beside[k, i, j] * x[k, i]
    z, y = np.empty(3), np.empty(3)
    for v in range(len(starts) - 1):
        n = normals[v]
        z[:] = 0.0
        for c in range(starts[v], starts[v + 1]):
            couple(shares, poses, means, origins, slopes, n, c, x, z)
        for i in range(3):
            y[i] = planes[v, i, 0] * z[0] + planes[v, i, 1] * z[1] + planes[v, i, 2] * z[2]
        for c in range(starts[v], starts[v + 1]):
            couple_back(shares, poses, means, origins, slopes, n, c, y, out)


@kernel
def inverses(blocks: Floats) -> Floats:
    """Inverse (K, 6, 6) of each block."""
    out = np.empty_like(blocks)
    for k in range(len(blocks)):
        out[k] = inverse(blocks[k])
    return out
