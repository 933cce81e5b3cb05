"""The drift factor by fixes and loops: it is found where there is drift, and not where there is noise alone."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from graph_builders import STEP_SIGMAS, ate, graph_of, measured, truth

from lslam.backend.graph.drift import correct_drift, drift_factor, with_drift
from lslam.backend.graph.pose_graph import optimise, with_distances
from lslam.backend.graph.problem import PoseGraph, PositionFix
from lslam.core.config.backend import GraphConfig
from lslam.core.geometry import se3, so3
from lslam.core.types.constraint import Constraint

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


def test_drift_is_estimated_from_accurate_and_from_noisy_fixes() -> None:
    for seed in range(6):
        assert drift_factor(fixed(seed, 0.5, 0.01), [], CONFIG) > 1.0
        assert drift_factor(fixed(seed, 5.0, 0.1), [], CONFIG) > 1.0


def test_by_the_identity_covariances_stay_as_they_are_given() -> None:
    graph = graph_of(REAL, 40, 0, np.random.default_rng(0), 2, believed=1e-4)
    assert optimise(graph, CONFIG).drift > 0
    assert optimise(graph, GraphConfig(information="identity")).drift == 0


@pytest.mark.parametrize("factor", [0.0, 0.25, 1.0, 4.0])
def test_drift_is_a_walk_beside_what_odometry_says(factor: float) -> None:
    """A hundred steps of a metre: 2 % per root metre are 20 cm, half a degree per hundred metres 0.05 deg, at factor 1."""
    own = np.diag([1e-4] * 3 + [1e-6] * 3)
    steps = [Constraint(k, k + 1, se3.make(np.eye(3), np.array([0.6, 0.0, -0.8])), own) for k in range(100)]
    config = GraphConfig(drift_percent=2.0, drift_deg_per_100m=0.5)
    grown = with_drift(PoseGraph(np.tile(np.eye(4), (101, 1, 1)), steps), factor, config)
    sums = [np.sum([c.covariance for c in each], axis=0) for each in (steps, grown)]
    drift = np.diag(np.repeat([0.2**2, np.deg2rad(0.05) ** 2], 3))
    np.testing.assert_allclose(sums[1], sums[0] + factor * drift, rtol=1e-12, atol=1e-18)


def test_drift_estimated_by_loops_does_not_depend_on_the_frame_of_the_world() -> None:
    """Odometry that thinks ten times too well of itself, and loops that know where they are along their way, not across."""
    graph = graph_of(REAL, 30, 0, np.random.default_rng(6), 2, 0.01)
    loops = [replace(c, covariance=np.diag([1e-4, 1.0, 1.0, 1e-6, 1e-2, 1e-2])) for c in graph.loops]
    found = []
    for turn in ([0.0, 0.0, 0.0], [0.3, -0.4, 2.0], [0.0, 2.5, 0.5]):
        T = se3.make(so3.exp(np.array(turn)), np.array([50.0, -20.0, 5.0]))
        found.append(drift_factor(replace(graph, poses=T @ graph.poses), loops, CONFIG))
    assert found[0] > 0
    np.testing.assert_allclose(found, found[0], rtol=0.02)
