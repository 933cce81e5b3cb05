"""Distribution to distribution over voxels (Koide et al. 2021, section IV): all around a point, each by its count."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from lslam.kernels.discs import disc
from lslam.kernels.gauss_newton import clear, trimmed, workspace
from lslam.kernels.jit import inline, kernel
from lslam.kernels.linalg import invert_symmetric, rotate_symmetric
from lslam.kernels.residuals import add_information, nearest, octant_slots, variance_of
from lslam.kernels.surface_information import add_surface, advance_on_surfaces, thin_information

Floats = NDArray[np.float64]
Longs = NDArray[np.int64]
Ints = NDArray[np.int32]
Flags = NDArray[np.bool_]


@kernel
def linearise_vgicp(source: Floats, covariance: Floats, R: Floats, t: Floats, size: float, scale: float, sigma2: float,
                    blob_weight: float, gate2: float, planes: Floats, counts: Floats, keys: Longs, table: Ints,
                    cells: Longs, slots: Ints, is_done: Flags, away2: Floats, H: Floats, S: Floats, g: Floats,
                    facts: Floats) -> None:  # fmt: skip
    """Add to H, S (6, 6), g (6,) and facts all source points (S, 3) with covariance (S, 6), LiDAR frame, not done yet.

    As `linearise_gicp`, but on all plane voxels of the eight around R s + t, each times the number of points in it,
    counts (C,). Distances are those to the closest; the eighth of the facts is the sum of the counts.
    """
    inverse = 1.0 / size
    unused = np.zeros(6)
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
        sxx, sxy, sxz, syy, syz, szz = rotate_symmetric(R, covariance[i])
        best, _, blob, _ = nearest(x, y, z, i, slots, planes)
        if best < 0 and (blob < 0 or blob_weight <= 0.0):
            continue
        is_done[i] = best >= 0
        closest, closest_robust = 1e300, 0.0
        for k in range(8):
            v = slots[i, k]
            if v < 0 or (v != blob if best < 0 else planes[v, 7] < 0.0):
                continue
            p = planes[v]
            ex, ey, ez = x - p[0], y - p[1], z - p[2]
            if best >= 0:
                off = p[3] * ex + p[4] * ey + p[5] * ez
                across = variance_of(p, off, ex * ex + ey * ey + ez * ez) + sigma2
                dxx, dxy, dxz, dyy, dyz, dzz = disc(p[3], p[4], p[5], across)
                n, thin = counts[v], across + sigma2
            else:
                dxx, dxy, dxz, dyy, dyz, dzz = p[6], 0.0, 0.0, p[6], 0.0, p[6]
                n, thin = blob_weight * counts[v], p[6] + sigma2
            mxx, mxy, mxz, myy, myz, mzz = invert_symmetric(
                sxx + dxx, sxy + dxy, sxz + dxz, syy + dyy, syz + dyz, szz + dzz
            )
            away = thin * (
                mxx * ex * ex + myy * ey * ey + mzz * ez * ez + 2.0 * (mxy * ex * ey + mxz * ex * ez + myz * ey * ez)
            )
            robust = c2 / (c2 + away)
            robust *= robust
            if away < closest:
                closest, closest_robust = away, robust
            facts[7] += n
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
            facts[0] += trace
            facts[4] += trace * (rx * rx + ry * ry + rz * rz)
        away2[i] = closest
        facts[3] += 1.0
        if closest < c2:
            facts[2] += 1.0
        if closest <= gate2:
            facts[1] += closest_robust * closest
            facts[5] += closest_robust


@inline
def scale_by_mean_count(H: Floats, S: Floats, g: Floats, facts: Floats) -> None:
    """Counts weigh points against each other; divided by their mean, the information stays that of the points."""
    w = facts[3] / max(facts[7], 1e-300)
    for i in range(6):
        g[i] *= w
        for j in range(6):
            H[i, j] *= w
            S[i, j] *= w
    facts[0] *= w
    facts[4] *= w


@kernel
def align_vgicp(
    source: Floats, covariance: Floats, R: Floats, t: Floats, scale_start: float, scale_end: float, decay: float,
    max_iterations: int, step_m: float, step_rad: float, inlier_distance: float, inlier_ratio: float, sigma2: float,
    blob_weight: float, weak_share: float, size: float, planes: Floats, counts: Floats, keys: Longs, table: Ints,
    has_coarse: bool, coarse_size: float, coarse_planes: Floats, coarse_counts: Floats, coarse_keys: Longs,
    coarse_table: Ints,
) -> tuple[Floats, Floats, Floats, int, bool, int, Floats]:  # fmt: skip
    """As `gauss_newton.align`, distribution to distribution; `counts` (C,) goes with `planes`."""
    cells, slots, is_done, away2 = workspace(len(source))
    coarse_cells, coarse_slots, _, _ = workspace(len(source) if has_coarse else 0)
    H, g, d, facts, weak = np.empty((6, 6)), np.empty(6), np.zeros(6), np.zeros(8), np.zeros((6, 6))
    S = np.empty((6, 6))
    farthest2 = inlier_distance * inlier_distance
    gate2, scale = farthest2, scale_start
    converged = False
    weak_count = 0
    iterations = 0
    for _ in range(max_iterations):
        clear(H, g, facts, is_done, away2)
        S[:] = 0.0
        linearise_vgicp(source, covariance, R, t, size, scale, sigma2, 0.0 if has_coarse else blob_weight, gate2, planes,
                        counts, keys, table, cells, slots, is_done, away2, H, S, g, facts)  # fmt: skip
        facts[6] = facts[2]
        if has_coarse:
            linearise_vgicp(source, covariance, R, t, coarse_size, scale, sigma2, blob_weight, gate2, coarse_planes,
                            coarse_counts, coarse_keys, coarse_table, coarse_cells, coarse_slots, is_done, away2, H, S, g,
                            facts)  # fmt: skip
        scale_by_mean_count(H, S, g, facts)
        iterations += 1
        moved, weak_count, move, turn = advance_on_surfaces(
            H, S, g, facts, scale, weak_share, R, t, d, weak, weak_count
        )
        if not moved:
            break
        if scale <= scale_end and move < step_m and turn < step_rad:
            converged = True
            break
        scale = max(scale * decay, scale_end)
        gate2 = trimmed(away2, inlier_ratio, farthest2)
    return H, facts, d, iterations, converged, weak_count, weak
