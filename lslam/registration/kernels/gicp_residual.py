"""Generalised ICP, both covariances discs: plane to plane (Segal et al. 2009, equation 2), and distribution to distribution.

The former takes the nearest Gaussian, the latter (Koide et al. 2021, section IV) all voxels around a point, each by its count.
Discs are Gaussians that are thin along a normal and wide in the plane. A point may have several matches: what it may match stands
first among its slots.
"""

from __future__ import annotations

import numpy as np

from lslam.core.arrays import Floats, Ints, Longs
from lslam.core.kernels.gaussians import BLOB, EMPTY, find
from lslam.core.kernels.jit import inline, kernel
from lslam.core.kernels.linalg import add_gradient, add_matrix, invert_symmetric, rotate_symmetric
from lslam.core.kernels.linearisation import (
    INFORMATION,
    INLIERS,
    LEVER,
    MATCHED,
    POPULATION,
    ROBUST,
    SQUARED,
    Pose,
    Search,
    Settings,
    Sums,
    Width,
)
from lslam.core.kernels.residuals import (
    Voxels,
    add_facts,
    add_information,
    add_surface,
    nearest,
    octant_slots,
    place,
    thin_information,
    variance_of,
    weigh_match,
)
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


@inline
def certainty_of_pair(
    p: Floats,
    is_plane: bool,
    ex: float,
    ey: float,
    ez: float,
    scatter: tuple[float, float, float, float, float, float],
    sigma2: float,
    extent2: float,
) -> tuple[float, float, float, float, float, float, float]:
    """Inverse xx..zz of the sum of both covariances, and the squared Mahalanobis distance, m2, scaled by `thin`.

    p : (8,) row of `planes`; e : from its mean to the point, m; scatter : m2, of the point, world axes
    thin : m2, the variance of the pair along a common normal
    """
    if is_plane:
        across = variance_of(p, p[3] * ex + p[4] * ey + p[5] * ez, ex * ex + ey * ey + ez * ez) + sigma2
        dxx, dxy, dxz, dyy, dyz, dzz = disc(p[3], p[4], p[5], across, extent2)
        thin = across + sigma2
    else:
        dxx, dxy, dxz, dyy, dyz, dzz = p[6], 0.0, 0.0, p[6], 0.0, p[6]
        thin = p[6] + sigma2
    sxx, sxy, sxz, syy, syz, szz = scatter
    mxx, mxy, mxz, myy, myz, mzz = invert_symmetric(sxx + dxx, sxy + dxy, sxz + dxz, syy + dyy, syz + dyz, szz + dzz)
    away = thin * (
        mxx * ex * ex + myy * ey * ey + mzz * ez * ez + 2.0 * (mxy * ex * ey + mxz * ex * ez + myz * ey * ez)
    )
    return mxx, mxy, mxz, myy, myz, mzz, away


@kernel
def linearise_gicp(
    points: tuple[Floats, Floats],
    voxels: Voxels,
    settings: Settings,
    search: Search,
    pose: Pose,
    width: Width,
    sums: Sums,
) -> None:
    """Add all source points (S, 3) with covariance (S, 6), LiDAR frame, not matched yet, to the sums, see `linearisation`.

    e = R s + t - mean of the nearest plane voxel of eight, and M = inv(C_t + R C_s R^T) with the voxel's disc C_t. The disc's
    variance along the normal is that of the voxel's points and tilt (Segal et al. take a constant, for planes of twenty
    neighbours). The cost is robust(thin e^T M e) / thin, where `thin`, m2, the variance of a pair along a common normal, scales
    the squared Mahalanobis distance to m2. Without a plane the nearest non-planar voxel is used, isotropic with its mean
    variance, times `non_planar_weight`. M is constant within a Gauss-Newton step. S is the information along the normals alone,
    and of non-planar voxels.
    """
    source, covariance = points
    planes, keys, table = voxels
    size, sigma2, plane_weight, non_planar_weight, _, _ = settings
    cells, slots, chosen, asked, is_done, distance2 = search
    R, t = pose
    scale, _, gate2 = width
    H, S, g, facts = sums
    inverse = 1.0 / size
    unused = np.zeros(6)
    c2 = scale * scale
    # A match may lie anywhere in its voxel: what is off sideways in a wide one says nothing.
    extent2 = max(EXTENT_M2, size * size)
    for i in range(len(source)):
        if is_done[i]:
            continue
        rx, ry, rz, x, y, z = place(source, i, R, t)
        if octant_slots(x, y, z, i, inverse, cells, slots, keys, table):
            asked[i, 3] = -1.0
        best, _, non_planar, _ = nearest(x, y, z, i, slots, chosen, asked, planes)
        if best < 0:
            if non_planar < 0 or non_planar_weight <= 0.0:
                continue
            best = non_planar
        is_done[i] = True
        p = planes[best]
        is_plane = p[7] >= 0.0
        ex, ey, ez = x - p[0], y - p[1], z - p[2]
        scatter = rotate_symmetric(R, covariance[i])
        mxx, mxy, mxz, myy, myz, mzz, away = certainty_of_pair(p, is_plane, ex, ey, ez, scatter, sigma2, extent2)
        distance2[i] = away
        robust = weigh_match(facts, away, c2, gate2)
        if robust == 0.0:
            continue
        w = robust * (plane_weight if is_plane else non_planar_weight)
        add_information(H, g, w, mxx, mxy, mxz, myy, myz, mzz, ex, ey, ez, rx, ry, rz)
        trace = w * (mxx + myy + mzz)
        if is_plane:
            along = w * thin_information(p, mxx, mxy, mxz, myy, myz, mzz)
            add_surface(S, unused, along, p[3], p[4], p[5], rx, ry, rz)
        else:
            add_information(S, unused, w, mxx, mxy, mxz, myy, myz, mzz, 0.0, 0.0, 0.0, rx, ry, rz)
        add_facts(facts, trace, robust * away, robust, rx, ry, rz)


@kernel
def linearise_vgicp(
    points: tuple[Floats, Floats],
    voxels: tuple[Floats, Floats, Longs, Ints],
    settings: Settings,
    search: Search,
    pose: Pose,
    width: Width,
    sums: Sums,
) -> None:
    """Add all source points (S, 3) with covariance (S, 6), LiDAR frame, not matched yet, to the sums, see `linearisation`.

    As `linearise_gicp`, but on all plane voxels of the eight around R s + t, each times the number of points in it,
    counts (C,). Distances are those to the closest.
    """
    source, covariance = points
    planes, counts, keys, table = voxels
    size, sigma2, plane_weight, non_planar_weight, _, _ = settings
    cells, slots, chosen, asked, is_done, distance2 = search
    R, t = pose
    scale, _, gate2 = width
    H, S, g, facts = sums
    inverse = 1.0 / size
    c2 = scale * scale
    # A match may lie anywhere in its voxel: what is off sideways in a wide one says nothing.
    extent2 = max(EXTENT_M2, size * size)
    for i in range(len(source)):
        if is_done[i]:
            continue
        rx, ry, rz, x, y, z = place(source, i, R, t)
        if octant_slots(x, y, z, i, inverse, cells, slots, keys, table):
            asked[i, 3] = -1.0
            # Planes, or non-planar voxels where there are none.
            least = EMPTY
            for k in range(8):
                if slots[i, k] >= 0 and planes[slots[i, k], 7] >= 0.0:
                    least = BLOB
            keep(i, slots, planes, 7, least)
        scatter = rotate_symmetric(R, covariance[i])
        best, _, non_planar, _ = nearest(x, y, z, i, slots, chosen, asked, planes)
        if best < 0 and (non_planar < 0 or non_planar_weight <= 0.0):
            continue
        is_done[i] = True
        closest, closest_robust = 1e300, 0.0
        hxx, hxy, hxz, hyy, hyz, hzz = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
        sxx, sxy, sxz, syy, syz, szz = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
        gx, gy, gz = 0.0, 0.0, 0.0
        for k in range(8):
            v = slots[i, k]
            if v < 0:
                break
            if best < 0 and v != non_planar:
                continue
            p = planes[v]
            ex, ey, ez = x - p[0], y - p[1], z - p[2]
            n = (plane_weight if best >= 0 else non_planar_weight) * counts[v]
            mxx, mxy, mxz, myy, myz, mzz, away = certainty_of_pair(p, best >= 0, ex, ey, ez, scatter, sigma2, extent2)
            robust = c2 / (c2 + away)
            robust *= robust
            if away < closest:
                closest, closest_robust = away, robust
            facts[POPULATION] += n
            if away > gate2:
                continue
            w = n * robust
            mxx, mxy, mxz, myy, myz, mzz = w * mxx, w * mxy, w * mxz, w * myy, w * myz, w * mzz
            hxx, hxy, hxz, hyy, hyz, hzz = hxx + mxx, hxy + mxy, hxz + mxz, hyy + myy, hyz + myz, hzz + mzz
            gx += mxx * ex + mxy * ey + mxz * ez
            gy += mxy * ex + myy * ey + myz * ez
            gz += mxz * ex + myz * ey + mzz * ez
            if best >= 0:
                along = thin_information(p, mxx, mxy, mxz, myy, myz, mzz)
                mxx, mxy, mxz = along * p[3] * p[3], along * p[3] * p[4], along * p[3] * p[5]
                myy, myz, mzz = along * p[4] * p[4], along * p[4] * p[5], along * p[5] * p[5]
            sxx, sxy, sxz, syy, syz, szz = sxx + mxx, sxy + mxy, sxz + mxz, syy + myy, syz + myz, szz + mzz
        add_matrix(H, hxx, hxy, hxz, hyy, hyz, hzz, rx, ry, rz)
        add_matrix(S, sxx, sxy, sxz, syy, syz, szz, rx, ry, rz)
        add_gradient(g, gx, gy, gz, rx, ry, rz)
        facts[INFORMATION] += hxx + hyy + hzz
        facts[LEVER] += (hxx + hyy + hzz) * (rx * rx + ry * ry + rz * rz)
        distance2[i] = closest
        facts[MATCHED] += 1.0
        if closest < c2:
            facts[INLIERS] += 1.0
        if closest <= gate2:
            facts[SQUARED] += closest_robust * closest
            facts[ROBUST] += closest_robust
