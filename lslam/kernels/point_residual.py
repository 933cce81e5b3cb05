"""Point to point: each source point is drawn to the nearest voxel mean, equally in all directions."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from lslam.kernels.gauss_newton import advance, clear, trimmed, workspace
from lslam.kernels.gaussians import BLOB
from lslam.kernels.jit import kernel
from lslam.kernels.residuals import add_information, octant_slots

Floats = NDArray[np.float64]
Longs = NDArray[np.int64]
Ints = NDArray[np.int32]
Flags = NDArray[np.bool_]


@kernel
def linearise_point(source: Floats, gaps: Floats, R: Floats, t: Floats, size: float, scale: float, sigma2: float, gate2: float,
                    planes: Floats, keys: Longs, table: Ints, cells: Longs, slots: Ints, is_done: Flags, away2: Floats,
                    H: Floats, g: Floats, facts: Floats) -> None:  # fmt: skip
    """Add to H (6, 6), g (6,) and facts all source points (S, 3), LiDAR frame, that are not done.

    Residual e = R s + t - mean of the nearest of eight voxels, planes or not; variance sigma2 plus that of a place in a
    voxel, size2 / 12; Geman-McClure weight of width sqrt(scale2 + size2): where in its voxel a point lies is no outlier.
    Where the next ring lies farther off than a voxel, gaps (S,), a mean of few points is one ring's, and would hold those
    that follow to where this one lies: such a match is left to a coarser map.
    `away2` and `facts` as in `residuals.linearise`, distances being those to the mean.
    """
    inverse = 1.0 / size
    c2 = scale * scale + size * size
    information = 1.0 / (sigma2 + size * size / 12.0)
    for i in range(len(source)):
        if is_done[i]:
            continue
        a, b, c = source[i, 0], source[i, 1], source[i, 2]
        rx = R[0, 0] * a + R[0, 1] * b + R[0, 2] * c
        ry = R[1, 0] * a + R[1, 1] * b + R[1, 2] * c
        rz = R[2, 0] * a + R[2, 1] * b + R[2, 2] * c
        x, y, z = rx + t[0], ry + t[1], rz + t[2]
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
        if best < 0 or (gaps[i] > size and planes[best, 7] < BLOB):
            continue
        is_done[i] = True
        away2[i] = best_d
        facts[3] += 1.0
        if best_d < c2:
            facts[2] += 1.0
        if best_d > gate2:
            continue
        p = planes[best]
        robust = c2 / (c2 + best_d)
        robust *= robust
        w = robust * information
        add_information(H, g, w, 1.0, 0.0, 0.0, 1.0, 0.0, 1.0, x - p[0], y - p[1], z - p[2], rx, ry, rz)
        facts[0] += 3.0 * w
        facts[1] += robust * best_d
        facts[4] += 3.0 * w * (rx * rx + ry * ry + rz * rz)
        facts[5] += robust


@kernel
def align_point(
    source: Floats, gaps: Floats, R: Floats, t: Floats, scale_start: float, scale_end: float, decay: float,
    max_iterations: int, step_m: float, step_rad: float, inlier_distance: float, inlier_ratio: float, sigma2: float,
    blob_weight: float, weak_share: float, size: float, planes: Floats, keys: Longs, table: Ints,
    has_coarse: bool, coarse_size: float, coarse_planes: Floats, coarse_keys: Longs,
    coarse_table: Ints,
) -> tuple[Floats, Floats, Floats, int, bool, int, Floats]:  # fmt: skip
    """As `gauss_newton.align`, point to point: gaps (S,), m, stand for the scatter, and blobs do not matter to it."""
    cells, slots, is_done, away2 = workspace(len(source))
    coarse_cells, coarse_slots, _, _ = workspace(len(source) if has_coarse else 0)
    everywhere = np.zeros(len(source))
    H, g, d, facts, weak = np.empty((6, 6)), np.empty(6), np.zeros(6), np.zeros(7), np.zeros((6, 6))
    farthest2 = inlier_distance * inlier_distance
    gate2, scale = farthest2, scale_start
    converged = False
    weak_count = 0
    iterations = 0
    for _ in range(max_iterations):
        clear(H, g, facts, is_done, away2)
        linearise_point(source, gaps, R, t, size, scale, sigma2, gate2, planes, keys, table, cells, slots, is_done, away2, H, g,
                        facts)  # fmt: skip
        facts[6] = facts[2]
        if has_coarse:
            linearise_point(source, everywhere, R, t, coarse_size, scale, sigma2, gate2, coarse_planes, coarse_keys, coarse_table,
                            coarse_cells, coarse_slots, is_done, away2, H, g, facts)  # fmt: skip
        iterations += 1
        moved, weak_count, move, turn = advance(H, g, facts, scale, weak_share, R, t, d, weak, weak_count)
        if not moved:
            break
        if scale <= scale_end and move < step_m and turn < step_rad:
            converged = True
            break
        scale = max(scale * decay, scale_end)
        gate2 = trimmed(away2, inlier_ratio, farthest2)
    return H, facts, d, iterations, converged, weak_count, weak
