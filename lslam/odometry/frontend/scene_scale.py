"""What a few scans tell before a run: how the sensor is mounted, and the scale of the scene.

Lengths of registration follow the scene: a voxel is a plane only where it is small against the room.
"""

from __future__ import annotations

from itertools import islice

import numpy as np

from lslam.core.arrays import Floats
from lslam.core.config import Config
from lslam.core.config.odometry import RegistrationConfig
from lslam.core.errors import InputError
from lslam.core.types.imu import ImuStream
from lslam.core.types.scan import has_return
from lslam.core.types.sequence import Sequence, readable
from lslam.odometry.inertial.imu_cleaning import gravity_unit
from lslam.registration.preprocessing.ground import Up, find_up
from lslam.registration.preprocessing.prepare import clean_points
from lslam.registration.preprocessing.rings import ring_gap

# rad that a voxel spans at the median range: small against the scene, and as wide as several rings are apart, since a plane
# needs a few of them.
VOXEL_RAD, RINGS = 0.1, 5
USUAL_RANGE_M = RegistrationConfig().voxel_size / VOXEL_RAD
# Keys, by section, that shrink with the range, unless they are set.
LENGTHS = {
    "registration": ("voxel_size",),
    "preprocess": ("range_min", "map_leaf", "source_voxel"),
    "loam": ("grid_step", "feature_map_voxel"),
}


def with_scene_scale(config: Config, sequence: Sequence) -> Config:
    """As `in_scale`, with a note of the sequence on the voxel size if the scene is small."""
    scaled = in_scale(config, sequence)
    if scaled != config:
        voxel_m = scaled.registration.voxel_size
        sequence.notes.append(f"a small scene: the voxels of the local map are {voxel_m:g} m wide")
    return scaled


def in_scale(config: Config, sequence: Sequence) -> Config:
    """The configuration with the lengths that the user has not set reduced by the scale of a small scene, below 1."""
    free = {
        name: [key for key in keys if key not in getattr(config, name).model_fields_set]
        for name, keys in LENGTHS.items()
    }
    scale = scene_scale(sequence) if any(free.values()) else 1.0
    if scale >= 1.0:
        return config
    sections = {
        name: section.model_copy(update={key: round(getattr(section, key) * scale, 3) for key in free[name]})
        for name in LENGTHS
        if free[name] and (section := getattr(config, name))
    }
    return config.model_copy(update=sections)


def scene_scale(sequence: Sequence) -> float:
    """Scale of the scene relative to streets, at most 1, by the median range and the gap between rings.

    The largest of the first, middle and last scan, so that a covered sensor decides nothing; 1 where none can be read.
    """
    largest = 0.0
    for i in sorted({0, len(sequence) // 2, len(sequence) - 1}):
        try:
            points = sequence.scan(i).points[:, :3]
        except InputError:
            continue
        ranges = np.linalg.norm(points, axis=1)
        is_measured = np.isfinite(ranges) & (ranges > 0)
        if not is_measured.any():
            continue
        range_m = float(np.median(ranges[is_measured]))
        span = VOXEL_RAD if range_m >= USUAL_RANGE_M else max(VOXEL_RAD, RINGS * ring_gap(points[is_measured]))
        largest = max(largest, span * range_m / RegistrationConfig().voxel_size)
        if largest >= 1.0:
            break
    return min(largest, 1.0) or 1.0


def with_ring_gap(config: Config, sequence: Sequence) -> Config:
    """The configuration with `preprocess.ring_gap_deg` as the first scan shows it, unless it is set or no rings show."""
    if config.preprocess.ring_gap_deg is not None:
        return config
    scan = next((scan for _, scan in readable(range(len(sequence)), sequence.scan)), None)
    gap = 0.0 if scan is None else ring_gap(scan.points[has_return(scan.points[:, :3]), :3])
    if gap == 0.0:
        return config
    known = {"ring_gap_deg": round(float(np.degrees(gap)), 3)}
    return config.model_copy(update={"preprocess": config.preprocess.model_copy(update=known)})


def with_up(sequence: Sequence, config: Config) -> Config:
    """The configuration with `preprocess.up` set where the sensor is tilted by more than 45 deg; else unchanged."""
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
    """Up direction by the first scan, and by the IMU if the run uses it; None without a scan.

    Where the first scan does not confirm that z is up, the largest of the first scans decides: one may be a sliver.
    """
    plain = config.preprocess.model_copy(update={"remove_ground": False, "denoise": False})
    scans = (scan for _, scan in readable(range(len(sequence)), sequence.scan))
    first = next(scans, None)
    if first is None:
        return None
    gravity = _gravity_up(sequence, config.imu.start_s) if config.imu.use else None
    up = find_up(clean_points(first.points, plain), gravity)
    if up.tilt_deg == 0.0 and up.source != "axis":
        return up
    largest = max((first, *islice(scans, config.registration.start_scans - 1)), key=len)
    return find_up(clean_points(largest.points, plain), gravity)


def _gravity_up(sequence: Sequence, seconds: float) -> Floats | None:
    """(3,) up in the LiDAR frame as the IMU measures it in the first `seconds`, s; None where it measures no gravity."""
    imu, T_lidar_imu = sequence.imu, sequence.calibration.T_lidar_imu
    if imu is None or len(imu) < 2:
        return None
    begin, end = np.searchsorted(imu.stamps_ns, int(sequence.stamps_ns[0]) + np.array([0, round(1e9 * seconds)]))
    if end - begin > 1:
        imu = ImuStream(imu.stamps_ns[begin:end], imu.accel[begin:end], imu.gyro[begin:end])
    if not np.isfinite(imu.accel).all() or gravity_unit(imu)[1] is None:
        return None
    force = imu.accel.mean(axis=0)
    return np.asarray((np.eye(3) if T_lidar_imu is None else T_lidar_imu[:3, :3]) @ force / np.linalg.norm(force))
