"""A plain folder of scans: `.bin`, `.pcd`, `.ply` or `.npy` files, directly or in a subfolder."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from lslam.errors import InputError
from lslam.formats.calibration_files import read_mcd_extrinsics, read_odometry_calib
from lslam.formats.point_cloud import PointCloud
from lslam.formats.point_files import SUFFIXES, read_points
from lslam.formats.point_records import KITTI, PointRecord
from lslam.formats.sequence_toml import LENGTHS, SequenceInfo
from lslam.printable import printable
from lslam.readers.clocks import follow
from lslam.readers.folder_sequence import FolderSequence
from lslam.readers.ground_truth import Numbered, Voice, find_ground_truth, load_poses, pair_by_number, to_lidar
from lslam.readers.listing import DEFAULT_RATE_HZ, check_stamps, list_scans, nominal_stamps
from lslam.readers.point_clock import PointClock, open_clock, read_samples
from lslam.readers.point_times import Sample
from lslam.readers.point_units import settle_unit
from lslam.readers.scan_records import scan_record
from lslam.readers.scan_stamps import StampedScans, rows_of_scans, stamp_scans
from lslam.readers.sidecars import (
    calibration_over,
    compensation_note,
    load_gnss,
    load_imu,
    per_point_folder,
    read_info,
    stated_times,
)
from lslam.types.gnss import GnssStream
from lslam.types.imu import ImuStream
from lslam.types.sequence import Calibration
from lslam.types.trajectory import Trajectory

Stream = TypeVar("Stream", ImuStream, GnssStream)
KIND = "scan-folder"
Read = Callable[[Path], PointCloud]
Matrix = NDArray[np.float64]
SUBFOLDERS = ("data", "scans", "lidar", "points", "clouds", "pcd", "ply", "bin")
STAMP_NAMES = ("times.txt", "timestamps.txt", "stamps.txt", "times.csv", "timestamps.csv", "stamps.csv")


def locate(folder: Path) -> tuple[Path, str] | None:
    """`folder` when point files lie in it or in a subfolder of a usual name, and why; None otherwise."""
    scans = _scans_in(folder)
    if scans is None:
        return None
    # `NN/velodyne` or `drive/velodyne_points/data` themselves are plain folders too: that is how a user gets around a layout.
    return folder, f"it holds *{scans[1][0].suffix} files in {scans[0].name}/"


def open_folder(folder: Path, overrides: SequenceInfo, why: str) -> FolderSequence:
    """Open the scans of `folder`. Raises InputError when there are none or `sequence.toml` is broken."""
    info, _ = read_info(folder, overrides)
    scans = _scans_in(folder)
    if scans is None:
        raise InputError(f"{folder} holds no scans ({', '.join('*' + s for s in SUFFIXES)})")
    _, files, left_out = scans
    voice = Voice([f"format {KIND}: {why}", *left_out, *compensation_note(info)], [])
    if folder.name == "velodyne" or folder.parts[-2:] == ("velodyne_points", "data"):
        whole = folder.parent if folder.name == "velodyne" else folder.parent.parent
        voice.problems.append(
            f"{folder} is the inside of a KITTI sequence: give {whole} for its stamps, calibration, ground truth and the "
            "vertical correction of its points"
        )
    calib = folder / "calib.txt"
    T_cam0_lidar = calibration_in(calib, read_odometry_calib, voice) if calib.is_file() else None
    calibration = calibration_over(info, Calibration(T_cam0_lidar))
    record = scan_record(files, info, voice)
    read = partial(read_points, record=record)
    imu, gnss = load_imu(folder, info, voice.problems), load_gnss(folder, info, voice.problems)
    beside = [stream.stamps_ns for stream in (imu, gnss) if stream is not None and len(stream)]
    scans_of, truth = _stamps_and_truth(folder, info, files, read, beside, calibration, voice)
    files, stamps, rate, _ = scans_of
    if info.vertical_correction_deg:
        voice.notes.append(f"vertical correction {info.vertical_correction_deg:g} deg, as stated")
    clock = clock_of_files(files, record, stamps, rate, info, voice)
    if info.rows and info.cols:
        voice.notes.append(f"organised clouds of {info.rows} rows x {info.cols} columns: the row is the ring")
    return folder_sequence(
        folder, KIND, info, voice,
        files=files, stamps_ns=stamps, rate_hz=rate, motion_compensated=info.motion_compensated,
        calibration=calibration, ground_truth=truth,
        imu=_with_scans(imu, scans_of, "IMU", voice), gnss=_with_scans(gnss, scans_of, "GNSS", voice),
        correction_deg=info.vertical_correction_deg or 0.0, clock=clock, sensor=info.sensor, record=record,
    )  # fmt: skip


def folder_sequence(folder: Path, kind: str, info: SequenceInfo, voice: Voice, **parts: Any) -> FolderSequence:
    """The sequence of `parts`, see `FolderSequence`, with what `info` says of every kind of folder, its points in m."""
    sequence = FolderSequence(
        name=info.name or printable(folder.name), path=folder, kind=kind, rows=info.rows, cols=info.cols,
        per_point=per_point_folder(folder, info), rings=info.rings or info.rows,
        unit_m=LENGTHS.get(info.point_unit or ""), notes=voice.notes, problems=voice.problems,
        stated_times=stated_times(info), **parts,
    )  # fmt: skip
    return settle_unit(sequence)


def stamps_by_rows(
    files: list[Path], stamps: NDArray[np.int64], source: Path, rate_hz: float | None, voice: Voice
) -> tuple[list[Path], NDArray[np.int64], float]:
    """The scans that have a row of stamps in `source`, the stamps of these, which increase, and the rate, Hz."""
    files, stamps = rows_of_scans(source, stamps, files, voice)
    return files, *check_stamps(stamps, rate_hz, source, voice.problems)


def calibration_in(path: Path, read: Callable[[Path], Matrix | None], voice: Voice) -> Matrix | None:
    """What `read` makes of the file; None, which is a problem, where it cannot be read."""
    try:
        return read(path)
    except InputError as error:
        voice.problems.append(f"calibration is not used: {error}")
        return None


def _scans_in(folder: Path) -> tuple[Path, list[Path], list[str]] | None:
    for place in (folder, *(folder / name for name in SUBFOLDERS)):
        if place.is_dir():
            files, notes = list_scans(place)
            if files:
                return place, files, notes
    return None


def _stamps_and_truth(
    folder: Path, info: SequenceInfo, files: list[Path], read: Read, beside: list[NDArray[np.int64]],
    calibration: Calibration, voice: Voice,
) -> tuple[StampedScans, Trajectory | None]:  # fmt: skip
    """Stamps from their file, the file names, or the ground truth that goes with the scans by index; else nominal."""
    own = _own_stamps(folder, info, files, read, beside, voice)
    rate = info.rate_hz or DEFAULT_RATE_HZ
    nominal = nominal_stamps(len(files), rate)
    scans = own or StampedScans(files, nominal, rate, nominal)
    truth_file = find_ground_truth(folder, info, voice)
    truth = None
    if truth_file is not None:
        truth = _truth(truth_file, folder, info, scans.files, scans.stamps_ns, calibration, voice)
    if own is not None:
        return own, truth
    if truth is not None and truth_file is not None and not np.isin(truth.stamps_ns, nominal).all():
        numbered = pair_by_number(truth, files)
        if numbered is not None or len(truth) == len(files):
            rule = "by its number column" if numbered is not None else "by index"
            voice.notes.append(f"no stamps of the scans: each takes the stamp of its row of {truth_file.name}, {rule}")
            if numbered is None:
                numbered = Numbered(truth, np.ones(len(files), np.bool_), truth.stamps_ns)
            without = np.flatnonzero(~numbered.have)
            if len(without):
                voice.problems.append(
                    f"{truth_file} has no pose for {len(without)} of {len(files)} scans, {files[without[0]].name} the first: "
                    "their stamps follow from their numbers, ground truth is of the others"
                )
            stamps, rate = check_stamps(numbered.stamps_ns, info.rate_hz, truth_file, voice.problems)
            truth = replace(numbered.truth, stamps_ns=stamps[numbered.have])
            return StampedScans(files, stamps, rate, numbered.stamps_ns), truth
        voice.problems.append(
            f"{truth_file} has {len(truth)} stamped poses for {len(files)} scans without stamps: ground truth is not used; "
            "add times.txt"
        )
        truth = None
    voice.notes.append(
        f"no stamps of the scans (looked for {', '.join(STAMP_NAMES[:3])} and stamps in file names): stamped at {rate:g} Hz"
    )
    return scans, truth


def _with_scans(stream: Stream | None, scans: StampedScans, what: str, voice: Voice) -> Stream | None:
    """An IMU or GNSS stream, moved where it steps with the clock of the scans."""
    if stream is None:
        return None
    moved = follow(stream.stamps_ns, scans.raw_ns, scans.stamps_ns, what)
    voice.problems.extend(moved.problems)
    return replace(stream, stamps_ns=moved.stamps_ns)


def _own_stamps(
    folder: Path, info: SequenceInfo, files: list[Path], read: Read, beside: list[NDArray[np.int64]], voice: Voice
) -> StampedScans | None:
    names = STAMP_NAMES if info.stamps is None else (info.stamps,)
    path = next((p for p in (folder / name for name in names) if p.is_file()), None)
    if path is None and info.stamps is not None:
        voice.problems.append(f"stamps {folder / info.stamps}, named by sequence.toml, do not exist")
    return stamp_scans(files, path, read, info.rate_hz, beside, voice)


def _truth(
    path: Path, folder: Path, info: SequenceInfo, files: list[Path], stamps: NDArray[np.int64],
    calibration: Calibration, voice: Voice,
) -> Trajectory | None:  # fmt: skip
    truth = load_poses(path, stamps, files, voice)
    if truth is None:
        return None
    frame = info.ground_truth_frame or truth.frame
    if frame == "cam0" and info.ground_truth_frame is None and calibration.T_cam0_lidar is None:
        # Outside KITTI's layout and without a camera calibration, 12 numbers a line are LiDAR poses.
        frame = "unknown"
    T_body_lidar = _mcd_extrinsics(folder, voice) if frame == "unknown" else None
    return to_lidar(truth, frame, calibration, voice, T_body_lidar)


def _mcd_extrinsics(folder: Path, voice: Voice) -> Matrix | None:
    """T_body_lidar of a Multi-Campus recording, where its calibration lies beside the scans."""
    for path in sorted(folder.glob("*_calib.yaml")):
        T_body_lidar = calibration_in(path, read_mcd_extrinsics, voice)
        if T_body_lidar is not None:
            voice.notes.append(f"ground truth holds body poses, carried to the LiDAR with os_sensor of {path.name}")
            return T_body_lidar
    return None


def clock_of_files(
    files: list[Path], record: PointRecord | None, stamps: NDArray[np.int64], rate: float, info: SequenceInfo,
    voice: Voice,
) -> PointClock | None:  # fmt: skip
    """How per-point times of the files are read, learnt on a few scans."""
    if record == KITTI:
        return None
    samples = read_samples(len(files), lambda k: Sample(read_points(files[k], record), int(stamps[k])))
    return open_clock(list(samples.values()), rate, info, voice.notes, voice.problems)
