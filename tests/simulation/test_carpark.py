"""The open car park: its way out and back, how rough and how open it is, and what of the own car is seen."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from numpy.typing import NDArray

from lslam.core.errors import UsageError
from lslam.core.geometry import se3
from lslam.simulation.curve import rolling
from lslam.simulation.lidar_models import LIDARS
from lslam.simulation.scenarios import SimulatedDrive, simulate
from lslam.simulation.scene_mesh import Surface

Floats = NDArray[np.float64]
SEEDS = (0, 1, 2)
# Without faults, so that all that scatters is the ground.
PERFECT = replace(LIDARS["vlp16"], range_noise=0.0, range_step=1e-6, angle_noise_deg=0.0, range_10pct=1e6, dropout=0.0)


@cache
def park(seed: int = 0, *settings: str) -> SimulatedDrive:
    return simulate("carpark", seed=seed, settings=settings, lidar=PERFECT, motion_compensated=True)


@cache
def at_speed(speed: int) -> SimulatedDrive:
    return simulate("carpark", settings=[f"speed={speed}"])


def speeds(drive: SimulatedDrive) -> Floats:
    """Over the ground at 20 Hz, m/s."""
    assert drive.ground_truth is not None
    motion = drive.vehicle.at(np.arange(0, drive.end, 0.05))
    return np.asarray(np.linalg.norm(motion.velocity[:, :2], axis=1))


def standing(drive: SimulatedDrive, *surfaces: Surface) -> Floats:
    """Corners (N, 3) of all faces of these surfaces."""
    mesh = drive.city.mesh
    return mesh.vertices[mesh.faces[np.isin(mesh.surfaces, surfaces)]].reshape(-1, 3).astype(float)


def aside(drive: SimulatedDrive, points: Floats) -> Floats:
    """Distance of points from the path, level, m."""
    from scipy.spatial import cKDTree

    return np.asarray(cKDTree(drive.city_poses[:, :2, 3]).query(points[:, :2])[0])


def ground_points(drive: SimulatedDrive, indices: range, steepest: float) -> tuple[Floats, Floats]:
    """Of rays that end on the ground steeper than `steepest` deg: height above the smooth ground, m, and sine of incidence."""
    heights, sines = [], []
    for i in indices:
        scan, T = drive.scan(i), drive.T_city_world
        assert scan.rings is not None
        assert drive.ground_truth is not None
        city = se3.apply(T @ drive.ground_truth.poses[i], scan.points)
        height = city[:, 2] - drive.city.terrain.height(city[:, :2])
        distance = np.linalg.norm(scan.points, axis=1)
        elevation = -np.array(drive.lidar.elevations_deg)[scan.rings]
        kept = (elevation > steepest) & (distance > 1.2) & (np.abs(height) < 0.15)
        heights.append(height[kept])
        sines.append(np.sin(np.radians(elevation[kept])))
    return np.concatenate(heights), np.concatenate(sines)


def spread(values: Floats) -> float:
    """Standard deviation by the middle two thirds: the wheels of a parked car are no ground."""
    return float(np.diff(np.percentile(values, [15.87, 84.13]))[0] / 2)


def test_it_stands_drives_off_turns_and_comes_back_in_151_metres() -> None:
    drive = simulate("carpark", seed=100, count=406, static_start=2.5, motion_compensated=False)
    truth = drive.ground_truth
    assert truth is not None
    assert len(drive) == 406
    assert truth.path_lengths[-1] == pytest.approx(151, abs=2)
    np.testing.assert_allclose(truth.positions[:25], 0, atol=1e-6)
    assert speeds(drive).max() == pytest.approx(5.0, abs=0.1)
    p = truth.positions
    assert 60 < p[:, 0].max() < 78
    assert np.linalg.norm(p[-1, :2]) < 20
    assert p[-1, 1] == pytest.approx(12.0, abs=0.3), "beside the way out, two turning radii away"
    np.testing.assert_allclose(truth.poses[-1, :2, 0], [-1, 0], atol=0.02)


@pytest.mark.parametrize("speed", [2, 12, 30])
def test_every_speed_is_reached_from_rest_and_given_up_for_the_turn(speed: int) -> None:
    drive = at_speed(speed)
    v = speeds(drive)
    assert v[0] < 0.05
    assert v.max() == pytest.approx(speed, rel=0.02)
    assert np.sum(v > 0.98 * speed) * 0.05 > 2 * 4.5, "it is held on both straights"
    gain = v[20:] - v[:-20]  # over a second, in which it pitches on its springs to and fro
    assert gain.max() < 2.4
    assert gain.min() > -2.9
    motion = drive.vehicle.at(np.arange(0, drive.end, 0.05))
    turning = np.abs(motion.rate[:, 2]) > 0.9 * v / 6.0
    assert np.sum(turning) > 20
    assert np.percentile(v[turning] ** 2 / 6.0, 95) < 1.2 * drive.scenario.lateral
    assert drive.ground_truth is not None
    assert drive.ground_truth.path_lengths[-1] >= 148
    assert np.linalg.norm(drive.ground_truth.positions[-1, :2] - [0, 12]) < 0.2 * speed + 2


def test_the_way_is_as_long_as_the_scans_that_are_asked_for() -> None:
    longer = simulate("carpark", count=500)
    assert len(longer) == 500
    assert longer.ground_truth is not None
    assert longer.ground_truth.path_lengths[-1] == pytest.approx(151 + 5 * (50.0 - 36.9), abs=3)


def test_parks_that_would_not_fit_into_memory_are_refused() -> None:
    with pytest.raises(UsageError, match=r"a car park of \d+ x 172 m .* is too large"):
        simulate("carpark", settings=["path.length=9000"])
    with pytest.raises(UsageError, match="ends after"):
        simulate("carpark", count=100_000)


def test_a_longer_park_begins_as_a_shorter_one() -> None:
    short, long = park(), at_speed(12)
    assert long.city.terrain.tilt == short.city.terrain.tilt
    assert len(long.city.footprints) > len(short.city.footprints) > 2
    for a, b in zip(short.city.footprints, long.city.footprints, strict=False):
        np.testing.assert_allclose(a, b, atol=1e-6)


def test_the_ground_is_as_rough_as_it_was_asked_to_be() -> None:
    """By the height of traced points above the smooth ground; rays meet it earlier or later by that over the sine."""
    height, sine = ground_points(park(), range(0, 360, 30), 6.0)
    assert len(height) > 40_000
    assert spread(height) == pytest.approx(0.02, rel=0.1)
    steep = sine > np.sin(np.radians(10))
    assert abs(np.mean(height[steep])) < 0.003
    for roughness in (0.0, 0.01):
        other, _ = ground_points(park(0, f"world.roughness={roughness}"), range(0, 360, 60), 10.0)
        assert spread(other) == pytest.approx(roughness, rel=0.1, abs=0.001)


def test_grazing_rays_scatter_by_the_roughness_over_the_sine_and_meet_the_crests() -> None:
    drive = park()
    height, sine = ground_points(drive, range(0, 360, 20), 4.0)
    ranges = [spread(height[np.isclose(sine, s)] / s) for s in np.sin(np.radians([5, 15]))]
    assert ranges[0] == pytest.approx(0.02 / np.sin(np.radians(5)), rel=0.2)
    assert ranges[1] == pytest.approx(0.02 / np.sin(np.radians(15)), rel=0.15)
    low, steep = (height[np.isclose(sine, np.sin(np.radians(e)))].mean() for e in (5, 15))
    assert low > steep + 0.002, "crests hide what lies behind them"


def test_the_roughness_is_the_grounds_and_not_the_rays() -> None:
    """While it stands, every scan meets the same bumps."""
    drive = simulate("carpark", lidar=PERFECT, count=30, static_start=2.5)
    np.testing.assert_allclose(drive.scan(3).points, drive.scan(17).points, atol=1e-4)


@pytest.mark.parametrize("seed", SEEDS)
def test_something_of_the_own_car_is_within_a_metre(seed: int) -> None:
    drive = simulate("carpark", seed=seed, count=2)
    scan = drive.scan(0)
    distance = np.linalg.norm(scan.points, axis=1)
    near = scan.points[distance < 1.0]
    assert 0.02 * len(scan) < len(near) < 0.15 * len(scan)
    np.testing.assert_allclose(near[:, 2], -0.2, atol=0.03)
    assert not np.any((distance > 1.1) & (distance < 4.0)), "and nothing else is near"


@pytest.mark.parametrize("seed", SEEDS)
def test_it_is_open_with_a_wall_trees_cars_and_houses_around(seed: int) -> None:
    drive = park(seed)
    terrain = drive.city.terrain
    assert 0.01 <= np.hypot(*terrain.tilt) <= 0.02
    for outline in drive.city.footprints:
        assert aside(drive, outline).min() > 38
    wall = standing(drive, Surface.WALL)
    low = wall[aside(drive, wall) < 30]
    assert 10 < aside(drive, low).min() < 23
    top = low[:, 2] - terrain.height(low[:, :2])
    assert 0.85 < top.max() < 1.2
    trees = standing(drive, Surface.TRUNK)
    assert len(trees) > 0
    assert np.sign(trees[:, 1].mean() - 6) == np.sign(low[:, 1].mean() - 6)
    assert np.abs(trees[:, 1] - 6).min() > np.abs(low[:, 1] - 6).max()
    cars = standing(drive, Surface.CAR)
    assert len(cars) > 0
    assert aside(drive, cars).min() > 5
    scan = drive.scan(150)
    height, _ = ground_points(drive, range(150, 151), 0.0)
    assert len(height) > 0.4 * np.sum(np.linalg.norm(scan.points, axis=1) > 1.2), "it is mostly ground that is seen"


def test_same_seed_same_bytes_and_other_seeds_other_places() -> None:
    first, again = park(), simulate("carpark", lidar=PERFECT, motion_compensated=True)
    assert first.city.mesh.vertices.tobytes() == again.city.mesh.vertices.tobytes()
    assert first.scan(40).points.tobytes() == again.scan(40).points.tobytes()
    assert len({park(seed).city.terrain.tilt for seed in SEEDS}) == len(SEEDS)
    assert len({park(seed).city.footprints[0].tobytes() for seed in SEEDS}) == len(SEEDS)
    assert len({len(standing(park(seed), Surface.CAR)) for seed in SEEDS}) == len(SEEDS)


def test_the_slope_of_tilted_ground_is_that_of_its_heights() -> None:
    terrain = rolling(np.random.default_rng(4), slope=(0.01, 0.02))
    xy, step = np.random.default_rng(5).uniform(-50, 50, (40, 2)), 1e-4
    numeric = [(terrain.height(xy + d) - terrain.height(xy - d)) / (2 * step) for d in step * np.eye(2)]
    np.testing.assert_allclose(terrain.slope(xy), np.stack(numeric, axis=1), atol=1e-7)
    assert 0.01 <= np.hypot(*terrain.tilt) <= 0.02
    assert rolling(np.random.default_rng(4)).tilt == (0.0, 0.0)
