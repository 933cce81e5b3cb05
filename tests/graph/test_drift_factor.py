"""Fixes tell that odometry drifts, and chance among noisy ones does not."""

from __future__ import annotations

import numpy as np
from graph_builders import STEP_SIGMAS, ate, measured, truth

from lslam.config.graph import GraphConfig
from lslam.geometry import se3
from lslam.graph.drift import drift_factor
from lslam.graph.pose_graph import optimise, with_distances
from lslam.graph.problem import PoseGraph, PositionFix
from lslam.graph.rates import correct_drift
from lslam.types.constraint import Constraint

CONFIG = GraphConfig()
REAL = truth(200, 2)


def fixed(seed: int, noise: float, drift: float = 0.0) -> PoseGraph:
    """Odometry with noise, that runs away to the side by a share `drift` of the way, and a fix on every fourth keyframe."""
    rng = np.random.default_rng(seed)
    steps = measured(se3.relative(REAL[:-1], REAL[1:]), 0.05 * STEP_SIGMAS, rng)
    poses = [REAL[0]]
    for step in steps:
        poses.append(se3.normalise(poses[-1] @ step))
    covariance = np.diag((0.05 * STEP_SIGMAS) ** 2)
    odometry = [Constraint(k, k + 1, step, covariance, "odometry") for k, step in enumerate(steps)]
    places = REAL[:, :3, 3] + noise * rng.normal(size=(len(REAL), 3))
    fixes = [PositionFix(k, places[k], np.full(3, noise), np.zeros(3)) for k in range(0, len(REAL), 4)]
    graph = with_distances(PoseGraph(np.stack(poses), odometry, fixes=fixes, is_anchored=False))
    return correct_drift(graph, np.tile([0.0, drift, 0.0, 0.0, 0.0, 0.0], (len(steps), 1)))


def test_noise_of_fixes_is_no_drift() -> None:
    """What explained by drift that fixes of 5 m are a little farther off than most would take centimetres for metres."""
    for seed in range(12):
        graph = fixed(seed, 5.0)
        assert drift_factor(graph, [], CONFIG) == 0.0, seed
    solution = optimise(graph, CONFIG)
    shape = se3.relative(solution.poses[0], solution.poses)
    assert ate(shape, se3.relative(REAL[0], REAL)) < 0.05


def test_fixes_still_tell_drift() -> None:
    for seed in range(6):
        assert drift_factor(fixed(seed, 0.5, 0.01), [], CONFIG) > 1.0
        assert drift_factor(fixed(seed, 5.0, 0.1), [], CONFIG) > 1.0
