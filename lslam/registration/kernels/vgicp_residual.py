"""Distribution to distribution over voxels (Koide et al. 2021, section IV): all around a point, each by its count."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from lslam.core.kernels.facts import INFORMATION, INLIERS, LEVER, MATCHED, POPULATION, ROBUST, SQUARED
from lslam.core.kernels.jit import kernel
from lslam.core.kernels.linalg import rotate_symmetric
from lslam.core.kernels.linearisation import Pose, Search, Settings, Sums, Width
from lslam.core.kernels.residuals import (
    add_information,
    add_surface,
    nearest,
    octant_slots,
    place,
    thin_information,
)
from lslam.registration.kernels.discs import EXTENT_M2
from lslam.registration.kernels.gicp_residual import certainty_of_pair

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
        spread = rotate_symmetric(R, covariance[i])
        best, _, blob, _ = nearest(x, y, z, i, slots, chosen, asked, planes)
        if best < 0 and (blob < 0 or blob_weight <= 0.0):
            continue
        is_done[i] = True
        closest, closest_robust = 1e300, 0.0
        for k in range(8):
            v = slots[i, k]
            if v < 0 or (v != blob if best < 0 else planes[v, 7] < 0.0):
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
            add_information(H, g, w, mxx, mxy, mxz, myy, myz, mzz, ex, ey, ez, rx, ry, rz)
            trace = w * (mxx + myy + mzz)
            if best >= 0:
                along = w * thin_information(p, mxx, mxy, mxz, myy, myz, mzz)
                add_surface(S, unused, along, p[3], p[4], p[5], rx, ry, rz)
            else:
                add_information(S, unused, w, mxx, mxy, mxz, myy, myz, mzz, 0.0, 0.0, 0.0, rx, ry, rz)
            facts[INFORMATION] += trace
            facts[LEVER] += trace * (rx * rx + ry * ry + rz * rz)
        away2[i] = closest
        facts[MATCHED] += 1.0
        if closest < c2:
            facts[INLIERS] += 1.0
        if closest <= gate2:
            facts[SQUARED] += closest_robust * closest
            facts[ROBUST] += closest_robust
