"""Trajectories as tables: EuRoC ground truth, MCD, prisms and RTK, exports of ROS, PlotJuggler and pandas."""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from lslam.core.errors import InputError
from lslam.core.geometry import se3, so3
from lslam.core.printable import shown
from lslam.core.types.trajectory import Trajectory
from lslam.io.formats.atomic import write_text
from lslam.io.formats.text_tables import TextTable, looks_like_header
from lslam.io.formats.time_columns import find_clock, unread_columns
from lslam.io.formats.trajectory_columns import named_columns, placed_columns

Floats = NDArray[np.float64]
# A path that strays so far from a line, in parts of its length, has bends, in which a body turns.
BENT = 0.01


def fits_csv(first: str) -> bool:
    """Whether the first line is of a table and not of numbers between blanks."""
    return any(separator in first for separator in ",;") or looks_like_header(first)


def fits_euroc(first: str) -> bool:
    """A bare table that starts with integer nanoseconds."""
    return fits_csv(first) and re.fullmatch(r"\d{15,}", re.split(r"[,;]", first)[0].strip()) is not None


def read_euroc(table: TextTable, times: Path | None) -> Trajectory:
    """Poses of the IMU, if no comment names another body."""
    return parse(table, scalar="first", default_ns=1, frame="imu")


def read_csv(table: TextTable, times: Path | None) -> Trajectory:
    """Poses of the body that a comment names."""
    return parse(table)


def write_euroc(path: str | Path, trajectory: Trajectory) -> None:
    """Write a EuRoC csv, atomically: integer ns, position, quaternion wxyz."""
    lines = [
        "#timestamp [ns],p_RS_R_x [m],p_RS_R_y [m],p_RS_R_z [m],q_RS_w [],q_RS_x [],q_RS_y [],q_RS_z []",
        f"# frame: {trajectory.frame}",
    ]
    for stamp, pose in zip(trajectory.stamps_ns.tolist(), pose_texts(trajectory, "wxyz"), strict=True):
        lines.append(",".join([str(stamp), *pose]))
    write_text(Path(path), "".join(f"{line}\n" for line in lines))


def pose_texts(trajectory: Trajectory, order: str) -> Iterator[list[str]]:
    """Cells of each pose: the position and the quaternion in the order `xyzw` or `wxyz`."""
    q = so3.to_quaternion(trajectory.poses[:, :3, :3])[:, ["xyzw".index(axis) for axis in order]]
    for position, rotation in zip(trajectory.positions.tolist(), q.tolist(), strict=True):
        yield [*(f"{v:.9f}" for v in position), *(f"{v:.12f}" for v in rotation)]


def frame_in(comments: list[str]) -> str | None:
    """The frame that a comment states as `frame: NAME`, or None."""
    for comment in comments:
        found = re.search(r"(?<![A-Za-z_])frame\s*[:=]\s*([A-Za-z_]\w*)", comment)
        if found:
            return found.group(1)
    return None


def parse(table: TextTable, scalar: str = "", default_ns: int | None = None, frame: str = "unknown") -> Trajectory:
    """Read a table by the names of its columns, which may stand in a comment, else by what stands in them.

    scalar : place of w in quaternions without names, `first` or `last`; default_ns : unit of times without one
    frame : the body, if no comment names another
    Rows whose position or rotation is NaN or empty are lost poses and are left out.
    """
    path = table.path
    chosen = named_columns(table) if table.names else None
    if chosen is not None and not any("_rs_" in name.lower() for name in table.names):
        frame = "unknown"
    if chosen is None:
        if looks_like_header(table.first):
            raise InputError(
                f"{path}: no column for x, y, z in the header {', '.join(table.names)}; "
                "name the columns t, x, y, z, qx, qy, qz, qw"
            )
        table = replace(table, names=())
    width = len(table.names) or len(table.rows[0].cells)
    table.check_widths(width, "the header" if table.names else "the first line", is_least=table.separator is not None)
    columns, leading, notes = chosen or placed_columns(table, scalar)
    values = table.values(columns)
    lost = table.lost_rows(values, "NaN or no numbers")
    table, values = table.select(~lost), values[~lost]
    clock = find_clock(table, columns if table.names else range(leading, width), default_ns)
    if clock is None:
        raise InputError(f"{path}: no column is a time in the header {', '.join(table.names)}; name it t, or stamp_ns")
    table.check_increasing(clock.stamps_ns)
    poses, has_rotations, rotation_notes = poses_of(values, table)
    left_out = unread_columns(table, clock.columns.union(columns))
    if left_out:
        hint = "" if len(columns) > 3 else "; rotations are read as quaternions (qx, qy, qz, qw)"
        notes.append(f"left out: {shown(left_out)}{hint}")
    notes += [*rotation_notes, *filter(None, [clock.note])]
    if lost.any():
        notes.append(f"{int(lost.sum())} of {len(lost)} rows hold NaN or no numbers: lost poses, left out")
    return Trajectory(
        stamps_ns=clock.stamps_ns,
        poses=poses,
        frame=frame_in(table.comments) or frame,
        source=str(path),
        has_rotations=has_rotations,
        notes=tuple(notes),
    )


def poses_of(values: Floats, table: TextTable) -> tuple[Floats, bool, list[str]]:
    """Poses (N, 4, 4) of positions (N, 3) or positions and quaternions xyzw (N, 7), whether their rotations are any, and notes.

    Quaternions of zeros everywhere are none, nor is one axis or identity everywhere along a path that bends: tools write
    those for positions alone. Raises InputError with the line of a quaternion far from unit length.
    """
    p, q = values[:, :3], values[:, 3:]
    alone = se3.make(np.eye(3), p)
    if q.shape[1] == 0:
        return alone, False, []
    if not q.any():
        return alone, False, ["all quaternions are zero: positions alone"]
    length = np.linalg.norm(q, axis=1)
    wrong = np.flatnonzero(np.abs(length - 1) > 0.05)
    if len(wrong):
        i = int(wrong[0])
        raise table.error(i, f"quaternion of length {length[i]:.3g}, a rotation has length 1")
    if len(q) > 2 and (q == q[0]).all() and np.count_nonzero(q[0]) == 1:
        spread_m = np.linalg.svd(p - p.mean(axis=0), compute_uv=False)
        if spread_m[1] > BENT * max(spread_m[0], np.sqrt(len(p))):
            return alone, False, ["the quaternion is the same everywhere on a path that bends: positions alone"]
    return se3.make(so3.from_quaternion(q), p), True, []
