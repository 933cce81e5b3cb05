"""Normal equations of scan points against Gaussian voxels, point to plane, and the functions that other residuals share."""

from __future__ import annotations

import math

import numpy as np

from lslam.core.arrays import Floats, Ints, Longs
from lslam.core.kernels.gaussians import BLOB, EMPTY, find
from lslam.core.kernels.jit import inline, inline_with_arrays, kernel
from lslam.core.kernels.linalg import add_gradient, add_matrix, eigen
from lslam.core.kernels.linearisation import (
    INFORMATION,
    INLIERS,
    LEVER,
    MATCHED,
    ROBUST,
    SIGNIFICANT_SIGMAS,
    SQUARED,
    Pose,
    Search,
    Settings,
    Sums,
    Width,
)
from lslam.core.kernels.voxel import hash_key, index_of, pack

# Rows of planes, keys and table, see `gaussians`.
Voxels = tuple[Floats, Longs, Ints]

# Factor on the variance of the normal: the errors of neighbouring points of one ring are correlated.
TILT_FACTOR = SIGNIFICANT_SIGMAS**2


@inline
def place(source: Floats, i: int, R: Floats, t: Floats) -> tuple[float, float, float, float, float, float]:
    """Source point i as seen from the sensor, world axes, and in the world, m."""
    a, b, c = source[i, 0], source[i, 1], source[i, 2]
    rx = R[0, 0] * a + R[0, 1] * b + R[0, 2] * c
    ry = R[1, 0] * a + R[1, 1] * b + R[1, 2] * c
    rz = R[2, 0] * a + R[2, 1] * b + R[2, 2] * c
    return rx, ry, rz, rx + t[0], ry + t[1], rz + t[2]


@inline
def add_facts(facts: Floats, information: float, square: float, robust: float, rx: float, ry: float, rz: float) -> None:
    """Sums of one residual at a point r, seen from the sensor: its information, its weighted square and its robust weight."""
    facts[INFORMATION] += information
    facts[SQUARED] += square
    facts[LEVER] += information * (rx * rx + ry * ry + rz * rz)
    facts[ROBUST] += robust


@inline
def weigh_match(facts: Floats, d2: float, c2: float, gate2: float) -> float:
    """Count a match at a squared distance, m2; its Geman-McClure weight of squared width `c2`, 0 beyond `gate2`."""
    facts[MATCHED] += 1.0
    if d2 < c2:
        facts[INLIERS] += 1.0
    root = c2 / (c2 + d2)
    return root * root if d2 <= gate2 else 0.0


@inline
def octant_slots(
    x: float, y: float, z: float, i: int, inverse: float, cells: Longs, slots: Ints, keys: Longs, table: Ints
) -> bool:
    """Look up the slots (8,) of the voxels around point i at x, y, z, m, world; True when it has left its octant cell.

    inverse : voxels per m
    """
    ix, iy, iz = (
        index_of(x - 0.5 / inverse, inverse),
        index_of(y - 0.5 / inverse, inverse),
        index_of(z - 0.5 / inverse, inverse),
    )
    cell = pack(ix, iy, iz)
    if cells[i] == cell:
        return False
    cells[i] = cell
    # All eight are fetched before any branch depends on one: mostly a voxel is found at once, or none is there.
    mask = len(table) - 1
    for k in range(8):
        slots[i, k] = table[hash_key(pack(ix + (k >> 2), iy + ((k >> 1) & 1), iz + (k & 1)), mask)]
    for k in range(8):
        key = pack(ix + (k >> 2), iy + ((k >> 1) & 1), iz + (k & 1))
        slot = slots[i, k]
        if slot >= 0 and keys[slot] != key:
            slots[i, k] = find(key, keys, table)
    return True


@inline
def nearest(
    x: float, y: float, z: float, i: int, slots: Ints, last_slots: Ints, spheres: Floats, planes: Floats
) -> tuple[int, float, int, float]:
    """Nearest plane and nearest non-planar voxel of the slots of point i: slot, or -1, and squared distance of its mean, m2.

    The result is reused while the point moves by less than half of the difference between the distances to the
    second nearest and to the nearest one. The non-planar voxel is updated only without a plane.
    last_slots : (S, 2) plane and non-planar voxel of the last search
    spheres : (S, 4) position of the point then, m, and the squared distance, m2, within which the result is valid
    """
    best, non_planar = int(last_slots[i, 0]), int(last_slots[i, 1])
    best_d, non_planar_d = 1e300, 1e300
    moved2 = (x - spheres[i, 0]) ** 2 + (y - spheres[i, 1]) ** 2 + (z - spheres[i, 2]) ** 2
    if moved2 < spheres[i, 3]:
        if best >= 0:
            best_d = (x - planes[best, 0]) ** 2 + (y - planes[best, 1]) ** 2 + (z - planes[best, 2]) ** 2
        elif non_planar >= 0:
            non_planar_d = (
                (x - planes[non_planar, 0]) ** 2 + (y - planes[non_planar, 1]) ** 2 + (z - planes[non_planar, 2]) ** 2
            )
        return best, best_d, non_planar, non_planar_d
    best, non_planar = -1, -1
    next_d, next_non_planar_d = 1e300, 1e300
    # Choices instead of branches: nobody can predict which of the eight is the nearest.
    for k in range(8):
        s = slots[i, k]
        at = max(s, 0)
        kind = planes[at, 7] if s >= 0 else EMPTY
        d = (x - planes[at, 0]) ** 2 + (y - planes[at, 1]) ** 2 + (z - planes[at, 2]) ** 2
        plane_d = d if kind >= 0.0 else 1e300
        next_d = min(next_d, max(best_d, plane_d))
        best = s if plane_d < best_d else best
        best_d = min(best_d, plane_d)
        far_d = d if kind == BLOB else 1e300
        next_non_planar_d = min(next_non_planar_d, max(non_planar_d, far_d))
        non_planar = s if far_d < non_planar_d else non_planar
        non_planar_d = min(non_planar_d, far_d)
    last_slots[i, 0], last_slots[i, 1] = best, non_planar
    spheres[i, 0], spheres[i, 1], spheres[i, 2] = x, y, z
    margin = (
        math.sqrt(next_d) - math.sqrt(best_d) if best >= 0 else math.sqrt(next_non_planar_d) - math.sqrt(non_planar_d)
    )
    spheres[i, 3] = 0.25 * margin * margin if best >= 0 or non_planar >= 0 else 1e300
    return best, best_d, non_planar, non_planar_d


@inline
def variance_of(p: Floats, off: float, d2: float) -> float:
    """Variance, m2, of the surface of a plane voxel at the foot of a point.

    The sum of the variance along the normal and of the normal's uncertainty times the squared distance of the foot from the
    mean.
    p : (8,) row of `planes`; off : distance of the point from the plane, m; d2 : squared distance from the mean, m2
    """
    variance: float = p[6] + TILT_FACTOR * p[7] * (d2 - off * off)
    return variance


@kernel
def linearise(
    points: tuple[Floats, Floats],
    voxels: Voxels,
    settings: Settings,
    search: Search,
    pose: Pose,
    width: Width,
    sums: Sums,
) -> None:
    """Add all source points (S, 3), LiDAR frame, with scatter (S, 6) around each, to H, g and facts, see `linearisation`.

    Points that are matched already are skipped; points that are matched with a plane here are marked. A coarser map takes the
    others.

    Each point takes the nearest plane voxel of the eight around it: residual n . (R s + t - mean), variance = map
    eigenvalue + source scatter along the normal + sigma2 + tilt at that distance from the mean, Geman-McClure weight of
    width `scale`, times `plane_weight`. Without a plane the residual is point to point to the nearest non-planar voxel, with
    its mean variance, times `non_planar_weight`, and times `axial_weight` in the direction of the sensor's axis.
    `distance2` (S,), m2, takes the squared distance of each matched point to its plane or mean. Points beyond `gate2` are
    rejected: they count as matched and have no weight.
    """
    source, scatter = points
    planes, keys, table = voxels
    size, sigma2, plane_weight, non_planar_weight, axial_weight, _ = settings
    cells, slots, chosen, asked, is_done, distance2 = search
    R, t = pose
    scale, _, gate2 = width
    H, _, g, facts = sums
    inverse = 1.0 / size
    c2 = scale * scale
    for i in range(len(source)):
        if is_done[i]:
            continue
        rx, ry, rz, x, y, z = place(source, i, R, t)
        if octant_slots(x, y, z, i, inverse, cells, slots, keys, table):
            asked[i, 3] = -1.0
        best, best_d, non_planar, non_planar_d = nearest(x, y, z, i, slots, chosen, asked, planes)
        if best >= 0:
            is_done[i] = True
            p = planes[best]
            nx, ny, nz = p[3], p[4], p[5]
            r = nx * (x - p[0]) + ny * (y - p[1]) + nz * (z - p[2])
            distance2[i] = r * r
            robust = weigh_match(facts, r * r, c2, gate2)
            if robust == 0.0:
                continue
            # The normal in the LiDAR frame, for the source scatter along it.
            lx = R[0, 0] * nx + R[1, 0] * ny + R[2, 0] * nz
            ly = R[0, 1] * nx + R[1, 1] * ny + R[2, 1] * nz
            lz = R[0, 2] * nx + R[1, 2] * ny + R[2, 2] * nz
            q = scatter[i]
            spread = (
                q[0] * lx * lx
                + q[3] * ly * ly
                + q[5] * lz * lz
                + 2.0 * (q[1] * lx * ly + q[2] * lx * lz + q[4] * ly * lz)
            )
            w = plane_weight * robust / (variance_of(p, r, best_d) + max(spread, 0.0) + sigma2)
            j3, j4, j5 = ry * nz - rz * ny, rz * nx - rx * nz, rx * ny - ry * nx
            add_row(H, g, w, r, nx, ny, nz, j3, j4, j5)
            add_facts(facts, w, robust * r * r, robust, rx, ry, rz)
        elif non_planar >= 0 and non_planar_weight > 0.0:
            is_done[i] = True
            p = planes[non_planar]
            ux, uy, uz = R[0, 2], R[1, 2], R[2, 2]
            ex, ey, ez = x - p[0], y - p[1], z - p[2]
            drop = 1.0 - axial_weight
            across2 = non_planar_d - drop * (ux * ex + uy * ey + uz * ez) ** 2
            distance2[i] = across2
            robust = weigh_match(facts, across2, c2, gate2)
            if robust == 0.0:
                continue
            q = scatter[i]
            w = non_planar_weight * robust / (p[6] + (q[0] + q[3] + q[5]) / 3.0 + sigma2)
            add_information(
                H,
                g,
                w,
                1.0 - drop * ux * ux,
                -drop * ux * uy,
                -drop * ux * uz,
                1.0 - drop * uy * uy,
                -drop * uy * uz,
                1.0 - drop * uz * uz,
                ex,
                ey,
                ez,
                rx,
                ry,
                rz,
            )
            facts[INFORMATION] += (2.0 + axial_weight) * w
            facts[LEVER] += (2.0 + axial_weight) * w * (rx * rx + ry * ry + rz * rz)


@inline
def add_row(
    H: Floats, g: Floats, w: float, r: float, j0: float, j1: float, j2: float, j3: float, j4: float, j5: float
) -> None:
    """Upper triangle of H += w j j^T and g += w r j."""
    w0, w1, w2, w3, w4, w5 = w * j0, w * j1, w * j2, w * j3, w * j4, w * j5
    H[0, 0] += w0 * j0
    H[0, 1] += w0 * j1
    H[0, 2] += w0 * j2
    H[0, 3] += w0 * j3
    H[0, 4] += w0 * j4
    H[0, 5] += w0 * j5
    H[1, 1] += w1 * j1
    H[1, 2] += w1 * j2
    H[1, 3] += w1 * j3
    H[1, 4] += w1 * j4
    H[1, 5] += w1 * j5
    H[2, 2] += w2 * j2
    H[2, 3] += w2 * j3
    H[2, 4] += w2 * j4
    H[2, 5] += w2 * j5
    H[3, 3] += w3 * j3
    H[3, 4] += w3 * j4
    H[3, 5] += w3 * j5
    H[4, 4] += w4 * j4
    H[4, 5] += w4 * j5
    H[5, 5] += w5 * j5
    g[0] += w0 * r
    g[1] += w1 * r
    g[2] += w2 * r
    g[3] += w3 * r
    g[4] += w4 * r
    g[5] += w5 * r


@inline
def add_information(
    H: Floats,
    g: Floats,
    w: float,
    xx: float,
    xy: float,
    xz: float,
    yy: float,
    yz: float,
    zz: float,
    ex: float,
    ey: float,
    ez: float,
    rx: float,
    ry: float,
    rz: float,
) -> None:
    """Upper triangle of H += w J^T M J and g += w J^T M e, with J = [I, -hat(r)] and M the symmetric matrix xx..zz."""
    xx, xy, xz, yy, yz, zz = w * xx, w * xy, w * xz, w * yy, w * yz, w * zz
    add_matrix(H, xx, xy, xz, yy, yz, zz, rx, ry, rz)
    px, py, pz = xx * ex + xy * ey + xz * ez, xy * ex + yy * ey + yz * ez, xz * ex + yz * ey + zz * ez
    add_gradient(g, px, py, pz, rx, ry, rz)


# The Gaussian of a plane voxel also has information within the plane, about the positions of the voxel's points. It is small,
# but it is the only information along a corridor, and it pulls the pose towards where the map was measured. So degenerate
# directions are found without it, and the pose keeps the motion prior along them.
@inline
def add_surface(
    S: Floats, rest: Floats, w: float, nx: float, ny: float, nz: float, rx: float, ry: float, rz: float
) -> None:
    """Upper triangle of S (6, 6) += w j j^T with j = [n, r x n]: information w, 1/m2, along the normal n at the point r, m.

    r : seen from the sensor, world axes; rest : (6,) unused gradient
    """
    add_information(S, rest, w, nx * nx, nx * ny, nx * nz, ny * ny, ny * nz, nz * nz, 0.0, 0.0, 0.0, rx, ry, rz)


@inline
def thin_information(p: Floats, xx: float, xy: float, xz: float, yy: float, yz: float, zz: float) -> float:
    """Information n^T M n along the unit normal n of a plane voxel; p : its row of `planes`, xx..zz : the symmetric M."""
    nx, ny, nz = p[3], p[4], p[5]
    along: float = xx * nx * nx + yy * ny * ny + zz * nz * nz + 2.0 * (xy * nx * ny + xz * nx * nz + yz * ny * nz)
    return along


@inline_with_arrays
def solve_on_surfaces(
    H: Floats, S: Floats, g: Floats, facts: Floats, weak_share: float, least: float, d: Floats, weak: Floats
) -> int:
    """Like `gauss_newton.solve_guarded_step`, with the observed directions determined by S; d solves H in them.

    `least` applies to H. Both matrices are full, not triangles.
    """
    lever = math.sqrt(max(facts[LEVER] / max(facts[INFORMATION], 1e-300), 1e-6))
    needed = weak_share * (S[0, 0] + S[1, 1] + S[2, 2])
    D = np.ones(6)
    D[3:] = 1.0 / lever
    A, B, P = np.empty((6, 6)), np.empty((6, 6)), np.zeros((6, 6))
    for i in range(6):
        for j in range(6):
            A[i, j] = S[i, j] * D[i] * D[j]
            B[i, j] = H[i, j] * D[i] * D[j]
    values, vectors = eigen(A)
    count = 0
    for k in range(6):
        held = 0.0
        for i in range(6):
            for j in range(6):
                held += vectors[i, k] * B[i, j] * vectors[j, k]
        if values[k] <= needed or held <= least or values[k] <= 0.0:
            for i in range(6):
                weak[count, i] = vectors[i, k]
            count += 1
            continue
        for i in range(6):
            for j in range(6):
                P[i, j] += vectors[i, k] * vectors[j, k]
    for i in range(6):
        for j in range(6):
            A[i, j] = 0.0
            for k in range(6):
                for m in range(6):
                    A[i, j] += P[i, k] * B[k, m] * P[m, j]
    values, vectors = eigen(A)
    largest = 0.0
    for k in range(6):
        largest = max(largest, values[k])
    d[:] = 0.0
    for k in range(6):
        if values[k] <= 1e-12 * largest:
            continue
        dot = 0.0
        for i in range(6):
            for j in range(6):
                dot += vectors[i, k] * P[i, j] * g[j] * D[j]
        for i in range(6):
            d[i] -= vectors[i, k] * dot / values[k] * D[i]
    return count
