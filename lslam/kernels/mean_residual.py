"""Normal equations of scan points against the means of voxels, point to point: for what stands and makes no planes."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from lslam.kernels.facts import INFORMATION, INLIERS, LEVER, MATCHED
from lslam.kernels.jit import kernel
from lslam.kernels.linearisation import Pose, Search, Settings, Sums, Width
from lslam.kernels.residuals import Voxels, add_information, nearest, octant_slots

Floats = NDArray[np.float64]


@kernel
def linearise_means(points: tuple[Floats], voxels: Voxels, settings: Settings, search: Search, pose: Pose, width: Width,
                    sums: Sums) -> None:  # fmt: skip
    """Add all source points (S, 3), LiDAR frame, that are not done, to H, g and facts, see `linearisation`.

    Residual e = R s + t - mean of the nearest blob of the eight voxels around; variance that of the blob plus sigma2;
    Geman-McClure weight of width `scale`. Distances are those to the mean.
    """
    (source,) = points
    planes, keys, table = voxels
    size, sigma2, _, blob_weight, _ = settings
    cells, slots, is_done, away2 = search
    R, t = pose
    scale, _, gate2 = width
    H, _, g, facts = sums
    inverse = 1.0 / size
    c2 = scale * scale
    for i in range(len(source)):
        if is_done[i]:
            continue
        a, b, c = source[i, 0], source[i, 1], source[i, 2]
        rx = R[0, 0] * a + R[0, 1] * b + R[0, 2] * c
        ry = R[1, 0] * a + R[1, 1] * b + R[1, 2] * c
        rz = R[2, 0] * a + R[2, 1] * b + R[2, 2] * c
        x, y, z = rx + t[0], ry + t[1], rz + t[2]
        octant_slots(x, y, z, i, inverse, cells, slots, keys, table)
        _, _, best, best_d = nearest(x, y, z, i, slots, planes)
        if best < 0:
            continue
        is_done[i] = True
        away2[i] = best_d
        facts[MATCHED] += 1.0
        if best_d < c2:
            facts[INLIERS] += 1.0
        if best_d > gate2:
            continue
        p = planes[best]
        robust = c2 / (c2 + best_d)
        robust *= robust
        w = blob_weight * robust / (p[6] + sigma2)
        add_information(H, g, w, 1.0, 0.0, 0.0, 1.0, 0.0, 1.0, x - p[0], y - p[1], z - p[2], rx, ry, rz)
        facts[INFORMATION] += 3.0 * w
        facts[LEVER] += 3.0 * w * (rx * rx + ry * ry + rz * rz)
