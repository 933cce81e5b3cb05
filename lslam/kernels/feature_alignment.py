"""Registration of a scan's edges and planar points in one call that holds no GIL: on the features of one earlier scan, or
on a feature map of Gaussian voxels.

Both are Gauss-Newton with new correspondences each step and a robust width that falls from `scale_start` by `decay` to
`scale_end`, with the guard on unobserved directions of `gauss_newton`. `allowed` (6, 6) projects every step: the identity,
or fewer directions, as LeGO-LOAM's two steps want. R (3, 3) and t (3,) are updated in place.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from lslam.kernels.feature_residuals import linearise_edges, linearise_planes
from lslam.kernels.gauss_newton import mirror, move_by, solve_observed
from lslam.kernels.jit import inline, kernel
from lslam.kernels.lines import linearise_lines
from lslam.kernels.residuals import linearise, step_norms
from lslam.kernels.surface_information import solve_on_surfaces

Floats = NDArray[np.float64]
Longs = NDArray[np.int64]
Ints = NDArray[np.int32]
Grid = tuple[Floats, NDArray[np.uint16], Ints, Longs, Ints]
# H, facts of edges and of planes, last step, iterations, converged, unobserved directions and these as rows
Aligned = tuple[Floats, Floats, Floats, Floats, int, bool, int, Floats]

# From scan to scan no map takes an error back, and it goes on as velocity: twice as much is asked for there. More would doubt
# sparse sensors, whose scans have few features, in every direction.
TIMES_ON_SCAN = 2.0


@inline
def _within(allowed: Floats, H: Floats) -> Floats:
    """H, an upper triangle, as seen by the directions that are allowed; H leaves whole."""
    mirror(H)
    A = np.zeros((6, 6))
    for i in range(6):
        for k in range(6):
            for m in range(6):
                for j in range(6):
                    A[i, j] += allowed[i, k] * H[k, m] * allowed[m, j]
    return A


@kernel
def align_to_scan(edges: Floats, planes: Floats, R: Floats, t: Floats, scale_start: float, scale_end: float, decay: float,
                  max_iterations: int, step_m: float, step_rad: float, edge_variance: float, plane_variance: float,
                  weak_share: float, least: float, allowed: Floats, one_to_many: bool, size: float, reach: float,
                  edge_grid: Grid, plane_grid: Grid, normals: Floats) -> Aligned:  # fmt: skip
    """Register edges (E, 3) and planar points (P, 3) on two grids of `feature_grid` with cells of `size`, m.

    A direction is observed when all hold it better than `least` planar points on a map would.
    Features within `reach`, m, are matched: rings lie farther apart than the kernel is wide.
    """
    H, S, g, d, weak = np.empty((6, 6)), np.empty((6, 6)), np.empty(6), np.zeros(6), np.zeros((6, 6))
    edge_facts, plane_facts = np.zeros(6), np.zeros(6)
    scale, converged, weak_count, iterations = scale_start, False, 0, 0
    needed = TIMES_ON_SCAN * least / plane_variance
    ep, er, es, ek, et = edge_grid
    pp, pr, ps, pk, pt = plane_grid
    for _ in range(max_iterations):
        H[:] = 0.0
        g[:] = 0.0
        edge_facts[:] = 0.0
        plane_facts[:] = 0.0
        linearise_edges(
            edges, R, t, size, reach, scale, edge_variance, one_to_many, ep, er, es, ek, et, H, g, edge_facts
        )
        # Lines are what they are; of the planes, those that are sure of themselves.
        S[:] = H
        linearise_planes(planes, R, t, size, reach, scale, plane_variance, one_to_many, pp, pr, ps, pk, pt, H, g,
                         plane_facts, normals, S)  # fmt: skip
        iterations += 1
        facts = edge_facts + plane_facts
        if facts[3] < 6.0:
            break
        # What the projector takes away has no eigenvalue left, so that the step never looks along it in g.
        weak_count = solve_on_surfaces(_within(allowed, H), _within(allowed, S), g, facts, weak_share, needed, d, weak)
        move, turn = step_norms(d)
        if not move_by(d, move, turn, scale, R, t):
            break
        if scale <= scale_end and move < step_m and turn < step_rad:
            converged = True
            break
        scale = max(scale * decay, scale_end)
    return H, edge_facts, plane_facts, d, iterations, converged, weak_count, weak


@kernel
def align_to_map(edges: Floats, planes: Floats, scatter: Floats, R: Floats, t: Floats, scale_start: float,
                 scale_end: float, decay: float, max_iterations: int, step_m: float, step_rad: float,
                 edge_variance: float, plane_variance: float, weak_share: float, least: float, allowed: Floats, line_size: float,
                 min_points: float, floor: float, edge_moments: Floats, edge_keys: Longs, edge_table: Ints,
                 lines: Floats, line_keys: Longs, line_sums: Floats, size: float, plane_rows: Floats, plane_keys: Longs,
                 plane_table: Ints, has_coarse: bool, coarse_size: float, coarse_rows: Floats, coarse_keys: Longs,
                 coarse_table: Ints) -> Aligned:  # fmt: skip
    """Register edges (E, 3) on line voxels of `line_size`, m, and planar points (P, 3) with scatter (P, 6) on
    plane voxels of `size`.

    A direction is observed when all hold it better than `least` planar points would. With a coarse map, points that find
    no plane in the fine one are matched there.
    """
    H, g, d, weak = np.empty((6, 6)), np.empty(6), np.zeros(6), np.zeros((6, 6))
    edge_facts, plane_facts = np.zeros(6), np.zeros(6)
    edge_cells, edge_slots = np.full(len(edges), -1, np.int64), np.full((len(edges), 8), -1, np.int32)
    cells, slots = np.full(len(planes), -1, np.int64), np.full((len(planes), 8), -1, np.int32)
    coarse_cells = np.full(len(planes) if has_coarse else 0, -1, np.int64)
    coarse_slots = np.full((len(coarse_cells), 8), -1, np.int32)
    is_done, away2 = np.zeros(len(planes), np.bool_), np.empty(len(planes))
    scale, converged, weak_count, iterations = scale_start, False, 0, 0
    for _ in range(max_iterations):
        H[:] = 0.0
        g[:] = 0.0
        edge_facts[:] = 0.0
        plane_facts[:] = 0.0
        is_done[:] = False
        linearise_lines(edges, R, t, line_size, scale, edge_variance, min_points, floor, edge_moments, edge_keys, edge_table,
                        lines, line_keys, line_sums, edge_cells, edge_slots, H, g, edge_facts)  # fmt: skip
        linearise(planes, scatter, R, t, size, scale, plane_variance, 0.0, np.inf, plane_rows, plane_keys, plane_table,
                  cells, slots, is_done, away2, H, g, plane_facts)  # fmt: skip
        if has_coarse:
            linearise(planes, scatter, R, t, coarse_size, scale, plane_variance, 0.0, np.inf, coarse_rows, coarse_keys,
                      coarse_table, coarse_cells, coarse_slots, is_done, away2, H, g, plane_facts)  # fmt: skip
        iterations += 1
        facts = edge_facts + plane_facts
        if facts[3] < 6.0:
            break
        weak_count = solve_observed(_within(allowed, H), g, facts, weak_share, least / plane_variance, 1.0, d, weak)
        move, turn = step_norms(d)
        if not move_by(d, move, turn, scale, R, t):
            break
        if scale <= scale_end and move < step_m and turn < step_rad:
            converged = True
            break
        scale = max(scale * decay, scale_end)
    return H, edge_facts, plane_facts, d, iterations, converged, weak_count, weak
