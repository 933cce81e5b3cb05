"""Trajectory formats with one pose per line and blanks between the numbers: KITTI and TUM."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from lslam.core.arrays import Floats, Longs
from lslam.core.errors import InputError
from lslam.core.geometry import noise, so3
from lslam.core.types.constraint import Constraint
from lslam.core.types.trajectory import Trajectory
from lslam.io.formats import trajectory_csv
from lslam.io.formats.atomic import write_text
from lslam.io.formats.text_tables import TextTable, looks_like_header, seconds_text, separator_of, split_cells
from lslam.io.formats.time_columns import find_clock, read_times
from lslam.io.remote import as_path

log = logging.getLogger("lslam")

NOMINAL_STEP_NS = 100_000_000
# A 3x4 or a 4x4 matrix, alone or behind one number.
WIDTHS = (12, 13, 16, 17)
_UPPER = np.triu_indices(6)
# From gtsam's order of `noise.to_body` (rotation first) to g2o's, and from rad to the quaternion's vector part.
_ORDER = np.array([3, 4, 5, 0, 1, 2])
_HALF = np.array([1.0, 1.0, 1.0, 0.5, 0.5, 0.5])


def fits_kitti(first: str) -> bool:
    """Whether a line holds a 3x4 or 4x4 pose, perhaps after an index or a time: 12, 13, 16 or 17 numbers."""
    separator = separator_of(first)
    cells = split_cells(first, separator)
    if len(cells) not in WIDTHS or looks_like_header(first):
        return False
    # EuRoC's tables are as wide as a stamp and a 4x4.
    return separator in (None, "\t") or _is_matrix(cells[-16:] if len(cells) > 13 else cells[-12:])


def _is_matrix(cells: list[str]) -> bool:
    """Whether the cells of a 3x4 or 4x4 matrix, row by row or column by column, hold a rotation."""
    try:
        numbers = np.array(cells, np.float64)
    except ValueError:
        return False
    return bool(np.isfinite(numbers).all() and so3.is_rotation(numbers.reshape(-1, 4)[None, :3, :3], 1e-2)[0])


def read_kitti(table: TextTable, times: Path | None) -> Trajectory:
    """Read poses of camera 0, with stamps from the file `times`, else from the times file that belongs to the poses."""
    trajectory = read_matrices(table)
    if not trajectory.has_stamps:
        stamps_ns = _stamps_of_kitti(table.path, scans_of(trajectory), times)
        if stamps_ns is not None:
            trajectory = replace(trajectory, stamps_ns=stamps_ns, has_stamps=True)
    return drop_lost_poses(trajectory)


def scans_of(trajectory: Trajectory) -> Longs:
    """(N,) numbers of the scans that poses without stamps belong to."""
    return trajectory.stamps_ns // NOMINAL_STEP_NS


def drop_lost_poses(trajectory: Trajectory) -> Trajectory:
    """Poses without NaN, and a note about the ones left out."""
    lost = np.asarray(np.isnan(trajectory.poses).any(axis=(1, 2)), np.bool_)
    if not lost.any():
        return trajectory
    note = f"{int(lost.sum())} of {len(lost)} rows hold NaN: lost poses, left out"
    return replace(trajectory.select(~lost), notes=(*trajectory.notes, note))


def read_matrices(table: TextTable) -> Trajectory:
    """Poses from rows of 12 or 16 numbers, row-major, perhaps after a scan number (KITTI-360) or a time.

    Lost poses are NaN. Without times the stamps count the scans at 10 Hz.
    Raises InputError naming the line that is short, no number, infinite, or no rotation.
    """
    table, rows = replace(table, names=()), table.rows
    width = len(rows[0].cells) if len(rows[0].cells) in WIDTHS else 12
    size = 16 if width >= 16 else 12
    table.check_widths(width, "KITTI poses")
    values = table.values(list(range(width)))
    lost = table.lost_rows(values, "NaN")
    matrices = values[:, -size:]
    poses = np.tile(np.eye(4), (len(rows), 1, 1))
    if size == 16 and not np.nan_to_num(matrices[:, [3, 7, 11]]).any() and np.nan_to_num(matrices[:, 12:15]).any():
        poses[:] = np.swapaxes(matrices.reshape(-1, 4, 4), 1, 2)
        how = "4x4 matrices, column by column"
    else:
        poses[:, :3, :] = matrices[:, :12].reshape(-1, 3, 4)
        how = f"{'4x4' if size == 16 else '3x4'} matrices, row by row"
    poses[lost] = np.nan
    wrong = np.flatnonzero(~lost & ~so3.is_rotation(np.nan_to_num(poses[:, :3, :3]), 1e-2))
    if len(wrong):
        raise table.error(int(wrong[0]), "the 3x3 part is no rotation matrix")
    scans = np.arange(len(rows), dtype=np.float64) if width == size else values[:, 0]
    is_number = np.all(scans == np.rint(scans)) and np.all(np.diff(scans) > 0) and 0 <= scans[0] <= scans[-1] < 1e8
    if is_number:
        how = how if width == size else f"the number of the scan, then {how}"
        stamps_ns = scans.astype(np.int64) * NOMINAL_STEP_NS
    else:
        clock = find_clock(table, other_columns=[1])
        assert clock is not None
        how, stamps_ns = f"the time, then {how}", clock.stamps_ns
        table.check_increasing(stamps_ns)
    frame, notes = ("cam0", ()) if width == 12 else ("unknown", (how,))
    return Trajectory(stamps_ns, poses, frame, not is_number, source=str(table.path), notes=notes)


def write_kitti(path: str | Path, trajectory: Trajectory) -> None:
    """Write a KITTI file, atomically. The caller has transformed the poses to camera 0 (`T_cam0_lidar`)."""
    rows = trajectory.poses[:, :3, :].reshape(-1, 12).tolist()
    write_text(Path(path), "".join(" ".join(f"{v:.12e}" for v in row) + "\n" for row in rows))


def fits_tum(first: str) -> bool:
    """Whether a line holds eight numbers between blanks, or a time and a position, perhaps after an index or a second time."""
    return not trajectory_csv.fits_csv(first) and not fits_kitti(first)


def read_tum(table: TextTable, times: Path | None) -> Trajectory:
    """Read poses of the body that a comment names."""
    return trajectory_csv.parse(table, scalar="last")


def write_tum(path: str | Path, trajectory: Trajectory, comment: str = "") -> None:
    """Write a TUM file, atomically: stamps with 9 decimals, xyzw, the frame in a comment; `comment` may have lines."""
    lines = ["# stamp_s tx ty tz qx qy qz qw", f"# frame: {trajectory.frame}"]
    lines += [f"# {line}" for line in comment.splitlines()]
    for stamp, pose in zip(trajectory.stamps_ns.tolist(), trajectory_csv.pose_texts(trajectory, "xyzw"), strict=True):
        lines.append(" ".join([seconds_text(stamp), *pose]))
    write_text(Path(path), "".join(f"{line}\n" for line in lines))


def find_times(path: str | Path) -> Path | None:
    """Times file of a KITTI pose file: `times.txt` beside it, `times/NN.txt` or `sequences/NN/times.txt`; None without."""
    path = as_path(path)
    above = path.resolve().parent
    candidates = (
        above / "times.txt",
        above.parent / "times" / path.name,
        above.parent / "sequences" / path.stem / "times.txt",
    )
    return next((c for c in candidates if c.is_file() and c != path.resolve()), None)


def _stamps_of_kitti(path: Path, scans: Longs, times: Path | None) -> Longs | None:
    """Stamps of the poses of `scans` (N,), of a file with one per scan; None without, InputError if `times` misfits."""
    source = find_times(path) if times is None else times
    if source is None:
        return None
    stamps_ns = read_times(source)
    is_of_some = scans[-1] >= len(scans) and scans[-1] < len(stamps_ns)
    if is_of_some or len(stamps_ns) == len(scans):
        if times is None:
            log.info("%s: stamps from %s", path, source)
        return stamps_ns[scans] if is_of_some else stamps_ns
    if times is not None:
        raise InputError(
            f"{times} has {len(stamps_ns)} stamps but {path} has {len(scans)} poses: give the times of these poses"
        )
    log.warning("%s has %d stamps but %s has %d poses: not used", source, len(stamps_ns), path, len(scans))
    return None


def write_g2o(path: Path, poses: Floats, constraints: Sequence[Constraint]) -> None:
    """Write poses (K, 4, 4), m, as vertices, the first fixed, and constraints as edges. Raises OutputError if it fails."""
    lines = [f"VERTEX_SE3:QUAT {k} {_pose_text(pose)}" for k, pose in enumerate(poses)]
    lines += ["FIX 0"] if len(poses) else []
    for c in constraints:
        body = noise.to_body(c.covariance, c.T_a_b)[np.ix_(_ORDER, _ORDER)] * np.outer(_HALF, _HALF)
        information = np.linalg.inv(body)
        values = " ".join(f"{v:.9g}" for v in (0.5 * (information + information.T))[_UPPER])
        lines.append(f"EDGE_SE3:QUAT {c.a} {c.b} {_pose_text(c.T_a_b)} {values}")
    write_text(path, "\n".join(lines) + "\n")


def _pose_text(T: Floats) -> str:
    """Position and quaternion xyzw of a pose (4, 4), with blanks between."""
    return " ".join(f"{v:.12g}" for v in (*T[:3, 3], *so3.to_quaternion(T[:3, :3])))
