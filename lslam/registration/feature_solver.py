"""One scan's features against an earlier scan or a feature map: pose, covariance and the facts of convergence."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from lslam.geometry import se3, so3
from lslam.kernels.feature_alignment import align_to_map, align_to_scan
from lslam.registration.feature_map import MIN_LINE_POINTS, FeatureMap
from lslam.registration.feature_scan import FeatureScan
from lslam.registration.gaussian_map import FLOOR, GaussianMap
from lslam.registration.robust import Annealing
from lslam.registration.solver import STEP_M, STEP_RAD, RegistrationResult, _covariance

Floats = NDArray[np.float64]
NONE: Floats = np.zeros((0, 3))


@dataclass(frozen=True)
class FeatureNoise:
    """Standard deviations of a feature's point, m: of an edge across it, of a planar point along the normal.

    weak_share : part of the information below which a direction counts as unobserved
    least : planar points that hold a direction no better than all features do when it counts as unobserved: one at most,
        for a few false edges hold as much, and fewer where the motion prior is worse
    """

    edge: float
    plane: float
    weak_share: float
    least: float = 1.0


def solve_on_scan(
    target: FeatureScan, edges: Floats, planes: Floats, T_prior: Floats, annealing: Annealing, noise: FeatureNoise, *,
    one_to_many: bool = True, allowed: Floats | None = None,
) -> RegistrationResult:  # fmt: skip
    """Align edges (E, 3) and planar points (P, 3), LiDAR frame, with an earlier scan, starting at `T_prior` (4, 4).

    `allowed` (6, 6) projects the steps; the result's degenerate directions are those that it allows.
    """
    R, t, projector = _start(T_prior, allowed)
    H, edge_facts, plane_facts, step, iterations, converged, count, weak = align_to_scan(
        edges, planes, R, t, annealing.start, annealing.end, annealing.decay, annealing.steps, STEP_M, STEP_RAD,
        noise.edge**2, noise.plane**2, noise.weak_share, noise.least, projector, one_to_many, target.size, target.reach,
        target.edges, target.planes, target.normals,
    )  # fmt: skip
    facts = edge_facts + plane_facts
    return _result(
        T_prior, R, t, H, facts, step, iterations, converged, weak[:count], len(edges) + len(planes), allowed
    )


def solve_on_map(
    target: FeatureMap, edges: Floats, planes: Floats, T_prior: Floats, annealing: Annealing, noise: FeatureNoise, *,
    scatter: Floats | None = None, coarse: GaussianMap | None = None, is_coarse_only: bool = False,
) -> RegistrationResult:  # fmt: skip
    """Align edges (E, 3) and planar points (P, 3), LiDAR frame, with the feature map, starting at `T_prior` (4, 4).

    scatter : (P, 6) m2, of the points behind each planar point when that is a centroid
    coarse : serves planar points without a plane in the map; alone when `is_coarse_only`
    """
    R, t, projector = _start(T_prior, None)
    if scatter is None:
        scatter = np.zeros((len(planes), 6))
    lines, fine = target.edges, target.planes
    second = fine if coarse is None else coarse
    if is_coarse_only:
        fine = second
    H, edge_facts, plane_facts, step, iterations, converged, count, weak = align_to_map(
        edges, planes, scatter, R, t, annealing.start, annealing.end, annealing.decay,
        annealing.steps, STEP_M, STEP_RAD, noise.edge**2, noise.plane**2, noise.weak_share, noise.least, projector,
        lines.size, float(MIN_LINE_POINTS), FLOOR, lines.moments, lines.keys, lines.table, *target.lines,
        fine.size, fine.planes, fine.keys, fine.table,
        second is not fine, second.size, second.planes, second.keys, second.table,
    )  # fmt: skip
    facts = edge_facts + plane_facts
    return _result(T_prior, R, t, H, facts, step, iterations, converged, weak[:count], len(edges) + len(planes), None)


def kept_where_blind(result: RegistrationResult, T_expected: Floats) -> RegistrationResult:
    """The result with the pose expected, (4, 4), along the directions that it does not observe, whatever led it there.

    Zhang, Kaess and Singh (2016), solution remapping. To leave such a direction out of the last step alone does not do:
    the ones before it, with a wider kernel, observed more, and falsely so. The error would go on as velocity.
    """
    R, arm = result.T_world_lidar[:3, :3], result.lever_arm
    moved = np.concatenate([result.T_world_lidar[:3, 3] - T_expected[:3, 3], arm * so3.log(R @ T_expected[:3, :3].T)])
    false = result.degenerate.T @ (result.degenerate @ moved)
    pose = se3.make(so3.exp(-false[3:] / arm) @ R, result.T_world_lidar[:3, 3] - false[:3])
    return replace(result, T_world_lidar=se3.normalise(pose))


def _start(T_prior: Floats, allowed: Floats | None) -> tuple[Floats, Floats, Floats]:
    R, t = np.ascontiguousarray(T_prior[:3, :3]).copy(), T_prior[:3, 3].copy()
    return R, t, np.eye(6) if allowed is None else np.ascontiguousarray(allowed)


def _result(
    T_prior: Floats, R: Floats, t: Floats, H: Floats, facts: Floats, step: Floats, iterations: int, converged: bool,
    weak: Floats, source_points: int, allowed: Floats | None,
) -> RegistrationResult:  # fmt: skip
    pose = se3.make(R, t)
    finite = bool(np.isfinite(pose).all() and np.isfinite(step).all())
    lever = float(np.sqrt(max(facts[4] / max(facts[0], 1e-300), 1e-6)))
    if allowed is not None:
        weak = weak[np.linalg.norm(weak @ allowed, axis=1) > 0.5]
    return RegistrationResult(
        T_world_lidar=pose if finite else T_prior,
        ok=finite,
        reason="" if finite else "the solution is not finite",
        covariance=_covariance(H, facts, weak, lever) if finite and facts[3] >= 6 else None,
        converged=converged,
        iterations=iterations,
        source_points=source_points,
        matched=int(facts[3]),
        inliers=int(facts[2]),
        fine_inliers=int(facts[2]),
        rmse=float(np.sqrt(facts[1] / max(facts[5], 1e-12))),
        degenerate=weak.copy(),
        lever_arm=lever,
    )
