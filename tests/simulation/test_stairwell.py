"""The stairs: two storeys of steps, and a corridor along which nothing observes the position."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
from numpy.typing import NDArray

from lslam.core.geometry import se3
from lslam.simulation import indoors as st
from lslam.simulation.scenarios import SimulatedDrive, simulate

SEEDS = (0, 1)


@cache
def walk(seed: int) -> SimulatedDrive:
    return simulate("stairs", seed=seed, lidar="vlp16", motion_compensated=True)


def in_city(drive: SimulatedDrive, index: int) -> NDArray[np.float64]:
    return se3.apply(drive.city_poses[index], drive.scan(index).points)


@pytest.mark.parametrize("seed", SEEDS)
def test_it_climbs_two_storeys_and_carries_the_sensor_above_the_steps(seed: int) -> None:
    drive = walk(seed)
    p = drive.vehicle.poses(np.arange(0, drive.end, 0.1))[:, :3, 3]
    assert p[-1, 2] - p[0, 2] == pytest.approx(st.TOP, abs=0.15)
    assert pytest.approx(st.TOP) == 2 * 18 * 0.17
    down = np.tile(np.array([[0.0, 0.0, -1.0]], np.float32), (len(p), 1))
    above = drive.scene.cast(p.astype(np.float32), down)[0]
    assert above.min() > 1.0
    assert above.max() < 1.9, "over steps and landings, never over a hole"


@pytest.mark.parametrize("seed", SEEDS)
def test_it_never_comes_near_a_wall(seed: int) -> None:
    drive = walk(seed)
    p = drive.vehicle.poses(np.arange(0, drive.end, 0.2))[:, :3, 3].astype(np.float32)
    angle = np.linspace(0, 2 * np.pi, 24, endpoint=False)
    rays = np.column_stack([np.cos(angle), np.sin(angle), np.zeros(24)]).astype(np.float32)
    far = drive.scene.cast(np.repeat(p, 24, axis=0), np.tile(rays, (len(p), 1)))[0]
    assert far.min() > 0.4


@pytest.mark.parametrize("seed", SEEDS)
def test_along_the_corridor_nothing_is_seen_that_stands_across_it_for_ten_seconds(seed: int) -> None:
    """Points off the two walls, the floor and the ceiling are those in the stairwell, and by and by there are none."""
    drive = walk(seed)
    for index in range(len(drive) - 100, len(drive), 20):
        points = in_city(drive, index)
        off = np.abs(points[:, [0, 0, 2, 2]] - [-st.LANDING, -st.LANDING - st.CORRIDOR, st.TOP, st.TOP + st.ROOM])
        assert np.mean(off.min(axis=1) > 0.15) < 0.003
        assert len(points) > 20_000
    # On the stairs they are a few tenths.
    points = in_city(drive, 150)
    assert np.mean(np.abs(points[:, 0]) < st.FLIGHT + st.LANDING + 0.2) > 0.9
    assert np.mean(np.abs(points[:, 0] - (st.FLIGHT + st.LANDING)) < 0.2) > 0.02


def test_other_seeds_furnish_it_otherwise_and_walk_otherwise() -> None:
    first, second = walk(0), walk(1)
    assert first.city.mesh.vertices.tobytes() != second.city.mesh.vertices.tobytes()
    assert not np.allclose(first.city_poses[100], second.city_poses[100], atol=0.02)
