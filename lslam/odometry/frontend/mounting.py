"""How the sensor is mounted: up in the LiDAR frame, found once at the beginning of a run."""

from __future__ import annotations

from itertools import islice

import numpy as np

from lslam.core.config import Config
from lslam.core.types.arrays import Floats
from lslam.core.types.imu import ImuStream
from lslam.core.types.sequence import Sequence, readable
from lslam.odometry.inertial.imu_cleaning import gravity_unit
from lslam.registration.preprocessing.prepare import clean_points
from lslam.registration.preprocessing.up import Up, find_up

# Scans of which the largest serves: the first message may be a sliver.
MOUNTING_SCANS = 3
# s; gravity is averaged over the first of the drive: swings of a hand and most of what a car accelerates cancel.
LEVELLING_S = 10.0


def with_up(sequence: Sequence, config: Config) -> Config:
    """The configuration with `preprocess.up` where the sensor hangs, lies or is pitched by more than 45 deg; else as it is."""
    if config.preprocess.up is not None:
        return config
    up = _up_of(sequence, config)
    if up is None or up.tilt_deg == 0.0:
        return config
    x, y, z = (round(float(v), 6) for v in up.direction)
    sequence.notes.append(
        f"up in the LiDAR frame: {x:.3f}, {y:.3f}, {z:.3f}, {up.tilt_deg:.0f} deg from its z, by {up.source} (preprocess.up)"
    )
    return config.model_copy(update={"preprocess": config.preprocess.model_copy(update={"up": (x, y, z)})})


def _up_of(sequence: Sequence, config: Config) -> Up | None:
    """Up by the first scan, and by the IMU if the run uses it; None without a scan.

    What the first scan does not confirm, that z is up, is asked of the largest of a few.
    """
    plain = config.preprocess.model_copy(update={"remove_ground": False, "denoise": False})
    scans = (scan for _, scan in readable(range(len(sequence)), sequence.scan))
    first = next(scans, None)
    if first is None:
        return None
    gravity = _gravity_up(sequence, int(sequence.stamps_ns[0])) if config.imu.use else None
    up = find_up(clean_points(first.points, plain), gravity)
    if up.tilt_deg == 0.0 and up.source != "axis":
        return up
    largest = max((first, *islice(scans, MOUNTING_SCANS - 1)), key=len)
    return find_up(clean_points(largest.points, plain), gravity)


def _gravity_up(sequence: Sequence, begin_ns: int) -> Floats | None:
    """(3,) up in the LiDAR frame as the IMU measures it; None where it measures no gravity."""
    imu, T_lidar_imu = sequence.imu, sequence.calibration.T_lidar_imu
    if imu is None or len(imu) < 2:
        return None
    begin, end = np.searchsorted(imu.stamps_ns, [begin_ns, begin_ns + round(1e9 * LEVELLING_S)])
    if end - begin > 1:
        imu = ImuStream(imu.stamps_ns[begin:end], imu.accel[begin:end], imu.gyro[begin:end])
    if not np.isfinite(imu.accel).all() or gravity_unit(imu)[1] is None:
        return None
    force = imu.accel.mean(axis=0)
    return np.asarray((np.eye(3) if T_lidar_imu is None else T_lidar_imu[:3, :3]) @ force / np.linalg.norm(force))
