"""Registration of one scan in one call that holds no GIL: annealed Gauss-Newton with a guard on unobserved directions."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from lslam.kernels.jit import inline, kernel
from lslam.kernels.linalg import eigen, rotate_left
from lslam.kernels.residuals import linearise, step_norms

Floats = NDArray[np.float64]
Longs = NDArray[np.int64]
Ints = NDArray[np.int32]
Flags = NDArray[np.bool_]


# A weak direction is followed, though not believed, until it holds less than this part of what makes it weak: normals that
# waver by a degree look like 3e-4 of the information.
UNSEEN = 0.3


@inline
def solve_observed(H: Floats, g: Floats, facts: Floats, weak_share: float, least: float, unseen: float, d: Floats,
                   weak: Floats) -> int:  # fmt: skip
    """Step d = -inv(H) g in the directions the points observe; returns how many they do not, as unit rows of `weak`.

    Rotations are scaled by the rms lever arm, which makes the six eigenvalues comparable; a direction is unobserved when
    it holds less than `weak_share` of the total information or less than `least`, 1/m2, and not followed below `unseen`
    times that.
    """
    lever = math.sqrt(max(facts[4] / max(facts[0], 1e-300), 1e-6))
    A = np.empty((6, 6))
    for i in range(6):
        for j in range(6):
            A[i, j] = H[i, j] * (1.0 if i < 3 else 1.0 / lever) * (1.0 if j < 3 else 1.0 / lever)
    values, vectors = eigen(A)
    d[:] = 0.0
    count = 0
    needed = max(weak_share * facts[0], least)
    for k in range(6):
        if values[k] <= needed or values[k] <= 0.0:
            for i in range(6):
                weak[count, i] = vectors[i, k]
            count += 1
            if values[k] <= unseen * needed or values[k] <= 0.0:
                continue
        dot = 0.0
        for i in range(6):
            dot += vectors[i, k] * g[i] * (1.0 if i < 3 else 1.0 / lever)
        for i in range(6):
            d[i] -= vectors[i, k] * dot / values[k] * (1.0 if i < 3 else 1.0 / lever)
    return count


@inline
def mirror(H: Floats) -> None:
    """The lower triangle from the upper."""
    for i in range(6):
        for j in range(i):
            H[i, j] = H[j, i]


@inline
def move_by(d: Floats, move: float, turn: float, scale: float, R: Floats, t: Floats) -> bool:
    """Move R and t by the step d, whose translation and rotation are given; False when it is not finite."""
    if not (np.isfinite(move) and np.isfinite(turn)):
        return False
    # A step beyond the kernel's width leaves the region where its correspondences mean anything.
    limit = 2.0 * max(scale, 0.5)
    if move > limit:
        for i in range(6):
            d[i] *= limit / move
    t[0] += d[0]
    t[1] += d[1]
    t[2] += d[2]
    rotate_left(R, d[3], d[4], d[5])
    return True


@inline
def advance(H: Floats, g: Floats, facts: Floats, scale: float, weak_share: float, R: Floats, t: Floats, d: Floats,
            weak: Floats, weak_count: int) -> tuple[bool, int, float, float]:  # fmt: skip
    """Move R and t by one guarded step: whether there was one, the unobserved directions, its translation and rotation.

    H comes with its upper triangle and leaves whole.
    """
    mirror(H)
    if facts[3] < 6.0:
        return False, weak_count, 0.0, 0.0
    weak_count = solve_observed(H, g, facts, weak_share, 0.0, UNSEEN, d, weak)
    move, turn = step_norms(d)
    return move_by(d, move, turn, scale, R, t), weak_count, move, turn


@inline
def trimmed(away2: Floats, share: float, gate2: float) -> float:
    """Squared distance up to which the nearest `share` of the matched points lie, `gate2` at most.

    Unmatched points have a negative distance. Bisection: no copy, no sort, and the same for any order of the points.
    """
    if share >= 1.0:
        return gate2
    high = 0.0
    total = 0
    for a in away2:
        if 0.0 <= a <= gate2:
            total += 1
            high = max(high, a)
    low = 0.0
    for _ in range(40):
        middle = 0.5 * (low + high)
        count = 0
        for a in away2:
            if 0.0 <= a <= middle:
                count += 1
        if count >= share * total:
            high = middle
        else:
            low = middle
    return high


@inline
def workspace(n: int) -> tuple[Longs, Ints, Flags, Floats]:
    """Octant cells and slots of n points, who is matched, and squared distances."""
    return np.full(n, -1, np.int64), np.full((n, 8), -1, np.int32), np.zeros(n, np.bool_), np.empty(n)


@inline
def clear(H: Floats, g: Floats, facts: Floats, is_done: Flags, away2: Floats) -> None:
    """Before a linearisation: sums are zero, nothing is matched."""
    H[:] = 0.0
    g[:] = 0.0
    facts[:] = 0.0
    is_done[:] = False
    away2[:] = -1.0


@kernel
def align(source: Floats, scatter: Floats, R: Floats, t: Floats, scale_start: float, scale_end: float, decay: float,
          max_iterations: int, step_m: float, step_rad: float, inlier_distance: float, inlier_ratio: float,
          sigma2: float, blob_weight: float, weak_share: float, size: float, planes: Floats, keys: Longs, table: Ints,
          has_coarse: bool, coarse_size: float, coarse_planes: Floats, coarse_keys: Longs,
          coarse_table: Ints) -> tuple[Floats, Floats, Floats, int, bool, int, Floats]:  # fmt: skip
    """Register source points on a map, point to plane: R (3, 3) and t (3,) are updated in place.

    With a coarse map, points that find no plane in the fine one are matched there; blobs serve the last map only.

    Correspondences beyond `inlier_distance`, m, are rejected, and from the second step on those beyond the distance
    within which the nearest `inlier_ratio` of the last step's lay. The robust width falls from `scale_start` by `decay`
    to `scale_end`; iterations stop when, at the end width, the update is under `step_m` and `step_rad`. Returns H (6, 6)
    and facts (7,) of the last linearisation, the seventh being the inliers in the fine map, the last update (6,),
    iterations, whether they converged, the number of unobserved directions and these (6, 6).
    """
    cells, slots, is_done, away2 = workspace(len(source))
    coarse_cells, coarse_slots, _, _ = workspace(len(source) if has_coarse else 0)
    H, g, d, facts, weak = np.empty((6, 6)), np.empty(6), np.zeros(6), np.zeros(7), np.zeros((6, 6))
    farthest2 = inlier_distance * inlier_distance
    gate2, scale = farthest2, scale_start
    converged = False
    weak_count = 0
    iterations = 0
    for _ in range(max_iterations):
        clear(H, g, facts, is_done, away2)
        linearise(source, scatter, R, t, size, scale, sigma2, 0.0 if has_coarse else blob_weight, gate2, planes, keys,
                  table, cells, slots, is_done, away2, H, g, facts)  # fmt: skip
        facts[6] = facts[2]
        if has_coarse:
            linearise(source, scatter, R, t, coarse_size, scale, sigma2, blob_weight, gate2, coarse_planes, coarse_keys,
                      coarse_table, coarse_cells, coarse_slots, is_done, away2, H, g, facts)  # fmt: skip
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
