"""Constant drift is estimated by sightings of walls, whatever the accuracy of the map, and none where there is none."""

from dataclasses import replace

import numpy as np
import pytest
from graph_builders import ate, truth

from lslam.backend.graph.pose_graph import optimise
from lslam.backend.graph.problem import PlanarPrior, PoseGraph
from lslam.core.config.backend import GraphConfig
from lslam.core.geometry import se2, se3, so3
from lslam.core.types.constraint import Constraint
from lslam.osm.wall_drift import WallDrift, WallSightings, find_wall_drift, without_drift

COUNT = 100
REAL = truth(COUNT, 1)
WAY = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(REAL[:, :3, 3], axis=0), axis=1))])
START = np.array([0.5, 0.5, 0.02])
SEEN, MAP = 0.3, 1.0  # m, as the configuration has them
WALLS, RANGE = 90, 30.0
SEEDS = range(5)


def odometry(percent: float, degrees: float) -> PoseGraph:
    """The real way, which runs away by so much to the north-west and turns by so much per 100 m."""
    return run_away(np.tile([-0.006 * percent, 0.008 * percent, np.radians(degrees) / 100], (COUNT - 1, 1)))


def wandering(seed: int, percent: float, degrees: float, memory: float) -> PoseGraph:
    """The same with rates drawn anew along the way, forgotten over `memory` m; percent to either side, rms."""
    rng = np.random.default_rng([seed, 7])
    rates = [rng.standard_normal(3)]
    for way in np.diff(WAY)[1:]:
        kept = np.exp(-way / memory)
        rates.append(kept * rates[-1] + np.sqrt(1.0 - kept**2) * rng.standard_normal(3))
    return run_away(np.array(rates) * [0.01 * percent, 0.01 * percent, np.radians(degrees) / 100])


def run_away(rates: np.ndarray) -> PoseGraph:
    """The real way with errors at `rates` (K-1, 3) per m: m to the east and north, rad to the left."""
    poses = [REAL[0]]
    for step, way, rate in zip(se3.relative(REAL[:-1], REAL[1:]), np.diff(WAY), rates, strict=True):
        pose = poses[-1] @ step
        pose[:3, :3] = so3.exp(np.array([0, 0, rate[2] * way])) @ pose[:3, :3]
        pose[:2, 3] += rate[:2] * way
        poses.append(se3.normalise(pose))
    found = np.stack(poses)
    steps = se3.relative(found[:-1], found[1:])
    links = [Constraint(k, k + 1, step, np.diag([1e-6] * 3 + [1e-8] * 3), "odometry") for k, step in enumerate(steps)]
    return PoseGraph(found, links, distances=WAY, start_sigma=START, shift_sigma=2.0)


def sighted(graph: PoseGraph, seed: int, size: float, facing: float | None = None) -> WallSightings:
    """Walls on either side of the way, each drawn wrong by about `size` m, seen to 4 cm; one in twenty is another's.

    facing : rad, where all of them look; any way by default
    """
    rng = np.random.default_rng(seed)
    places = REAL[rng.integers(0, COUNT, WALLS), :2, 3] + rng.uniform(-15, 15, (WALLS, 2))
    angles = rng.uniform(-np.pi, np.pi, WALLS) if facing is None else np.full(WALLS, facing)
    normals = np.column_stack([np.cos(angles), np.sin(angles)])
    drawn = size * rng.standard_normal(WALLS)
    away = np.linalg.norm(places[None] - REAL[:, None, :2, 3], axis=2)
    keyframes, walls = np.nonzero(away < RANGE)
    noise = 0.04 * rng.standard_normal(len(walls)) + rng.choice([0.0, 1.5], len(walls), p=[0.95, 0.05])
    real, told = se2.of_se3(REAL)[keyframes], se2.of_se3(graph.poses)[keyframes]
    seen = np.array([
        se2.apply(p, se2.apply(se2.inverse(r), place[None]))[0]
        for p, r, place in zip(told, real, places[walls] + noise[:, None] * normals[walls], strict=True)
    ])  # fmt: skip
    off = np.einsum("ni,ni->n", normals[walls], seen - places[walls]) + drawn[walls]
    return WallSightings(keyframes, walls, normals[walls], seen, off, 1.0)


def found(graph: PoseGraph, seen: WallSightings) -> WallDrift | None:
    return find_wall_drift(graph, seen, SEEN, MAP, GraphConfig())


@pytest.mark.parametrize("size", [0.1, 1.0])
@pytest.mark.parametrize("seed", SEEDS)
def test_drift_is_corrected_on_a_perturbed_map(seed: int, size: float) -> None:
    graph = odometry(2.0, 1.0)
    drift = found(graph, sighted(graph, seed, size))
    assert drift is not None
    assert drift.is_sure
    assert not drift.estimated_drift.is_varying
    assert not drift.is_final
    straight = without_drift(graph, drift.rates)
    assert ate(straight.poses, REAL) < 0.1 * ate(graph.poses, REAL)
    # Odometry goes along: without the map it is what the poses say.
    alone = optimise(straight, GraphConfig())
    np.testing.assert_allclose(alone.poses, straight.poses, atol=1e-6)


def test_the_reported_rates_are_those_of_the_drift() -> None:
    graph = odometry(1.0, 0.4)
    drift = found(graph, sighted(graph, 0, 0.5))
    assert drift is not None
    mean = drift.rates.mean(axis=0)
    np.testing.assert_allclose(mean[:2], [0.006, -0.008], atol=1e-3)
    assert mean[2] == pytest.approx(-np.radians(0.4) / 100, rel=0.15)
    for _ in range(3):
        graph = without_drift(graph, drift.rates)
        drift = found(graph, sighted(graph, 0, 0.5))
        assert drift is not None
    assert drift.is_final
    assert not drift.is_sure


def test_downweighted_sightings_give_the_same_rates_with_larger_sigmas() -> None:
    graph = odometry(1.0, 0.4)
    seen = sighted(graph, 0, 0.5)
    once, fifth = found(graph, seen), found(graph, replace(seen, share=0.2))
    assert once is not None
    assert fifth is not None
    np.testing.assert_array_equal(fifth.rates, once.rates)
    ratio = fifth.spread[-1][[0, 1, 5], [0, 1, 5]] / once.spread[-1][[0, 1, 5], [0, 1, 5]]
    assert (ratio > 2.0).all()
    assert (ratio < 5.1).all()


@pytest.mark.parametrize("size", [0.1, 1.0])
def test_errors_of_the_map_are_no_drift(size: float) -> None:
    graph = odometry(0.0, 0.0)
    for seed in range(20):
        drift = found(graph, sighted(graph, seed, size))
        assert drift is not None
        assert not drift.is_sure, seed
        assert drift.estimated_drift.gain < 0.0, "not even likelier"


def test_drift_along_parallel_walls_is_not_observed() -> None:
    graph = odometry(2.0, 0.0)
    drift = found(graph, sighted(graph, 1, 0.1, np.pi / 2))
    assert drift is not None
    assert np.abs(drift.rates[:, 0]).max() < 0.2 * np.abs(drift.rates[:, 1]).max()


def test_without_a_start_a_path_or_walls_there_is_no_estimate() -> None:
    graph = odometry(2.0, 1.0)
    seen = sighted(graph, 0, 0.1)
    assert found(replace(graph, start_sigma=None), seen) is None
    assert found(replace(graph, distances=np.zeros(COUNT)), seen) is None
    none = WallSightings(seen.keyframes[:0], seen.walls[:0], seen.normals[:0], seen.places[:0], seen.offsets[:0], 1.0)
    assert found(graph, none) is None


def unsure(drift: WallDrift, straight: PoseGraph) -> float:
    """Normalised squared error a coordinate, of the poses but for the first ones."""
    error = se2.of_se3(straight.poses) - se2.of_se3(REAL)
    error[:, 2] = se2.wrap(error[:, 2])
    planar = drift.spread[:, [[0], [1], [5]], [0, 1, 5]]
    return float(np.einsum("ki,kij,kj->k", error[10:], np.linalg.inv(planar[10:]), error[10:]).mean() / 3)


def test_the_covariances_of_poses_follow_from_those_of_the_rates() -> None:
    """Over drifts and maps."""
    squared = []
    for seed in range(12):
        rng = np.random.default_rng(100 + seed)
        graph = odometry(*rng.uniform([1.5, -2.0], [4.0, 2.0]))
        drift = found(graph, sighted(graph, seed, 0.7))
        assert drift is not None
        squared.append(unsure(drift, without_drift(graph, drift.rates)))
        assert not drift.spread[0].any(), "the start is not unsure for that"
        assert not drift.spread[:, 2:5].any(), "from above nothing is said of height, roll and pitch"
    assert 0.3 < np.mean(squared) < 3.0


@pytest.mark.parametrize("memory", [20.0, 50.0])
def test_wandering_drift_is_recognised_and_corrected(memory: float) -> None:
    """Rates that last explain it worse, and would be far too sure of it."""
    ratios, squared = [], []
    for seed in range(6):
        graph = wandering(seed, 2.0, 1.0, memory)
        seen = sighted(graph, seed, 0.7)
        drift = found(graph, seen)
        assert drift is not None
        assert drift.is_sure
        assert drift.estimated_drift.is_varying
        straight = without_drift(graph, drift.rates)
        again = find_wall_drift(straight, sighted(straight, seed, 0.7), SEEN, MAP, GraphConfig(), drift)
        assert again is not None
        assert again.estimated_drift.is_varying
        assert again.knots.shape == drift.knots.shape
        straight = without_drift(straight, again.rates)
        ratios.append(ate(straight.poses, REAL) / ate(graph.poses, REAL))
        squared.append(unsure(again, straight))
        assert again.estimated_drift.rms is not None
        assert 0.3 < again.estimated_drift.rms[0] / 0.02 < 2.0
        assert 0.3 < again.estimated_drift.rms[2] / (np.radians(1.0) / 100) < 2.0
    assert max(ratios) < 0.5
    assert 0.3 < np.mean(squared) < 3.0


def test_covariances_include_what_is_given_beside_the_graph() -> None:
    spread = np.zeros((COUNT, 6, 6))
    spread[:, 0, 0] = np.linspace(0, 1, COUNT)
    graph = replace(odometry(0.0, 0.0), map_priors=[PlanarPrior(0, se2.of_se3(REAL)[0], np.eye(3), 3)])
    known, unsure = (optimise(g, GraphConfig()) for g in (graph, replace(graph, spread=spread)))
    np.testing.assert_allclose(unsure.covariances - known.covariances, spread, atol=1e-12)
    np.testing.assert_array_equal(unsure.poses, known.poses)
