"""One scan's features against an earlier scan or a feature map: pose, covariance and the facts of convergence.

Scan to scan all six directions are found at once (LOAM), or in two steps (LeGO-LOAM).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from lslam.core.arrays import Floats
from lslam.core.geometry import se3, so3
from lslam.core.types.scan_result import StageClock
from lslam.odometry.feature_map import MIN_LINE_POINTS, FeatureMap, FeatureScan
from lslam.odometry.kernels.feature_residuals import linearise_edges, linearise_planes
from lslam.odometry.kernels.lines import linearise_lines
from lslam.registration.alignment import prior_term, upright_directions, voxel_terms
from lslam.registration.gaussian_map import FLOOR_M2, GaussianMap
from lslam.registration.optimiser import (
    EVERYWHERE,
    Annealing,
    Correspondences,
    Limits,
    Problem,
    Term,
    optimise,
    slots_of,
)
from lslam.registration.preprocessing.features import Features
from lslam.registration.residuals import PLANES_ALONE
from lslam.registration.result import RegistrationResult

NONE: Floats = np.zeros((0, 3))
# Scan-to-scan errors persist as velocity, without a map to correct them: the threshold of degeneracy is twice as high there.
# Higher ones would call sparse scans degenerate in every direction.
TIMES_ON_SCAN = 2.0


@dataclass(frozen=True)
class FeatureNoise:
    """Standard deviations of a feature's point, m: of an edge across it, of a planar point along the normal.

    weak_share : part of the information below which a direction counts as unobserved
    least : information, in planar points, below which a direction is degenerate: one at most, since a few outlier edges have as
        much, and fewer where the motion prior is worse
    """

    edge: float
    plane: float
    weak_share: float
    least: float = 1.0


def solve_on_scan(
    target: FeatureScan,
    annealing: Annealing,
    noise: FeatureNoise,
    one_to_many: bool,
    edges: Floats,
    planes: Floats,
    T_prior: Floats,
    directions: Floats = EVERYWHERE,
) -> RegistrationResult:
    """Align edges (E, 3) and planar points (P, 3), LiDAR frame, with an earlier scan, starting at `T_prior` (4, 4).

    one_to_many : whether a feature is matched with several points of the earlier scan, by the line or plane through them
    directions : (6, 6) projector of the steps; the result's degenerate directions are among them
    """
    terms = [
        Term(
            linearise,
            (points,),
            surfaces,
            (float(target.size), float(target.reach), float(sigma) ** 2, one_to_many),
            target.matches_of(kind, len(points)),
        )
        for kind, linearise, points, surfaces, sigma in (
            ("edges", linearise_edges, edges, target.edges, noise.edge),
            ("planes", linearise_planes, planes, (*target.planes, target.normals), noise.plane),
        )
    ]
    least, along = TIMES_ON_SCAN * noise.least / noise.plane**2, np.ascontiguousarray(directions)
    limits = Limits(noise.weak_share, least, by_surfaces=True, directions=along)
    return optimise(Problem(terms, T_prior, annealing, limits, Correspondences(len(edges) + len(planes))))


def solve_on_map(
    target: FeatureMap,
    edges: Floats,
    planes: Floats,
    T_prior: Floats,
    annealing: Annealing,
    noise: FeatureNoise,
    *,
    scatter: Floats | None = None,
    levels: Sequence[GaussianMap] | None = None,
    inlier_ratio: float = 1.0,
    information: Floats | None = None,
) -> RegistrationResult:
    """Align edges (E, 3) and planar points (P, 3), LiDAR frame, with the feature map, starting at `T_prior` (4, 4).

    scatter : (P, 6) m2, of the points behind each planar point when that is a centroid
    levels : voxel sizes of the map's planes, finest first, each for points without a plane in finer ones; None: all
    inlier_ratio : share of the correspondences, the closest ones, that are used from the second step on
    information : (6, 6) of the start as a prior besides the features; None: it is only the initial guess
    """
    if scatter is None:
        scatter = np.zeros((len(planes), 6))
    lines, matches = target.edges, Correspondences(len(planes) + len(edges))
    on_lines = Term(
        linearise_lines,
        (edges,),
        (lines.moments, lines.keys, lines.table, *target.lines),
        (float(lines.size), float(noise.edge) ** 2, float(MIN_LINE_POINTS), FLOOR_M2),
        (*slots_of(len(edges)), matches.distance2[len(planes) :]),
    )
    on_planes = voxel_terms(PLANES_ALONE, (planes, scatter), levels or target.planes.levels, matches, noise.plane)
    limits = Limits(noise.weak_share, noise.least / noise.plane**2, unseen=1.0)
    prior = [] if information is None else [prior_term(T_prior, information)]
    terms = [on_lines, *on_planes, *prior]
    return optimise(Problem(terms, T_prior, annealing, limits, matches, inlier_ratio=inlier_ratio))


def remap_solution(result: RegistrationResult, T_prior: Floats) -> RegistrationResult:
    """Solution remapping (Zhang, Kaess and Singh 2016): the result at the prior (4, 4) along degenerate directions.

    Remapping the last step alone does not suffice: earlier ones with a wider kernel moved along such directions by outliers.
    """
    R, arm = result.T_world_lidar[:3, :3], result.lever_arm
    moved = np.concatenate([result.T_world_lidar[:3, 3] - T_prior[:3, 3], arm * so3.log(R @ T_prior[:3, :3].T)])
    false = result.degenerate.T @ (result.degenerate @ moved)
    pose = se3.make(so3.exp(-false[3:] / arm) @ R, result.T_world_lidar[:3, 3] - false[:3])
    return replace(result, T_world_lidar=se3.normalise(pose))


# `solve_on_scan` on one scan, as configured.
Align = Callable[..., RegistrationResult]
ScanStep = Callable[[Align, Features, Floats, StageClock], RegistrationResult]


def joint_step(align: Align, features: Features, T_prior: Floats, clock: StageClock) -> RegistrationResult:
    """Edges and planar points together, stage `scan`."""
    with clock.stage("scan"):
        return align(features.edges.points, features.planes.points, T_prior)


def two_steps(align: Align, features: Features, T_prior: Floats, clock: StageClock) -> RegistrationResult:
    """z, roll and pitch from planar points, stage `ground`; then x, y and yaw from edges, stage `edges`.

    LeGO-LOAM (Shan and Englot 2018), section IV-D. Axes are the sensor's at the prior. The covariance joins the two, since
    each step does not observe the other's directions.
    """
    upright = upright_directions(T_prior)
    with clock.stage("ground"):
        ground = align(NONE, features.planes.points, T_prior, upright)
    with clock.stage("edges"):
        level = np.eye(6) - upright
        edges = align(features.edges.points, NONE, ground.T_world_lidar, level)
    if ground.covariance is None or edges.covariance is None:
        covariance = None
    else:
        covariance = upright @ ground.covariance @ upright + level @ edges.covariance @ level
    return replace(
        edges,
        covariance=covariance,
        converged=ground.converged and edges.converged,
        iterations=ground.iterations + edges.iterations,
        source_points=ground.source_points + edges.source_points,
        matched=ground.matched + edges.matched,
        inliers=ground.inliers + edges.inliers,
        degenerate=np.concatenate([ground.degenerate, edges.degenerate]),
    )
