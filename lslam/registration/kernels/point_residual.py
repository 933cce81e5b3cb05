"""Point to point: the distance of each source point to the nearest voxel mean, weighted equally in all directions."""

from __future__ import annotations

from lslam.core.arrays import Floats
from lslam.core.kernels.gaussians import BLOB
from lslam.core.kernels.jit import kernel
from lslam.core.kernels.linearisation import Pose, Search, Settings, Sums, Width
from lslam.core.kernels.residuals import Voxels, add_facts, add_information, octant_slots, place, weigh_match


@kernel
def linearise_point(
    points: tuple[Floats, Floats],
    voxels: Voxels,
    settings: Settings,
    search: Search,
    pose: Pose,
    width: Width,
    sums: Sums,
) -> None:
    """Add all source points (S, 3), LiDAR frame, not matched yet, to H, g and facts, see `linearisation`.

    Residual e = R s + t - mean of the nearest of eight voxels of any kind. Its variance is sigma2 plus that of a uniform
    position within a voxel, size2 / 12; its Geman-McClure weight has the width sqrt(scale2 + size2), as an offset within the
    voxel is no outlier. Where the next ring lies farther away than a voxel, gaps (S,), m, the mean of few points is that of
    a single ring, which moves with the sensor: such a point is left to a coarser map, and the coarsest map takes all.
    Distances are those to the mean.
    """
    source, gaps = points
    planes, keys, table = voxels
    size, sigma2, _, _, _, takes_all = settings
    cells, slots, _, _, is_done, distance2 = search
    R, t = pose
    scale, _, gate2 = width
    H, _, g, facts = sums
    inverse = 1.0 / size
    c2 = scale * scale + size * size
    information = 1.0 / (sigma2 + size * size / 12.0)
    for i in range(len(source)):
        if is_done[i]:
            continue
        rx, ry, rz, x, y, z = place(source, i, R, t)
        octant_slots(x, y, z, i, inverse, cells, slots, keys, table)
        best = -1
        best_d = 1e300
        for k in range(8):
            s = slots[i, k]
            if s < 0:
                continue
            p = planes[s]
            d = (x - p[0]) ** 2 + (y - p[1]) ** 2 + (z - p[2]) ** 2
            if d < best_d:
                best_d, best = d, s
        if best < 0 or (gaps[i] > size and planes[best, 7] < BLOB and not takes_all):
            continue
        is_done[i] = True
        distance2[i] = best_d
        robust = weigh_match(facts, best_d, c2, gate2)
        if robust == 0.0:
            continue
        p = planes[best]
        w = robust * information
        add_information(H, g, w, 1.0, 0.0, 0.0, 1.0, 0.0, 1.0, x - p[0], y - p[1], z - p[2], rx, ry, rz)
        add_facts(facts, 3.0 * w, robust * best_d, robust, rx, ry, rz)
