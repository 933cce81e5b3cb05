"""Trajectory files: KITTI, TUM, EuRoC and CSV with named columns, read and written side by side.

| format | line | time | rotation | frame |
|---|---|---|---|---|
| `kitti` | 12 numbers, the upper 3x4 of a pose, row-major | none, or `times.txt` | matrix | cam0 |
| `tum` | `stamp tx ty tz qx qy qz qw` | s | xyzw | in a comment: `# frame: lidar` |
| `euroc` | `ns, p, q_w q_x q_y q_z, ...` | ns | wxyz | imu |
| `csv` | columns named in the header | s, or the unit in the name | by name | unknown |

Stamps go between text and int64 ns without passing through a float. Matrices are kept as the file states them, so that
numbers agree with tools that do the same.
"""

from __future__ import annotations

import logging
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from lslam.errors import InputError, UsageError, nearest
from lslam.formats import trajectory_csv
from lslam.formats.atomic import atomic_write
from lslam.formats.pose_rows import (
    Row,
    check_increasing,
    frame_in,
    numbers,
    poses_from_quaternions,
    read_rows,
    seconds_text,
    seconds_to_ns,
)
from lslam.geometry import so3
from lslam.types.trajectory import Trajectory

log = logging.getLogger("lslam")

FORMATS = ("kitti", "tum", "euroc", "csv")
NOMINAL_STEP_NS = 100_000_000


def read_trajectory(path: str | Path, format: str | None = None, times: str | Path | None = None) -> Trajectory:  # noqa: A002
    """Read poses T_world_body.

    Parameters
    ----------
    path : the file, or a run folder, whose `trajectory.tum` is read
    format : one of FORMATS; detected from the first line when None
    times : file with one stamp in seconds per line, for KITTI poses; when None, `times.txt` beside the file is taken, or
        the one of the same sequence in KITTI's layout; without any, stamps count poses at 10 Hz and `has_stamps` is False

    Raises
    ------
    InputError naming file and line: missing, empty, short lines, NaN, no rotation, stamps that do not increase.
    UsageError for an unknown `format`.
    """
    path = Path(path)
    if path.is_dir():
        path = _in_run_folder(path)
    rows, comments = read_rows(path)
    if format is not None and format not in FORMATS:
        raise UsageError(f"no trajectory format {format!r}; {nearest(format, FORMATS)}")
    if not rows:
        raise InputError(f"{path} holds no poses: the file is empty or all comments")
    kind = format or detect_format(path, rows)
    if kind == "kitti":
        return _read_kitti(path, rows, None if times is None else Path(times))
    if kind == "tum":
        return _read_tum(path, rows, comments)
    return trajectory_csv.parse(path, rows, comments, is_euroc=kind == "euroc")


def detect_format(path: Path, rows: list[Row]) -> str:
    """Name of the format of `rows`, the lines of a file without comments; InputError when it is none we know."""
    first = rows[0].text
    fields = first.split()
    if any(separator in first for separator in ",;") or trajectory_csv.looks_like_header(first):
        return trajectory_csv.detect(first)
    if len(fields) == 12:
        return "kitti"
    if len(fields) == 8:
        return "tum"
    raise InputError(
        f"{path}, line {rows[0].number}: {len(fields)} columns are no trajectory format lslam knows "
        "(12 numbers: KITTI; 8: TUM; commas: EuRoC or named columns); --format forces one"
    )


def write_tum(path: str | Path, trajectory: Trajectory, comment: str = "") -> None:
    """Write a TUM file, atomically: stamps with 9 decimals, xyzw, the frame in a comment; `comment` may have lines."""
    lines = ["# stamp_s tx ty tz qx qy qz qw", f"# frame: {trajectory.frame}"]
    lines += [f"# {line}" for line in comment.splitlines()]
    q = so3.to_quaternion(trajectory.poses[:, :3, :3])
    for stamp, p, r in zip(trajectory.stamps_ns.tolist(), trajectory.positions.tolist(), q.tolist(), strict=True):
        pose = " ".join([*(f"{v:.9f}" for v in p), *(f"{v:.12f}" for v in r)])
        lines.append(f"{seconds_text(stamp)} {pose}")
    _write_lines(path, lines)


def write_kitti(path: str | Path, trajectory: Trajectory) -> None:
    """Write a KITTI file, atomically: the poses as they are; the caller brings them into camera 0 (`T_cam0_lidar`)."""
    rows = trajectory.poses[:, :3, :].reshape(-1, 12).tolist()
    _write_lines(path, [" ".join(f"{v:.12e}" for v in row) for row in rows])


def write_euroc(path: str | Path, trajectory: Trajectory) -> None:
    """Write a EuRoC csv, atomically: integer ns, position, quaternion wxyz."""
    lines = [
        "#timestamp [ns],p_RS_R_x [m],p_RS_R_y [m],p_RS_R_z [m],q_RS_w [],q_RS_x [],q_RS_y [],q_RS_z []",
        f"# frame: {trajectory.frame}",
    ]
    q = np.roll(so3.to_quaternion(trajectory.poses[:, :3, :3]), 1, axis=-1)
    for stamp, p, r in zip(trajectory.stamps_ns.tolist(), trajectory.positions.tolist(), q.tolist(), strict=True):
        lines.append(",".join([str(stamp), *(f"{v:.9f}" for v in p), *(f"{v:.12f}" for v in r)]))
    _write_lines(path, lines)


def read_times(path: str | Path) -> NDArray[np.int64]:
    """Stamps (N,) int64 ns of a file with one time in seconds per line, as KITTI's `times.txt`."""
    path = Path(path)
    rows, _ = read_rows(path)
    if not rows:
        raise InputError(f"{path} holds no times")
    stamps = np.array([seconds_to_ns(row.text.strip(), path, row.number) for row in rows], np.int64)
    check_increasing(stamps, rows, path)
    return stamps


def find_times(path: str | Path) -> Path | None:
    """The times that belong to a KITTI pose file: `times.txt` beside it, `times/NN.txt` or `sequences/NN/times.txt`."""
    path = Path(path)
    above = path.resolve().parent
    candidates = (
        above / "times.txt",
        above.parent / "times" / path.name,
        above.parent / "sequences" / path.stem / "times.txt",
    )
    return next((c for c in candidates if c.is_file() and c != path.resolve()), None)


def _in_run_folder(folder: Path) -> Path:
    inside = folder / "trajectory.tum"
    if not inside.is_file():
        raise InputError(f"{folder} is a folder without trajectory.tum: name a run folder or a trajectory file")
    return inside


def _read_kitti(path: Path, rows: list[Row], times: Path | None) -> Trajectory:
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


def _read_tum(path: Path, rows: list[Row], comments: list[str]) -> Trajectory:
    values = numbers(rows, 8, path, "TUM (stamp tx ty tz qx qy qz qw)")
    stamps = np.array([seconds_to_ns(row.text.split()[0], path, row.number) for row in rows], np.int64)
    check_increasing(stamps, rows, path)
    return Trajectory(
        stamps_ns=stamps,
        poses=poses_from_quaternions(values[:, 1:4], values[:, 4:8], rows, path),
        frame=frame_in(comments) or "unknown",
        source=str(path),
    )


def _write_lines(path: str | Path, lines: list[str]) -> None:
    with atomic_write(Path(path)) as stream:
        stream.writelines(f"{line}\n".encode("utf-8", "backslashreplace") for line in lines)
