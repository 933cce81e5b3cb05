"""Simulated wheels against the motion behind them; the other sensors stay as they were."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from lslam.core.types.imu import WheelStream
from lslam.io.readers import open_sequence
from lslam.io.readers.wheels import read_wheels
from lslam.simulation.record import record
from lslam.simulation.scenarios import SimulatedDrive, simulate
from lslam.simulation.sensors import T_CAR_BASE, WheelModel

SHARES_TOWNS = True
PERFECT = WheelModel(100.0, 0, 0, 0, 0, 0, 0, 0, 0)


def drive_with(model: WheelModel | None, scenario: str = "block", count: int = 30) -> SimulatedDrive:
    return simulate(scenario, count=count, seed=4, imu="icm20948", wheels=model)


def wheels_of(drive: SimulatedDrive) -> WheelStream:
    assert drive.wheels is not None
    return drive.wheels


def test_perfect_wheels_tell_the_speed_of_the_axle() -> None:
    drive = drive_with(PERFECT)
    wheels = wheels_of(drive)
    poses = drive.vehicle.poses(wheels.stamps_ns / 1e9) @ T_CAR_BASE
    moved = np.einsum("ni,ni->n", np.diff(poses[:, :3, 3], axis=0), poses[:-1, :3, 0])
    np.testing.assert_allclose(0.5 * (wheels.speed[1:] + wheels.speed[:-1]), moved / 0.01, atol=0.01)
    turned = np.unwrap(np.arctan2(poses[:, 1, 0], poses[:, 0, 0]))
    assert wheels.yaw_rate is not None
    np.testing.assert_allclose(np.sum(wheels.yaw_rate[1:]) * 0.01, turned[-1] - turned[0], atol=0.01)


def test_errors_are_those_of_the_model() -> None:
    perfect = wheels_of(drive_with(replace(PERFECT, rate_hz=50.0)))
    drive = drive_with(replace(WheelModel(), noise=0.0, step=0.0, slip=0.0, yaw_noise=0.0))
    assert drive.readings.wheels is not None
    scale = drive.readings.wheels.scale
    assert 0 < abs(scale) <= 0.02
    late = np.interp(perfect.stamps_ns / 1e9 - 0.03, perfect.stamps_ns / 1e9, perfect.speed)
    np.testing.assert_allclose(wheels_of(drive).speed[5:], (1 + scale) * late[5:], atol=0.01)


def test_slip_comes_and_goes() -> None:
    model = replace(PERFECT, slip=0.2, slip_s=0.8, every=1.0)
    slip = drive_with(model).readings.wheels.slip  # type: ignore[union-attr]
    assert 0.02 < np.abs(slip).max() <= 0.2
    assert np.mean(slip == 0) > 0.2
    np.testing.assert_allclose(wheels_of(drive_with(model)).speed, (1 + slip) * wheels_of(drive_with(PERFECT)).speed)


def test_scans_and_other_readings_stay_as_they_were() -> None:
    with_wheels, without = drive_with(WheelModel()), drive_with(None)
    np.testing.assert_array_equal(with_wheels.scan(3).points, without.scan(3).points)
    assert with_wheels.imu is not None
    assert without.imu is not None
    np.testing.assert_array_equal(with_wheels.imu.gyro, without.imu.gyro)
    np.testing.assert_array_equal(wheels_of(with_wheels).speed, wheels_of(drive_with(WheelModel())).speed)


@pytest.mark.parametrize("scenario", ["walk"])
def test_what_walks_has_no_wheels(scenario: str) -> None:
    assert drive_with(WheelModel(), scenario, 5).wheels is None


def test_a_recording_reads_back(tmp_path: Path) -> None:
    drive = drive_with(WheelModel(), count=3)
    sequence = open_sequence(record(drive, tmp_path / "out").sequence)
    again = read_wheels(sequence, "wheels.csv", "", None, [], [])
    np.testing.assert_array_equal(again.speed, wheels_of(drive).speed)
    assert again.yaw_rate is not None
    np.testing.assert_array_equal(again.yaw_rate, wheels_of(drive).yaw_rate)
    np.testing.assert_allclose(again.T_lidar_base, T_CAR_BASE)
