"""Distribution to distribution over voxels (Koide et al. 2021, section IV): all around a point, each by its count."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from lslam.core.kernels.gaussians import BLOB, EMPTY
from lslam.core.kernels.jit import kernel
from lslam.core.kernels.linalg import add_gradient, add_matrix, rotate_symmetric
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
from lslam.core.kernels.residuals import nearest, octant_slots, place, thin_information
from lslam.registration.kernels.discs import EXTENT_M2
from lslam.registration.kernels.gicp_residual import certainty_of_pair
from lslam.registration.kernels.point_sums import keep

Floats = NDArray[np.float64]
Longs = NDArray[np.int64]
Ints = NDArray[np.int32]


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
    size, sigma2, plane_weight, blob_weight, _, _ = settings
    cells, slots, chosen, asked, is_done, away2 = search
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
            # Planes, or blobs where there are none.
            least = EMPTY
            for k in range(8):
                if slots[i, k] >= 0 and planes[slots[i, k], 7] >= 0.0:
                    least = BLOB
            keep(i, slots, planes, 7, least)
        spread = rotate_symmetric(R, covariance[i])
        best, _, blob, _ = nearest(x, y, z, i, slots, chosen, asked, planes)
        if best < 0 and (blob < 0 or blob_weight <= 0.0):
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
            if best < 0 and v != blob:
                continue
            p = planes[v]
            ex, ey, ez = x - p[0], y - p[1], z - p[2]
            n = (plane_weight if best >= 0 else blob_weight) * counts[v]
            mxx, mxy, mxz, myy, myz, mzz, away = certainty_of_pair(p, best >= 0, ex, ey, ez, spread, sigma2, extent2)
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
        away2[i] = closest
        facts[MATCHED] += 1.0
        if closest < c2:
            facts[INLIERS] += 1.0
        if closest <= gate2:
            facts[SQUARED] += closest_robust * closest
            facts[ROBUST] += closest_robust
