"""The normal distributions transform (Magnusson 2009, chapter 6): a score over the eight voxels around a point."""

from __future__ import annotations

import math

from lslam.core.arrays import Floats, Longs
from lslam.core.kernels.gaussians import BLOB, FREE
from lslam.core.kernels.jit import inline, kernel
from lslam.core.kernels.linalg import add_gradient, add_matrix, invert_symmetric, plane_of
from lslam.core.kernels.linearisation import (
    INFORMATION,
    INLIERS,
    LEVER,
    MATCHED,
    ROBUST,
    SQUARED,
    Pose,
    Search,
    Settings,
    Sums,
    Width,
)
from lslam.core.kernels.residuals import Voxels, octant_slots, place
from lslam.registration.kernels.gicp_residual import disc, keep

# Eigenvalues below this share of the largest are raised to it (Magnusson, section 6.2.1).
SMALLEST_SHARE = 0.01
# A voxel whose second eigenvalue is below this share of the largest holds a line: one ring, or a few neighbouring ones. Across
# the line such a Gaussian describes where the beams of an earlier scan were, not the surface.
LINE_SHARE = 0.1
OUTLIER_RATIO = 0.55


@inline
def mixture(size: float) -> tuple[float, float]:
    """Weights d1 (positive) and d2 of the score for voxels of `size`, m (Magnusson, equations 6.8)."""
    c1, c2 = 10.0 * (1.0 - OUTLIER_RATIO), OUTLIER_RATIO / size**3
    d3 = -math.log(c2)
    d1 = -math.log(c1 + c2) - d3
    d2 = -2.0 * math.log((-math.log(c1 * math.exp(-0.5) + c2) - d3) / d1)
    return -d1, d2


@kernel
def describe(
    moments: Floats,
    planes: Floats,
    keys: Longs,
    counts: Floats,
    end: int,
    floor: float,
    extent2: float,
    shapes: Floats,
) -> None:
    """Bring shapes (C, 14) up to date: mean, inverse covariance xx..zz, smallest eigenvalue, count when it was computed,
    unit vector of the smallest eigenvalue.

    The variance within the plane of a plane voxel is `extent2`, m2: that of its points tells where the beams of earlier scans
    were, not where the surface is. Voxels that hold too few points, a line, or one ring have a smallest eigenvalue of 0.
    """
    for slot in range(end):
        p, q = planes[slot], shapes[slot]
        if keys[slot] == FREE or (q[10] == counts[slot] and q[0] == p[0] and q[1] == p[1] and q[2] == p[2]):
            continue
        q[0], q[1], q[2] = p[0], p[1], p[2]
        q[10] = counts[slot]
        q[9] = 0.0
        if p[7] < BLOB:
            continue
        s = moments[slot]
        w = 1.0 / s[0]
        mx, my, mz = s[1] * w, s[2] * w, s[3] * w
        xx, xy, xz = s[4] * w - mx * mx + floor, s[5] * w - mx * my, s[6] * w - mx * mz
        yy, yz, zz = s[7] * w - my * my + floor, s[8] * w - my * mz, s[9] * w - mz * mz + floor
        l0, l1, l2, nx, ny, nz = plane_of(xx, xy, xz, yy, yz, zz)
        if l1 < LINE_SHARE * l2:
            continue
        lift = max(SMALLEST_SHARE * l2 - l0, 0.0)
        if p[7] >= 0.0:
            xx, xy, xz, yy, yz, zz = disc(nx, ny, nz, l0, extent2)
        q[3], q[4], q[5], q[6], q[7], q[8] = invert_symmetric(
            xx + lift * nx * nx,
            xy + lift * nx * ny,
            xz + lift * nx * nz,
            yy + lift * ny * ny,
            yz + lift * ny * nz,
            zz + lift * nz * nz,
        )
        q[9] = l0 + lift
        q[11], q[12], q[13] = nx, ny, nz


@kernel
def linearise_ndt(
    points: tuple[Floats], voxels: Voxels, settings: Settings, search: Search, pose: Pose, width: Width, sums: Sums
) -> None:
    """Add all source points (S, 3), LiDAR frame, not matched yet, to the sums, see `linearisation`.

    The cost is the negative score: -d1 u exp(-d2 / (2 u) e^T C^-1 e) over the eight voxels around R s + t, where u =
    `widening` is 1 except during annealing, when it widens the Gaussians as the kernel is widened. g is the gradient. H is
    the Gauss-Newton Hessian, J^T C^-1 J times the weight d1 d2 exp(..) of the gradient. Newton's Hessian, which Magnusson
    uses, also has the curvature of that weight and of the rotation; it is indefinite away from the optimum and then needs
    correction. The score is robust by itself: the variance of a point and the weight of non-planar voxels do not enter. Distances
    are e^T C^-1 e times the smallest eigenvalue of C, for the nearest voxel. S is the information along the thinnest axis of
    each voxel alone.
    """
    (source,) = points
    shapes, keys, table = voxels
    size, _, _, _, _, _ = settings
    cells, slots, _, _, is_done, distance2 = search
    R, t = pose
    scale, scale_end, gate2 = width
    widening = (scale / scale_end) ** 2
    H, S, g, facts = sums
    inverse = 1.0 / size
    c2 = scale * scale
    d1, d2 = mixture(size)
    for i in range(len(source)):
        if is_done[i]:
            continue
        rx, ry, rz, x, y, z = place(source, i, R, t)
        if octant_slots(x, y, z, i, inverse, cells, slots, keys, table):
            keep(i, slots, shapes, 9, 0.0)
        best, best_score = 1e300, 0.0
        hxx, hxy, hxz, hyy, hyz, hzz = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
        sxx, sxy, sxz, syy, syz, szz = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
        gx, gy, gz = 0.0, 0.0, 0.0
        for k in range(8):
            s = slots[i, k]
            if s < 0:
                break
            q = shapes[s]
            ex, ey, ez = x - q[0], y - q[1], z - q[2]
            m2 = (
                q[3] * ex * ex
                + q[6] * ey * ey
                + q[8] * ez * ez
                + 2.0 * (q[4] * ex * ey + q[5] * ex * ez + q[7] * ey * ez)
            )
            away = q[9] * m2
            weight = math.exp(-0.5 * d2 * m2 / widening)
            if away < best:
                best, best_score = away, weight
            if away > gate2:
                continue
            w = d1 * d2 * weight
            mxx, mxy, mxz, myy, myz, mzz = w * q[3], w * q[4], w * q[5], w * q[6], w * q[7], w * q[8]
            hxx, hxy, hxz, hyy, hyz, hzz = hxx + mxx, hxy + mxy, hxz + mxz, hyy + myy, hyz + myz, hzz + mzz
            gx += mxx * ex + mxy * ey + mxz * ez
            gy += mxy * ex + myy * ey + myz * ez
            gz += mxz * ex + myz * ey + mzz * ez
            thin = w / q[9]
            nx, ny, nz = q[11], q[12], q[13]
            sxx, sxy, sxz = sxx + thin * nx * nx, sxy + thin * nx * ny, sxz + thin * nx * nz
            syy, syz, szz = syy + thin * ny * ny, syz + thin * ny * nz, szz + thin * nz * nz
        if best < 1e300:
            add_matrix(H, hxx, hxy, hxz, hyy, hyz, hzz, rx, ry, rz)
            add_matrix(S, sxx, sxy, sxz, syy, syz, szz, rx, ry, rz)
            add_gradient(g, gx, gy, gz, rx, ry, rz)
            facts[INFORMATION] += hxx + hyy + hzz
            facts[LEVER] += (hxx + hyy + hzz) * (rx * rx + ry * ry + rz * rz)
            is_done[i] = True
            distance2[i] = best
            facts[MATCHED] += 1.0
            facts[SQUARED] += best_score * best
            facts[ROBUST] += best_score
            if best < c2:
                facts[INLIERS] += 1.0
