"""Simulated drives with an IMU, made once, and ways to spoil the IMU."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
from numpy.typing import NDArray

from lslam.core.types.imu import ImuStream
from lslam.simulation.scenarios import SimulatedDrive, simulate

# Thesis, table 2.3: on each axis.
GYRO_BIAS, ACCEL_BIAS = 0.087266462, 0.4905


@cache
def walk(imu: str = "icm20948", static_start: float = 0.0, count: int = 100) -> SimulatedDrive:
    """A walker who looks about; scans are traced only where a test asks for them."""
    return simulate("walk", count=count, imu=imu, static_start=static_start)


@cache
def drone(count: int = 80) -> SimulatedDrive:
    """A flight at full speed from the first scan on."""
    return simulate("open", count=count, imu="icm20948")


def truth_of(drive: SimulatedDrive, count: int | None = None) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Stamps and true poses of the first scans."""
    assert drive.ground_truth is not None
    return drive.ground_truth.stamps_ns[:count], drive.ground_truth.poses[:count]


def stream_of(drive: SimulatedDrive) -> ImuStream:
    assert drive.imu is not None
    return drive.imu


def extrinsics_of(drive: SimulatedDrive) -> NDArray[np.float64]:
    assert drive.calibration.T_lidar_imu is not None
    return drive.calibration.T_lidar_imu


def late(imu: ImuStream, seconds: float) -> ImuStream:
    """The same readings with stamps that are `seconds` too late."""
    return replace(imu, stamps_ns=imu.stamps_ns + round(1e9 * seconds))
