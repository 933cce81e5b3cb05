"""Trajectories of one pose a line, numbers between blanks: KITTI and TUM."""

from __future__ import annotations

import logging
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from lslam.errors import InputError
from lslam.formats import trajectory_csv
from lslam.formats.pose_rows import Row, check_increasing, numbers, pose_texts, seconds_text, write_lines
from lslam.formats.stamp_files import read_times
from lslam.formats.text_tables import TextTable
from lslam.formats.time_columns import find_clock
from lslam.geometry import so3
from lslam.remote import as_path
from lslam.types.trajectory import Trajectory

log = logging.getLogger("lslam")

NOMINAL_STEP_NS = 100_000_000
WIDTHS = (12, 16)


def fits_kitti(first: str) -> bool:
    """The upper 3x4 of a pose or the whole 4x4, with an index or a time before it or not: 12, 13, 16 or 17 numbers."""
    return not trajectory_csv.is_table(first) and len(first.split()) in (*WIDTHS, *(width + 1 for width in WIDTHS))


def read_kitti(path: Path, rows: list[Row], comments: list[str], times: Path | None) -> Trajectory:
    """Poses of camera 0; stamps of `times`, else of the times that belong to the file."""
    table = read_matrices(path, rows)
    notes = [] if table.note is None else [table.note]
    kept = np.asarray(~np.isnan(table.poses).any(axis=(1, 2)), np.bool_)
    if not kept.all():
        notes.append(f"{int((~kept).sum())} of {len(kept)} rows hold NaN: lost poses, left out")
    stamps = table.stamps_ns
    if stamps is None:
        stamps = _stamps_of_kitti(path, table.numbers, times)
    return Trajectory(
        stamps_ns=(table.numbers * NOMINAL_STEP_NS if stamps is None else stamps)[kept],
        poses=table.poses[kept],
        frame="cam0" if table.is_cam0 else "unknown",
        has_stamps=stamps is not None,
        source=str(path),
        notes=tuple(notes),
    )


@dataclass(frozen=True)
class MatrixRows:
    """Poses as matrices: numbers (N,) of the scans they belong to, poses (N, 4, 4), NaN where lost; stamps_ns (N,) or None.

    is_cam0 : whether they are camera 0's by convention; note : how they were read, None for 12 numbers
    """

    numbers: NDArray[np.int64]
    poses: NDArray[np.float64]
    stamps_ns: NDArray[np.int64] | None
    is_cam0: bool
    note: str | None


def read_matrices(path: Path, rows: list[Row]) -> MatrixRows:
    """The poses of rows of 12 or 16 numbers, row-major, perhaps behind a number of the scan (KITTI-360) or a time.

    Raises InputError naming the line that is short, no number, infinite, or no rotation.
    """
    width = len(rows[0].text.split())
    size = next((w for w in WIDTHS if width in (w, w + 1)), WIDTHS[0])
    lead = width - size if width in (size, size + 1) else 0
    values = numbers(rows, size + lead, path, "KITTI poses", may_be_nan=True)
    matrices = values[:, lead:]
    poses = np.tile(np.eye(4), (len(rows), 1, 1))
    if size == 16 and not np.nan_to_num(matrices[:, [3, 7, 11]]).any() and np.nan_to_num(matrices[:, 12:15]).any():
        poses[:] = np.swapaxes(matrices.reshape(-1, 4, 4), 1, 2)
        how = "4x4 matrices, column by column"
    else:
        poses[:, :3, :] = matrices[:, :12].reshape(-1, 3, 4)
        how = f"{'4x4' if size == 16 else '3x4'} matrices, row by row"
    lost = np.isnan(matrices).any(axis=1)
    poses[lost] = np.nan
    if lost.all():
        raise InputError(f"{path}: every row holds NaN: there is no pose")
    wrong = np.flatnonzero(~lost & ~so3.is_rotation(np.nan_to_num(poses[:, :3, :3]), 1e-2))
    if len(wrong):
        raise InputError(f"{path}, line {rows[wrong[0]].number}: the 3x3 part is no rotation matrix")
    indices, stamps = np.arange(len(rows), dtype=np.int64), None
    if lead:
        first = values[:, 0]
        is_number = bool(
            np.all(first == np.rint(first)) and np.all(np.diff(first) > 0) and 0 <= first[0] <= first[-1] < 1e8
        )
        if is_number:
            indices, how = first.astype(np.int64), f"the number of the scan, then {how}"
        else:
            clock = find_clock(TextTable(path, (), rows, [row.text.split()[:1] for row in rows], None))
            assert clock is not None
            stamps, how = clock.stamps_ns, f"the time, then {how}"
            check_increasing(stamps, rows, path)
    return MatrixRows(indices, poses, stamps, width == 12, None if width == 12 else how)


def write_kitti(path: str | Path, trajectory: Trajectory) -> None:
    """Write a KITTI file, atomically: the poses as they are; the caller brings them into camera 0 (`T_cam0_lidar`)."""
    rows = trajectory.poses[:, :3, :].reshape(-1, 12).tolist()
    write_lines(path, [" ".join(f"{v:.12e}" for v in row) for row in rows])


def fits_tum(first: str) -> bool:
    """Other numbers between blanks: eight, or a time and a position, with an index or a second column of time or not."""
    return not trajectory_csv.is_table(first) and not fits_kitti(first)


def read_tum(path: Path, rows: list[Row], comments: list[str], times: Path | None) -> Trajectory:
    """Poses of the body that a comment names."""
    return trajectory_csv.parse(path, rows, comments, scalar="last")


def write_tum(path: str | Path, trajectory: Trajectory, comment: str = "") -> None:
    """Write a TUM file, atomically: stamps with 9 decimals, xyzw, the frame in a comment; `comment` may have lines."""
    lines = ["# stamp_s tx ty tz qx qy qz qw", f"# frame: {trajectory.frame}"]
    lines += [f"# {line}" for line in comment.splitlines()]
    for stamp, pose in zip(trajectory.stamps_ns.tolist(), pose_texts(trajectory, "xyzw"), strict=True):
        lines.append(" ".join([seconds_text(stamp), *pose]))
    write_lines(path, lines)


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


def _stamps_of_kitti(path: Path, scans: NDArray[np.int64], times: Path | None) -> NDArray[np.int64] | None:
    """Stamps of the poses that belong to `scans` (N,), of a file with one for each scan."""
    found = find_times(path) if times is None else times
    if found is None:
        return None
    stamps = read_times(found)
    is_numbered = bool(np.any(np.diff(scans) != 1)) or bool(scans[0])
    if len(stamps) == len(scans) or (is_numbered and scans[-1] < len(stamps)):
        if times is None:
            log.info("%s: stamps from %s", path, found)
        return stamps[scans] if is_numbered and scans[-1] < len(stamps) else stamps
    if times is not None:
        raise InputError(
            f"{times} has {len(stamps)} stamps but {path} has {len(scans)} poses: give the times of these poses"
        )
    log.warning("%s has %d stamps but %s has %d poses: not used", found, len(stamps), path, len(scans))
    return None
