"""`imu.csv`: inertial measurements; EuRoC's imu0/data.csv reads as well."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from lslam.formats.stamped_csv import read_stamped_csv, write_stamped_csv
from lslam.types.imu import ImuStream

_NAMES = ("accel_x", "accel_y", "accel_z", "gyro_x", "gyro_y", "gyro_z")
_ALIASES = [
    *((f"accel_{axis}", f"a{axis}", f"a_rs_s_{axis}", f"acc_{axis}", f"linear_acceleration_{axis}") for axis in "xyz"),
    *((f"gyro_{axis}", f"w{axis}", f"w_rs_s_{axis}", f"g{axis}", f"angular_velocity_{axis}") for axis in "xyz"),
]


def read_imu_csv(path: Path) -> ImuStream:
    """Read specific force (m/s2, +g up at rest) and angular rate (rad/s) in the IMU frame; nothing is converted.

    Columns are `stamp_ns` (or seconds as `t`, `time`, `timestamp`), `accel_x..z` and `gyro_x..z` or their usual aliases.
    Raises InputError naming file and line.
    """
    stamps, values = read_stamped_csv(path, _ALIASES)
    return ImuStream(stamps, values[:, :3], values[:, 3:])


def write_imu_csv(path: Path, imu: ImuStream) -> None:
    """Write `imu` atomically; it reads back exactly."""
    write_stamped_csv(path, _NAMES, imu.stamps_ns, np.hstack([imu.accel, imu.gyro]))
