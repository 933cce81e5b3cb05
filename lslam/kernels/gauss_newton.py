"""Registration of one scan in one call that holds no GIL: annealed Gauss-Newton with a guard on unobserved directions."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from lslam.kernels.jit import inline, kernel
from lslam.kernels.linalg import eigen, rotate_left
from lslam.kernels.residuals import linearise, step_norms

Floats = NDArray[np.float64]


@inline
def solve_observed(H: Floats, g: Floats, facts: Floats, weak_share: float, d: Floats, weak: Floats) -> int:
    """Step d = -inv(H) g in the directions the points observe; returns how many they do not, as unit rows of `weak`.

    Rotations are scaled by the rms lever arm, which makes the six eigenvalues comparable; a direction is unobserved when
    it holds less than `weak_share` of the total information.
    """
    lever = math.sqrt(max(facts[4] / max(facts[0], 1e-300), 1e-6))
    A = np.empty((6, 6))
    for i in range(6):
        for j in range(6):
            A[i, j] = H[i, j] * (1.0 if i < 3 else 1.0 / lever) * (1.0 if j < 3 else 1.0 / lever)
    values, vectors = eigen(A)
    d[:] = 0.0
    count = 0
    for k in range(6):
        if values[k] <= weak_share * facts[0] or values[k] <= 0.0:
            for i in range(6):
                weak[count, i] = vectors[i, k]
            count += 1
            continue
        dot = 0.0
        for i in range(6):
            dot += vectors[i, k] * g[i] * (1.0 if i < 3 else 1.0 / lever)
        for i in range(6):
            d[i] -= vectors[i, k] * dot / values[k] * (1.0 if i < 3 else 1.0 / lever)
    return count


@kernel
def align(source: Floats, scatter: Floats, R: Floats, t: Floats, scale_start: float, scale_end: float, decay: float,
          max_iterations: int, step_m: float, step_rad: float, sigma2: float, blob_weight: float, weak_share: float,
          size: float, planes: Floats, keys: NDArray[np.int64], table: NDArray[np.int32],
          has_coarse: bool, coarse_size: float, coarse_planes: Floats, coarse_keys: NDArray[np.int64],
          coarse_table: NDArray[np.int32]) -> tuple[Floats, Floats, Floats, int, bool, int, Floats]:  # fmt: skip
    """Register source points on a map: R (3, 3) and t (3,) are updated in place.

    With a coarse map, points that find no plane in the fine one are matched there; blobs serve the last map only.

    The robust width falls from `scale_start` by `decay` to `scale_end`; iterations stop when, at the end width, the update
    is under `step_m` and `step_rad`. Returns H (6, 6) and facts (7,) of the last linearisation, the seventh being the
    inliers in the fine map, the last update (6,), iterations, whether they converged, the number of unobserved directions
    and these (6, 6).
    """
    n = len(source)
    cells = np.full(n, -1, np.int64)
    slots = np.full((n, 8), -1, np.int32)
    coarse_cells = np.full(n if has_coarse else 0, -1, np.int64)
    coarse_slots = np.full((len(coarse_cells), 8), -1, np.int32)
    is_done = np.zeros(n, np.bool_)
    H, g, d, facts = np.empty((6, 6)), np.empty(6), np.zeros(6), np.zeros(7)
    weak = np.zeros((6, 6))
    scale = scale_start
    converged = False
    weak_count = 0
    iterations = 0
    for _ in range(max_iterations):
        H[:] = 0.0
        g[:] = 0.0
        facts[:] = 0.0
        is_done[:] = False
        linearise(source, scatter, R, t, size, scale, sigma2, 0.0 if has_coarse else blob_weight, planes, keys, table,
                  cells, slots, is_done, H, g, facts)  # fmt: skip
        facts[6] = facts[2]
        if has_coarse:
            linearise(source, scatter, R, t, coarse_size, scale, sigma2, blob_weight, coarse_planes, coarse_keys,
                      coarse_table, coarse_cells, coarse_slots, is_done, H, g, facts)  # fmt: skip
        for i in range(6):
            for j in range(i):
                H[i, j] = H[j, i]
        iterations += 1
        if facts[3] < 6.0:
            break
        weak_count = solve_observed(H, g, facts, weak_share, d, weak)
        move, turn = step_norms(d)
        if not (np.isfinite(move) and np.isfinite(turn)):
            break
        # A step beyond the kernel's width leaves the region where its correspondences mean anything.
        limit = 2.0 * max(scale, 0.5)
        if move > limit:
            for i in range(6):
                d[i] *= limit / move
        t[0] += d[0]
        t[1] += d[1]
        t[2] += d[2]
        rotate_left(R, d[3], d[4], d[5])
        if scale <= scale_end and move < step_m and turn < step_rad:
            converged = True
            break
        scale = max(scale * decay, scale_end)
    return H, facts, d, iterations, converged, weak_count, weak
