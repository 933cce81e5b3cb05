"""Drives by name: lengths, exact truth, determinism, sensible errors."""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from lslam.core.errors import UsageError
from lslam.core.geometry import se3
from lslam.core.types.scan import Scan
from lslam.core.types.sequence import Sequence
from lslam.simulation.scenarios import SimulatedDrive, simulate
from lslam.simulation.scene_mesh import Surface


@pytest.fixture(scope="module")
def block() -> SimulatedDrive:
    return simulate("block")


@pytest.fixture(scope="module")
def street() -> SimulatedDrive:
    return simulate("street", seed=1, count=40)


@cache
def whole(scenario: str, seed: int) -> SimulatedDrive:
    """Its whole way, for those who ask nothing about building it twice."""
    return simulate(scenario, seed=seed)


def truth(drive: SimulatedDrive) -> NDArray[np.float64]:
    assert drive.ground_truth is not None
    return drive.ground_truth.poses


def same(a: Scan, b: Scan) -> bool:
    pairs: list[tuple[Any, Any]] = [
        (a.points, b.points),
        (a.intensity, b.intensity),
        (a.times, b.times),
        (a.rings, b.rings),
    ]
    return all((p is None and q is None) or p.tobytes() == q.tobytes() for p, q in pairs)


def test_a_drive_is_a_sequence(block: SimulatedDrive) -> None:
    sequence: Sequence = block
    scan = sequence.scan(2)
    assert scan.index == 2
    assert scan.stamp_ns == block.stamps_ns[2] == 200_000_000
    assert scan.points.dtype == np.float32
    assert len(list(block)) == len(block)
    with pytest.raises(IndexError, match="scan 99999"):
        sequence.scan(99999)


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_block_is_one_lap_that_closes_and_is_long_enough_for_kitti_drift(seed: int) -> None:
    drive = whole("block", seed)
    assert drive.ground_truth is not None
    length = drive.ground_truth.path_lengths
    assert 110 < length[-1] < 125
    assert 88 <= len(drive) <= 100
    assert length[-1] - length[10] > 100, "two KITTI segments of 100 m"
    p = drive.ground_truth.positions
    assert np.linalg.norm(p[-5:] - p[0], axis=1).min() < 1.0
    assert np.linalg.norm(np.diff(p, axis=0), axis=1).max() < 1.4


def test_street_reaches_two_and_a_half_metres_per_scan() -> None:
    drive = simulate("street", speed=25.0)
    assert drive.ground_truth is not None
    steps = np.linalg.norm(np.diff(drive.ground_truth.positions, axis=0), axis=1)
    assert np.percentile(steps, 90) == pytest.approx(2.5, abs=0.03)
    assert drive.ground_truth.path_lengths[-1] > 200


def test_ground_truth_starts_at_the_first_scan_and_is_the_vehicles(block: SimulatedDrive) -> None:
    np.testing.assert_allclose(truth(block)[0], np.eye(4), atol=1e-12)
    city = block.vehicle.poses(block.stamps_ns / 1e9)
    np.testing.assert_allclose(block.T_city_world @ truth(block), city, atol=1e-9)


def test_start_from_rest_and_many_laps() -> None:
    rest = simulate("block", start_speed=0.0, count=5)
    assert np.linalg.norm(truth(rest)[1, :3, 3]) < 0.1
    laps = simulate("block", count=400)
    assert laps.ground_truth is not None
    assert laps.ground_truth.path_lengths[-1] > 4 * 110
    assert np.linalg.norm(laps.ground_truth.positions, axis=1).max() < 60


def test_same_seed_same_bytes_in_any_order(block: SimulatedDrive) -> None:
    again = simulate("block")
    later, first = again.scan(7), again.scan(3)
    assert same(block.scan(3), first)
    assert same(block.scan(7), later)
    assert truth(again).tobytes() == truth(block).tobytes()
    assert not same(block.scan(3), simulate("block", seed=1).scan(3))


def test_sensor_and_speed_leave_the_city_alone(block: SimulatedDrive) -> None:
    other = simulate("block", lidar="vlp16", speed=4.0, motion_compensated=False)
    assert other.city.mesh.vertices.tobytes() == block.city.mesh.vertices.tobytes()


def test_cities_differ_by_seed() -> None:
    a, b = simulate("street", seed=0, count=1), simulate("street", seed=1, count=1)
    assert a.city.mesh.vertices.shape != b.city.mesh.vertices.shape


def off_the_surface(drive: SimulatedDrive, scan: Scan, T_city_lidar: NDArray[np.float64]) -> NDArray[np.float64]:
    """Distance of points to the planes of the faces that exact rays through them meet, m."""
    from lslam.simulation.scene_mesh import RayScene

    poses = np.broadcast_to(T_city_lidar, (len(scan), 4, 4))
    points = np.einsum("nij,nj->ni", poses[:, :3, :3], scan.points.astype(float)) + poses[:, :3, 3]
    ray = points - poses[:, :3, 3]
    ray /= np.linalg.norm(ray, axis=1, keepdims=True)
    mesh = drive.city.mesh
    _, face = RayScene(mesh).cast(poses[:, :3, 3].astype(np.float32), ray.astype(np.float32))
    corner = mesh.vertices[mesh.faces[face, 0]].astype(float)
    return np.asarray(np.abs(np.sum((points - corner) * mesh.normals[face], axis=1)))


def test_points_lie_on_the_surfaces_they_hit(street: SimulatedDrive) -> None:
    scan = street.scan(20)
    off = off_the_surface(street, scan, street.T_city_world @ truth(street)[20])
    assert np.percentile(off, 95) < 3 * street.lidar.range_noise


def test_distorted_scans_agree_with_the_city_through_their_sub_scan_poses() -> None:
    drive = simulate("street", seed=1, count=10, speed=20.0, motion_compensated=False)
    scan = drive.scan(4)
    assert scan.times is not None
    stamps = drive.stamps_ns[4] / 1e9 + scan.times.astype(float)
    off = off_the_surface(drive, scan, drive.vehicle.poses(stamps))
    assert np.percentile(off, 95) < 3 * drive.lidar.range_noise
    assert np.ptp(scan.times) > 0.09


def thickness(drive: SimulatedDrive, poses: NDArray[np.float64], scans: list[Scan]) -> float:
    """Median thickness of the merged cloud above the ground, m: what is left across the best plane of each half-metre cell."""
    points = np.concatenate([se3.apply(poses[scan.index], scan.points) for scan in scans])
    city = se3.apply(drive.T_city_world, points)
    points = points[city[:, 2] - drive.city.terrain.height(city[:, :2]) > 1.0]
    x, y, z = np.floor(points / 0.5).astype(np.int64).T
    keys = (x * 2**20 + y) * 2**20 + z
    order = np.argsort(keys, kind="stable")
    groups = np.split(points[order], np.flatnonzero(np.diff(keys[order])) + 1)
    groups = [group for group in groups if len(group) >= 60]
    return float(np.median(np.sqrt(np.linalg.eigvalsh([np.cov(group.T) for group in groups])[:, 0])))


def test_walls_of_the_merged_cloud_are_as_thin_as_the_noise(street: SimulatedDrive) -> None:
    scans = [street.scan(i) for i in range(0, 40, 4)]
    assert thickness(street, truth(street), scans) < 1.3 * street.lidar.range_noise
    standing = np.tile(np.eye(4), (40, 1, 1))
    assert thickness(street, standing, scans) > 2.5 * street.lidar.range_noise


def test_drive_keeps_clear_of_everything() -> None:
    """No part of the city between bumper and LiDAR comes within 1 m of the LiDAR's line."""
    from scipy.spatial import cKDTree

    for name in ("block", "street"):
        for seed in (0, 1, 2):
            drive = whole(name, seed)
            mesh = drive.city.mesh
            corners = mesh.vertices[mesh.faces[mesh.surfaces > Surface.LAWN]].reshape(-1, 3).astype(float)
            above = corners[:, 2] - drive.city.terrain.height(corners[:, :2])
            line = (drive.T_city_world @ truth(drive))[:, :2, 3]
            near = np.asarray(cKDTree(line).query(corners[(above > 0.3) & (above < 1.9), :2])[0])
            assert near.min() > 1.0, (name, seed)


def test_houses_stand_apart() -> None:
    from shapely import Polygon

    for seed in (0, 1, 2):
        houses = [Polygon(f) for f in whole("block", seed).city.footprints]
        assert len(houses) > 15
        assert not any(a.intersects(b) for i, a in enumerate(houses) for b in houses[:i])


def test_a_scan_sees_a_street(street: SimulatedDrive) -> None:
    """Ground, walls and clutter in plausible shares, and fewer points than rays."""
    scan = street.scan(20)
    assert 0.85 * street.lidar.rays < len(scan) < street.lidar.rays
    city = se3.apply(street.T_city_world @ truth(street)[20], scan.points)
    ground = np.abs(city[:, 2] - street.city.terrain.height(city[:, :2])) < 0.2
    assert 0.3 < ground.mean() < 0.8


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        ({"scenario": "blok"}, "did you mean 'block'"),
        ({"lidar": "vlp-16"}, "did you mean 'vlp16'"),
        ({"count": 0}, "--count 0 is out of range"),
        ({"speed": 0.0}, "--speed 0 is out of range"),
        ({"speed": 300.0}, "at most 40 m/s"),
        ({"speed": float("nan")}, "--speed nan is out of range"),
        ({"seed": -1}, "--seed -1 is out of range"),
        ({"speed": 5.0, "start_speed": 6.0}, "a start at 6 m/s is out of range"),
        ({"scenario": "street", "count": 1000}, "ends after 265 scans"),
    ],
)
def test_wrong_arguments_are_named(arguments: dict[str, Any], sentence: str) -> None:
    with pytest.raises(UsageError, match=sentence):
        simulate(**{"scenario": "block", **arguments})
