"""Rays against surfaces with known answers."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from lslam.core.errors import UsageError
from lslam.core.geometry import se3, so3
from lslam.simulation.lidar import trace
from lslam.simulation.lidar_models import LIDARS, LidarModel, find_lidar
from lslam.simulation.scene_mesh import MeshBuilder, RayScene, SceneMesh, Surface

# A LiDAR without faults, so that answers are exact.
PERFECT = LidarModel("perfect", (10.0, 2.0, -5.0, -15.0, -30.0), 360, 0.1, 500.0, 0.0, 1e-6, 0.0, 1e6, 0.0)


def quad(*corners: tuple[float, float, float], surface: int = Surface.WALL) -> SceneMesh:
    builder = MeshBuilder()
    builder.add_quads([corners], surface)
    return builder.build()


def floor(z: float) -> SceneMesh:
    return quad((-900, -900, z), (900, -900, z), (900, 900, z), (-900, 900, z))


def room(half: float) -> SceneMesh:
    builder = MeshBuilder()
    builder.add_box([-half] * 3, [half] * 3, Surface.WALL)
    return builder.build()


def rng() -> np.random.Generator:
    return np.random.default_rng(3)


def elevation(points: NDArray[np.float32]) -> NDArray[np.float64]:
    p = points.astype(np.float64)
    return np.degrees(np.arctan2(p[:, 2], np.hypot(p[:, 0], p[:, 1])))


def test_ground_is_met_at_the_height_over_the_sine() -> None:
    scan = trace(RayScene(floor(-1.73)), PERFECT, np.eye(4), rng())
    assert len(scan) == 3 * 360  # the two upper rings see the sky
    ranges = np.linalg.norm(scan.points.astype(np.float64), axis=1)
    assert scan.rings is not None
    expected = 1.73 / np.sin(-np.radians(np.array(PERFECT.elevations_deg)[scan.rings]))
    np.testing.assert_allclose(ranges, expected, rtol=1e-5)
    np.testing.assert_allclose(scan.points[:, 2], -1.73, atol=1e-4)


def test_points_come_ring_by_ring_with_growing_azimuth() -> None:
    scan = trace(RayScene(room(8.0)), PERFECT, np.eye(4), rng())
    assert scan.rings is not None
    np.testing.assert_array_equal(scan.rings, np.repeat(np.arange(5), 360))
    np.testing.assert_allclose(elevation(scan.points), np.repeat(PERFECT.elevations_deg, 360), atol=1e-3)
    azimuth = np.degrees(np.arctan2(scan.points[:, 1], scan.points[:, 0])) % 360
    np.testing.assert_allclose((azimuth - np.tile(np.arange(360.0), 5) + 180) % 360 - 180, 0, atol=1e-3)


def test_points_come_column_by_column_and_clockwise_when_the_model_says_so() -> None:
    model = replace(PERFECT, order="column", clockwise=True, start_deg=180.0)
    scan = trace(RayScene(room(8.0)), model, np.eye(4), rng())
    assert scan.rings is not None
    np.testing.assert_array_equal(scan.rings, np.tile(np.arange(5), 360))
    azimuth = np.degrees(np.arctan2(scan.points[:, 1], scan.points[:, 0]))
    np.testing.assert_allclose(azimuth[5], 179.0, atol=1e-3)


def test_pose_carries_the_sensor() -> None:
    """In a room, every point carried by the pose lies on a wall."""
    T = se3.make(so3.from_euler_rpy(np.array([0.1, -0.2, 0.7])), np.array([1.0, -2.0, 0.5]))
    scan = trace(RayScene(room(8.0)), PERFECT, T, rng())
    assert len(scan) == PERFECT.rays
    np.testing.assert_allclose(np.abs(se3.apply(T, scan.points)).max(axis=1), 8.0, atol=1e-4)


def test_distorted_points_lie_on_the_walls_from_their_own_poses() -> None:
    """Points with times, each carried by the pose of its time, land on the walls; by the first pose they do not."""
    times = np.arange(360) * 0.1 / 360
    poses = se3.exp(times[:, None] * np.array([20.0, -5.0, 0.0, 0.0, 0.0, 1.5]))
    scan = trace(RayScene(room(8.0)), PERFECT, poses, rng())
    assert scan.times is not None
    column = np.round(scan.times * 3600).astype(int)
    carried = np.einsum("nij,nj->ni", poses[column, :3, :3], scan.points.astype(float)) + poses[column, :3, 3]
    np.testing.assert_allclose(np.abs(carried).max(axis=1), 8.0, atol=1e-4)
    off = np.abs(np.abs(scan.points).max(axis=1) - 8.0)
    assert off.max() > 0.5


def test_times_run_over_the_scan() -> None:
    poses = np.tile(np.eye(4), (360, 1, 1))
    column_major = trace(RayScene(room(8.0)), replace(PERFECT, order="column"), poses, rng(), period=0.2)
    assert column_major.times is not None
    assert column_major.times.dtype == np.float32
    assert (np.diff(column_major.times) >= 0).all()
    assert column_major.times[0] == 0
    assert 0.199 < column_major.times[-1] < 0.2
    compensated = trace(RayScene(room(8.0)), PERFECT, np.eye(4), rng())
    assert compensated.times is None


def test_nearer_and_farther_surfaces_give_nothing() -> None:
    scene = RayScene(floor(-2.0))
    gated = replace(PERFECT, range_min=5.0, range_max=20.0)
    scan = trace(scene, gated, np.eye(4), rng())
    # 2 m / sin(30 deg) = 4 m is too near, 2 m / sin(5 deg) = 22.9 m too far.
    assert scan.rings is not None
    assert set(scan.rings.tolist()) == {3}


def test_noise_and_resolution_are_those_of_the_model() -> None:
    model = replace(PERFECT, range_noise=0.03, range_step=0.01, elevations_deg=(0.0,), columns=20000)
    wall = RayScene(room(50.0))
    exact = trace(wall, replace(model, range_noise=0.0, range_step=1e-6), np.eye(4), rng())
    noisy = trace(wall, model, np.eye(4), rng())
    truth, ranges = (np.linalg.norm(s.points.astype(np.float64), axis=1) for s in (exact, noisy))
    assert np.std(ranges - truth) == pytest.approx(0.03, rel=0.05)
    assert abs(np.mean(ranges - truth)) < 0.001
    np.testing.assert_allclose(ranges / 0.01, np.round(ranges / 0.01), atol=1e-3)


def test_angle_noise_moves_points_across_the_ray() -> None:
    model = replace(PERFECT, angle_noise_deg=0.1, elevations_deg=(0.0,), columns=20000)
    scan = trace(RayScene(room(50.0)), model, np.eye(4), rng())
    assert np.std(elevation(scan.points)) == pytest.approx(0.1, rel=0.05)


def wall_at(x: float, surface: int = Surface.WALL) -> SceneMesh:
    return quad((x, -500, -500), (x, 500, -500), (x, 500, 500), (x, -500, 500), surface=surface)


def returned(mesh: SceneMesh, azimuth_deg: float = 0.0) -> float:
    """Share of rays near one azimuth that come back."""
    model = replace(LIDARS["hdl64"], elevations_deg=(0.0,), columns=36000, firing_us=())
    scan = trace(RayScene(mesh), model, np.eye(4), rng())
    azimuth = np.degrees(np.arctan2(scan.points[:, 1], scan.points[:, 0]))
    return float(np.sum(np.abs(azimuth - azimuth_deg) < 5) / 1000)


def test_far_grazing_and_dark_surfaces_return_less() -> None:
    near, far = returned(wall_at(10)), returned(wall_at(110))
    assert near > 0.95
    assert far < near - 0.03
    assert returned(wall_at(10), 83.0) < 0.9 * near
    assert returned(wall_at(50, Surface.GLASS)) < 0.8 * returned(wall_at(50))


def test_intensity_falls_with_incidence_and_differs_by_surface() -> None:
    """By Oren and Nayar's model of a rough surface, written out anew, for light that returns to where it came from."""
    scan = trace(RayScene(wall_at(10)), LIDARS["hdl64"], np.eye(4), rng())
    assert scan.intensity is not None
    assert scan.intensity.min() >= 0
    assert scan.intensity.max() <= 1
    p = scan.points.astype(float)
    incidence = np.arccos(p[:, 0] / np.linalg.norm(p, axis=1))
    variance = 0.6**2
    a, b = 1 - 0.5 * variance / (variance + 0.33), 0.45 * variance / (variance + 0.09)
    for low, high in ((0, 10), (40, 50), (70, 80)):
        here = (np.degrees(incidence) >= low) & (np.degrees(incidence) < high)
        i = incidence[here]
        brightness = (a + b * np.sin(i) * np.tan(i)) * np.cos(i) / a
        assert scan.intensity[here].mean() == pytest.approx(0.45 * brightness.mean(), rel=0.03)
    glass = trace(RayScene(wall_at(10, Surface.GLASS)), LIDARS["hdl64"], np.eye(4), rng())
    assert glass.intensity is not None
    assert glass.intensity.mean() < 0.1 * scan.intensity.mean()


def test_a_vlp16_fires_one_laser_after_the_other() -> None:
    """Elevations alternate between the halves, 2.304 us apart; the head turns on and the LiDAR moves meanwhile."""
    model = replace(
        LIDARS["vlp16"], range_noise=0.0, range_step=1e-6, angle_noise_deg=0.0, range_10pct=1e6, dropout=0.0
    )
    still = trace(RayScene(room(8.0)), model, np.tile(np.eye(4), (1800, 1, 1)), rng())
    assert still.times is not None
    times = still.times.reshape(1800, 16)
    np.testing.assert_allclose(times - times[:, :1], np.tile(2.304e-6 * np.arange(16), (1800, 1)), atol=1e-8)
    assert np.all(np.diff(still.times) > 0)
    order = np.round(elevation(still.points[:16])).tolist()
    assert order == [-15, 1, -13, 3, -11, 5, -9, 7, -7, 9, -5, 11, -3, 13, -1, 15]
    azimuth = np.unwrap(np.arctan2(still.points[:, 1], still.points[:, 0]).astype(float))
    np.testing.assert_allclose(azimuth, -2 * np.pi * still.times / 0.1, atol=1e-5)


def test_points_of_one_column_lie_where_the_lidar_was_when_each_was_fired() -> None:
    """Fast enough that a column smears by centimetres: each point carried by the pose at its own time is on the wall."""
    model = replace(
        LIDARS["vlp16"], range_noise=0.0, range_step=1e-6, angle_noise_deg=0.0, range_10pct=1e6, dropout=0.0
    )
    twist = np.array([15.0, 40.0, -9.0, 2.0, -4.0, 3.0])
    scan = trace(RayScene(room(20.0)), model, se3.exp(np.arange(1800)[:, None] * (0.1 / 1800) * twist), rng())
    assert scan.times is not None
    exact, column = se3.exp(scan.times[:, None].astype(float) * twist), np.floor(scan.times * 18000 + 1e-3) / 18000
    for times, bound in ((exact, 3e-5), (se3.exp(column[:, None] * twist), None)):
        carried = np.einsum("nij,nj->ni", times[:, :3, :3], scan.points.astype(float)) + times[:, :3, 3]
        off = np.abs(np.abs(carried).max(axis=1) - 20.0).max()
        assert off < bound if bound is not None else off > 1e-3


def test_lasers_at_different_heights_see_from_there() -> None:
    """A laser 0.2 m above the origin meets the floor farther out; its points are given from the origin all the same."""
    raised = replace(PERFECT, ring_heights=(0.2, 0.2, 0.2, 0.1, 0.1))
    scan = trace(RayScene(floor(-1.73)), raised, np.eye(4), rng())
    assert scan.rings is not None
    np.testing.assert_allclose(scan.points[:, 2], -1.73, atol=1e-4)
    out = np.hypot(scan.points[:, 0], scan.points[:, 1]).astype(float)
    height, fall = (
        np.array(raised.ring_heights)[scan.rings],
        np.tan(np.radians(np.array(PERFECT.elevations_deg)[scan.rings])),
    )
    np.testing.assert_allclose(out, (1.73 + height) / -fall, rtol=1e-5)
    with pytest.raises(ValueError, match="ring_heights of 'perfect': 2 values for 5 rings"):
        replace(PERFECT, ring_heights=(0.1, 0.2))


def test_the_lasers_of_an_ouster_fire_together_and_those_of_an_hdl64_in_pairs() -> None:
    assert not LIDARS["os1-64"].firing.any()
    pairs, counts = np.unique(LIDARS["hdl64-kitti"].firing, return_counts=True)
    assert set(counts.tolist()) == {2}
    np.testing.assert_allclose(np.diff(pairs), 0.728e-6)
    for model in LIDARS.values():
        assert model.firing.max() < 0.1 / model.columns


def test_nothing_around_gives_an_empty_scan() -> None:
    scan = trace(RayScene(floor(-1000.0)), PERFECT, np.eye(4), rng())
    assert scan.points.shape == (0, 3)
    assert scan.points.dtype == np.float32


def test_ready_models_are_what_they_are_called() -> None:
    assert (LIDARS["sample"].rings, LIDARS["sample"].columns) == (16, 400)
    assert LIDARS["hdl64"].rings == 64
    assert LIDARS["hdl64"].elevations_deg[0] == 2.0
    assert LIDARS["hdl64"].elevations_deg[-1] == -24.33
    assert LIDARS["os1-32"].rays == 32 * 1024
    assert all(np.all(np.diff(m.elevations_deg) < 0) for m in LIDARS.values())
    with pytest.raises(UsageError, match="did you mean 'hdl64'"):
        find_lidar("hdl46")
