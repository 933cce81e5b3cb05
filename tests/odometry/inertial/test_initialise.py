"""What is found out about an IMU at the start, and which ones are refused, with true poses for registration's."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from imu_drives import ACCEL_BIAS, GYRO_BIAS, drone, extrinsics_of, late, stream_of, truth_of, walk
from numpy.typing import NDArray

from lslam.core.config.odometry import ImuConfig
from lslam.core.geometry import se3
from lslam.core.types.imu import ImuStream
from lslam.odometry.inertial.imu_cleaning import ImuRefusedError, clean, gaps, gravity_unit
from lslam.odometry.inertial.initialise import FirstPoses, InertialStart, covered_stretches, start
from lslam.simulation.scenarios import SimulatedDrive


def begun(
    drive: SimulatedDrive, imu: ImuStream | None = None, *, T_lidar_imu: object = None, **keys: object
) -> InertialStart:
    """The start after five seconds of true poses with the noise of a registration."""
    stamps, poses = truth_of(drive, 50)
    rng = np.random.default_rng(3)
    noisy = poses @ se3.exp(rng.normal(0, [0.002] * 3 + [2e-4] * 3, (len(poses), 6)))
    return start(
        stream_of(drive) if imu is None else imu,
        extrinsics_of(drive) if T_lidar_imu is None else np.asarray(T_lidar_imu),
        FirstPoses(stamps, noisy, stamps, noisy), int(drive.stamps_ns[-1]), ImuConfig.model_validate(keys),
    )  # fmt: skip


def spoilt(imu: ImuStream, **values: object) -> ImuStream:
    return dataclasses.replace(imu, **values)  # type: ignore[arg-type]


def test_first_poses_are_split_where_the_imu_has_a_gap() -> None:
    """Sweeps of 0.1 s and no sample from 0.32 to 0.58 s, of which 50 ms at either end are known: scans 3 to 6 stand apart."""
    stamps = np.arange(12) * 100_000_000
    numbered = np.arange(12.0)[:, None, None] * np.eye(4)
    first = FirstPoses(stamps, numbered, stamps + 50_000_000, numbered, numbered)
    times = np.arange(0, 1_400_000_000, 10_000_000)
    whole = ImuStream(times, np.ones((140, 3)), np.ones((140, 3)))
    heard = (times <= 320_000_000) | (times >= 580_000_000)
    parted = ImuStream(times[heard], whole.accel[heard], whole.gyro[heard])
    longest, opening = covered_stretches(first, parted)
    for found, scans, middles in ((longest, range(6, 12), range(6, 12)), (opening, range(4), range(3))):
        np.testing.assert_array_equal(found.stamps_ns, stamps[list(scans)])
        np.testing.assert_array_equal(found.poses[:, 3, 3], list(scans))
        np.testing.assert_array_equal(found.instants_ns, first.instants_ns[list(middles)])
        assert found.covariances is not None
        for values in (found.middles, found.covariances):
            np.testing.assert_array_equal(values[:, 0, 0], list(middles))
    for found in covered_stretches(first, whole):
        np.testing.assert_array_equal(found.stamps_ns, stamps)
        np.testing.assert_array_equal(found.instants_ns, first.instants_ns)


@pytest.mark.parametrize("make", [walk, drone])
def test_a_moving_start_finds_speed_biases_and_gravity(make: object) -> None:
    drive: SimulatedDrive = make()  # type: ignore[operator]
    found = begun(drive)
    assert drive.readings.imu is not None
    truth, T_world_city = drive.readings.imu.truth, np.linalg.inv(drive.T_city_world)
    assert not found.is_static
    # Axes that feel 2 % of each other add 0.2 m/s2 of gravity to two biases, and 2 % of any turn.
    assert np.abs(found.estimate.gyroscope.bias - GYRO_BIAS).max() < 0.012
    down = T_world_city[:3, :3] @ [0, 0, -9.80665]
    felt = found.estimate.accel_bias - extrinsics_of(drive)[:3, :3].T @ found.estimate.gravity
    meant = ACCEL_BIAS + np.array([0.02, 0.02, 0]) * 9.8 - extrinsics_of(drive)[:3, :3].T @ down
    assert np.abs(felt - meant).max() < 0.25
    velocity = T_world_city[:3, :3] @ truth.velocity[0]
    assert np.linalg.norm(found.estimate.velocity - velocity) < 0.1


def test_a_static_start_is_detected_and_levels_to_half_a_degree() -> None:
    drive = walk("icm20948-calibrated", static_start=2.0)
    found = begun(drive)
    assert found.is_static
    assert np.linalg.norm(found.estimate.velocity) < 0.02
    assert np.abs(found.estimate.gyroscope.bias).max() < 5e-4
    down = -np.linalg.inv(drive.T_city_world)[:3, 2]
    cosine = found.estimate.gravity @ down / np.linalg.norm(found.estimate.gravity)
    assert np.rad2deg(np.arccos(cosine)) < 0.5


def test_a_time_offset_of_the_imu_is_corrected() -> None:
    drive = walk()
    for wrong in (0.02, -0.035):
        found = begun(drive, late(stream_of(drive), wrong))
        assert found.offset_s == pytest.approx(-wrong, abs=2e-3)
        right = begun(drive).imu.stamps_ns
        assert np.abs(found.imu.stamps_ns - right[: len(found.imu)]).max() < 2_500_000
    assert begun(drive).offset_s == pytest.approx(0.0, abs=2e-3)


def test_a_configured_time_offset_and_configured_values_are_used() -> None:
    drive = drone()
    found = begun(
        drive, late(stream_of(drive), 3.0), time_offset_s=-3.0, gyro_bias=(GYRO_BIAS,) * 3, initial_velocity=(9.0, 0, 0)
    )
    assert found.offset_s == -3.0
    assert np.abs(found.estimate.gyroscope.bias - GYRO_BIAS).max() < 6e-3
    assert np.linalg.norm(found.estimate.velocity - [9.0, 0, 0]) < 0.1


@pytest.mark.parametrize("make", [walk, drone])
def test_a_configured_bias_is_used_unless_the_first_scans_contradict_it(make: object) -> None:
    drive: SimulatedDrive = make()  # type: ignore[operator]
    right, wrong = (begun(drive, gyro_bias=(given,) * 3).estimate.gyroscope for given in (GYRO_BIAS, GYRO_BIAS - 0.025))
    assert np.abs(right.bias - GYRO_BIAS).max() < 5e-4
    assert np.sqrt(np.diag(right.covariance)[:3]).max() < 5e-4
    assert np.abs(wrong.bias - GYRO_BIAS).max() < 0.004


def test_readings_in_g_are_converted_and_noted() -> None:
    drive = walk()
    imu = stream_of(drive)
    found = begun(drive, spoilt(imu, accel=imu.accel / 9.80665))
    assert np.linalg.norm(found.estimate.gravity) == pytest.approx(9.81, abs=0.1)
    assert any("in g" in note for note in found.notes)


def test_a_slow_imu_is_noted_with_its_rate() -> None:
    drive = walk()
    imu = stream_of(drive)
    found = begun(drive, ImuStream(imu.stamps_ns[::10], imu.accel[::10], imu.gyro[::10]))
    assert any("10 Hz" in note for note in found.notes)


def about_axes(imu: ImuStream, axes: NDArray[np.float64]) -> ImuStream:
    """As an IMU with other axes (3, 3), in the rows, would feel it."""
    return spoilt(imu, accel=imu.accel @ axes.T, gyro=imu.gyro @ axes.T)


ROLLED = np.roll(np.eye(3), 1, axis=0)


@pytest.mark.parametrize(
    ("kind", "says"),
    [
        ("zeros", "repeats one reading"),
        ("degrees", "deg/s"),
        ("no gravity", "neither in m/s2"),
        ("axes", "T_lidar_imu"),
        ("sign", "do not fit"),
        ("a quarter turn aside", r"turned by (8|9)\d deg"),
        ("half a turn aside", r"turned by 1[78]\d deg"),
        ("an axis mirrored", "when mirrored"),
        ("two axes swapped", "when mirrored"),
        ("forces down", "point the other way"),
        ("seconds late", "imu.time_offset_s"),
        ("hours late", "imu.time_offset_s"),
        ("noise", "check"),
        ("not finite", "not finite"),
        ("going back", "go back"),
        ("empty", "0 usable"),
    ],
)
def test_invalid_streams_are_refused_with_a_reason(kind: str, says: str) -> None:
    drive = walk()
    imu = stream_of(drive)
    rng = np.random.default_rng(0)
    nan = imu.gyro.copy()
    nan[::4] = np.nan
    bad = {
        "zeros": lambda: spoilt(imu, accel=imu.accel * 0, gyro=imu.gyro * 0),
        "degrees": lambda: spoilt(imu, gyro=np.rad2deg(imu.gyro)),
        "no gravity": lambda: spoilt(imu, accel=imu.accel - imu.accel.mean(axis=0)),
        "axes": lambda: spoilt(imu, gyro=imu.gyro @ ROLLED.T),
        "sign": lambda: spoilt(imu, gyro=-imu.gyro),
        "a quarter turn aside": lambda: about_axes(imu, np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])),
        "half a turn aside": lambda: about_axes(imu, np.diag([-1.0, -1, 1])),
        "an axis mirrored": lambda: about_axes(imu, np.diag([-1.0, 1, 1])),
        "two axes swapped": lambda: about_axes(imu, np.array([[0.0, 1, 0], [1, 0, 0], [0, 0, 1]])),
        "forces down": lambda: spoilt(imu, accel=-imu.accel),
        "seconds late": lambda: late(imu, 1.5),
        "hours late": lambda: late(imu, 3600.0),
        "noise": lambda: spoilt(imu, gyro=rng.normal(0, imu.gyro.std(), imu.gyro.shape)),
        "not finite": lambda: spoilt(imu, gyro=nan),
        "going back": lambda: spoilt(imu, stamps_ns=imu.stamps_ns[::-1].copy()),
        "empty": lambda: ImuStream(imu.stamps_ns[:0], imu.accel[:0], imu.gyro[:0]),
    }[kind]()
    with pytest.raises(ImuRefusedError, match=says):
        begun(drive, bad)


def test_a_time_offset_beyond_the_near_search_is_reported_with_its_value() -> None:
    """At 0.25 s a slow turner's rates still correlate above the limit of a refusal."""
    drive = drone()
    shake = walk()
    for made, wrong in ((drive, 0.6), (shake, 0.33)):
        with pytest.raises(ImuRefusedError, match=r"imu\.time_offset_s") as refused:
            begun(made, late(stream_of(made), wrong))
        assert f"{-wrong:.2f}"[:4] in str(refused.value)


def test_a_rough_road_does_not_hide_gravity() -> None:
    """Heave of 0.6 g at 1.3 Hz: its calmest half seconds weigh a quarter less than gravity."""
    t = np.arange(0, 60, 0.01)
    up = 9.80665 + 6.0 * np.sin(2 * np.pi * 1.3 * t)
    rough = ImuStream((t * 1e9).astype(np.int64), np.outer(up, [0, 0, 1.0]), np.zeros((len(t), 3)))
    assert gravity_unit(rough)[1] == "m/s2"
    assert gravity_unit(spoilt(rough, accel=rough.accel / 9.80665))[1] == "g"
    assert gravity_unit(spoilt(rough, accel=rough.accel - [0, 0, 9.80665]))[1] is None


def test_wrong_extrinsics_are_reported_with_the_rotation_that_corrects_them() -> None:
    drive = walk()
    with pytest.raises(ImuRefusedError, match=r"turned by 1[12]\d deg"):
        begun(drive, T_lidar_imu=se3.make(ROLLED, np.zeros(3)))


def test_few_bad_samples_are_left_out_and_counted() -> None:
    imu = stream_of(walk())
    accel, stamps = imu.accel.copy(), imu.stamps_ns.copy()
    accel[7, 1] = np.inf
    stamps[20:23] -= 200_000_000
    cleaned = clean(ImuStream(stamps, accel, imu.gyro), 0, int(stamps[-1]))
    assert len(cleaned.imu) == len(imu) - 4
    assert (np.diff(cleaned.imu.stamps_ns) > 0).all()
    assert [note.split(" of ")[0] for note in cleaned.notes] == ["IMU: 1", "IMU: 3"]


def test_gaps_are_longer_than_the_limit_and_than_a_slow_rate() -> None:
    fast = ImuStream(np.array([0, 10, 20, 170, 180]) * 1_000_000, np.zeros((5, 3)), np.zeros((5, 3)))
    assert gaps(fast, 0.1)[1:-1].tolist() == [[70_000_000, 120_000_000]]
    assert gaps(fast, 0.1)[[0, -1], [1, 0]].tolist() == [-100_000_000, 280_000_000]
    assert len(gaps(fast, 0.15)) == 2
    slow = ImuStream(np.arange(9) * 101_000_000, np.zeros((9, 3)), np.zeros((9, 3)))
    assert len(gaps(slow, 0.1)) == 2
    assert gaps(slow, 0.1)[0, 1] < 0
    assert gaps(slow, 0.1)[-1, 0] > 808_000_000


def test_a_sensor_that_stood_has_no_path_that_tells_of_the_sign() -> None:
    """Forces that lead against a path of a centimetre: so far registration errs, as among traffic that starts."""
    t, swing = np.arange(0.0, 3.0, 0.01), np.pi
    accel = np.column_stack([0.01 * swing**2 * np.sin(swing * t), 0 * t, 9.81 + 0 * t])
    rng = np.random.default_rng(0)
    imu = ImuStream(
        (1e9 * t).astype(np.int64), accel + rng.normal(0, 1e-3, accel.shape), rng.normal(0, 1e-3, accel.shape)
    )

    def started(metres: float) -> InertialStart:
        poses = np.tile(np.eye(4), (29, 1, 1))
        poses[:, 0, 3] = metres * np.sin(swing * t[::10][:29])
        stamps = imu.stamps_ns[::10][:29]
        first = FirstPoses(stamps, poses, stamps, poses, np.tile(1e-6 * np.eye(6), (29, 1, 1)))
        return start(imu, np.eye(4), first, int(stamps[-1]), ImuConfig())

    assert np.linalg.norm(started(0.01).estimate.gravity) == pytest.approx(9.81, abs=0.05)
    imu = spoilt(imu, accel=np.column_stack([20 * accel[:, 0], accel[:, 1:]]))
    with pytest.raises(ImuRefusedError, match="point the other way"):
        started(0.2)
