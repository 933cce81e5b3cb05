"""Which way is down for the LiDAR, against the simulation's own attitude: in a world that drifts, through gaps, on garbage."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from imu_drives import drone, extrinsics_of, stream_of, truth_of, walk
from numpy.typing import NDArray

from lslam.core.config import Config
from lslam.core.config.odometry import ImuConfig
from lslam.core.geometry import se3, so3
from lslam.core.types.imu import GravityDirection, ImuStream
from lslam.core.types.scan import Span
from lslam.odometry.inertial.fusion import InertialMotion
from lslam.odometry.inertial.initialise import FirstPoses, start
from lslam.simulation.scenarios import SimulatedDrive

Floats = NDArray[np.float64]

BIAS = {"gyro_bias": (0.0873,) * 3, "accel_bias": (0.4905,) * 3}


def directions(
    drive: SimulatedDrive, tilts: Floats | None = None, imu: ImuStream | None = None, **keys: Any
) -> list[GravityDirection | None]:
    """As a run would store them per scan; registration gives true poses in a world that turns by `tilts` (N,) about x."""
    stamps, poses = truth_of(drive)
    if tilts is not None:
        poses = se3.make(so3.exp(tilts[:, None] * np.array([1.0, 0, 0])), np.zeros((len(tilts), 3))) @ poses
    config = ImuConfig.model_validate(keys)
    first = FirstPoses(stamps[:50], poses[:50], stamps[:50], poses[:50])
    begun = start(stream_of(drive), extrinsics_of(drive), first, int(stamps[-1]), config)
    motion = InertialMotion(begun if imu is None else replace(begun, imu=imu), Config(imu=config))
    found = []
    for stamp, pose in zip(stamps, poses, strict=True):
        motion.correct(int(stamp), pose, motion.sweep(int(stamp), Span()))
        found.append(motion.gravity_at(pose))
    return found


def tilt_errors(drive: SimulatedDrive, found: list[GravityDirection | None]) -> Floats:
    """Angles, rad, from where the simulated sensor has its down."""
    down = -drive.city_poses[:, 2, :3]
    known = [direction.direction for direction in found if direction is not None]
    assert len(known) == len(found)
    return np.asarray(np.arccos(np.clip(np.sum(np.stack(known) * down, axis=1), -1, 1)))


@pytest.mark.parametrize("is_bias_given", [False, True])
@pytest.mark.parametrize("make", [walk, drone])
def test_the_direction_of_gravity_is_within_its_sigma(make: object, is_bias_given: bool) -> None:
    """Biases of 0.49 m/s2 on each axis, axes 2 % askew, and a swinging or banking sensor included."""
    drive: SimulatedDrive = make()  # type: ignore[operator]
    found = directions(drive, **(BIAS if is_bias_given else {}))
    off = tilt_errors(drive, found)
    sigmas = np.array([direction.sigma for direction in found if direction is not None])
    assert (off < 3 * np.sqrt(2) * sigmas).all()
    assert sigmas[-1] < sigmas[0]


def test_the_direction_of_gravity_follows_the_sensor_while_registration_drifts() -> None:
    """A third and more of a degree of drift in half a minute shows at once: that is what a graph corrects by."""
    drive = walk(count=300)
    tilts = np.deg2rad(np.linspace(0, 1.0, len(drive.stamps_ns)))
    straight, drifted = directions(drive, **BIAS), directions(drive, tilts, **BIAS)
    a, b = straight[-1], drifted[-1]
    assert a is not None
    assert b is not None
    moved = np.rad2deg(np.arccos(min(float(a.direction @ b.direction), 1.0)))
    assert moved < 0.7, "a direction that is fixed in the world would move by 1 deg"


def test_no_direction_of_gravity_in_a_gap_or_with_integrated_velocity() -> None:
    drive = walk()
    imu = stream_of(drive)
    keep = (imu.stamps_ns < 6_020_000_000) | (imu.stamps_ns > 6_310_000_000)
    found = directions(drive, imu=ImuStream(imu.stamps_ns[keep], imu.accel[keep], imu.gyro[keep]))
    missing = [k for k, direction in enumerate(found) if direction is None]
    assert 3 <= len(missing) <= 5
    assert all(60 <= k <= 65 for k in missing)
    assert directions(drive, velocity="integrated") == [None] * len(drive.stamps_ns)
