"""Drift that lasts is told by a map whose houses err one by one, and nothing is told where there is none."""

from dataclasses import replace

import numpy as np
import pytest
from graph_builders import ate, truth

from lslam.config.graph import GraphConfig
from lslam.geometry import se2, se3, so3
from lslam.graph.pose_graph import optimise
from lslam.graph.problem import PlanarPrior, PoseGraph
from lslam.graph.steady_drift import find_steady_drift, without_drift
from lslam.types.constraint import Constraint

COUNT = 100
REAL = truth(COUNT, 1)
WAY = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(REAL[:, :3, 3], axis=0), axis=1))])
START = np.array([0.5, 0.5, 0.02])
MAP = np.array([0.5, 0.5, np.radians(1.0)])
SHARP = np.diag([50.0, 50.0, 4e4])  # 0.14 m, 0.005 rad
HOUSES = 25
SEEDS = range(5)


def odometry(percent: float, degrees: float) -> PoseGraph:
    """The real way, which runs away by so much to the north-west and turns by so much per 100 m."""
    poses = [REAL[0]]
    for step, way in zip(se3.relative(REAL[:-1], REAL[1:]), np.diff(WAY), strict=True):
        pose = poses[-1] @ step
        pose[:3, :3] = so3.exp(np.array([0, 0, np.radians(degrees) / 100 * way])) @ pose[:3, :3]
        pose[:2, 3] += 0.01 * percent * way * np.array([-0.6, 0.8])
        poses.append(se3.normalise(pose))
    found = np.stack(poses)
    steps = se3.relative(found[:-1], found[1:])
    links = [Constraint(k, k + 1, step, np.diag([1e-6] * 3 + [1e-8] * 3), "odometry") for k, step in enumerate(steps)]
    return PoseGraph(found, links, distances=WAY, start_sigma=START, shift_sigma=2.0)


def on_map(graph: PoseGraph, seed: int, size: float, information: np.ndarray = SHARP) -> tuple[PoseGraph, np.ndarray]:
    """Matches with houses that are each off by `size` of what a map is believed to be; keyframes see four of them."""
    rng = np.random.default_rng(seed)
    errors = size * 2 * MAP * rng.standard_normal((HOUSES, 3))
    seen = np.zeros((COUNT, HOUSES))
    for k in range(COUNT):
        seen[k, (k * HOUSES // COUNT + np.arange(4)) % HOUSES] = 1.0
    places = se2.of_se3(REAL) + seen @ errors / 4 + 0.1 * size * MAP * rng.standard_normal((COUNT, 3))
    rank = int(np.linalg.matrix_rank(information))
    priors = [PlanarPrior(k, place, information, rank, 0.1) for k, place in enumerate(places)]
    return replace(graph, map_priors=priors), seen @ seen.T / 4


@pytest.mark.parametrize("seed", SEEDS)
def test_drift_is_taken_out_though_the_map_errs(seed: int) -> None:
    graph, shared = on_map(odometry(2.0, 1.0), seed, 0.5)
    rates = find_steady_drift(graph, shared, MAP, GraphConfig())
    assert rates is not None
    straight = without_drift(graph, rates)
    assert ate(straight.poses, REAL) < 0.4 * ate(graph.poses, REAL)
    # Odometry goes along: without the map it is what the poses say.
    alone = optimise(replace(straight, map_priors=()), GraphConfig())
    np.testing.assert_allclose(alone.poses, straight.poses, atol=1e-6)


def test_what_is_told_are_the_rates_themselves() -> None:
    graph, shared = on_map(odometry(1.0, 0.4), 0, 0.0)
    rates = find_steady_drift(graph, shared, MAP, GraphConfig())
    assert rates is not None
    mean = rates.mean(axis=0)
    np.testing.assert_allclose(mean[:2], [0.006, -0.008], atol=1.5e-3)
    assert mean[2] == pytest.approx(-np.radians(0.4) / 100, rel=0.25)


@pytest.mark.parametrize("size", [0.1, 0.5, 1.0])
def test_errors_of_the_map_are_no_drift(size: float) -> None:
    for seed in range(20):
        graph, shared = on_map(odometry(0.0, 0.0), seed, size)
        assert find_steady_drift(graph, shared, MAP, GraphConfig()) is None, seed


def test_walls_on_one_line_tell_no_drift_along_it() -> None:
    north = np.diag([0.0, 50.0, 4e4])
    graph, shared = on_map(odometry(2.0, 0.0), 1, 0.1, north)
    rates = find_steady_drift(graph, shared, MAP, GraphConfig())
    assert rates is not None
    assert np.abs(rates[:, 0]).max() < 0.2 * np.abs(rates[:, 1]).max()


def test_without_a_start_on_the_map_or_matches_nothing_is_told() -> None:
    graph, shared = on_map(odometry(2.0, 1.0), 0, 0.1)
    assert find_steady_drift(replace(graph, start_sigma=None), shared, MAP, GraphConfig()) is None
    alone = replace(graph, map_priors=graph.map_priors[:1])
    assert find_steady_drift(alone, shared[:1, :1], MAP, GraphConfig()) is None
