"""From a sequence with an IMU to the motion model of a run: a few scans are registered without it first."""

from __future__ import annotations

import logging
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lslam.config import Config
from lslam.errors import InputError
from lslam.inertial.fusion import InertialMotion
from lslam.inertial.initialise import Start, start
from lslam.inertial.stream import ImuRefusedError
from lslam.odometry import create_odometry
from lslam.pipeline.front_end import estimate
from lslam.readers import select
from lslam.readers.selection import Selection
from lslam.types.scan_result import ScanResult
from lslam.types.sequence import Sequence

log = logging.getLogger("lslam")


@dataclass
class Inertial:
    """The IMU's part in a run.

    motion : None when it was refused from the start; problems : why it was, or could not do all of its work
    """

    motion: InertialMotion | None
    start: Start | None = None
    notes: list[str] = field(default_factory=list)
    problems: list[str] = field(default_factory=list)


def begin_inertial(sequence: Sequence, config: Config) -> Inertial:
    """Check and align the sequence's IMU; a refused one leaves the run to constant velocity.

    Raises InputError when the sequence has no IMU.
    """
    if sequence.imu is None:
        raise InputError(f"{sequence.path} has no IMU: name its file with `imu` in sequence.toml, or run without --imu")
    part = Inertial(None)
    T_lidar_imu = sequence.calibration.T_lidar_imu
    if T_lidar_imu is None:
        part.problems.append("T_lidar_imu is not known: the IMU is taken to sit in the LiDAR with the same axes")
        T_lidar_imu = np.eye(4)
    stamps, poses = _first_poses(sequence, config)
    try:
        begun = start(sequence.imu, T_lidar_imu, stamps, poses, int(sequence.stamps_ns[-1]), config.imu)
    except ImuRefusedError as error:
        part.problems.append(f"the IMU is refused, the run goes on without it: {error}")
        log.warning("%s", part.problems[-1])
        return part
    part.start, part.notes = begun, list(begun.notes)
    part.problems += begun.problems
    part.motion = InertialMotion(begun.imu, T_lidar_imu, begun.estimate, config.imu)
    for note in part.notes:
        log.info("%s", note)
    return part


def with_imu_settings(config: Config) -> Config:
    """The configuration of a run that the IMU predicts: better priors want a narrower search."""
    if not config.imu.use or config.imu.inlier_distance is None:
        return config
    narrow = config.registration.model_copy(update={"inlier_distance": config.imu.inlier_distance})
    return config.model_copy(update={"registration": narrow})


def _first_poses(sequence: Sequence, config: Config) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Stamps and poses of the first seconds, every scan of them, by `icp` in its defaults."""
    whole, first = (sequence.whole, int(sequence.indices[0])) if isinstance(sequence, Selection) else (sequence, 0)
    count = max(
        int(np.searchsorted(whole.stamps_ns[first:], whole.stamps_ns[first] + round(1e9 * config.imu.start_s))), 1
    )
    gate = config.preprocess.model_dump(include={"range_min", "range_max", "deskew"})
    plain = Config.model_validate({"preprocess": gate})
    results = estimate(select(whole, first, count), create_odometry(plain), threads=config.input.threads)
    bad = [k for k, r in enumerate(results) if r.status != "ok"]
    good = results[: bad[0]] if bad else results
    if not good:
        return whole.stamps_ns[first : first + 1], np.eye(4)[None]
    return np.array([r.stamp_ns for r in good], np.int64), np.stack([r.T_world_lidar for r in good])


def close_inertial(part: Inertial, results: list[ScanResult]) -> dict[str, Any]:
    """What the manifest says of the IMU when the run is over; problems that arose on the way are added to `part`."""
    motion, begun = part.motion, part.start
    if motion is None or begun is None:
        return {"used": False, "decisions": [*part.notes, *part.problems]}
    if motion.gap_scans:
        part.problems.append(
            f"IMU: {motion.gap_scans} scans fell into gaps of the IMU and were predicted by constant velocity"
        )
    if motion.refusal:
        part.problems.append(f"the IMU was refused on the way, the run went on without it: {motion.refusal}")
    last = motion.estimate
    errors = motion.prior_errors()
    norms = [r.prior_norm for r in results[1:] if r.status == "ok"]
    return {
        "used": not motion.refusal,
        "decisions": part.notes,
        "velocity": motion.config.velocity,
        "time_offset_s": round(begun.offset_s, 5),
        "is_checked_by_turns": begun.is_checked,
        "is_static_start": begun.is_static,
        "gyro_bias_rad_s": _rounded(last.gyro_bias, 5),
        "accel_bias_m_s2": _rounded(last.accel_bias, 4),
        "gravity_in_world_m_s2": _rounded(last.gravity, 4),
        "scans_in_gaps": motion.gap_scans,
        "median_prior_norm": round(float(np.median(norms)), 5) if norms else None,
        "prior_error_m": None if errors is None else round(errors[0], 5),
        "constant_velocity_error_m": None if errors is None else round(errors[1], 5),
    }


def _rounded(values: NDArray[np.float64], digits: int) -> list[float]:
    return [round(float(v), digits) for v in values]
