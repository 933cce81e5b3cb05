"""Perturbed drives are those of the simulator but for what was asked for."""

from __future__ import annotations

import numpy as np
import pytest
from perturbed_scans import draw_other_noise, move_points

from lslam.simulation import scenarios
from lslam.simulation.scenarios import SimulatedDrive, simulate


def drive() -> SimulatedDrive:
    return simulate("block", count=3, lidar="vlp16", motion_compensated=True, imu="phone")


@pytest.fixture(autouse=True)
def as_before(monkeypatch: pytest.MonkeyPatch) -> None:
    """Undoes after each test what it does to the simulator."""
    monkeypatch.setattr(SimulatedDrive, "scan", SimulatedDrive.scan)
    monkeypatch.setattr(SimulatedDrive, "__init__", SimulatedDrive.__init__)
    monkeypatch.setattr(scenarios, "read_sensors", scenarios.read_sensors)


def test_every_point_is_moved_by_about_as_much_as_is_asked_for_and_the_same_each_time() -> None:
    exact = drive().scan(1)
    move_points(1e-5, 0)
    moved = drive().scan(1)
    off = (moved.points - exact.points).astype(np.float64)
    assert 0.9e-5 < off.std() < 1.1e-5
    assert np.abs(off).max(axis=1).min() > 0
    assert moved.rings is not None
    assert (moved.rings == exact.rings).all()
    assert (drive().scan(1).points == moved.points).all()
    assert not (drive().scan(2).points[:5] - drive().scan(1).points[:5] == off[:5]).any()


def test_other_noise_leaves_town_and_path_as_they_are() -> None:
    usual = drive()
    draw_other_noise(1)
    other = drive()
    assert (usual.ground_truth.poses == other.ground_truth.poses).all()
    assert (usual.city.mesh.vertices == other.city.mesh.vertices).all()
    assert (usual.imu.accel != other.imu.accel).mean() > 0.9
    points, others = usual.scan(1).points, other.scan(1).points
    assert abs(len(points) - len(others)) < 0.1 * len(points)
    assert not np.isin(points[:, 0], others[:, 0]).all()
