"""Method `icp-svd`: its closed form against SciPy, known motions with and without outliers, and its options."""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np
import pytest
from analytic_scenes import distance, random_pose, room, seen_from
from drives import ate, standing
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from lslam.core.config.config import Config
from lslam.core.geometry import se3
from lslam.core.types.motion_prior import MotionPrior
from lslam.core.types.scan import Scan
from lslam.odometry.frontend.register_scans import estimate
from lslam.odometry.icp_svd import Partners, align_closed_form, create, keep_pairs
from lslam.simulation.scenarios import SimulatedDrive, simulate

Floats = NDArray[np.float64]


def scattered(rng: np.random.Generator, n: int = 300) -> Floats:
    """Points so far apart that a small motion leaves every one its own nearest."""
    grid = np.stack(np.meshgrid(*[np.arange(-4, 5) * 4.0] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
    return rng.permutation(grid + rng.uniform(-0.8, 0.8, grid.shape))[:n]


@pytest.mark.parametrize("seed", range(5))
def test_one_round_is_the_least_squares_solution_of_scipy(seed: int) -> None:
    rng = np.random.default_rng(seed)
    target = scattered(rng).astype(np.float32)
    true = random_pose(rng, 0.3, 2.0)
    source = se3.apply(se3.inverse(true), target) + rng.normal(0, 0.02, target.shape)
    world = target.astype(np.float64)
    found = align_closed_form(source, Partners(world, np.eye(4)), np.eye(4), inlier_distance=5.0, max_iterations=1)
    rotation, _ = Rotation.align_vectors(world - world.mean(0), source - source.mean(0))
    R = rotation.as_matrix()
    expected = se3.make(R, world.mean(0) - R @ source.mean(0))
    np.testing.assert_allclose(found.T_world_lidar, expected, atol=1e-9)
    assert (found.inliers, found.source_points, found.iterations) == (len(source), len(source), 1)


@pytest.mark.parametrize("seed", range(3))
def test_a_known_motion_is_found_in_any_world(seed: int) -> None:
    rng = np.random.default_rng(seed)
    target = scattered(rng).astype(np.float32)
    at, true = random_pose(rng, 50, 180), random_pose(rng, 0.4, 2.0)
    source = se3.apply(se3.inverse(true), target)
    found = align_closed_form(source, Partners(target.astype(np.float64), at), at)
    np.testing.assert_allclose(found.T_world_lidar, at @ true, atol=1e-6)
    assert found.converged
    assert found.rmse < 1e-5


def test_a_room_sampled_anew_is_found() -> None:
    rng = np.random.default_rng(0)
    true = random_pose(rng, 0.3, 3.0)
    partners = Partners(seen_from(room(rng, 3000), np.eye(4)).astype(np.float64), np.eye(4))
    source = seen_from(room(rng, 1500), true).astype(np.float64)
    found = align_closed_form(source, partners, np.eye(4), max_iterations=100)
    metres, degrees = distance(found.T_world_lidar, true)
    assert metres < 0.03
    assert degrees < 0.2
    assert distance(np.eye(4), true)[0] > 0.1


def test_trimming_and_the_distance_leave_outliers_out() -> None:
    rng = np.random.default_rng(1)
    target = scattered(rng, 200).astype(np.float32)
    true = random_pose(rng, 0.3, 1.0)
    source = se3.apply(se3.inverse(true), target)
    # A bus that drove on: a third of the points moved 1.6 m, still nearest to where they were.
    source[:66] += [0.0, 0.0, 1.6]
    partners = Partners(target.astype(np.float64), np.eye(4))
    options: tuple[dict[str, Any], ...] = ({"inlier_ratio": 0.6, "inlier_distance": 9.0}, {"inlier_distance": 1.0}, {})
    for option in options:
        found = align_closed_form(source, partners, np.eye(4), **option)
        assert distance(found.T_world_lidar, true)[0] < 1e-4, option
        assert found.inliers <= 134
    dragged = align_closed_form(source, partners, np.eye(4), inlier_distance=9.0)
    assert distance(dragged.T_world_lidar, true)[0] > 0.2


def test_pairs_are_kept_nearest_first_and_deterministically() -> None:
    away = np.array([0.3, np.inf, 0.1, 0.2, 0.2, 9.0, 0.4])
    assert keep_pairs(away, 1.0, 10.0).tolist() == [0, 2, 3, 4, 5, 6]
    assert keep_pairs(away, 0.5, 10.0).tolist() == [2, 3, 4]
    assert keep_pairs(away, 0.01, 10.0).tolist() == [2]
    assert keep_pairs(away, 1.0, None).tolist() == [0, 2, 3, 4, 6]
    assert keep_pairs(np.full(4, np.inf), 1.0, None).tolist() == []


def test_without_partners_or_on_a_line_the_prior_stays() -> None:
    prior = random_pose(np.random.default_rng(2), 1.0, 5.0)
    line = np.column_stack([np.arange(50.0), np.zeros((50, 2))])
    partners = Partners(line, np.eye(4))
    for source, option in ((line + 500.0, {"inlier_distance": 1.0}), (line, {})):
        found = align_closed_form(source, partners, prior, **option)
        np.testing.assert_array_equal(found.T_world_lidar, prior)
        assert (found.inliers, found.converged) == (0, False)


@cache
def from_rest() -> SimulatedDrive:
    return simulate("block", seed=0, count=30, start_speed=0.0)


@pytest.mark.parametrize("kind", ["target", "grid", "random"])
def test_a_drive_is_followed_with_every_down_sampling_and_standing_still_would_not_pass(kind: str) -> None:
    config = Config.model_validate(
        {"preprocess": {"downsample": kind, "range_shape": "cylinder"}, "odometry": {"method": "icp-svd"}}
    )
    drive = from_rest()
    assert drive.ground_truth is not None
    truth = drive.ground_truth.poses
    results = estimate(drive, create(config))
    assert all(r.status == "ok" and r.iterations <= 10 for r in results)
    bound = 0.5
    assert ate(np.stack([r.T_world_lidar for r in results]), truth) < bound
    assert ate(standing(truth), truth) > 5 * bound


def test_a_bad_scan_is_bridged_and_no_reference_until_it_persists() -> None:
    config = Config.model_validate({"registration": {"max_jump_m": 2.0, "inlier_distance": 1.0}})
    method = create(config)
    rng = np.random.default_rng(3)
    here, away = room(rng, 1500).astype(np.float32), (room(rng, 1500) + 300).astype(np.float32)

    def feed(points: NDArray[Any], index: int) -> str:
        scan = Scan(points.astype(np.float32), index, index)
        prior = MotionPrior.at_once(np.eye(4))
        result = method.register(scan, method.prepare(scan), prior)
        if result.status == "bridged":
            assert result.reason
            np.testing.assert_array_equal(result.T_world_lidar, np.eye(4))
        return result.status

    assert feed(here, 0) == "ok"
    assert feed(np.zeros((0, 3)), 1) == "bridged"
    assert feed(here, 2) == "ok"
    assert feed(away * [1, 1, 0.1], 3) == "bridged"
    assert feed(here, 4) == "ok"


def test_the_options_reach_the_method() -> None:
    rng = np.random.default_rng(4)
    clouds = [seen_from(room(rng, 1500), pose) for pose in (np.eye(4), random_pose(rng, 0.4, 1.0))]

    def result(**options: Any) -> Any:
        method = create(Config.model_validate({"registration": options}))
        for index, cloud in enumerate(clouds):
            scan = Scan(cloud, index, index)
            last = method.register(scan, method.prepare(scan), MotionPrior.at_once(np.eye(4)))
        return last

    assert result(max_iterations=2).iterations == 2
    assert result(inlier_ratio=0.5).inliers <= 0.5 * result().source_points + 1
    assert result(inlier_distance=0.05).rmse <= 0.05 < result(inlier_distance=3.0).rmse


@pytest.mark.parametrize("target", ["scan", "sample"])
def test_the_target_is_the_whole_scan_or_its_sample_but_at_first(target: str) -> None:
    cloud = room(np.random.default_rng(4), 1500)
    preprocess = {"downsample": "random", "random_share": 0.3}
    method = create(Config.model_validate({"registration": {"target": target}, "preprocess": preprocess}))
    sizes = []
    for index in range(2):
        scan = Scan(cloud, index, index)
        prepared = method.prepare(scan)
        method.register(scan, prepared, MotionPrior.at_once(np.eye(4)))
        assert method._last is not None
        sizes.append(len(method._last.points))
    assert sizes == [len(prepared.map_points), len(prepared.source if target == "sample" else prepared.map_points)]
