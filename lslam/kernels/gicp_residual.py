"""Plane to plane (Segal et al. 2009, equation 2): the nearest Gaussian, both covariances discs."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from lslam.kernels.discs import disc
from lslam.kernels.gauss_newton import clear, trimmed, workspace
from lslam.kernels.jit import kernel
from lslam.kernels.linalg import invert_symmetric, rotate_symmetric
from lslam.kernels.residuals import add_information, nearest, octant_slots, variance_of
from lslam.kernels.surface_information import add_surface, advance_on_surfaces, thin_information

Floats = NDArray[np.float64]
Longs = NDArray[np.int64]
Ints = NDArray[np.int32]
Flags = NDArray[np.bool_]


@kernel
def linearise_gicp(source: Floats, covariance: Floats, R: Floats, t: Floats, size: float, scale: float, sigma2: float,
                   blob_weight: float, gate2: float, planes: Floats, keys: Longs, table: Ints, cells: Longs, slots: Ints,
                   is_done: Flags, away2: Floats, H: Floats, S: Floats, g: Floats, facts: Floats) -> None:  # fmt: skip
    """Add to H, S (6, 6), g (6,) and facts all source points (S, 3) with covariance (S, 6), LiDAR frame, not done yet.

    e = R s + t - mean of the nearest plane voxel of eight, M = inv(C_t + R C_s R^T) with the voxel's disc C_t, as thick as
    its points and its tilt make it (Segal et al. take all alike, but theirs are planes of twenty neighbours), cost
    robust(thin e^T M e) / thin: `thin`, the variance of a pair along a common normal, makes metres of the Mahalanobis
    distance. Without a plane the nearest blob stands in, isotropic with its mean variance, times `blob_weight`.
    Gauss-Newton holds M while the pose moves. S is the information along the normals
    alone, with blobs. `away2` and `facts` as in `residuals.linearise`.
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
        best, best_d, blob, _ = nearest(x, y, z, i, slots, planes)
        if best < 0:
            if blob < 0 or blob_weight <= 0.0:
                continue
            best = blob
        else:
            is_done[i] = True
        p = planes[best]
        sxx, sxy, sxz, syy, syz, szz = rotate_symmetric(R, covariance[i])
        if p[7] >= 0.0:
            off = p[3] * (x - p[0]) + p[4] * (y - p[1]) + p[5] * (z - p[2])
            across = variance_of(p, off, best_d) + sigma2
            dxx, dxy, dxz, dyy, dyz, dzz = disc(p[3], p[4], p[5], across)
            share, thin = 1.0, across + sigma2
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
        facts[3] += 1.0
        if away < c2:
            facts[2] += 1.0
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
        facts[0] += trace
        facts[1] += robust * away
        facts[4] += trace * (rx * rx + ry * ry + rz * rz)
        facts[5] += robust


@kernel
def align_gicp(
    source: Floats, covariance: Floats, R: Floats, t: Floats, scale_start: float, scale_end: float, decay: float,
    max_iterations: int, step_m: float, step_rad: float, inlier_distance: float, inlier_ratio: float, sigma2: float,
    blob_weight: float, weak_share: float, size: float, planes: Floats, keys: Longs, table: Ints,
    has_coarse: bool, coarse_size: float, coarse_planes: Floats, coarse_keys: Longs,
    coarse_table: Ints,
) -> tuple[Floats, Floats, Floats, int, bool, int, Floats]:  # fmt: skip
    """As `gauss_newton.align`, plane to plane."""
    cells, slots, is_done, away2 = workspace(len(source))
    coarse_cells, coarse_slots, _, _ = workspace(len(source) if has_coarse else 0)
    H, g, d, facts, weak = np.empty((6, 6)), np.empty(6), np.zeros(6), np.zeros(7), np.zeros((6, 6))
    S = np.empty((6, 6))
    farthest2 = inlier_distance * inlier_distance
    gate2, scale = farthest2, scale_start
    converged = False
    weak_count = 0
    iterations = 0
    for _ in range(max_iterations):
        clear(H, g, facts, is_done, away2)
        S[:] = 0.0
        linearise_gicp(source, covariance, R, t, size, scale, sigma2, 0.0 if has_coarse else blob_weight, gate2, planes, keys,
                       table, cells, slots, is_done, away2, H, S, g, facts)  # fmt: skip
        facts[6] = facts[2]
        if has_coarse:
            linearise_gicp(source, covariance, R, t, coarse_size, scale, sigma2, blob_weight, gate2, coarse_planes,
                           coarse_keys, coarse_table, coarse_cells, coarse_slots, is_done, away2, H, S, g, facts)  # fmt: skip
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
