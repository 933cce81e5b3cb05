"""A pose graph with planar priors: x, y and yaw only, along observed directions only, with a common shift of the map."""

from dataclasses import replace

import numpy as np
import pytest
from graph_builders import graph_of, truth

from lslam.backend.graph import factors
from lslam.backend.graph.drift import drift_factor
from lslam.backend.graph.marginals import marginal_blocks, scaled_blocks
from lslam.backend.graph.pose_graph import optimise
from lslam.backend.graph.problem import PlanarPrior, PoseGraph, PositionFix
from lslam.backend.graph.solve import join_factors
from lslam.core.config.backend import GraphConfig
from lslam.core.geometry import se2, se3
from lslam.core.types.constraint import Constraint

REAL = truth(120, 1)
SHARP = np.diag([100.0, 100.0, 1e4])  # 0.1 m, 0.01 rad
ANYWHERE = np.array([10.0, 10.0, 0.5])


def held(seed: int, every: int = 2, information: np.ndarray = SHARP, rank: int = 3) -> PoseGraph:
    """Noisy odometry from the true start, and the true place of every second keyframe."""
    graph = graph_of(REAL, 0, 0, np.random.default_rng(seed), 1)
    priors = [PlanarPrior(k, se2.of_se3(REAL[k]), information, rank) for k in range(0, len(REAL), every)]
    return replace(graph, map_priors=priors, start_sigma=ANYWHERE)


def off(poses: np.ndarray, real: np.ndarray = REAL) -> np.ndarray:
    error = se2.of_se3(poses) - se2.of_se3(real)
    error[:, 2] = se2.wrap(error[:, 2])
    return np.abs(error)


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_planar_priors_bound_position_and_heading(seed: int) -> None:
    graph = held(seed)
    solution = optimise(graph, GraphConfig())
    assert off(graph.poses)[:, :2].max() > 0.4
    assert off(solution.poses)[:, :2].max() < 0.15
    assert off(solution.poses)[:, 2].max() < 0.01
    assert solution.map_reasons == [""] * len(graph.map_priors)


def test_planar_priors_do_not_constrain_height_and_tilt() -> None:
    """Twenty metres up everything is the same but the height; a tilt of the whole stays, where the plan allows it."""
    graph = held(4)
    low = optimise(graph, GraphConfig()).poses
    up = np.array([0.0, 0.0, 20.0])
    lifted = se3.make(np.eye(3), up) @ graph.poses
    high = optimise(replace(graph, poses=lifted), GraphConfig()).poses
    np.testing.assert_allclose(high[:, :3, 3] - up, low[:, :3, 3], atol=1e-4)
    np.testing.assert_allclose(high[:, :3, :3], low[:, :3, :3], atol=1e-6)
    tilted = optimise(replace(graph, poses=se3.exp(np.array([0, 0, 0, 0.05, 0, 0])) @ graph.poses), GraphConfig()).poses
    assert abs(tilted[0, 2, 1] - np.sin(0.05)) < 1e-3


def test_a_lone_wall_leaves_the_way_along_it_free() -> None:
    """Walls that run east fix the northing and the heading; nothing pulls on the easting, whatever the match said."""
    graph = held(5)
    east = np.array([1.0, 0.0, 0.0])
    wall = np.diag([0.0, 100.0, 1e4])
    priors = [PlanarPrior(k, se2.of_se3(REAL[k]) + 5 * east, wall, 2) for k in range(0, 120, 2)]
    solution = optimise(replace(graph, map_priors=priors, start_sigma=np.array([1e-3, 10.0, 0.5])), GraphConfig())
    assert off(solution.poses)[:, 1].max() < 0.15
    assert off(solution.poses)[:, 0].max() < 1.5
    assert abs(solution.poses[0, 0, 3] - graph.poses[0, 0, 3]) < 1e-3


def test_a_shift_of_the_map_does_not_move_a_known_start() -> None:
    graph = held(6)
    shift = np.array([1.5, -2.0])
    priors = [replace(p, pose=p.pose - [*shift, 0.0]) for p in graph.map_priors]
    known = replace(graph, map_priors=priors, start_sigma=np.full(3, 1e-3))
    free = optimise(replace(known, shift_sigma=2.0), GraphConfig())
    assert np.abs(free.shift - shift).max() < 0.2
    assert (free.shift_sigma < 0.2).all()
    assert off(free.poses)[:, :2].max() < 0.3
    rigid = optimise(replace(known, shift_sigma=0.0), GraphConfig())
    assert np.abs(rigid.shift).max() < 1e-3
    assert off(rigid.poses)[60:, :2].max() > 1.0


def test_start_and_map_are_weighted_by_their_covariances() -> None:
    """The start is said to be 1.3 m beside where the map puts it: of one metre's sigma against the map's two."""
    graph = held(6)
    begun = se2.of_se3(REAL[0]) + np.array([1.2, -0.5, 0.0])
    told = replace(graph, start=begun, start_sigma=np.array([1.0, 1.0, 0.5]))
    shared = optimise(replace(told, shift_sigma=2.0), GraphConfig())
    np.testing.assert_allclose(shared.shift, 0.8 * np.array([1.2, -0.5]), atol=0.08)
    trusted = optimise(told, GraphConfig())
    assert off(trusted.poses)[:, :2].max() < 0.15


def test_a_match_with_the_wrong_house_is_rejected() -> None:
    graph = held(7)
    wrong = [5, 20, 41]
    priors = [
        replace(p, pose=p.pose + np.array([4.0, 0.0, 0.1])) if i in wrong else p for i, p in enumerate(graph.map_priors)
    ]
    solution = optimise(replace(graph, map_priors=priors), GraphConfig())
    assert [i for i, reason in enumerate(solution.map_reasons) if reason] == wrong
    assert off(solution.poses)[:, :2].max() < 0.15


def test_a_share_of_a_match_counts_that_much() -> None:
    pose = REAL[30]
    whole = PlanarPrior(30, np.add(se2.of_se3(pose), [0.4, -0.3, 0.02]), SHARP, 3)
    graph = replace(held(1), map_priors=[whole])
    values = factors.start_values(graph, REAL)
    errors = [
        factors.planar(replace(whole, share=share), pose, factors.map_key(graph), scale).error(values)
        for share, scale in ((1.0, 1.0), (0.25, 1.0), (1.0, 4.0))
    ]
    assert errors[0] == pytest.approx(0.5 * (0.4**2 * 100 + 0.3**2 * 100 + 0.02**2 * 1e4), rel=0.02)
    np.testing.assert_allclose(errors[1:], errors[0] / 4, rtol=1e-9)


@pytest.mark.parametrize("seed", range(4))
def test_errors_of_the_map_are_not_attributed_to_drift(seed: int) -> None:
    graph = held(seed)
    rng = np.random.default_rng(seed)
    drawn = [replace(p, pose=np.add(p.pose, [*rng.normal(0, 0.5, 2), 0.0])) for p in graph.map_priors]
    sure, doubtful = (replace(graph, map_priors=drawn, map_sigma=sigma) for sigma in (0.0, 0.7))
    assert drift_factor(sure, [], GraphConfig()) > 0
    assert drift_factor(doubtful, [], GraphConfig()) == 0


def test_two_matches_with_the_map_seldom_say_that_odometry_drifts() -> None:
    graph, rng = held(0), np.random.default_rng(3)
    factors = []
    for _ in range(100):
        ends = [graph.map_priors[0], graph.map_priors[-1]]
        drawn = [replace(p, pose=np.add(p.pose, [*rng.normal(0, 0.7, 2), 0.0])) for p in ends]
        factors.append(drift_factor(replace(graph, map_priors=drawn, map_sigma=0.7), [], GraphConfig()))
    assert np.count_nonzero(factors) < 5


def test_it_comes_to_the_same_keyframe_by_keyframe() -> None:
    graph = held(8)
    at_once = optimise(graph, GraphConfig())
    in_turn = optimise(graph, GraphConfig(optimizer="isam2"))
    np.testing.assert_allclose(in_turn.poses, at_once.poses, atol=2e-3)


def test_covariances_do_not_depend_on_how_they_are_had() -> None:
    """The scaled normal equations against gtsam's elimination; the frame of the map is the last of the unknowns."""
    graph = held(9)
    values = factors.start_values(graph, graph.poses)
    whole = join_factors(
        factors.fixed_part(replace(graph, start_sigma=np.full(3, 0.1), shift_sigma=1.0)),
        [factors.planar(p, graph.poses[p.keyframe], factors.map_key(graph)) for p in graph.map_priors],
    )
    keys = [0, 40, 119, factors.map_key(graph)]
    by_gtsam = marginal_blocks(whole, values, keys)
    by_scaling = scaled_blocks(whole, values, keys)
    np.testing.assert_allclose(by_scaling, by_gtsam, rtol=1e-4, atol=1e-9)


def test_a_straight_path_with_unobserved_roll_has_covariances() -> None:
    """gtsam's elimination gives up here: odometry to 0.1 mm, and a first pose of which little is known."""
    poses = np.tile(np.eye(4), (20, 1, 1))
    poses[:, 0, 3] = 2.0 * np.arange(20)
    covariance = np.diag(np.repeat([1e-8, 4e-10], 3))
    steps = [Constraint(k, k + 1, se3.relative(poses[k], poses[k + 1]), covariance, "odometry") for k in range(19)]
    fixes = [PositionFix(k, poses[k, :3, 3], np.full(3, 1.0), np.zeros(3)) for k in range(0, 20, 3)]
    solution = optimise(PoseGraph(poses, steps, fixes=fixes, is_anchored=False), GraphConfig())
    sigma = np.sqrt(np.diagonal(solution.covariances, axis1=1, axis2=2))
    assert (np.abs(sigma[:, 3] - 3.0) < 0.1).all()  # as it was held
    assert (sigma[:, 1] < 1.0).all()
