"""Trajectories of one pose a line, numbers between blanks: KITTI and TUM."""

from __future__ import annotations

import logging
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from lslam.errors import InputError
from lslam.formats import trajectory_csv
from lslam.formats.pose_rows import (
    Row,
    check_increasing,
    frame_in,
    numbers,
    poses_from_quaternions,
    read_rows,
    seconds_text,
    seconds_to_ns,
    write_lines,
)
from lslam.geometry import so3
from lslam.remote import as_path
from lslam.types.trajectory import Trajectory

log = logging.getLogger("lslam")

NOMINAL_STEP_NS = 100_000_000


def fits_kitti(first: str) -> bool:
    """Twelve numbers."""
    return not trajectory_csv.is_table(first) and len(first.split()) == 12


def read_kitti(path: Path, rows: list[Row], comments: list[str], times: Path | None) -> Trajectory:
    """Poses of camera 0; stamps of `times`, else of the times that belong to the file."""
    values = numbers(rows, 12, path, "KITTI poses")
    poses = np.tile(np.eye(4), (len(rows), 1, 1))
    poses[:, :3, :] = values.reshape(-1, 3, 4)
    wrong = np.flatnonzero(~so3.is_rotation(poses[:, :3, :3], 1e-2))
    if len(wrong):
        raise InputError(f"{path}, line {rows[wrong[0]].number}: the 3x3 part is no rotation matrix")
    stamps = _stamps_of_kitti(path, len(rows), times)
    return Trajectory(
        stamps_ns=np.arange(len(rows), dtype=np.int64) * NOMINAL_STEP_NS if stamps is None else stamps,
        poses=poses,
        frame="cam0",
        has_stamps=stamps is not None,
        source=str(path),
    )


def write_kitti(path: str | Path, trajectory: Trajectory) -> None:
    """Write a KITTI file, atomically: the poses as they are; the caller brings them into camera 0 (`T_cam0_lidar`)."""
    rows = trajectory.poses[:, :3, :].reshape(-1, 12).tolist()
    write_lines(path, [" ".join(f"{v:.12e}" for v in row) for row in rows])


def fits_tum(first: str) -> bool:
    """Eight numbers."""
    return not trajectory_csv.is_table(first) and len(first.split()) == 8


def read_tum(path: Path, rows: list[Row], comments: list[str], times: Path | None) -> Trajectory:
    """Poses of the body that a comment names."""
    values = numbers(rows, 8, path, "TUM (stamp tx ty tz qx qy qz qw)")
    stamps = np.array([seconds_to_ns(row.text.split()[0], path, row.number) for row in rows], np.int64)
    check_increasing(stamps, rows, path)
    return Trajectory(
        stamps_ns=stamps,
        poses=poses_from_quaternions(values[:, 1:4], values[:, 4:8], rows, path),
        frame=frame_in(comments) or "unknown",
        source=str(path),
    )


def write_tum(path: str | Path, trajectory: Trajectory, comment: str = "") -> None:
    """Write a TUM file, atomically: stamps with 9 decimals, xyzw, the frame in a comment; `comment` may have lines."""
    lines = ["# stamp_s tx ty tz qx qy qz qw", f"# frame: {trajectory.frame}"]
    lines += [f"# {line}" for line in comment.splitlines()]
    q = so3.to_quaternion(trajectory.poses[:, :3, :3])
    for stamp, p, r in zip(trajectory.stamps_ns.tolist(), trajectory.positions.tolist(), q.tolist(), strict=True):
        pose = " ".join([*(f"{v:.9f}" for v in p), *(f"{v:.12f}" for v in r)])
        lines.append(f"{seconds_text(stamp)} {pose}")
    write_lines(path, lines)


def read_times(path: str | Path) -> NDArray[np.int64]:
    """Stamps (N,) int64 ns of a file with one time in seconds per line, as KITTI's `times.txt`."""
    path = as_path(path)
    rows, _ = read_rows(path)
    if not rows:
        raise InputError(f"{path} holds no times")
    stamps = np.array([seconds_to_ns(row.text.strip(), path, row.number) for row in rows], np.int64)
    check_increasing(stamps, rows, path)
    return stamps


def find_times(path: str | Path) -> Path | None:
    """The times that belong to a KITTI pose file: `times.txt` beside it, `times/NN.txt` or `sequences/NN/times.txt`."""
    path = as_path(path)
    above = path.resolve().parent
    candidates = (
        above / "times.txt",
        above.parent / "times" / path.name,
        above.parent / "sequences" / path.stem / "times.txt",
    )
    return next((c for c in candidates if c.is_file() and c != path.resolve()), None)


def _stamps_of_kitti(path: Path, count: int, times: Path | None) -> NDArray[np.int64] | None:
    if times is not None:
        stamps = read_times(times)
        if len(stamps) != count:
            raise InputError(
                f"{times} has {len(stamps)} stamps but {path} has {count} poses: give the times of these poses"
            )
        return stamps
    found = find_times(path)
    if found is None:
        return None
    stamps = read_times(found)
    if len(stamps) != count:
        log.warning("%s has %d stamps but %s has %d poses: not used", found, len(stamps), path, count)
        return None
    log.info("%s: stamps from %s", path, found)
    return stamps
