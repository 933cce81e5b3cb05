"""Plane to plane (Segal et al. 2009, equation 2): the nearest Gaussian, both covariances discs."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from lslam.core.kernels.facts import INFORMATION, INLIERS, LEVER, MATCHED, ROBUST, SQUARED
from lslam.core.kernels.jit import kernel
from lslam.core.kernels.linalg import invert_symmetric, rotate_symmetric
from lslam.core.kernels.linearisation import Pose, Search, Settings, Sums, Width
from lslam.core.kernels.residuals import (
    Voxels,
    add_information,
    add_surface,
    nearest,
    octant_slots,
    thin_information,
    variance_of,
)
from lslam.registration.kernels.discs import EXTENT2, disc

Floats = NDArray[np.float64]


@kernel
def linearise_gicp(points: tuple[Floats, Floats], voxels: Voxels, settings: Settings, search: Search, pose: Pose,
                   width: Width, sums: Sums) -> None:  # fmt: skip
    """Add all source points (S, 3) with covariance (S, 6), LiDAR frame, not matched yet, to the sums, see `linearisation`.

    e = R s + t - mean of the nearest plane voxel of eight, and M = inv(C_t + R C_s R^T) with the voxel's disc C_t. The disc's
    variance along the normal is that of the voxel's points and tilt (Segal et al. take a constant, for planes of twenty
    neighbours). The cost is robust(thin e^T M e) / thin, where `thin`, m2, the variance of a pair along a common normal, scales
    the squared Mahalanobis distance to m2. Without a plane the nearest blob is used, isotropic with its mean variance, times
    `blob_weight`. M is constant within a Gauss-Newton step. S is the information along the normals alone, with blobs.
    """
    source, covariance = points
    planes, keys, table = voxels
    size, sigma2, plane_weight, blob_weight, _, _ = settings
    cells, slots, chosen, asked, is_done, away2 = search
    R, t = pose
    scale, _, gate2 = width
    H, S, g, facts = sums
    inverse = 1.0 / size
    unused = np.zeros(6)
    c2 = scale * scale
    # A match may lie anywhere in its voxel: what is off sideways in a wide one says nothing.
    extent2 = max(EXTENT2, size * size)
    for i in range(len(source)):
        if is_done[i]:
            continue
        a, b, c = source[i, 0], source[i, 1], source[i, 2]
        rx = R[0, 0] * a + R[0, 1] * b + R[0, 2] * c
        ry = R[1, 0] * a + R[1, 1] * b + R[1, 2] * c
        rz = R[2, 0] * a + R[2, 1] * b + R[2, 2] * c
        x, y, z = rx + t[0], ry + t[1], rz + t[2]
        if octant_slots(x, y, z, i, inverse, cells, slots, keys, table):
            asked[i, 3] = -1.0
        best, best_d, blob, _ = nearest(x, y, z, i, slots, chosen, asked, planes)
        if best < 0:
            if blob < 0 or blob_weight <= 0.0:
                continue
            best = blob
        is_done[i] = True
        p = planes[best]
        sxx, sxy, sxz, syy, syz, szz = rotate_symmetric(R, covariance[i])
        if p[7] >= 0.0:
            off = p[3] * (x - p[0]) + p[4] * (y - p[1]) + p[5] * (z - p[2])
            across = variance_of(p, off, best_d) + sigma2
            dxx, dxy, dxz, dyy, dyz, dzz = disc(p[3], p[4], p[5], across, extent2)
            share, thin = plane_weight, across + sigma2
        else:
            dxx, dxy, dxz, dyy, dyz, dzz = p[6], 0.0, 0.0, p[6], 0.0, p[6]
            share, thin = blob_weight, p[6] + sigma2
        mxx, mxy, mxz, myy, myz, mzz = invert_symmetric(
            sxx + dxx, sxy + dxy, sxz + dxz, syy + dyy, syz + dyz, szz + dzz
        )
        ex, ey, ez = x - p[0], y - p[1], z - p[2]
        away = thin * (
            mxx * ex * ex + myy * ey * ey + mzz * ez * ez + 2.0 * (mxy * ex * ey + mxz * ex * ez + myz * ey * ez)
        )
        away2[i] = away
        facts[MATCHED] += 1.0
        if away < c2:
            facts[INLIERS] += 1.0
        if away > gate2:
            continue
        robust = c2 / (c2 + away)
        robust *= robust
        w = robust * share
        add_information(H, g, w, mxx, mxy, mxz, myy, myz, mzz, ex, ey, ez, rx, ry, rz)
        trace = w * (mxx + myy + mzz)
        if p[7] >= 0.0:
            along = w * thin_information(p, mxx, mxy, mxz, myy, myz, mzz)
            add_surface(S, unused, along, p[3], p[4], p[5], rx, ry, rz)
        else:
            add_information(S, unused, w, mxx, mxy, mxz, myy, myz, mzz, 0.0, 0.0, 0.0, rx, ry, rz)
        facts[INFORMATION] += trace
        facts[SQUARED] += robust * away
        facts[LEVER] += trace * (rx * rx + ry * ry + rz * rz)
        facts[ROBUST] += robust
