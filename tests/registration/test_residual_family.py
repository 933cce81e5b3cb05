"""Every residual in scenes whose answer is known, against every kind of target."""

from __future__ import annotations

import copy
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from analytic_scenes import corridor, distance, is_near, pose_at, random_pose, room, seen_from
from numpy.typing import NDArray

from lslam.core.config.config import Config
from lslam.core.config.input import PreprocessConfig
from lslam.core.config.odometry import RegistrationConfig, Residual
from lslam.core.geometry import se3
from lslam.odometry.icp import registration_of
from lslam.odometry.uncertainty import PoseUncertainty
from lslam.registration.alignment import solve
from lslam.registration.optimiser import Annealing
from lslam.registration.preprocessing.prepare import prepare_points
from lslam.registration.registration import Registration
from lslam.registration.residuals import RESIDUALS as TABLE
from lslam.registration.residuals import find_residual
from lslam.simulation.scenarios import SimulatedDrive, simulate

Floats = NDArray[np.float64]
RESIDUALS: list[Residual] = list(TABLE)
# m, deg: a point finds the mean of a voxel, not the place where it lies, so its residual averages out only.
ROOM = {"plane": (0.01, 0.05), "point": (0.06, 0.3), "gicp": (0.01, 0.05), "vgicp": (0.01, 0.05), "ndt": (0.01, 0.05)}


def in_room(residual: Residual, seed: int = 0, **given: object) -> Registration:
    """A registration that has seen the room from its middle."""
    config = Config.model_validate({"registration": {"residual": residual, **given}})
    registration = registration_of(config, residual)
    registration.register(room(np.random.default_rng(seed)).astype(np.float32))
    return registration


@pytest.mark.parametrize("residual", RESIDUALS)
def test_a_start_at_unknown_speed_is_found(residual: Residual) -> None:
    for seed in range(4):
        rng = np.random.default_rng(seed + 10)
        T = random_pose(rng, 1.5, 5.0)
        result = in_room(residual, seed).register(seen_from(room(rng), T))
        assert result.ok
        assert result.converged
        assert len(result.degenerate) == 0
        assert is_near(T, result.T_world_lidar, *ROOM[residual])
        assert result.covariance is not None
        assert np.linalg.eigvalsh(result.covariance).min() > 0
        assert 0 < result.inliers <= result.matched <= result.source_points


@pytest.mark.parametrize("residual", RESIDUALS)
def test_the_coarse_map_alone_brings_a_start_near(residual: Residual) -> None:
    """What the fine map corrects afterwards hides a residual that sees nothing in the coarse one."""
    for seed in range(3):
        rng = np.random.default_rng(seed + 20)
        T = pose_at((0.8, 0.6, 0.0), 3.0)
        registration = in_room(residual, seed)
        points = prepare_points(seen_from(room(rng), T), registration.preprocess)
        slow = Annealing.slow(5.0)
        coarse = registration.map.coarser[0]
        found = solve((coarse,), points, np.eye(4), slow, RegistrationConfig(), residual=find_residual(residual))
        assert distance(T, found.T_world_lidar)[0] < 0.1


@pytest.mark.parametrize("residual", RESIDUALS)
@pytest.mark.parametrize("target", ["map", "submap", "keyframe", "scan"])
def test_a_drive_through_the_room_is_followed(residual: Residual, target: str) -> None:
    """Twelve scans, 0.3 m and 2 deg apart; one that claims to stand still is 3.3 m off in the end."""
    rng = np.random.default_rng(1)
    registration = in_room(residual, target=target)
    for k in range(1, 12):
        T = pose_at((-0.3 * k, 0.1 * k, 0.0), 2.0 * k)
        result = registration.register(seen_from(room(rng, 3000), T))
        assert result.ok, result.reason
    away, turned = distance(T, result.T_world_lidar)
    slack = 4.0 if target == "scan" else 1.0
    assert away < slack * ROOM[residual][0]
    assert turned < slack * ROOM[residual][1]
    assert not is_near(np.eye(4), T, 1.0, 10.0)


@pytest.mark.parametrize("residual", ["gicp", "vgicp"])
def test_the_second_scan_of_a_drive_agrees_as_on_planes(residual: Residual) -> None:
    """One scan makes few small planes: its points find wide voxels, and lie anywhere in them."""
    drive = simulate("small-eight", seed=100, count=2, motion_compensated=True)
    shares = {}
    for name in ("plane", residual):
        registration = Registration(RegistrationConfig(residual=name))
        registration.register(drive.scan(0).points)
        result = registration.register(drive.scan(1).points)
        assert is_near(drive.ground_truth.poses[1], result.T_world_lidar, 0.03, 0.1)
        shares[name] = result.inlier_share
    assert shares[residual] > 0.8 * shares["plane"]


@cache
def on_a_motorway(seed: int) -> SimulatedDrive:
    return simulate("motorway", seed=seed, count=10, motion_compensated=True)


@pytest.mark.parametrize("residual", ["point", "vgicp"])
@pytest.mark.parametrize("seed", [0, 1])
def test_rings_on_flat_ground_do_not_bias_the_velocity(residual: Residual, seed: int) -> None:
    """3 m per scan on a motorway: what the first steps are short of would be kept at every later one."""
    drive = on_a_motorway(seed)
    registration = Registration(RegistrationConfig(residual=residual))
    found = [registration.register(drive.scan(i).points).T_world_lidar for i in range(len(drive))]
    truth = drive.ground_truth.poses
    last = distance(se3.relative(truth[-4], truth[-1]), se3.relative(found[-4], found[-1]))[0]
    assert last < 0.2
    assert distance(se3.relative(truth[0], truth[-1]), found[-1])[0] < 0.8


@cache
def on_the_way(residual: Residual) -> tuple[Registration, np.random.Generator]:
    """A registration that has followed six scans through the room, and the generator of the next one."""
    rng = np.random.default_rng(2)
    registration = in_room(residual)
    for k in range(1, 7):
        assert registration.register(seen_from(room(rng, 2000), pose_at((0.1 * k, 0.0, 0.0)))).ok
    return registration, rng


@pytest.mark.parametrize("residual", RESIDUALS)
@pytest.mark.parametrize("kind", ["noise", "nan", "far", "few"])
def test_a_bad_scan_fails_with_a_reason_and_does_not_change_the_map(residual: Residual, kind: str) -> None:
    registration, rng = copy.deepcopy(on_the_way(residual))
    before = copy.deepcopy(registration.map)
    points = {
        "noise": rng.uniform(-40, 40, (20_000, 3)),
        "nan": np.full((500, 3), np.nan),
        "far": rng.uniform(1e6, 1e9, (500, 3)),
        "few": rng.uniform(-5, 5, (20, 3)),
    }[kind]
    result = registration.register(points.astype(np.float32))
    assert not result.ok
    assert result.reason
    assert result.covariance is not None
    assert np.sqrt(result.covariance[0, 0]) == pytest.approx(0.5)
    assert is_near(result.T_world_lidar, pose_at((0.7, 0.0, 0.0)), 0.05, 0.3)
    for name in ("moments", "planes", "keys", "table"):
        np.testing.assert_array_equal(getattr(registration.map.fine, name), getattr(before.fine, name))
    T = pose_at((0.8, 0.0, 0.0))
    assert is_near(T, registration.register(seen_from(room(rng), T)).T_world_lidar, *ROOM[residual])


@pytest.mark.parametrize("residual", ["plane", "gicp", "vgicp", "ndt"])
def test_a_corridor_keeps_the_prior_along_itself(residual: Residual) -> None:
    rng = np.random.default_rng(3)
    registration = Registration(RegistrationConfig(residual=residual))
    for k in range(8):
        x = 0.5 * k
        prior = pose_at((x + 0.1, 0.05, 0.03), 0.5) if k else np.eye(4)
        result = registration.register(seen_from(corridor(rng, along=x), pose_at((x, 0.0, 0.0))), prior)
        assert result.ok
        if k:
            assert len(result.degenerate) == 1
            assert abs(result.degenerate[0, 0]) > 0.99
            assert result.T_world_lidar[0, 3] == pytest.approx(prior[0, 3], abs=2e-3)
            assert np.abs(result.T_world_lidar[1:3, 3]).max() < 0.01


def with_lorry(rng: np.random.Generator, y: float) -> NDArray[np.float32]:
    """The room with the side of a lorry in it, 12 m long."""
    side = np.column_stack([rng.uniform(-6, 6, 2000), rng.normal(y, 0.01, 2000), rng.uniform(-1.5, 2.0, 2000)])
    return np.concatenate([room(rng, 3000), side]).astype(np.float32)


def error_beside_a_lorry(residual: Residual, **given: object) -> float:
    """Metres off when the lorry has moved by 0.25 m and the sensor has not."""
    rng = np.random.default_rng(5)
    # Points spread evenly over surfaces, as no pulses fall, are sparse near the sensor.
    spread = PreprocessConfig(least_line=0)
    registration = Registration(RegistrationConfig.model_validate({"residual": residual, **given}), spread)
    registration.register(with_lorry(rng, 3.0))
    result = registration.register(with_lorry(rng, 3.25), np.eye(4))
    assert result.ok, result.reason
    return distance(np.eye(4), result.T_world_lidar)[0]


# Not vgicp: by its counts the lorry, near and dense, outweighs the walls, and trimming then drops the walls.
@pytest.mark.parametrize("residual", ["plane", "point", "gicp"])
def test_a_wide_bound_sees_what_has_moved_and_trimming_leaves_it_out(residual: Residual) -> None:
    everything = error_beside_a_lorry(residual, inlier_distance=2.0)
    trimmed = error_beside_a_lorry(residual, inlier_distance=2.0, inlier_ratio=0.8)
    assert everything > 0.03
    assert trimmed < 0.5 * everything


@pytest.mark.parametrize("residual", ["plane", "gicp", "vgicp", "ndt"])
def test_a_narrow_bound_rejects_what_has_moved(residual: Residual) -> None:
    assert error_beside_a_lorry(residual, inlier_distance=0.1) < 0.005


@pytest.mark.parametrize("target", ["keyframe", "scan"])
def test_the_map_has_the_extent_of_its_target(target: str) -> None:
    """Along a corridor 20 m are driven: the map of the last scan ends with it, that of three keyframes a little earlier."""
    rng = np.random.default_rng(6)
    registration = Registration(RegistrationConfig.model_validate({"target": target, "keyframes": 3}))
    behind = []
    for k in range(21):
        scan = seen_from(corridor(rng, 4000, along=float(k)), pose_at((float(k), 0.0, 0.0)))
        registration.register(scan, pose_at((float(k), 0.0, 0.0)))
        live = registration.map.fine.keys >= 0
        behind.append(k - float(registration.map.fine.planes[live, 0].min()))
    assert behind[0] == pytest.approx(25.0, abs=0.5)
    # Keyframes are two metres apart, or three where an estimate falls short; the newest is up to as old.
    low, high = (24.5, 25.5) if target == "scan" else (28.5, 33.5)
    assert low < behind[20] < high


def test_from_scan_to_scan_every_error_stays() -> None:
    """The covariance of a pose grows by that of every registration; on a map that begins ever less, as it is their mean."""
    rng = np.random.default_rng(7)
    result = in_room("plane").register(room(rng).astype(np.float32))
    assert result.covariance is not None
    for is_scan_to_scan, times in ((True, 11.0), (False, 1 + sum(1 / n**2 for n in range(1, 11)))):
        uncertainty = PoseUncertainty(is_scan_to_scan=is_scan_to_scan)
        for _ in range(10):
            C = uncertainty.add(replace(result, is_stationary=False))
        assert C is not None
        np.testing.assert_allclose(C, times * result.covariance, rtol=1e-9)
