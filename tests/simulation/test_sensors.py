"""A drive with all its sensors on disk: what a reader finds, and the truth beside it."""

from __future__ import annotations

import shutil
import tomllib
from pathlib import Path

import numpy as np
import pytest

from lslam.core.errors import UsageError
from lslam.core.geometry import geodesy, se3, so3
from lslam.io.formats.stamped_csv import read_stamped_csv
from lslam.io.formats.trajectory_files import read_trajectory
from lslam.io.readers import open_sequence
from lslam.simulation.imu import GRAVITY
from lslam.simulation.record import record
from lslam.simulation.scenarios import SimulatedDrive, simulate
from lslam.simulation.sensors import GnssModel

SHARES_TOWNS = True


@pytest.fixture(scope="module")
def drive() -> SimulatedDrive:
    gnss = GnssModel(5.0, outages=((0.5, 1.0),))
    return simulate("block", count=30, motion_compensated=False, imu="icm20948", gnss=gnss, static_start=1.0)


@pytest.fixture(scope="module")
def folder(drive: SimulatedDrive, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return record(drive, tmp_path_factory.mktemp("drive") / "out").sequence


def test_a_reader_finds_the_streams_and_where_the_sensors_sit(drive: SimulatedDrive, folder: Path) -> None:
    sequence = open_sequence(folder)
    assert sequence.problems == []
    assert sequence.imu is not None
    assert sequence.gnss is not None
    assert drive.imu is not None
    assert drive.gnss is not None
    assert (len(sequence.imu), len(sequence.gnss)) == (301, 16 - 3)
    for name in ("stamps_ns", "accel", "gyro"):
        np.testing.assert_array_equal(getattr(sequence.imu, name), getattr(drive.imu, name))
    for name in ("stamps_ns", "lat_lon_alt", "sigma"):
        np.testing.assert_array_equal(getattr(sequence.gnss, name), getattr(drive.gnss, name))
    for key, T in drive.calibration.extrinsics.items():
        np.testing.assert_allclose(sequence.calibration.extrinsics[key], T, atol=1e-12)
    # It stands still for a second: gravity plus the bias of the data sheet, and the gyroscope's bias alone.
    still = sequence.imu.stamps_ns < 1e9
    assert np.linalg.norm(sequence.imu.accel[still].mean(axis=0)) == pytest.approx(10.35, abs=0.1)
    np.testing.assert_allclose(sequence.imu.gyro[still].mean(axis=0), 0.0873, atol=0.002)


def test_truth_agrees_with_itself_and_with_the_ground_truth(drive: SimulatedDrive, folder: Path) -> None:
    truth = folder / "truth"
    scans, fine = (read_trajectory(truth / name) for name in ("trajectory.tum", "trajectory_100hz.tum"))
    assert drive.ground_truth is not None
    assert scans.frame == fine.frame == "lidar"
    np.testing.assert_array_equal(scans.stamps_ns, drive.stamps_ns)
    np.testing.assert_allclose(scans.poses, drive.ground_truth.poses, atol=1e-8)
    np.testing.assert_array_equal(fine.stamps_ns, np.arange(301) * 10_000_000)
    np.testing.assert_allclose(fine.poses[::10][:30], scans.poses, atol=1e-8)
    names = [(f"{what}_{axis}",) for what in ("velocity", "rate") for axis in "xyz"]
    stamps, motion = read_stamped_csv(truth / "motion.csv", names)
    np.testing.assert_array_equal(stamps, fine.stamps_ns)
    differences = (fine.positions[2:] - fine.positions[:-2]) / 0.02
    np.testing.assert_allclose(motion[1:-1, :3], differences, atol=0.01)
    turn = so3.log(se3.relative(fine.poses[:-2], fine.poses[2:])[:, :3, :3]) / 0.02
    np.testing.assert_allclose(motion[1:-1, 3:], turn, atol=0.01)
    assert np.linalg.norm(motion[0]) < 1e-6
    assert np.linalg.norm(motion[-1, :3]) > 0.1


def test_true_biases_are_those_of_the_readings(drive: SimulatedDrive, folder: Path) -> None:
    names = [(f"{what}_bias_{axis}",) for what in ("accel", "gyro") for axis in "xyz"]
    stamps, bias = read_stamped_csv(folder / "truth" / "imu_bias.csv", names)
    assert drive.readings.imu is not None
    np.testing.assert_array_equal(stamps, drive.readings.imu.stream.stamps_ns)
    np.testing.assert_array_equal(bias, np.hstack([drive.readings.imu.accel_bias, drive.readings.imu.gyro_bias]))


def test_the_world_lies_on_the_earth_where_the_fixes_are(drive: SimulatedDrive, folder: Path) -> None:
    world = tomllib.loads((folder / "truth" / "world.toml").read_text())
    T_enu_world = np.array(world["T_enu_world"])
    scans = read_trajectory(folder / "truth" / "trajectory.tum")
    gnss, calibration = open_sequence(folder).gnss, drive.calibration
    assert gnss is not None
    assert calibration.T_lidar_gnss is not None
    local = geodesy.to_local(gnss.lat_lon_alt, np.array(world["origin_lat_lon_alt"]))
    common = np.isin(scans.stamps_ns, gnss.stamps_ns)
    antenna = (T_enu_world @ scans.poses[common] @ calibration.T_lidar_gnss)[:, :3, 3]
    off = local[np.isin(gnss.stamps_ns, scans.stamps_ns)] - antenna
    assert np.linalg.norm(off, axis=1).max() < 8.0
    assert drive.readings.gnss is not None
    np.testing.assert_allclose(off, drive.readings.gnss.error[: len(off)], atol=1e-6)
    gravity = np.array(world["gravity_world"])
    assert np.linalg.norm(gravity) == pytest.approx(GRAVITY)
    np.testing.assert_allclose(T_enu_world[:3, :3] @ gravity, [0, 0, -GRAVITY], atol=1e-12)


def test_nothing_that_reads_the_sequence_needs_its_truth(folder: Path, tmp_path: Path) -> None:
    copy = tmp_path / "out"
    shutil.copytree(folder.parent.parent, copy)
    shutil.rmtree(copy / "sequences" / "00" / "truth")
    sequence = open_sequence(copy)
    assert sequence.problems == []
    assert sequence.imu is not None
    assert sequence.ground_truth is not None
    np.testing.assert_array_equal(sequence.scan(3).points, open_sequence(folder).scan(3).points)


def test_sensors_sit_where_the_carrier_has_room_for_them_whatever_the_lidar() -> None:
    """A car's roof is below its LiDAR, a drone's belly above it; a hand holds less than an arm's length."""
    for name, lidar in (("urban", "os1-32"), ("small-eight", "vlp16"), ("walk", "os1-64"), ("corridor", "hdl64")):
        bare = ["world.levels=0", "traffic.cars=0", "traffic.people=0"]
        made = simulate(name, lidar=lidar, count=2, imu="ideal", gnss=GnssModel(), settings=bare)
        T_imu, T_antenna = made.calibration.T_lidar_imu, made.calibration.T_lidar_gnss
        assert T_imu is not None
        assert T_antenna is not None
        imu, antenna = T_imu[:3, 3], T_antenna[:3, 3]
        if made.scenario.carrier == "car":
            behind, ahead, aside, below = made.scenario.roof or (0.95, 0.75, 0.53, 0.3)
            assert -behind <= antenna[0] <= ahead
            assert abs(antenna[1]) <= aside
            assert -below <= antenna[2] <= 0, "on the roof, out of the LiDAR's level view"
            assert imu[2] < -below, "inside the car"
            assert imu[2] > -made.scenario.lidar_height, "above the ground"
        else:
            assert np.linalg.norm(imu) < 0.1
            assert 0.2 < antenna[2] < 0.6, "above the LiDAR, under the sky"
            assert np.hypot(*antenna[:2]) < 0.15


def test_static_start_comes_on_top_of_the_drive() -> None:
    plain, waiting = simulate("street"), simulate("street", static_start=2.0)
    assert waiting.ground_truth is not None
    assert plain.ground_truth is not None
    assert len(waiting) >= len(plain) + 20
    still = waiting.ground_truth.select(waiting.stamps_ns <= 2_000_000_000)
    np.testing.assert_allclose(still.poses, np.broadcast_to(np.eye(4), still.poses.shape), atol=1e-6)
    gap = waiting.ground_truth.positions[-1] - plain.ground_truth.positions[-1]
    assert np.linalg.norm(gap) < 3.0, "it ends where the street ends"


def test_scans_that_are_asked_for_may_pass_standing() -> None:
    assert len(simulate("street", count=285, static_start=2.0)) == 285
    with pytest.raises(UsageError, match="ends after 285 scans"):
        simulate("street", count=290, static_start=2.0)
