"""Scan to scan with features: all six directions at once (LOAM), or in two steps (LeGO-LOAM)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from lslam.core.types.arrays import Floats
from lslam.core.types.scan_result import StageClock
from lslam.odometry.feature_scan import FeatureScan
from lslam.odometry.feature_solver import NONE, FeatureNoise, solve_on_scan
from lslam.registration.alignment import upright_directions
from lslam.registration.preprocessing.features import Features
from lslam.registration.robust import Annealing
from lslam.registration.solver import RegistrationResult

ScanStep = Callable[[FeatureScan, Features, Floats, Annealing, FeatureNoise, bool, StageClock], RegistrationResult]


def joint_step(
    target: FeatureScan, features: Features, T_prior: Floats, annealing: Annealing, noise: FeatureNoise,
    one_to_many: bool, clock: StageClock,
) -> RegistrationResult:  # fmt: skip
    """Edges and planar points together, stage `scan`."""
    with clock.stage("scan"):
        return solve_on_scan(
            target, features.edges.points, features.planes.points, T_prior, annealing, noise, one_to_many=one_to_many
        )


def two_steps(
    target: FeatureScan, features: Features, T_prior: Floats, annealing: Annealing, noise: FeatureNoise,
    one_to_many: bool, clock: StageClock,
) -> RegistrationResult:  # fmt: skip
    """z, roll and pitch from planar points, stage `ground`; then x, y and yaw from edges, stage `edges`.

    LeGO-LOAM (Shan and Englot 2018), section IV-D. Axes are the sensor's at the prior. The covariance joins the two:
    each step is blind in the other's directions.
    """
    upright = upright_directions(T_prior)
    with clock.stage("ground"):
        ground = solve_on_scan(
            target, NONE, features.planes.points, T_prior, annealing, noise, one_to_many=one_to_many, allowed=upright
        )
    with clock.stage("edges"):
        level = np.eye(6) - upright
        edges = solve_on_scan(
            target, features.edges.points, NONE, ground.T_world_lidar, annealing, noise, one_to_many=one_to_many,
            allowed=level,
        )  # fmt: skip
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
