"""What was known of an IMU after a scan: errors of its readings, gravity, and how it is mounted and timed."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lslam.types.gravity import GravityDirection

XYZ = ("x", "y", "z")
# In the order of the values.
IMU_STATES = (
    *(f"accel_bias_{axis}" for axis in XYZ), *(f"gyro_bias_{axis}" for axis in XYZ), *(f"gravity_{axis}" for axis in XYZ),
    *(f"mounting_{axis}" for axis in XYZ), "offset_s",
)  # fmt: skip


@dataclass(frozen=True)
class ImuState:
    """Means and standard deviations of `IMU_STATES`, NaN where one is not estimated.

    values, sigmas : (13,) accelerometer bias, m/s2, and gyroscope bias, rad/s, in IMU axes; gravity in the world, m/s2; the
    rotation vector from the IMU's axes to those of the T_lidar_imu that was given, rad; s to add to its stamps
    """

    values: NDArray[np.float64]
    sigmas: NDArray[np.float64]


@dataclass(frozen=True)
class ImuDiagnostics:
    """What an IMU made of one scan beside its pose, all None without one.

    state : errors of its readings after the scan, until it was refused
    gravity : the direction down; None where the scan is bridged or the IMU has a gap
    steady_norm : as `ScanResult.prior_norm`, of constant velocity, which the IMU took the place of
    steady_iterations : iterations of registration from constant velocity on the same map, of a sample of the scans
    saved_s : likewise, how much longer that took, s; the IMU's own part counted against it
    """

    state: ImuState | None = None
    gravity: GravityDirection | None = None
    steady_norm: float | None = None
    steady_iterations: int | None = None
    saved_s: float | None = None
