"""Ground truth of a sequence as LiDAR poses: found, matched with the scans and transformed to the LiDAR frame."""

from __future__ import annotations

import os
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np

from lslam.core.arrays import Bools, Floats, Longs
from lslam.core.errors import InputError
from lslam.core.geometry import geodesy, portable, se3, so3
from lslam.core.geometry.se3 import poses_at
from lslam.core.types.sequence import Calibration
from lslam.core.types.trajectory import Trajectory
from lslam.core.untrusted import whole_number
from lslam.io.formats.kitti_layout import POS_ACC, ROLL, YAW, Oxts
from lslam.io.formats.sequence_toml import FILE_NAME, SequenceInfo
from lslam.io.formats.text_tables import read_table
from lslam.io.formats.trajectory_files import read_trajectory
from lslam.io.formats.trajectory_lines import drop_lost_poses, fits_kitti, read_matrices, scans_of
from lslam.io.readers.listing import file_numbers, filled_stamps, rows_of
from lslam.io.remote import RemotePath, as_path

USUAL_NAMES = (
    "gt.tum",
    "groundtruth.tum",
    "ground_truth.tum",
    "gt_poses.tum",
    "poses.tum",
    "gt.csv",
    "groundtruth.csv",
    "ground_truth.csv",
    "pose_inW.csv",
    "poses.csv",
    "gt.txt",
    "groundtruth.txt",
    "ground_truth.txt",
    "poses.txt",
)

_NUMBER_COLUMNS = ("num", "number", "index", "scan")
# Above this the reference is worse than LiDAR odometry over the length of a drive.
_POOR_M = 0.2
# How far a scan may lie before the first or after the last OXTS sample: one period.
_BEYOND_NS = 100_000_000


@dataclass
class Voice:
    """Lists for the notes and problems of a reader."""

    notes: list[str]
    problems: list[str]


def find_ground_truth(folder: Path, info: SequenceInfo, voice: Voice) -> Path | None:
    """File named in `sequence.toml`, whose absence is a problem, else the first of `USUAL_NAMES` in `folder`, else None."""
    if info.ground_truth is not None:
        path = folder / info.ground_truth
        path = path.resolve() if isinstance(path, RemotePath) else Path(os.path.normpath(path))
        if path.is_file():
            return path
        voice.problems.append(f"ground truth {path}, named by {FILE_NAME}, does not exist")
        return None
    return next((folder / name for name in USUAL_NAMES if (folder / name).is_file()), None)


def load_poses(path: Path, stamps_ns: Longs, files: list[Path], voice: Voice) -> Trajectory | None:
    """Poses of `path` in the frame of the file; rows without time get the stamps of the scans they belong to."""
    try:
        table = read_table(path)
        truth = drop_lost_poses(read_matrices(table)) if fits_kitti(table.first) else read_trajectory(path)
        voice.notes += [f"ground truth {path}: {note}" for note in truth.notes]
        return truth if truth.has_stamps else _pair(truth, stamps_ns, files, voice)
    except InputError as error:
        voice.problems.append(f"ground truth is not used: {error}")
        return None


class NumberedPoses(NamedTuple):
    """Scans and poses matched by number: truth of the scans that `have` (N,) a pose, and stamps_ns (N,) of all scans."""

    truth: Trajectory
    have: Bools
    stamps_ns: Longs


def pair_by_number(truth: Trajectory, files: list[Path]) -> NumberedPoses | None:
    """Poses of a CSV matched with scan files by its first column, `num` (MCD).

    Scans without a pose get their stamps from their numbers. The result is None when the file has no such column or fewer
    than two of the scans. It is None, too, when poses and scans are equally many but of different numbers, since then their
    numbering differs.
    """
    numbers_of_files = file_numbers(files)
    table = read_table(as_path(truth.source))
    if numbers_of_files is None or not table.names or table.names[0].lower() not in _NUMBER_COLUMNS:
        return None
    row_of = {whole_number(row.cells[0]): k for k, row in enumerate(table.rows)}
    if len(table.rows) != len(truth) or None in row_of:
        return None
    rows = np.array([row_of.get(int(n), -1) for n in numbers_of_files])
    have = rows >= 0
    known = rows[have]
    if len(known) < 2 or np.any(np.diff(known) <= 0) or (not have.all() and len(truth) == len(files)):
        return None
    return NumberedPoses(
        truth.select(known), have, filled_stamps(numbers_of_files, numbers_of_files[have], truth.stamps_ns[known])
    )


def to_lidar(
    truth: Trajectory,
    frame: str,
    calibration: Calibration,
    voice: Voice,
    T_body_lidar: Floats | None = None,
) -> Trajectory | None:
    """`truth`, poses of `frame`, as poses of the LiDAR; None, with the reason in the problems, when extrinsics are missing.

    KITTI's camera poses live in a world that is camera 0 at the start: T_world_lidar = inv(Tr) @ T_cam0 @ Tr.
    Positions without rotations are not transformed, since the lever arm rotates with the body; a note says so.
    """
    if not truth.has_rotations:
        sentence = f"ground truth {truth.source} has positions without rotations: taken as the LiDAR's"
        if T_body_lidar is not None:
            sentence += f"; the lever arm of {np.linalg.norm(T_body_lidar[:3, 3]):.2f} m stays in them"
        voice.notes.append(sentence)
        return replace(truth, frame="lidar")
    if frame == "cam0":
        T = calibration.T_cam0_lidar
        if T is None:
            voice.problems.append(
                f"ground truth {truth.source} holds poses of camera 0 and no calibration gives Tr (T_cam0_lidar), so it "
                f"cannot be compared: add calib.txt with Tr, or [extrinsics] T_cam0_lidar to {FILE_NAME}"
            )
            return None
        return replace(truth, poses=se3.normalise(portable.product(se3.relative(T, truth.poses), T)), frame="lidar")
    if frame == "imu" and T_body_lidar is None and calibration.T_lidar_imu is not None:
        T_body_lidar = se3.inverse(calibration.T_lidar_imu)
    if T_body_lidar is not None:
        return replace(truth, poses=se3.normalise(portable.product(truth.poses, T_body_lidar)), frame="lidar")
    if frame == "imu":
        voice.problems.append(
            f"ground truth {truth.source} holds poses of the IMU and T_lidar_imu is unknown: they are taken as LiDAR poses; "
            f"add [extrinsics] T_lidar_imu to {FILE_NAME}"
        )
    elif frame != "lidar":
        voice.notes.append(
            f"ground truth {truth.source}: its body is not stated and taken as the LiDAR; ground_truth_frame in {FILE_NAME} "
            "says otherwise"
        )
    return replace(truth, frame="lidar")


def _pair(truth: Trajectory, stamps_ns: Longs, files: list[Path], voice: Voice) -> Trajectory | None:
    """Poses paired with scans by file number or index, at the scans' stamps; None, with a problem, without any."""
    numbers = scans_of(truth)
    count = int(numbers[-1]) + 1
    scans, rule = rows_of(files, count)
    numbers_of_files = file_numbers(files)
    if numbers_of_files is not None and len(truth) < count != len(files):
        scans, rule = numbers_of_files, "by the number in the file name"
    have = np.isin(scans, numbers)
    if not have.any():
        voice.problems.append(f"ground truth {truth.source} has no pose for any scan")
        return None
    if len(truth) != len(files) or not have.all():
        voice.problems.append(
            f"{truth.source} has {len(truth)} poses for {len(files)} scans: the {int(have.sum())} common ones are used, {rule}"
        )
    poses = truth.poses[np.searchsorted(numbers, scans[have])]
    return Trajectory(stamps_ns[have], poses, truth.frame, source=truth.source)


def oxts_truth(oxts: Oxts, scan_stamps_ns: Longs, T_lidar_imu: Floats | None, voice: Voice) -> Trajectory | None:
    """LiDAR poses from OXTS at the stamps of the scans, in the frame of the first; None, with a note, when data are missing.

    Rotations as by the devkit's convertOxtsToPose, Rz(yaw) Ry(pitch) Rx(roll), but positions in a transverse Mercator
    projection at the first fix: the devkit's spherical one stretches Karlsruhe by 0.1 to 0.2 %.
    """
    if oxts.stamps_ns is None or len(oxts.stamps_ns) < 2:
        return None
    if T_lidar_imu is None:
        voice.problems.append("OXTS is no ground truth here: calib_imu_to_velo.txt is missing, so its place is unknown")
        return None
    keep = np.concatenate([[True], oxts.stamps_ns[1:] > np.maximum.accumulate(oxts.stamps_ns)[:-1]])
    stamps, values = oxts.stamps_ns[keep], oxts.values[keep]
    if len(stamps) < 2:
        voice.problems.append("OXTS is no ground truth here: its stamps do not increase")
        return None
    if len(scan_stamps_ns) and (
        scan_stamps_ns[-1] < stamps[0] - _BEYOND_NS or scan_stamps_ns[0] > stamps[-1] + _BEYOND_NS
    ):
        voice.problems.append("OXTS is no ground truth here: it shares no time with the scans")
        return None
    positions = geodesy.to_local(values[:, :3], values[0, :3])
    T_enu_imu = se3.make(so3.from_euler_rpy(values[:, ROLL : YAW + 1]), positions)
    T_enu_lidar = portable.product(T_enu_imu, se3.inverse(T_lidar_imu))
    at = stamps
    if not np.isin(scan_stamps_ns, stamps).all():
        # LiDAR and OXTS have their own clocks' ticks: 5 ms apart are 7 cm at 15 m/s.
        at = scan_stamps_ns[(scan_stamps_ns >= stamps[0] - _BEYOND_NS) & (scan_stamps_ns <= stamps[-1] + _BEYOND_NS)]
        T_enu_lidar = poses_at(stamps, T_enu_lidar, at)
        voice.notes.append("OXTS poses are interpolated to the stamps of the scans")
    poses = se3.normalise(se3.relative(T_enu_lidar[0], T_enu_lidar))
    accuracy = float(np.median(values[:, POS_ACC]))
    voice.notes.append(
        "ground truth from OXTS (attitude and position, transverse Mercator at the first fix) as LiDAR poses; its own "
        f"pos_acc: median {accuracy:.2f} m, worst {values[:, POS_ACC].max():.2f} m"
    )
    if accuracy > _POOR_M:
        voice.notes.append(
            f"OXTS positions are poor (pos_acc median {accuracy:.2f} m): position errors against them say more about GNSS than "
            "about SLAM, trust rotation and short relative errors"
        )
    return Trajectory(at, poses, "lidar", True, None, "oxts")
