"""The local map as a pyramid of resolutions: insertion, decay, restoring, and a young map."""

from __future__ import annotations

from copy import deepcopy

import numpy as np
import pytest
from analytic_scenes import pose_at, room

from lslam.core.config.input import PreprocessConfig
from lslam.core.config.odometry import RegistrationConfig
from lslam.registration.alignment import MapAlignment
from lslam.registration.gaussian_map import FLOOR_M2, GaussianMap
from lslam.registration.local_map import LEAST_BREADTH, LocalMap
from lslam.registration.optimiser import optimise
from lslam.registration.preprocessing.prepare import PreparedPoints, prepare_points
from lslam.registration.registration import Registration
from lslam.registration.voxel_target import make_map_scans
from lslam.simulation.scenarios import simulate

ARRAYS = ("moments", "planes", "keys", "table")


def new_map() -> LocalMap:
    return LocalMap(0.8, reach=100.0, scan_variance=FLOOR_M2)


def scan(seed: int) -> PreparedPoints:
    return prepare_points(room(np.random.default_rng(seed)).astype(np.float32), PreprocessConfig(), seed)


def assert_same(a: GaussianMap, b: GaussianMap) -> None:
    for name in ARRAYS:
        np.testing.assert_array_equal(getattr(a, name), getattr(b, name))


def test_map_points_enter_fine_voxels_and_source_points_all_larger_ones() -> None:
    target, points, T = new_map(), scan(0), pose_at((1.0, 2.0, 0.5), 30.0)
    target.insert(points.map_points, points.source, T)
    kept = {
        "min_points": 6,
        "planarity": 0.3,
        "count_cap": 200.0,
        "reach": 100.0,
        "breadth": LEAST_BREADTH,
        "scan_variance": FLOOR_M2,
    }
    fine, *coarser = (GaussianMap(size, **kept) for size in (0.8, 3 * 0.8, 6 * 0.8, 12 * 0.8))
    fine.insert(points.map_points, T)
    assert_same(target.fine, fine)
    for level, expected in zip(target.coarser, coarser, strict=True):
        expected.insert(points.source.astype(np.float32), T)
        assert_same(level, expected)
    assert len(target) == len(fine) > len(target.coarser[0]) > len(target.coarser[2]) > 0


def test_the_target_is_the_sample_of_the_scan_before_and_at_first_the_whole_scan() -> None:
    """Girolimetto, listings 4.3 and 4.5."""
    scans, target = make_map_scans(RegistrationConfig(target="sample")), new_map()
    config = PreprocessConfig(downsample="random", random_share=0.3)
    cloud = room(np.random.default_rng(0)).astype(np.float32)
    first, second = (prepare_points(cloud, config, k) for k in range(2))
    for points, expected in ((first, first.map_points), (second, second.source)):
        scans.enter(target, points, np.eye(4))
        alone = new_map()
        alone.insert(expected.astype(np.float32), points.source, np.eye(4))
        kept, own = target.fine, alone.fine
        np.testing.assert_array_equal(kept.keys, own.keys)
        np.testing.assert_array_equal(kept.planes[kept.keys >= 0, :3], own.planes[own.keys >= 0, :3])


def test_all_levels_are_cleared_and_restored() -> None:
    target = new_map()
    target.insert(scan(0).map_points, scan(0).source, np.eye(4))
    known, again = deepcopy(target.state()), new_map()
    again.restore(known)
    for one in (target, again):
        one.insert(scan(1).map_points, scan(1).source, pose_at((0.3, 0.0, 0.0)))
    for a, b in zip(target.levels, again.levels, strict=True):
        live = np.sort(a.keys[a.keys >= 0])
        np.testing.assert_array_equal(live, np.sort(b.keys[b.keys >= 0]))
        np.testing.assert_array_equal(a.planes[a.keys >= 0], b.planes[b.keys >= 0])
    target.clear()
    assert [len(level) for level in target.levels] == [0] * 4


@pytest.mark.parametrize("scenario", ["street", "block", "walk"])
def test_near_its_prior_a_scan_is_placed_well_while_the_map_is_young(scenario: str) -> None:
    """Single rings of one scan must not pass for planes in fine voxels: they held the next four centimetres off."""
    drive = simulate(scenario, count=2, lidar="vlp16", motion_compensated=True)
    first, second = (drive.ground_truth.poses[i] for i in range(2))
    registration = Registration()
    points = [prepare_points(drive.scan(i).points, registration.preprocess) for i in range(2)]
    registration.align(points[0], first)
    prior = second @ pose_at((0.1, 0.05, 0.0))
    result = registration.locate(points[1], prior, is_near=True)
    assert result.ok
    assert np.linalg.norm(result.T_world_lidar[:3, 3] - second[:3, 3]) < 0.02


def test_cached_correspondences_are_discarded_when_the_map_changes() -> None:
    target, config = new_map(), RegistrationConfig()
    target.insert(scan(0).map_points, scan(0).source, np.eye(4))
    alignment, points = MapAlignment(target, config), scan(1)

    def align(by: MapAlignment, x: float) -> list[float]:
        found = optimise(by.problem(points, pose_at((x, 0.0, 0.0)), 0.5, 10))
        return [*found.T_world_lidar.ravel(), found.rmse, found.matched]

    for x in (0.1, 0.05):
        assert align(alignment, x) == align(MapAlignment(target, config), x)
    before = align(alignment, 0.1)
    target.insert(scan(2).map_points, scan(2).source, pose_at((0.02, 0.0, 0.0), 0.2))
    assert before != align(alignment, 0.1) == align(MapAlignment(target, config), 0.1)
