"""Constraints out of odometry's covariances, and keyframes' corrections spread over all scans."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from graph_builders import STEP_SIGMAS, measured, truth

from lslam.backend.graph.odometry_constraints import (
    correct_scans,
    fitness_covariance,
    fitness_score,
    growth,
    odometry_constraints,
)
from lslam.core.config.backend import GraphConfig
from lslam.core.geometry import noise, se3, so3
from lslam.core.types.scan_result import ScanResult
from lslam.core.types.trajectory import Keyframe

POSES = truth(60, 1)
OWN = np.diag([1e-4, 1e-4, 1e-4, 1e-6, 1e-6, 1e-6])


def results_of(poses: np.ndarray, has_covariances: bool = True) -> list[ScanResult]:
    """Odometry whose local map's error grows by independent steps, each in the axes of the scan before."""
    total, out = np.zeros((6, 6)), []
    for i, pose in enumerate(poses):
        if i:
            step = noise.rotate(np.diag(STEP_SIGMAS**2), poses[i - 1, :3, :3])
            total = noise.transport(total, pose[:3, 3] - poses[i - 1, :3, 3]) + step
        known = (total + OWN, OWN) if has_covariances else (None, None)
        out.append(
            ScanResult(i, i * 100_000_000, pose, "ok", covariance=known[0], registration_covariance=known[1], rmse=0.1)
        )
    return out


def keyframes_of(results: list[ScanResult], every: int = 5) -> list[Keyframe]:
    numbers = range(0, len(results), every)
    return [
        Keyframe(n, i, results[i].stamp_ns, results[i].T_world_lidar, distance=float(i)) for n, i in enumerate(numbers)
    ]


def test_growth_is_what_the_steps_between_added() -> None:
    results = results_of(POSES)
    direct = results_of(POSES[20:30])[-1]
    np.testing.assert_allclose(
        growth(results[20], results[29], 9.0, GraphConfig()), direct.covariance - OWN, atol=1e-12
    )


def test_the_identity_is_the_covariance_of_each_step_but_one_into_another_frame() -> None:
    """Girolimetto, listing 4.5, whatever the steps and what registration says of itself."""
    results = results_of(POSES)
    results[40:] = [replace(result, frame=1) for result in results[40:]]
    found = odometry_constraints(keyframes_of(results), results, GraphConfig(information="identity"))
    sigmas = [float(np.sqrt(c.covariance[0, 0])) for c in found]
    assert [k for k, sigma in enumerate(sigmas) if sigma > 100] == [7]
    for constraint in found[:7] + found[8:]:
        np.testing.assert_array_equal(constraint.covariance, np.eye(6))


def test_constraints_are_in_the_axes_of_their_first_keyframe() -> None:
    turned = se3.make(so3.exp(np.array([0.0, 0.0, 1.0])), np.array([5.0, 5, 5])) @ POSES
    here = odometry_constraints(keyframes_of(results_of(POSES)), results_of(POSES), GraphConfig())
    there = odometry_constraints(keyframes_of(results_of(turned)), results_of(turned), GraphConfig())
    assert [(c.a, c.b) for c in here] == [(k, k + 1) for k in range(11)]
    for a, b in zip(here, there, strict=True):
        np.testing.assert_allclose(a.T_a_b, b.T_a_b, atol=1e-9)
        np.testing.assert_allclose(a.covariance, b.covariance, atol=1e-12)


def test_methods_without_covariances_drift_as_configured() -> None:
    results = results_of(POSES, has_covariances=False)
    covariance = odometry_constraints(keyframes_of(results), results, GraphConfig(drift_percent=2.0))[0].covariance
    np.testing.assert_allclose(np.sqrt(covariance[0, 0]), 0.02 * 5 + 1e-3)


def test_fitness_maps_between_two_variances() -> None:
    """hdl_graph_slam's weight: var = near + (far - near) (1 - exp(-gain x)) / (1 - exp(-gain limit))."""
    config = GraphConfig(information="fitness")
    np.testing.assert_allclose(np.sqrt(np.diag(fitness_covariance(0.0, config)))[[0, 5]], [0.1, 0.05])
    np.testing.assert_allclose(np.sqrt(np.diag(fitness_covariance(9.0, config)))[[0, 5]], [5.0, 0.2])
    between = 0.01 + (25.0 - 0.01) * (1 - np.exp(-20 * 0.03)) / (1 - np.exp(-20 * 0.5))
    np.testing.assert_allclose(fitness_covariance(0.03, config)[0, 0], between)
    results = results_of(POSES)
    scores = np.linspace(0.0, 0.5, len(keyframes_of(results)) - 1).tolist()
    found = odometry_constraints(keyframes_of(results), results, config, scores)
    np.testing.assert_allclose([c.covariance for c in found], [fitness_covariance(s, config) for s in scores])


def test_the_fitness_score_is_the_mean_square_of_the_way_to_the_nearest_point() -> None:
    rng = np.random.default_rng(0)
    wall = np.column_stack([np.arange(0, 40, 2.0), np.zeros(20), np.zeros(20)]).astype(np.float32)
    T = se3.make(so3.exp(np.array([0.0, 0.0, 0.3])), np.array([1.0, 2.0, 0.5]))
    beside = wall + np.array([0.3, 0.0, 0.4], np.float32)
    seen = se3.apply(se3.inverse(T), beside.astype(np.float64)).astype(np.float32)
    assert fitness_score(seen, wall, T) == pytest.approx(0.25, abs=1e-5)
    cloud = rng.uniform(-5, 5, (50, 3)).astype(np.float32)
    away = np.linalg.norm(seen[:, None].astype(float) - cloud[None].astype(float), axis=2).min(axis=1)
    assert fitness_score(seen, cloud, np.eye(4)) == pytest.approx(np.mean(away**2), rel=1e-6)
    assert fitness_score(seen, cloud[:0], np.eye(4)) == np.inf


def test_a_correction_that_is_rigid_moves_all_scans_alike() -> None:
    results = results_of(POSES)
    keyframes = keyframes_of(results)
    D = se3.exp(np.array([3.0, -2.0, 1.0, 0.02, -0.01, 0.3]))
    poses = np.stack([D @ k.T_world_lidar for k in keyframes])
    final = correct_scans(results, keyframes, poses, np.zeros((12, 6, 6)), 0.0, GraphConfig())
    np.testing.assert_allclose(np.stack([r.T_world_lidar for r in final]), D @ POSES, atol=1e-9)


def test_between_keyframes_corrections_blend_without_a_seam() -> None:
    rng = np.random.default_rng(1)
    results = results_of(POSES)
    keyframes = keyframes_of(results, 6)
    poses = measured(np.stack([k.T_world_lidar for k in keyframes]), 10 * STEP_SIGMAS, rng)
    final = correct_scans(results, keyframes, poses, np.zeros((len(keyframes), 6, 6)), 0.0, GraphConfig())
    for keyframe, pose in zip(keyframes, poses, strict=True):
        np.testing.assert_allclose(final[keyframe.scan].T_world_lidar, pose, atol=1e-12)
    before = se3.relative(POSES[:-1], POSES[1:])
    steps = np.stack([r.T_world_lidar for r in final])
    after = se3.relative(steps[:-1], steps[1:])
    change = np.linalg.norm(se3.log(se3.relative(before, after)), axis=1)
    assert change.max() < 3 * np.linalg.norm(10 * STEP_SIGMAS) / 6 * 1.5
    # Before the first and beyond the last keyframe the nearest one's correction holds.
    last = se3.relative(final[54].T_world_lidar, final[59].T_world_lidar)
    np.testing.assert_allclose(last, se3.relative(POSES[54], POSES[59]), atol=1e-9)


def test_covariances_of_scans_grow_from_their_keyframe() -> None:
    results = results_of(POSES)
    keyframes = keyframes_of(results, 10)
    known = np.stack([np.diag([1e-2] * 3 + [1e-5] * 3)] * 6)
    final = correct_scans(results, keyframes, np.stack([k.T_world_lidar for k in keyframes]), known, 4.0, GraphConfig())
    traces = [float(np.trace(r.covariance[:3, :3])) for r in final]
    assert traces[0] < traces[2] < traces[4]
    assert traces[10] < traces[8]
    np.testing.assert_allclose(final[0].covariance, known[0] + OWN, atol=1e-12)
    for result in final:
        assert np.linalg.eigvalsh(result.covariance).min() > 0


def test_the_covariance_of_a_scan_includes_the_path_to_its_keyframe() -> None:
    """Keyframes that are known without an error: what is left is the steps between and the scan's own registration."""
    results = results_of(POSES)
    keyframes = keyframes_of(results, 10)
    final = correct_scans(
        results, keyframes, np.stack([k.T_world_lidar for k in keyframes]), np.zeros((6, 6, 6)), 0.0, GraphConfig()
    )
    np.testing.assert_allclose(final[24].covariance, results_of(POSES[20:25])[-1].covariance, atol=1e-10)
    np.testing.assert_allclose(final[27].covariance, results_of(POSES[27:31])[-1].covariance, atol=1e-10)


def test_a_graph_of_two_dimensions_keeps_height_roll_and_pitch_as_they_are() -> None:
    results = results_of(POSES)
    keyframes = keyframes_of(results)
    free = odometry_constraints(keyframes, results, GraphConfig())
    flat = odometry_constraints(keyframes, results, GraphConfig(planar=True))
    plane, other = [0, 1, 5], [2, 3, 4]
    for a, b in zip(free, flat, strict=True):
        np.testing.assert_allclose(b.covariance[np.ix_(plane, plane)], a.covariance[np.ix_(plane, plane)])
        assert (np.sqrt(np.diag(b.covariance)[other]) <= [1e-3, 1e-4, 1e-4]).all()
        assert not b.covariance[np.ix_(plane, other)].any()
