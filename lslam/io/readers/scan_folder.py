"""A plain folder of scans: `.bin`, `.pcd`, `.ply` or `.npy` files, directly or in a subfolder."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TypeVar

import numpy as np

from lslam.core.arrays import Floats, Longs
from lslam.core.types.gnss import GnssStream
from lslam.core.types.imu import ImuStream
from lslam.core.types.sequence import Calibration
from lslam.core.types.trajectory import Trajectory
from lslam.io.formats.kitti_layout import read_mcd_extrinsics, read_odometry_calib
from lslam.io.formats.point_files import SUFFIXES
from lslam.io.formats.sequence_toml import SequenceInfo
from lslam.io.readers.clocks import follow
from lslam.io.readers.folder_sequence import Folder, FolderSequence
from lslam.io.readers.ground_truth import NumberedPoses, find_ground_truth, pair_by_number, to_lidar
from lslam.io.readers.listing import DEFAULT_RATE_HZ, check_stamps, list_scans, nominal_stamps
from lslam.io.readers.scan_stamps import StampedScans, stamp_scans
from lslam.io.readers.sidecars import calibration_over, load_streams

Stream = TypeVar("Stream", ImuStream, GnssStream)
KIND = "scan-folder"
SUBFOLDERS = ("data", "scans", "lidar", "points", "clouds", "pcd", "ply", "bin")
STAMP_NAMES = ("times.txt", "timestamps.txt", "stamps.txt", "times.csv", "timestamps.csv", "stamps.csv")


def locate(folder: Path) -> tuple[Path, str] | None:
    """`folder` and the reason, when point files lie in it or in a subfolder of a usual name; None otherwise."""
    files, _ = _scans_in(folder)
    # `NN/velodyne` or `drive/velodyne_points/data` themselves are plain folders too: that is how a user gets around a layout.
    return (folder, f"it holds *{files[0].suffix} files in {files[0].parent.name}/") if files else None


def open_folder(path: Path, overrides: SequenceInfo, why: str) -> FolderSequence:
    """Open the scans of `path`; overrides : outrank `sequence.toml`; why : reason for this format, for the notes.

    Raises InputError when there are none or `sequence.toml` is broken.
    """
    nothing = f"{path} holds no scans ({', '.join('*' + s for s in SUFFIXES)})"
    folder = Folder.begin(path, KIND, why, overrides, _scans_in(path), nothing)
    info, voice = folder.info, folder.voice
    if path.name == "velodyne" or path.parts[-2:] == ("velodyne_points", "data"):
        whole = path.parent if path.name == "velodyne" else path.parent.parent
        voice.problems.append(
            f"{path} is the inside of a KITTI sequence: give {whole} for its stamps, calibration, ground truth and the "
            "vertical correction of its points"
        )
    calib = path / "calib.txt"
    T_cam0_lidar = folder.calibration(calib, read_odometry_calib) if calib.is_file() else None
    calibration = calibration_over(info, Calibration(T_cam0_lidar))
    imu, gnss = load_streams(path, info, voice)
    beside = [stream.stamps_ns for stream in (imu, gnss) if stream is not None and len(stream)]
    scans, truth = _stamps_and_truth(folder, beside, calibration)
    folder.files = scans.files
    if info.vertical_correction_deg:
        voice.notes.append(f"vertical correction {info.vertical_correction_deg:g} deg, as stated")
    clock = folder.clock(scans.stamps_ns, scans.rate_hz)
    if info.rows and info.cols:
        voice.notes.append(f"organised clouds of {info.rows} rows x {info.cols} columns: the row is the ring")
    return folder.sequence(
        stamps_ns=scans.stamps_ns,
        rate_hz=scans.rate_hz,
        calibration=calibration,
        ground_truth=truth,
        clock=clock,
        imu=_with_scans(imu, scans, "IMU", folder),
        gnss=_with_scans(gnss, scans, "GNSS", folder),
        correction_deg=info.vertical_correction_deg or 0.0,
    )


def _scans_in(folder: Path) -> tuple[list[Path], list[str]]:
    """Scan files of the folder or the first of its subfolders that has any, and notes about those left out."""
    for place in (folder, *(folder / name for name in SUBFOLDERS)):
        if place.is_dir() and (scans := list_scans(place))[0]:
            return scans
    return [], []


def _stamps_and_truth(
    folder: Folder, beside: list[Longs], calibration: Calibration
) -> tuple[StampedScans, Trajectory | None]:
    """Stamps from their file, the file names, or the ground truth matched by index; else nominal. And the ground truth, or None.

    beside : stamps of other streams, for comparison
    """
    info, files, voice = folder.info, folder.files, folder.voice
    own = stamp_scans(files, _stamps_file(folder), folder.read, info.rate_hz, beside, voice)
    rate = info.rate_hz or DEFAULT_RATE_HZ
    nominal = nominal_stamps(len(files), rate)
    scans = own or StampedScans(files, nominal, rate, nominal)
    path = find_ground_truth(folder.path, info, voice)
    folder.files = scans.files
    truth = _truth(folder, path, scans.stamps_ns, calibration)
    if own is not None:
        return own, truth
    if path is not None and truth is not None and not np.isin(truth.stamps_ns, nominal).all():
        numbered, rule = pair_by_number(truth, files), "by its number column"
        if numbered is None and len(truth) == len(files):
            numbered, rule = NumberedPoses(truth, np.ones(len(files), np.bool_), truth.stamps_ns), "by index"
        if numbered is not None:
            voice.notes.append(f"no stamps of the scans: each takes the stamp of its row of {path.name}, {rule}")
            without = np.flatnonzero(~numbered.have)
            if len(without):
                voice.problems.append(
                    f"{path} has no pose for {len(without)} of {len(files)} scans, {files[without[0]].name} the first: "
                    "their stamps follow from their numbers, ground truth is of the others"
                )
            stamps, rate = check_stamps(numbered.stamps_ns, info.rate_hz, path, voice.problems)
            truth = replace(numbered.truth, stamps_ns=stamps[numbered.have])
            return StampedScans(files, stamps, rate, numbered.stamps_ns), truth
        voice.problems.append(
            f"{path} has {len(truth)} stamped poses for {len(files)} scans without stamps: ground truth is not used; "
            "add times.txt"
        )
        truth = None
    voice.notes.append(
        f"no stamps of the scans (looked for {', '.join(STAMP_NAMES[:3])} and stamps in file names): stamped at {rate:g} Hz"
    )
    return scans, truth


def _with_scans(stream: Stream | None, scans: StampedScans, what: str, folder: Folder) -> Stream | None:
    """IMU or GNSS stream, corrected where it steps together with the clock of the scans."""
    if stream is None:
        return None
    return replace(stream, stamps_ns=follow(stream.stamps_ns, scans.raw_ns, scans.stamps_ns, what, folder.voice))


def _stamps_file(folder: Folder) -> Path | None:
    """File of stamps, named by `sequence.toml` or one of `STAMP_NAMES`; None without it.

    That the file named by `sequence.toml` is missing becomes a problem.
    """
    stated = folder.info.stamps
    for name in STAMP_NAMES if stated is None else (stated,):
        if (folder.path / name).is_file():
            return folder.path / name
    if stated is not None:
        folder.voice.problems.append(f"stamps {folder.path / stated}, named by sequence.toml, do not exist")
    return None


def _truth(folder: Folder, path: Path | None, stamps: Longs, calibration: Calibration) -> Trajectory | None:
    """Ground truth of the file `path` as LiDAR poses; None if it is unusable."""
    truth = folder.truth(path, stamps)
    if truth is None:
        return None
    frame = truth.frame
    if frame == "cam0" and folder.info.ground_truth_frame is None and calibration.T_cam0_lidar is None:
        # Outside KITTI's layout and without a camera calibration, 12 numbers a line are LiDAR poses.
        frame = "unknown"
    T_body_lidar = _mcd_extrinsics(folder) if frame == "unknown" else None
    return to_lidar(truth, frame, calibration, folder.voice, T_body_lidar)


def _mcd_extrinsics(folder: Folder) -> Floats | None:
    """T_body_lidar of a Multi-Campus recording, by the calibration beside the scans; None without one."""
    for path in sorted(folder.path.glob("*_calib.yaml")):
        T_body_lidar = folder.calibration(path, read_mcd_extrinsics)
        if T_body_lidar is not None:
            folder.voice.notes.append(
                f"ground truth holds body poses, carried to the LiDAR with os_sensor of {path.name}"
            )
            return T_body_lidar
    return None
