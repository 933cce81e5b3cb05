"""Matching of directed segments in the plane: corners, votes of their pairs for a pose, score of a pose, and its refinement.

A segment is a row x y x y of (N, 4) float64, m. A corner is a row of (E, 5): x, y, the directions of its two walls, rad, the
second to the left of the first, and its weight. A pose is x, y, yaw of the source's frame in the target's.
"""

from __future__ import annotations

import math

import numpy as np

from lslam.core.arrays import Floats, Longs
from lslam.core.kernels.jit import inline, inline_with_arrays, kernel

STAYS, STAYS_RAD = 0.002, 0.0001  # m and rad; a smaller step ends the iteration: far below the accuracy of a map


@inline
def wrap(angle: float) -> float:
    """The same angle within -pi .. pi."""
    return angle - 2.0 * math.pi * math.floor(angle / (2.0 * math.pi) + 0.5)


@kernel
def corners(segments: Floats, reach: float, sharpest: float) -> Floats:
    """Corners of all pairs of segments (N, 4) that meet at `sharpest` rad or more, at most `reach` m beyond their ends.

    The walls of an angular edge meet, those of a virtual edge meet when extended (Del Tufo, section 3.3.1). The weight is the
    shorter of both lengths, and decreases with the distance by which the walls are extended.
    """
    n = len(segments)
    found = np.empty((n * (n - 1) // 2, 5))
    count = 0
    for i in range(n):
        a = segments[i]
        ux, uy = a[2] - a[0], a[3] - a[1]
        lu = math.hypot(ux, uy)
        for j in range(i):
            b = segments[j]
            vx, vy = b[2] - b[0], b[3] - b[1]
            lv = math.hypot(vx, vy)
            cross = ux * vy - uy * vx
            if abs(cross) < math.sin(sharpest) * lu * lv:
                continue
            s = ((b[0] - a[0]) * vy - (b[1] - a[1]) * vx) / cross
            t = ((b[0] - a[0]) * uy - (b[1] - a[1]) * ux) / cross
            x, y = a[0] + s * ux, a[1] + s * uy
            gap = max(lu * (abs(s - 0.5) - 0.5), lv * (abs(t - 0.5) - 0.5), 0.0)
            if gap > reach:
                continue
            f = found[count]
            count += 1
            f[0], f[1] = x, y
            first, second = math.atan2(uy, ux), math.atan2(vy, vx)
            f[2], f[3] = (first, second) if cross > 0.0 else (second, first)
            f[4] = min(lu, lv) * reach / (reach + 4.0 * gap)
    return found[:count]


@kernel
def votes(
    source: Floats, target: Floats, prior: Floats, window: Floats, cell: Floats, angle_tolerance: float
) -> Floats:
    """Votes (X, Y, A, 4) of pairs of corners for poses: sum of weights, weighted sums of x, y, m, and yaw, rad, less `prior`.

    source, target : (N, 5) corners: x, y, m, two angles, rad, weight; prior : (3,) x, y, yaw
    Poses lie within `window` (3,), m, m, rad, of `prior`, in cells of `cell` (3,). The angles of the two corners of a pair
    differ by `angle_tolerance`, rad, at most.
    """
    nx, ny = int(2.0 * window[0] / cell[0]) + 1, int(2.0 * window[1] / cell[1]) + 1
    na = int(2.0 * window[2] / cell[2]) + 1
    grid = np.zeros((nx, ny, na, 4))
    for i in range(len(source)):
        s = source[i]
        for j in range(len(target)):
            t = target[j]
            first, second = wrap(t[2] - s[2]), wrap(t[3] - s[3])
            apart = wrap(second - first)
            if abs(apart) > angle_tolerance:
                continue
            yaw = first + 0.5 * apart
            da = wrap(yaw - prior[2])
            if abs(da) > window[2]:
                continue
            c, sn = math.cos(yaw), math.sin(yaw)
            dx = t[0] - c * s[0] + sn * s[1] - prior[0]
            dy = t[1] - sn * s[0] - c * s[1] - prior[1]
            if abs(dx) > window[0] or abs(dy) > window[1]:
                continue
            w = math.sqrt(s[4] * t[4])
            g = grid[int((dx + window[0]) / cell[0]), int((dy + window[1]) / cell[1]), int((da + window[2]) / cell[2])]
            g[0] += w
            g[1] += w * dx
            g[2] += w * dy
            g[3] += w * da
    return grid


@kernel
def peaks(grid: Floats, prior: Floats, count: int, is_round: bool) -> Floats:
    """Poses (K, 3) of the local maxima of `votes`, at most `count` of them, those of largest weight first.

    is_round : whether the first and the last cell of yaw are neighbours
    """
    nx, ny, na = grid.shape[0], grid.shape[1], grid.shape[2]
    best = np.zeros((count, 5))
    for i in range(nx):
        for j in range(ny):
            for k in range(na):
                own = grid[i, j, k, 0]
                if own <= best[count - 1, 0]:
                    continue
                sx = sy = sa = total = 0.0
                is_peak = True
                for a in range(max(i - 1, 0), min(i + 2, nx)):
                    for b in range(max(j - 1, 0), min(j + 2, ny)):
                        for d in range(k - 1, k + 2):
                            if not is_round and (d < 0 or d >= na):
                                continue
                            g = grid[a, b, d % na]
                            if g[0] > own:
                                is_peak = False
                            total += g[0]
                            sx += g[1]
                            sy += g[2]
                            # Across the seam of yaw the sums are off by a whole turn.
                            sa += g[3] + g[0] * 2.0 * math.pi * ((d >= na) - (d < 0))
                if not is_peak:
                    continue
                place = count - 1
                while place > 0 and best[place - 1, 0] < own:
                    best[place, :4] = best[place - 1, :4]
                    place -= 1
                best[place, 0] = own
                best[place, 1], best[place, 2], best[place, 3] = sx / total, sy / total, sa / total
    found = 0
    poses = np.empty((count, 3))
    for p in range(count):
        if best[p, 0] > 0.0:
            for q in range(3):
                poses[found, q] = prior[q] + best[p, 1 + q]
            poses[found, 2] = wrap(poses[found, 2])
            found += 1
    return poses[:found]


@inline
def move(segment: Floats, pose: Floats) -> tuple[float, float, float, float]:
    """End points x y x y, m, of a segment (4,) of a moving frame, transformed by `pose` (3,) x, y, yaw."""
    c, s = math.cos(pose[2]), math.sin(pose[2])
    return (
        pose[0] + c * segment[0] - s * segment[1],
        pose[1] + s * segment[0] + c * segment[1],
        pose[0] + c * segment[2] - s * segment[3],
        pose[1] + s * segment[2] + c * segment[3],
    )


@inline
def line_distance(
    ax: float, ay: float, bx: float, by: float, target: Floats, farthest: float, likeness: float, by_coverage: bool
) -> tuple[float, float]:
    """Distance of the segment a b from a target segment, m, and the length covered by it, m; `farthest` and 0 for no pair.

    Del Tufo, section 3.3.4 and figure 3.8. Without coverage: mean distance of both ends from the target segment. With
    coverage: mean distance from the target's line over the part where both lie side by side.
    farthest : m, largest distance of a pair
    likeness : least cosine between the directions; outside and inside of a wall have opposite directions
    """
    ux, uy = target[2] - target[0], target[3] - target[1]
    lu, lv = math.hypot(ux, uy), math.hypot(bx - ax, by - ay)
    if lu < 1e-9 or lv < 1e-9 or ((bx - ax) * ux + (by - ay) * uy) < likeness * lu * lv:
        return farthest, 0.0
    ux, uy = ux / lu, uy / lu
    sa, sb = (ax - target[0]) * ux + (ay - target[1]) * uy, (bx - target[0]) * ux + (by - target[1]) * uy
    da, db = (ay - target[1]) * ux - (ax - target[0]) * uy, (by - target[1]) * ux - (bx - target[0]) * uy
    low, high = max(sa, 0.0), min(sb, lu)
    if by_coverage:
        if high <= low:
            return farthest, 0.0
        slope = (db - da) / (sb - sa)
        distance = 0.5 * (abs(da + slope * (low - sa)) + abs(da + slope * (high - sa)))
    else:
        out_a, out_b = max(-sa, sa - lu, 0.0), max(-sb, sb - lu, 0.0)
        distance = 0.5 * (math.hypot(da, out_a) + math.hypot(db, out_b))
    if distance >= farthest:
        return farthest, 0.0
    return distance, min(max(high - low, 0.0), lv)


@kernel
def fit(
    source: Floats, target: Floats, pose: Floats, farthest: float, likeness: float, by_coverage: bool
) -> tuple[float, float, Longs]:
    """Mean distance, m, of the source (S, 4) at `pose` from the target, the covered share of its length, and the pairs (S,).

    The mean is weighted by length. A wall without a partner has the distance `farthest`, m, and pair -1.
    pose : (3,) m and rad; likeness, by_coverage : as in `line_distance`
    """
    distance = covered = total = 0.0
    pair = np.full(len(source), -1, np.int64)
    for i in range(len(source)):
        ax, ay, bx, by = move(source[i], pose)
        best, best_cover = farthest, 0.0
        for j in range(len(target)):
            d, cover = line_distance(ax, ay, bx, by, target[j], farthest, likeness, by_coverage)
            if d < best:
                best, best_cover, pair[i] = d, cover, j
        length = math.hypot(bx - ax, by - ay)
        distance += length * best
        covered += best_cover
        total += length
    return distance / max(total, 1e-9), covered / max(total, 1e-9), pair


@kernel
def refine(
    source: Floats,
    target: Floats,
    pose: Floats,
    prior: Floats,
    trust: Floats,
    gates: Floats,
    more: int,
    likeness: float,
    short: float,
    by_coverage: bool,
) -> tuple[Floats, Floats, Floats, float, Longs]:
    """Gauss-Newton from `pose` on the distances of walls from their partners' lines; new pairs for each of the `gates`, m.

    The last gate is repeated until the pose converges, `more` times at most: walls with half weight converge slowly.
    Every wall is one measurement of an offset and an angle: two points at +- length / sqrt(12) about its middle, weighted by
    length / (length + short) and by the Geman-McClure weight. `trust` (3,), the inverse variances of `prior` relative to that
    of a wall, decides along free directions. Returns the pose (3,), the normal matrix (3, 3) of the walls alone about their
    centre, the centre (2,), m, the weighted rms of the distances, m, and the pairs (S,) of the last iteration.
    likeness, by_coverage : as in `line_distance`
    """
    pose = pose.copy()
    normal = np.zeros((3, 3))
    centre = np.zeros(2)
    rms = 0.0
    pair = np.full(len(source), -1, np.int64)
    for r in range(len(gates) + more):
        gate = gates[min(r, len(gates) - 1)]
        _, _, pair = fit(source, target, pose, gate, likeness, by_coverage)
        sw = cx = cy = 0.0
        for i in range(len(source)):
            if pair[i] >= 0:
                ax, ay, bx, by = move(source[i], pose)
                w = math.hypot(bx - ax, by - ay)
                sw += w
                cx += 0.5 * w * (ax + bx)
                cy += 0.5 * w * (ay + by)
        if sw <= 0.0:
            break
        centre[0], centre[1] = cx / sw, cy / sw
        normal[:] = 0.0
        gradient = np.zeros(3)
        total = squares = 0.0
        for i in range(len(source)):
            if pair[i] < 0:
                continue
            t = target[pair[i]]
            ax, ay, bx, by = move(source[i], pose)
            lt, length = math.hypot(t[2] - t[0], t[3] - t[1]), math.hypot(bx - ax, by - ay)
            nx, ny = -(t[3] - t[1]) / lt, (t[2] - t[0]) / lt
            for side in range(2):
                k = 0.5 + (0.2886751 if side == 1 else -0.2886751)
                x, y = ax + k * (bx - ax), ay + k * (by - ay)
                e = (x - t[0]) * nx + (y - t[1]) * ny
                scale = gate * gate / (gate * gate + 4.0 * e * e)
                w = 0.5 * length / (length + short) * scale * scale
                turn = ny * (x - centre[0]) - nx * (y - centre[1])
                effect = (nx, ny, turn)
                for p in range(3):
                    gradient[p] += w * effect[p] * e
                    for q in range(p, 3):
                        normal[p, q] += w * effect[p] * effect[q]
                total += w
                squares += w * e * e
        normal[1, 0], normal[2, 0], normal[2, 1] = normal[0, 1], normal[0, 2], normal[1, 2]
        rms = math.sqrt(squares / max(total, 1e-12))
        step = damped_step(normal, gradient, trust, pose, prior, centre)
        c, s = math.cos(step[2]), math.sin(step[2])
        dx, dy = pose[0] - centre[0], pose[1] - centre[1]
        pose[0] = centre[0] + c * dx - s * dy + step[0]
        pose[1] = centre[1] + s * dx + c * dy + step[1]
        pose[2] = wrap(pose[2] + step[2])
        if r >= len(gates) and math.hypot(step[0], step[1]) < STAYS and abs(step[2]) < STAYS_RAD:
            break
    return pose, normal, centre, rms, pair


@inline_with_arrays
def damped_step(normal: Floats, gradient: Floats, trust: Floats, pose: Floats, prior: Floats, centre: Floats) -> Floats:
    """Solution (3,) of the normal equations with the prior added: step of the walls' centre in x, y, m, and of yaw, rad."""
    arm_x, arm_y = pose[0] - centre[0], pose[1] - centre[1]
    # Jacobian of the pose by the centre's x, y and yaw: the prior is one of the pose.
    jacobian = np.eye(3)
    jacobian[0, 2], jacobian[1, 2] = -arm_y, arm_x
    away = np.array([pose[0] - prior[0], pose[1] - prior[1], wrap(pose[2] - prior[2])])
    a = normal.copy()
    b = gradient.copy()
    for i in range(3):
        for k in range(3):
            b[i] += jacobian[k, i] * trust[k] * away[k]
            for j in range(3):
                a[i, j] += jacobian[k, i] * trust[k] * jacobian[k, j]
    det = (
        a[0, 0] * (a[1, 1] * a[2, 2] - a[1, 2] * a[2, 1])
        - a[0, 1] * (a[1, 0] * a[2, 2] - a[1, 2] * a[2, 0])
        + a[0, 2] * (a[1, 0] * a[2, 1] - a[1, 1] * a[2, 0])
    )
    step = np.zeros(3)
    if abs(det) < 1e-12:
        return step
    for i in range(3):
        m = a.copy()
        for k in range(3):
            m[k, i] = -b[k]
        step[i] = (
            m[0, 0] * (m[1, 1] * m[2, 2] - m[1, 2] * m[2, 1])
            - m[0, 1] * (m[1, 0] * m[2, 2] - m[1, 2] * m[2, 0])
            + m[0, 2] * (m[1, 0] * m[2, 1] - m[1, 1] * m[2, 0])
        ) / det
    return step
