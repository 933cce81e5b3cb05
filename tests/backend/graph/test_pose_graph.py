"""Graphs with known truth: loops correct drift, wrong ones are rejected, covariances are consistent."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from graph_builders import LOOP_SIGMAS, ate, graph_of, measured, truth

from lslam.backend.graph.pose_graph import optimise
from lslam.backend.graph.problem import FloorPlane, PlanarPrior, PoseGraph, PositionFix, UpDirection
from lslam.core.config.backend import GraphConfig
from lslam.core.errors import GraphError
from lslam.core.geometry import se3, so3
from lslam.core.types.constraint import Constraint, Turn

LAPS = 6
REAL = truth(240, LAPS)


def errors(poses: np.ndarray, real: np.ndarray) -> np.ndarray:
    """(K, 6) d of t' = t + d[:3], R' = exp(d[3:]) R from truth to estimate."""
    turn = so3.log(poses[:, :3, :3] @ np.swapaxes(real[:, :3, :3], -1, -2))
    return np.concatenate([poses[:, :3, 3] - real[:, :3, 3], turn], axis=1)


def test_loops_take_the_drift_away() -> None:
    graph = graph_of(REAL, 80, 0, np.random.default_rng(1), LAPS)
    solution = optimise(graph, GraphConfig())
    assert ate(solution.poses, REAL) < 0.2 * ate(graph.poses, REAL)
    assert solution.loop_reasons == [""] * 80
    np.testing.assert_allclose(solution.poses[0], graph.poses[0], atol=1e-3)


@pytest.mark.parametrize("settings", [{}, {"is_pairwise": False}, {"optimizer": "dogleg"}, {"optimizer": "isam2"}])
def test_a_third_of_wrong_loops_changes_little(settings: dict[str, object]) -> None:
    rng = np.random.default_rng(2)
    graph = graph_of(REAL, 90, 27, rng, LAPS)
    right = optimise(replace(graph, loops=graph.loops[:63]), GraphConfig())
    solution = optimise(graph, GraphConfig.model_validate(settings))
    refused = np.array([bool(reason) for reason in solution.loop_reasons])
    assert refused[63:].all()
    assert refused[:63].sum() <= 2
    assert ate(solution.poses, REAL) < 1.2 * ate(right.poses, REAL)
    assert set(np.array(solution.loop_stages)[refused]) <= {"consistency", "graph"}


def test_without_robustness_they_spoil_everything() -> None:
    graph = graph_of(REAL, 90, 27, np.random.default_rng(2), LAPS)
    blind = optimise(graph, GraphConfig(robust="none", is_pairwise=False))
    assert ate(blind.poses, REAL) > 5 * ate(optimise(graph, GraphConfig()).poses, REAL)
    assert blind.loop_reasons == [""] * 90


@pytest.mark.parametrize("robust", ["huber", "cauchy"])
def test_estimators_bend_less_than_least_squares(robust: str) -> None:
    graph = graph_of(REAL, 90, 9, np.random.default_rng(3), LAPS)
    config = {"is_pairwise": False}
    bent = optimise(graph, GraphConfig.model_validate({**config, "robust": robust}))
    blind = optimise(graph, GraphConfig.model_validate({**config, "robust": "none"}))
    assert ate(bent.poses, REAL) < 0.5 * ate(blind.poses, REAL)
    assert all(bent.loop_reasons[-9:])


def test_covariances_are_as_large_as_errors_are(monkeypatch: pytest.MonkeyPatch) -> None:
    """Normalised squared errors over simulated graphs, per degree of freedom, are 1 on average."""
    for module in ("pose_graph", "drift", "loop_drift", "solve"):
        monkeypatch.setattr(f"lslam.backend.graph.{module}.RIGHT_PROBABILITY", 0.999999)
    ratios = []
    for seed in range(12):
        graph = graph_of(REAL[:120], 25, 0, np.random.default_rng(seed), 3)
        solution = optimise(graph, GraphConfig())
        d = errors(solution.poses, REAL[:120])[20::20]
        ratios += [float(e @ np.linalg.solve(S, e)) / 6 for e, S in zip(d, solution.covariances[20::20], strict=True)]
    assert 0.6 < np.mean(ratios) < 1.5


def test_odometry_that_thinks_too_well_of_itself_is_found_out() -> None:
    rng = np.random.default_rng(5)
    graph = graph_of(REAL, 80, 0, rng, LAPS, believed=1e-4)
    solution = optimise(graph, GraphConfig())
    assert optimise(graph_of(REAL, 80, 0, np.random.default_rng(5), LAPS), GraphConfig()).drift == 0
    assert solution.drift > 0.1
    assert ate(solution.poses, REAL) < 0.35 * ate(graph.poses, REAL)


def test_a_loop_closure_between_far_places_is_not_accepted_alone() -> None:
    """One loop has no other to contradict it, but odometry cannot have drifted so far."""
    graph = graph_of(REAL, 0, 0, np.random.default_rng(6), LAPS)
    wrong = Constraint(0, 20, se3.exp(np.array([0.5, 0.0, 0, 0, 0, 0])), np.diag(LOOP_SIGMAS**2))
    solution = optimise(replace(graph, loops=[wrong]), GraphConfig())
    assert "odometry" in solution.loop_reasons[0]
    np.testing.assert_allclose(solution.poses, graph.poses, atol=1e-6)


def test_fixes_place_the_graph_and_wrong_ones_are_left_out() -> None:
    """An unanchored graph starts where a rough alignment put it; 1 m noise, a fifth of the fixes 30 m off."""
    rng = np.random.default_rng(7)
    graph = graph_of(REAL, 0, 0, rng, LAPS)
    arm = np.array([-0.9, 0.2, 0.4])
    fixes = []
    for k in range(0, 240, 2):
        position = REAL[k, :3, :3] @ arm + REAL[k, :3, 3] + rng.normal(size=3)
        fixes.append(PositionFix(k, position + (30.0 if k % 10 == 0 else 0.0), np.full(3, 1.0), arm))
    rough = se3.exp(np.array([1.0, -1.0, 0.5, 0.0, 0.0, 0.03])) @ graph.poses
    solution = optimise(replace(graph, poses=rough, fixes=fixes, is_anchored=False), GraphConfig())
    np.testing.assert_array_equal(solution.fix_inliers, [k % 10 != 0 for k in range(0, 240, 2)])
    assert ate(solution.poses, REAL) < 0.7 < ate(rough, REAL)


def test_up_directions_level_the_graph() -> None:
    rng = np.random.default_rng(8)
    graph = graph_of(REAL, 0, 0, rng, LAPS)
    sigma = 0.002
    ups = [
        UpDirection(k, measured(REAL[k], np.array([0, 0, 0, sigma, sigma, sigma]), rng)[2, :3], sigma)
        for k in range(240)
    ]
    solution = optimise(replace(graph, ups=ups), GraphConfig())
    before, after = errors(graph.poses, REAL), errors(solution.poses, REAL)
    assert np.abs(after[:, 3:5]).max() < 0.3 * np.abs(before[:, 3:5]).max()
    assert np.abs(after[:, 2]).max() < 0.7 * np.abs(before[:, 2]).max()


@pytest.mark.parametrize(("is_doubtful", "x"), [(True, 0.4), (False, 0.0)])
def test_a_start_that_is_doubted_moves_though_up_is_seen(is_doubtful: bool, x: float) -> None:
    """A map puts all poses 0.4 m ahead; where nothing doubts the first one it stays, whatever gravity does to the tilt."""
    poses = np.tile(np.eye(4), (3, 1, 1))
    poses[:, 0, 3] = 10.0 * np.arange(3)
    steps = [Constraint(k, k + 1, se3.relative(poses[k], poses[k + 1]), 1e-6 * np.eye(6)) for k in range(2)]
    priors = [PlanarPrior(k, np.array([10.0 * k + 0.4, 0.0, 0.0]), 1e4 * np.eye(3), 3) for k in range(3)]
    graph = PoseGraph(
        poses,
        steps,
        ups=[UpDirection(k, np.array([0.0, 0.0, 1.0]), 0.01) for k in range(3)],
        distances=poses[:, 0, 3],
        map_priors=priors,
        start_sigma=np.array([5.0, 5.0, 0.1]) if is_doubtful else None,
        shift_sigma=1e-4 if is_doubtful else 5.0,
        map_sigma=1e-3,
    )
    solution = optimise(graph, GraphConfig())
    np.testing.assert_allclose(solution.poses[:, 0, 3], x + 10.0 * np.arange(3), atol=0.01)
    np.testing.assert_allclose(solution.poses[:, 1:3, 3], 0.0, atol=1e-3)


def test_gravity_bends_no_trajectory_to_a_first_guess_of_it() -> None:
    """Straight on for 200 m in a world that is two degrees askew, as all the keyframes feel: it was the guess that was wrong."""
    poses = np.tile(np.eye(4), (21, 1, 1))
    poses[:, 0, 3] = 10.0 * np.arange(21)
    loose = np.diag([1e-4] * 3 + [1e-4] * 3)
    steps = [Constraint(k, k + 1, se3.relative(poses[k], poses[k + 1]), loose) for k in range(20)]
    up = so3.exp(np.deg2rad([1.2, 1.6, 0.0]))[:, 2]
    graph = PoseGraph(poses, steps, ups=[UpDirection(k, up, 0.002) for k in range(21)])
    np.testing.assert_allclose(optimise(graph, GraphConfig()).poses, poses, atol=1e-3)


def test_inliers_make_poses_surer_where_up_is_measured_too() -> None:
    """Two steps of 0.1 m and a loop of 0.05 m: along the way 1 / (1 / 0.02 + 1 / 0.0025) m2, and 0.02 beside a wrong loop."""
    poses = np.tile(np.eye(4), (3, 1, 1))
    poses[:, 0, 3] = 10.0 * np.arange(3)
    own, loop = (np.diag([s**2] * 3 + [1e-8] * 3) for s in (0.1, 0.05))
    steps = [Constraint(k, k + 1, se3.relative(poses[k], poses[k + 1]), own) for k in range(2)]
    ups = [UpDirection(k, np.array([0.0, 0.0, 1.0]), 0.01) for k in range(3)]
    for off, variance in ((0.0, 1 / 450), (5.0, 0.02)):
        T = se3.make(np.eye(3), np.array([20.0 + off, 0, 0]))
        graph = PoseGraph(poses, steps, [Constraint(0, 2, T, loop)], ups=ups, distances=poses[:, 0, 3])
        solution = optimise(graph, GraphConfig(drift_percent=1e-6, drift_deg_per_100m=1e-6))
        assert solution.covariances[2, 0, 0] == pytest.approx(variance, rel=0.02)


def test_turns_hold_the_heading() -> None:
    rng = np.random.default_rng(9)
    graph = graph_of(REAL, 0, 0, rng, LAPS)
    turns = [Turn(k, k + 1, (se3.inverse(REAL[k]) @ REAL[k + 1])[:3, :3], 1e-5) for k in range(239)]
    solution = optimise(replace(graph, turns=turns), GraphConfig())
    assert np.abs(errors(solution.poses, REAL)[:, 3:]).max() < 0.1 * np.abs(errors(graph.poses, REAL)[:, 3:]).max()


def test_one_floor_keeps_the_height() -> None:
    """On flat ground 1.7 m below the sensor."""
    rng = np.random.default_rng(10)
    flat = REAL.copy()
    flat[:, 2, 3] = 0
    yaw = so3.euler_rpy(flat[:, :3, :3])[:, 2]
    flat[:, :3, :3] = so3.from_euler_rpy(np.column_stack([0 * yaw, 0 * yaw, yaw]))
    graph = graph_of(se3.inverse(flat[0]) @ flat, 0, 0, rng, LAPS)
    floors = [
        FloorPlane(k, np.array([0.0, 0.0, 1.0]), 1.7 + 0.02 * rng.normal(), 0.005, 0.05) for k in range(0, 240, 3)
    ]
    solution = optimise(replace(graph, floors=floors), GraphConfig(optimizer="isam2"))
    assert np.abs(solution.poses[:, 2, 3]).max() < 0.15 < np.abs(graph.poses[:, 2, 3]).max()


def broken(name: str) -> PoseGraph:
    graph = graph_of(REAL[:20], 0, 0, np.random.default_rng(11), 2)
    steps = list(graph.odometry)
    if name == "pieces":
        return replace(graph, odometry=steps[:9] + steps[10:])
    if name == "empty":
        return replace(graph, poses=graph.poses[:0], odometry=[])
    if name == "infinite":
        return replace(graph, odometry=[*steps[:-1], replace(steps[-1], covariance=np.full((6, 6), np.nan))])
    if name == "pose":
        return replace(graph, poses=np.where(np.arange(20)[:, None, None] == 3, np.nan, graph.poses))
    return replace(graph, loops=[Constraint(3, 99, np.eye(4), np.eye(6))])


@pytest.mark.parametrize(
    ("name", "said"),
    [
        ("pieces", "keyframe 10"),
        ("empty", "no keyframes"),
        ("infinite", "not finite"),
        ("pose", "not finite"),
        ("loop", "99"),
    ],
)
def test_a_graph_without_a_solution_is_an_error_that_says_why(name: str, said: str) -> None:
    with pytest.raises(GraphError, match=said):
        optimise(broken(name), GraphConfig())


def test_covariances_that_are_zero_do_not_stop_it() -> None:
    graph = graph_of(REAL[:20], 0, 0, np.random.default_rng(12), 2)
    sure = replace(graph, odometry=[replace(c, covariance=np.zeros((6, 6))) for c in graph.odometry])
    np.testing.assert_allclose(optimise(sure, GraphConfig()).poses, graph.poses, atol=1e-9)


def test_same_input_same_bytes() -> None:
    graph = graph_of(REAL, 60, 10, np.random.default_rng(13), LAPS)
    first, second = optimise(graph, GraphConfig()), optimise(graph, GraphConfig())
    assert first.poses.tobytes() == second.poses.tobytes()
    assert first.covariances.tobytes() == second.covariances.tobytes()
