"""The edge half of the feature map: voxels of `gaussians` read as lines.

A row of `lines` (C, 8) float64 belongs to a slot of the voxel pool: a point x y z on the line (the mean), its unit direction
x y z (the largest eigenvector), the variance across it, and the variance of its direction, rad2, or NO_LINE. Rows are
computed when a point is matched with the voxel, and kept until the voxel changes: most voxels behind the sensor never do.
A voxel has changed when the sum of its count and second moments has changed: the count alone is constant in a full voxel.
"""

from __future__ import annotations

import math

from lslam.core.arrays import Floats, Ints, Longs
from lslam.core.kernels.jit import inline, kernel
from lslam.core.kernels.linalg import plane_of
from lslam.core.kernels.linearisation import MATCHED, Pose, Sums, Width
from lslam.core.kernels.residuals import TILT_FACTOR, add_facts, add_row, octant_slots, place, weigh_match
from lslam.core.kernels.voxel import MASK, OFFSET

# Moments, keys and table of a voxel pool, see `gaussians`; rows of lines, and the keys and sums they were computed at.
LineVoxels = tuple[Floats, Longs, Ints, Floats, Longs, Floats]

NO_LINE = -1.0
# LOAM's rule: a line when the largest eigenvalue is three times the second one.
ELONGATION = 3.0


@inline
def line_of(
    slot: int,
    size: float,
    min_points: float,
    floor: float,
    moments: Floats,
    keys: Longs,
    lines: Floats,
    line_keys: Longs,
    line_sums: Floats,
) -> None:
    """Recompute the cached line of voxel `slot` if its moments changed: point, unit direction, variance across, tilt variance.

    The last column of `lines` is `NO_LINE` for fewer points than `min_points` or points that are not elongated.
    size : edge of a voxel, m; floor : m2, added to the variance across
    """
    s = moments[slot]
    key = keys[slot]
    known = s[0] + s[4] + s[7] + s[9]
    if line_keys[slot] == key and line_sums[slot] == known:
        return
    line_keys[slot] = key
    line_sums[slot] = known
    row = lines[slot]
    row[7] = NO_LINE
    if s[0] < min_points:
        return
    w = 1.0 / s[0]
    mx, my, mz = s[1] * w, s[2] * w, s[3] * w
    # The smallest eigenvector of -C is the largest of C.
    l2, l1, l0, ux, uy, uz = plane_of(
        mx * mx - s[4] * w,
        mx * my - s[5] * w,
        mx * mz - s[6] * w,
        my * my - s[7] * w,
        my * mz - s[8] * w,
        mz * mz - s[9] * w,
    )
    l2, l1, l0 = -l2, -l1, -l0
    if l2 < ELONGATION * max(l1, floor):
        return
    row[0] = mx + ((key >> 42) - OFFSET + 0.5) * size
    row[1] = my + (((key >> 21) & MASK) - OFFSET + 0.5) * size
    row[2] = mz + ((key & MASK) - OFFSET + 0.5) * size
    row[3], row[4], row[5] = ux, uy, uz
    row[6] = 0.5 * (max(l0, 0.0) + max(l1, 0.0)) + floor
    row[7] = row[6] / (s[0] * l2)


@inline
def add_line(
    H: Floats,
    g: Floats,
    facts: Floats,
    ex: float,
    ey: float,
    ez: float,
    ux: float,
    uy: float,
    uz: float,
    rx: float,
    ry: float,
    rz: float,
    variance: float,
    c2: float,
) -> None:
    """Point to line, equation 2.24 of Girolimetto, squared: (I - u u^T) e has two components across the unit direction u.

    e = (ex, ey, ez) goes from a point of the line to the transformed point, m; r = (rx, ry, rz) is that point seen from the
    sensor, world axes; variance : m2, along each component.
    Geman-McClure weight of squared width `c2`, m2; upper triangle of H.
    """
    along = ex * ux + ey * uy + ez * uz
    ex, ey, ez = ex - along * ux, ey - along * uy, ez - along * uz
    d2 = ex * ex + ey * ey + ez * ez
    robust = weigh_match(facts, d2, c2, math.inf)
    w = robust / variance
    # Two unit vectors across the line, beginning with the axis that is most nearly across it.
    ax, ay, az = abs(ux), abs(uy), abs(uz)
    if ax <= ay and ax <= az:
        px, py, pz = 0.0, -uz, uy
    elif ay <= az:
        px, py, pz = uz, 0.0, -ux
    else:
        px, py, pz = -uy, ux, 0.0
    s = 1.0 / math.sqrt(px * px + py * py + pz * pz)
    px, py, pz = px * s, py * s, pz * s
    qx, qy, qz = uy * pz - uz * py, uz * px - ux * pz, ux * py - uy * px
    add_row(H, g, w, ex * px + ey * py + ez * pz, px, py, pz, ry * pz - rz * py, rz * px - rx * pz, rx * py - ry * px)
    add_row(H, g, w, ex * qx + ey * qy + ez * qz, qx, qy, qz, ry * qz - rz * qy, rz * qx - rx * qz, rx * qy - ry * qx)
    add_facts(facts, 2.0 * w, robust * d2, robust, rx, ry, rz)


@kernel
def linearise_lines(
    points: tuple[Floats],
    voxels: LineVoxels,
    settings: tuple[float, float, float, float],
    search: tuple[Longs, Ints, Floats],
    pose: Pose,
    width: Width,
    sums: Sums,
) -> None:
    """Add all edge points (S, 3), LiDAR frame, to H, g and facts, see `linearisation`.

    Each takes the line voxel, of the eight around it, whose mean is nearest: residual across its line, variance =
    that of the voxel across its line + sigma2 + tilt at that distance along it, Geman-McClure weight of width `scale`.
    settings : voxel size, m; variance of a point, m2; points and floor of a line's variance, m2, see `line_of`
    search : octant cells and slots; `distance2` (S,) takes the squared distance of each matched point to its line: those beyond
    `gate2` are rejected: they count as matched and have no weight
    """
    (source,) = points
    moments, keys, table, lines, line_keys, line_sums = voxels
    size, sigma2, min_points, floor = settings
    cells, slots, distance2 = search
    R, t = pose
    scale, _, gate2 = width
    H, _, g, facts = sums
    inverse = 1.0 / size
    c2 = scale * scale
    for i in range(len(source)):
        rx, ry, rz, x, y, z = place(source, i, R, t)
        octant_slots(x, y, z, i, inverse, cells, slots, keys, table)
        best = -1
        best_d = 1e300
        for k in range(8):
            s = slots[i, k]
            if s < 0:
                continue
            line_of(s, size, min_points, floor, moments, keys, lines, line_keys, line_sums)
            p = lines[s]
            if p[7] < 0.0:
                continue
            ex, ey, ez = x - p[0], y - p[1], z - p[2]
            d = ex * ex + ey * ey + ez * ez
            if d < best_d:
                best_d, best = d, s
        if best < 0:
            continue
        p = lines[best]
        ex, ey, ez = x - p[0], y - p[1], z - p[2]
        along = ex * p[3] + ey * p[4] + ez * p[5]
        distance2[i] = max(ex * ex + ey * ey + ez * ez - along * along, 0.0)
        if distance2[i] > gate2:
            facts[MATCHED] += 1.0
            continue
        variance = p[6] + sigma2 + TILT_FACTOR * p[7] * along * along
        add_line(H, g, facts, ex, ey, ez, p[3], p[4], p[5], rx, ry, rz, variance, c2)
