"""Scenario `lights`: the sensor stands among vehicles that drive off, and every method stays where it is."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest

import lslam
from lslam.simulation.scenarios import SimulatedDrive, simulate

SHARES_TOWNS = True


@cache
def standing(seed: int) -> SimulatedDrive:
    """Seven of the nine seconds at the lights; what waits drives off after three."""
    return simulate("lights", seed=seed, count=70, motion_compensated=True, imu="icm20948")


def farthest(seed: int, *settings: str) -> float:
    """m that a run's pose is from the first, which all of them are."""
    drive = standing(seed)
    config = lslam.load_config(settings=[*settings, "map.write=false", "loops.use=false", "odometry.integrity=false"])
    positions = lslam.run(drive, config).record.trajectory.poses[:, :3, 3]
    return float(np.linalg.norm(positions - positions[0], axis=1).max())


def test_the_sensor_stands_while_what_is_around_it_drives_off() -> None:
    drive = standing(1)
    assert np.linalg.norm(drive.ground_truth.poses[:, :3, 3] - drive.ground_truth.poses[0, :3, 3], axis=1).max() < 1e-6
    ahead = []
    for index in (0, 29, 69):
        points = drive.scan(index).points
        is_ahead = (np.abs(points[:, 1]) < 1.0) & (points[:, 0] > 1.0) & (points[:, 2] > -1.2)
        ahead.append(np.min(points[is_ahead, 0]))
    assert 5.0 < ahead[0] < 10.0
    assert ahead[1] == pytest.approx(ahead[0], abs=0.1)
    assert ahead[2] > ahead[0] + 5.0


def test_vehicles_gain_their_speed_and_keep_it() -> None:
    queue = [mover for mover in standing(1).movers if mover.start is not None]
    assert len(queue) == 3
    for mover in queue:
        begin, gain = mover.start or (0.0, 0.0)
        times = np.array([0.0, begin, begin + 1.0, begin + 60.0, begin + 61.0])
        way = mover.along(times) - mover.begin
        np.testing.assert_allclose(way[:3], [0, 0, gain / 2], atol=1e-9)
        assert way[4] - way[3] == pytest.approx(mover.speed)
        moved = mover.poses(times)[:, :3, 3]
        assert np.linalg.norm(moved[2] - moved[0]) == pytest.approx(gain / 2, abs=0.05)


@pytest.mark.parametrize("method", ["icp", "loam", "icp imu", "fast-lio2 imu"])
def test_methods_stay_where_the_sensor_stands(method: str) -> None:
    """Without the policy they follow the truck, by 1.8 to 7.8 m."""
    name, _, imu = method.partition(" ")
    settings = f"odometry.method={name}", f"imu.use={str(bool(imu)).lower()}"
    assert farthest(1, *settings) < 0.1
    if method in ("icp", "fast-lio2 imu"):
        assert farthest(1, *settings, "recovery.at_rest=false") > 1.0
