"""Normal equations of edges and planar points against the features of one earlier scan (thesis, equation 2.24).

Edge: distance to the line through the two nearest less sharp edges, on different rings. Planar point: distance to the
plane through the three nearest less planar points, two of one ring and one of another (Zhang and Singh 2014). With
one-to-one matching the distance to the nearest feature itself takes their place.
"""

from __future__ import annotations

import math

import numpy as np

from lslam.core.arrays import Floats, Ints, Longs, Rings
from lslam.core.kernels.gaussians import find
from lslam.core.kernels.jit import inline, kernel
from lslam.core.kernels.linearisation import Pose, Sums, Width
from lslam.core.kernels.residuals import add_facts, add_row, add_surface, place, weigh_match
from lslam.core.kernels.voxel import index_of, pack
from lslam.odometry.kernels.feature_grid import Matches, counterparts
from lslam.odometry.kernels.lines import add_line

# A grid, see `feature_grid`; a grid with the normal of the surface around each point; and the size of its cells, m, the
# largest distance of a counterpart, m, the variance of a point, m2, and whether counterparts are joined to lines and planes.
Grid = tuple[Floats, Rings, Ints, Longs, Ints]
SurfaceGrid = tuple[Floats, Rings, Ints, Longs, Ints, Floats]
Reach = tuple[float, float, float, bool]

# Three points that are nearly in line define no plane: least sine of the angle at the nearest point.
LEAST_SINE = 0.1
# Largest variance, rad2, of a normal of three points that counts as observing a direction: four degrees.
NORMAL_VARIANCE_RAD2 = 5e-3


@inline
def _add_point(
    H: Floats,
    g: Floats,
    facts: Floats,
    ex: float,
    ey: float,
    ez: float,
    rx: float,
    ry: float,
    rz: float,
    variance: float,
    c2: float,
) -> None:
    """Add a point-to-point residual (ex, ey, ez), m, to H and g.

    (rx, ry, rz) : m, point seen from the sensor, world axes; variance : m2, of the residual along each axis
    c2 : m2, squared width of Geman-McClure
    """
    d2 = ex * ex + ey * ey + ez * ez
    robust = weigh_match(facts, d2, c2, np.inf)
    w = robust / variance
    add_row(H, g, w, ex, 1.0, 0.0, 0.0, 0.0, rz, -ry)
    add_row(H, g, w, ey, 0.0, 1.0, 0.0, -rz, 0.0, rx)
    add_row(H, g, w, ez, 0.0, 0.0, 1.0, ry, -rx, 0.0)
    add_facts(facts, 3.0 * w, robust * d2, robust, rx, ry, rz)


@inline
def _add_plane(
    H: Floats,
    g: Floats,
    facts: Floats,
    e: float,
    nx: float,
    ny: float,
    nz: float,
    rx: float,
    ry: float,
    rz: float,
    variance: float,
    c2: float,
) -> float:
    """Add a point-to-plane residual e (m) along the unit normal n to H and g; returns its weight; r, c2 : as in `_add_point`."""
    robust = weigh_match(facts, e * e, c2, np.inf)
    w = robust / variance
    add_row(H, g, w, e, nx, ny, nz, ry * nz - rz * ny, rz * nx - rx * nz, rx * ny - ry * nx)
    add_facts(facts, w, robust * e * e, robust, rx, ry, rz)
    return w


@kernel
def linearise_edges(
    points: tuple[Floats], grid: Grid, settings: Reach, search: Matches, pose: Pose, width: Width, sums: Sums
) -> None:
    """Add all edges (S, 3), LiDAR frame, to H, S, g and facts, see `linearisation`. Both H and S take all of them."""
    (source,) = points
    edges = grid[0]
    size, limit, variance, with_lines = settings
    R, t = pose
    scale, _, _ = width
    H, S, g, facts = sums
    E = np.zeros((6, 6))
    c2 = scale * scale
    for i in range(len(source)):
        rx, ry, rz, x, y, z = place(source, i, R, t)
        counterparts(x, y, z, i, False, 2 if with_lines else 1, (size, limit), grid, search)
        j, k = search[0][i, 0], search[0][i, 1]
        if j < 0:
            continue
        p = edges[j]
        ex, ey, ez = x - p[0], y - p[1], z - p[2]
        if not with_lines:
            _add_point(E, g, facts, ex, ey, ez, rx, ry, rz, variance, c2)
            continue
        if k < 0:
            continue
        ux, uy, uz = edges[k, 0] - p[0], edges[k, 1] - p[1], edges[k, 2] - p[2]
        length = math.sqrt(ux * ux + uy * uy + uz * uz)
        if length == 0.0:
            continue
        s = 1.0 / length
        ux, uy, uz = ux * s, uy * s, uz * s
        # Variance of the line, by the noise of its two points, at the foot of the source point.
        share = (ex * ux + ey * uy + ez * uz) * s
        spread = variance * (1.0 + share * share + (1.0 - share) * (1.0 - share))
        add_line(E, g, facts, ex, ey, ez, ux, uy, uz, rx, ry, rz, spread, c2)
    for i in range(6):
        for j in range(i, 6):
            H[i, j] += E[i, j]
            S[i, j] += E[i, j]


@kernel
def add_normals(
    points: Floats, size: float, thick: float, waver: float, rows: Floats, keys: Longs, table: Ints, normals: Floats
) -> None:
    """Fill in `normals` (N, 3), where they are zero, from the plane voxels of `size`, m, in which points (N, 3) lie.

    thick : m2, variance along the normal above which a voxel has more than one surface
    waver : rad2, variance of the normal's direction above which it is too uncertain
    """
    inverse = 1.0 / size
    for i in range(len(points)):
        if normals[i, 0] != 0.0 or normals[i, 1] != 0.0 or normals[i, 2] != 0.0:
            continue
        x, y, z = points[i, 0], points[i, 1], points[i, 2]
        slot = find(pack(index_of(x, inverse), index_of(y, inverse), index_of(z, inverse)), keys, table)
        if slot >= 0 and 0.0 <= rows[slot, 7] < waver and rows[slot, 6] < thick:
            normals[i] = rows[slot, 3:6]


@kernel
def linearise_planes(
    points: tuple[Floats], grid: SurfaceGrid, settings: Reach, search: Matches, pose: Pose, width: Width, sums: Sums
) -> None:
    """Add all planar points (S, 3) to H, S, g and facts, like `linearise_edges`. S takes only planes of well-known normal.

    normals : (N, 3) of the surface around each point of the grid, zero where unknown. The normal of three points
        a few decimetres apart has an error of ten degrees and more, and a sum of such normals seems to observe every
        direction, the one along a corridor included. So the residual is the distance to the plane through the three
        points, but its Jacobian uses the surface's normal: an instrumental variable, whose error is independent of theirs.
    """
    (source,) = points
    surface, rings, starts, keys, table, normals = grid
    size, limit, variance, with_planes = settings
    R, t = pose
    scale, _, _ = width
    H, S, g, facts = sums
    c2 = scale * scale
    unused = np.zeros(6)
    for i in range(len(source)):
        rx, ry, rz, x, y, z = place(source, i, R, t)
        counterparts(
            x, y, z, i, True, 3 if with_planes else 1, (size, limit), (surface, rings, starts, keys, table), search
        )
        j, k, m = search[0][i, 0], search[0][i, 1], search[0][i, 2]
        if j < 0:
            continue
        p = surface[j]
        ex, ey, ez = x - p[0], y - p[1], z - p[2]
        if not with_planes:
            _add_point(H, g, facts, ex, ey, ez, rx, ry, rz, variance, c2)
            continue
        if m < 0:
            continue
        ax, ay, az = surface[k, 0] - p[0], surface[k, 1] - p[1], surface[k, 2] - p[2]
        bx, by, bz = surface[m, 0] - p[0], surface[m, 1] - p[1], surface[m, 2] - p[2]
        nx, ny, nz = ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx
        area = math.sqrt(nx * nx + ny * ny + nz * nz)
        aa, bb = ax * ax + ay * ay + az * az, bx * bx + by * by + bz * bz
        if area <= LEAST_SINE * math.sqrt(aa * bb):
            continue
        s = 1.0 / area
        nx, ny, nz = nx * s, ny * s, nz * s
        e = nx * ex + ny * ey + nz * ez
        # Variance of the plane, by the noise of its three points, at the foot of the source point: barycentric coordinates.
        ab = ax * bx + ay * by + az * bz
        ea, eb = ex * ax + ey * ay + ez * az, ex * bx + ey * by + ez * bz
        wa, wb = (ea * bb - eb * ab) * s * s, (eb * aa - ea * ab) * s * s
        spread = variance * (1.0 + wa * wa + wb * wb + (1.0 - wa - wb) * (1.0 - wa - wb))
        ux, uy, uz = normals[j, 0], normals[j, 1], normals[j, 2]
        towards = nx * ux + ny * uy + nz * uz
        if towards != 0.0:
            sign = 1.0 if towards > 0.0 else -1.0
            nx, ny, nz = sign * ux, sign * uy, sign * uz
        w = _add_plane(H, g, facts, e, nx, ny, nz, rx, ry, rz, spread, c2)
        # The normal is that of the surface, or the noise of the three points leaves it a small variance, rad2.
        if towards != 0.0 or 2.0 * variance * (aa + bb - ab) * s * s < NORMAL_VARIANCE_RAD2:
            add_surface(S, unused, w, nx, ny, nz, rx, ry, rz)
