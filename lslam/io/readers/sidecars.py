"""Files beside the scans: `sequence.toml`, the IMU and GNSS files it names; and the HDL-64E's vertical correction."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import TypeVar

import numpy as np

from lslam.core.errors import InputError
from lslam.core.types.gnss import GnssStream
from lslam.core.types.imu import ImuStream
from lslam.core.types.sequence import Calibration, StatedTimes, readable
from lslam.io.formats.point_files import read_points
from lslam.io.formats.point_records import KITTI, PointRecord
from lslam.io.formats.sequence_toml import EXTRINSICS, FILE_NAME, SequenceInfo, read_sequence_toml
from lslam.io.formats.stamped_csv import read_gnss_csv, read_imu_csv
from lslam.io.readers.ground_truth import Voice

T = TypeVar("T")

# Elevation error of KITTI's HDL-64E calibration (Deschaud 2018, IMLS-SLAM).
HDL64_CORRECTION_DEG = 0.205
# An HDL-64E looks up to +2 deg; objects close by reach a few more through the laser offsets.
_HDL64_TOP_DEG = 6.0


def read_info(folder: Path, overrides: SequenceInfo) -> tuple[SequenceInfo, bool]:
    """Settings of the user over those of `sequence.toml` in `folder`, and whether that file exists."""
    path = folder / FILE_NAME
    if not path.is_file():
        return overrides, False
    return overrides.over(read_sequence_toml(path)), True


def compensation_note(info: SequenceInfo) -> list[str]:
    """Sentence on motion compensation as `sequence.toml` or the user states it; empty when nothing is stated."""
    if info.motion_compensated is None:
        return []
    if not info.motion_compensated:
        return ["scans are motion distorted, as stated"]
    instant = f", to {info.compensated_to}: the stamp is taken as that instant" if info.compensated_to else ""
    return [f"scans are motion compensated, as stated{instant}"]


def stated_times(info: SequenceInfo) -> StatedTimes:
    """Stated rule of the points' times. Raises InputError if it contradicts a stated motion compensation."""
    if info.motion_compensated and info.point_times not in (None, "none"):
        raise InputError(
            f"point_times = {info.point_times!r} and motion_compensated = true contradict each other: state one of them"
        )
    return StatedTimes(info.point_times, info.point_time_reference)


def vertical_correction(info: SequenceInfo, files: list[Path], record: PointRecord | None, notes: list[str]) -> float:
    """Angle, deg, by which points of KITTI's HDL-64E are raised; 0 if not needed. The reason is added to `notes`."""
    if info.vertical_correction_deg is not None:
        degrees = info.vertical_correction_deg
        notes.append(
            f"vertical correction {degrees:g} deg, as stated" if degrees else "no vertical correction, as stated"
        )
        return degrees
    why = ""
    sensor = re.sub(r"[^a-z0-9]", "", (info.sensor or "HDL-64E").lower()).replace("velodyne", "")
    if not sensor.startswith("hdl64"):
        why = f"the sensor is {info.sensor}"
    elif record not in (None, KITTI):
        why = "the points are no records of KITTI's HDL-64E"
    elif (top_deg := _top_elevation_deg(files, record)) is not None and top_deg > _HDL64_TOP_DEG:
        why = f"points up to {top_deg:.1f} deg of elevation are no HDL-64E's"
    if why:
        notes.append(f"no vertical correction: {why}")
        return 0.0
    notes.append(f"vertical correction of {HDL64_CORRECTION_DEG} deg for KITTI's HDL-64E, applied in the reader")
    return HDL64_CORRECTION_DEG


def _top_elevation_deg(files: list[Path], record: PointRecord | None) -> float | None:
    """99th percentile of elevation beyond 2 m in the first of five scans with 100 such points; None without one."""
    for _, cloud in readable(range(len(files[:5])), lambda k: read_points(files[k], record)):
        points = cloud.points[np.isfinite(cloud.points).all(1)]
        h = np.hypot(points[:, 0], points[:, 1])
        far = h > 2
        if far.sum() >= 100:
            return float(np.degrees(np.percentile(np.arctan2(points[far, 2], h[far]), 99)))
    return None


def load_streams(folder: Path, info: SequenceInfo, voice: Voice) -> tuple[ImuStream | None, GnssStream | None]:
    """The IMU and the fixes in the files that `sequence.toml` names, or in `imu.csv` and `gnss.csv` in the sequence folder."""
    imu = _load(folder, info.imu, "imu.csv", read_imu_csv, voice)
    return imu, _load(folder, info.gnss, "gnss.csv", read_gnss_csv, voice)


def calibration_over(info: SequenceInfo, calibration: Calibration) -> Calibration:
    """Extrinsics that `sequence.toml` states, else those of the reader."""
    stated = {name: T for name in EXTRINSICS if (T := getattr(info, name)) is not None}
    return replace(calibration, frames={**calibration.frames, **(info.frames or {})}, **stated)


def per_point_folder(folder: Path, info: SequenceInfo) -> Path | None:
    """The folder of per-point times and rings that `sequence.toml` names, or None. Raises InputError when it does not exist."""
    if info.per_point is None:
        return None
    path = folder / info.per_point
    if not path.is_dir():
        raise InputError(f"{path}, named by per_point of {folder / FILE_NAME}, is no folder: correct or remove the key")
    return path


def _load(
    folder: Path, stated_name: str | None, usual: str, read: Callable[[Path, list[str]], T], voice: Voice
) -> T | None:
    """The file `stated_name` of `sequence.toml`, or `usual`, read by `read`; None, perhaps with a problem, if none is valid."""
    path = folder / (stated_name or usual)
    if not path.is_file():
        if stated_name is not None:
            voice.problems.append(f"{path}, named by {FILE_NAME}, does not exist")
        return None
    try:
        return read(path, voice.notes)
    except InputError as error:
        voice.problems.append(f"not used: {error}")
        return None
