"""KITTI odometry layout: `sequences/NN/{velodyne/*.bin, calib.txt, times.txt}` and `poses/NN.txt`."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from lslam.errors import InputError
from lslam.formats.calibration_files import read_odometry_calib
from lslam.formats.point_records import KITTI
from lslam.formats.sequence_toml import SequenceInfo
from lslam.readers.folder_sequence import FolderSequence
from lslam.readers.ground_truth import Voice, find_ground_truth, load_poses, to_lidar
from lslam.readers.listing import DEFAULT_RATE_HZ, list_scans, load_stamps, nominal_stamps
from lslam.readers.lookup import sequence_number
from lslam.readers.scan_folder import calibration_in, clock_of_files, folder_sequence, stamps_by_rows
from lslam.readers.scan_records import scan_record
from lslam.readers.sidecars import (
    calibration_over,
    compensation_note,
    load_gnss,
    load_imu,
    read_info,
    vertical_correction,
)
from lslam.types.sequence import Calibration
from lslam.types.trajectory import Trajectory

KIND = "kitti-odometry"


def locate(folder: Path) -> tuple[Path, str] | None:
    """The sequence folder in or at `folder` and why it is one; None when this is no KITTI odometry layout.

    Raises InputError listing the sequences when `folder` is a root that holds several.
    """
    if (folder / "velodyne").is_dir():
        return folder, "it has velodyne/, as KITTI odometry sequences do"
    for sequences in (folder / "sequences", folder / "dataset" / "sequences"):
        if sequences.is_dir():
            found = sorted(p for p in sequences.iterdir() if (p / "velodyne").is_dir())
            if len(found) == 1:
                return found[0], f"{sequences} holds this single KITTI odometry sequence"
            names = ", ".join(p.name for p in found)
            if found:
                raise InputError(f"{folder} holds {len(found)} sequences ({names}): name one, for example {found[0]}")
            raise InputError(f"{sequences} holds no sequence with a velodyne folder: fetch the velodyne data")
    return None


def open_folder(folder: Path, overrides: SequenceInfo, why: str) -> FolderSequence:
    """Open the sequence in `folder`. Raises InputError when it has no scans or a broken `sequence.toml`."""
    info, has_toml = read_info(folder, overrides)
    files, left_out = list_scans(folder / "velodyne")
    if not files:
        raise InputError(f"{folder / 'velodyne'} holds no scans (*.bin): fetch the velodyne data of this sequence")
    voice = Voice([f"format {KIND}: {why}", *left_out, *compensation_note(info)], [])
    files, stamps, rate = _stamps(folder, info, files, voice)
    calibration = calibration_over(info, Calibration(T_cam0_lidar=_tr(folder, voice)))
    record = scan_record(files, info, voice)
    # The benchmark's points have no times: scans with times are of another sensor.
    has_times = record is not None and "time" in record.names
    has_times_stated = info.per_point is not None or info.point_times not in (None, "none")
    is_benchmark = info.motion_compensated is None and not has_times and not has_times_stated
    compensated = True if is_benchmark else info.motion_compensated
    if info.motion_compensated is None and compensated:
        voice.notes.append("scans are motion compensated, as in the KITTI odometry benchmark")
    return folder_sequence(
        folder, KIND, replace(info, name=info.name or f"seq{folder.name}") if folder.name.isdigit() else info, voice,
        files=files, stamps_ns=stamps, rate_hz=rate, motion_compensated=compensated, calibration=calibration,
        ground_truth=_ground_truth(folder, info, files, stamps, calibration, voice),
        imu=load_imu(folder, info, voice.problems), gnss=load_gnss(folder, info, voice.problems),
        correction_deg=vertical_correction(info, files, record, voice.notes),
        sensor=info.sensor or (None if has_toml or record != KITTI else "HDL-64E"), record=record,
        clock=clock_of_files(files, record, stamps, rate, info, voice) if has_times and not compensated else None,
    )  # fmt: skip


def _stamps(
    folder: Path, info: SequenceInfo, files: list[Path], voice: Voice
) -> tuple[list[Path], NDArray[np.int64], float]:
    path = folder / (info.stamps or "times.txt")
    stamps = load_stamps(path, voice.problems) if path.is_file() else None
    if stamps is None:
        rate = info.rate_hz or DEFAULT_RATE_HZ
        voice.notes.append(f"no usable {path.name}: scans are stamped at {rate:g} Hz")
        return files, nominal_stamps(len(files), rate), rate
    return stamps_by_rows(files, stamps, path, info.rate_hz, voice)


def _tr(folder: Path, voice: Voice) -> NDArray[np.float64] | None:
    path = folder / "calib.txt"
    if not path.is_file():
        voice.notes.append(f"{path} is missing: the camera's place is unknown")
        return None
    return calibration_in(path, _read_tr, voice)


def _read_tr(path: Path) -> NDArray[np.float64]:
    T_cam0_lidar = read_odometry_calib(path)
    if T_cam0_lidar is None:
        raise InputError(f"{path} has no Tr (T_cam0_lidar): poses cannot be carried between camera and LiDAR")
    return T_cam0_lidar


def _ground_truth(
    folder: Path, info: SequenceInfo, files: list[Path], stamps: NDArray[np.int64], calibration: Calibration,
    voice: Voice,
) -> Trajectory | None:  # fmt: skip
    number = sequence_number(folder.name) or folder.name
    usual = [above / "poses" / f"{number}.txt" for above in (folder.parent.parent, folder.parent)]
    path = next((p for p in usual if p.is_file()), None)
    if info.ground_truth is not None:
        path = find_ground_truth(folder, info, voice)
    elif path is None and (folder / "poses.txt").is_file():
        voice.notes.append(
            f"{folder / 'poses.txt'} (SemanticKITTI) holds SLAM estimates, it is not taken as ground truth"
        )
    if path is None:
        return None
    truth = load_poses(path, stamps, files, voice)
    if truth is None:
        return None
    frame = info.ground_truth_frame or truth.frame
    if frame == "cam0":
        voice.notes.append(f"ground truth {path}: camera 0 poses, carried to the LiDAR with Tr")
    return to_lidar(truth, frame, calibration, voice)
