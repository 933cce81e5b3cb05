"""Trajectories as tables: EuRoC ground truth, MCD, prisms and RTK, exports of ROS, PlotJuggler and pandas."""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np

from lslam.core.arrays import Floats
from lslam.core.errors import InputError
from lslam.core.geometry import se3, so3
from lslam.core.printable import first_of
from lslam.core.types.trajectory import Trajectory
from lslam.io.formats.atomic import write_text
from lslam.io.formats.text_tables import TextTable, looks_like_header, utc_of
from lslam.io.formats.time_columns import SECOND_NS, find_clock, is_index, tokens_of, unit_of_fraction, unread_columns

# A path that strays so far from a line, in parts of its length, has bends, in which a body turns.
BENT = 0.01
Prefix = tuple[str, ...]
_POSITIONS = ("position", "positions", "pos", "translation", "trans", "point", "p", "t", "xyz")
_ROTATIONS = ("orientation", "ori", "rotation", "quaternion", "quat", "rot", "q")
# Words before a bare x, y or z that leave it a position.
_BODIES = frozenset(
    (
        "field",
        "pose",
        "poses",
        "gt",
        "est",
        "ref",
        "true",
        "truth",
        "ground",
        "groundtruth",
        "reference",
        "utm",
        "enu",
        "world",
        "map",
        "odom",
        "lidar",
        "base",
        "imu",
        "body",
        "cam",
        "camera",
        "local",
        "global",
        "prism",
        "leica",
        "rtk",
        "gps",
        "gnss",
    )
)
_EARTH = {
    **dict.fromkeys(("east", "easting", "e"), "x"),
    **dict.fromkeys(("north", "northing", "n"), "y"),
    **dict.fromkeys(("up", "u", "height", "h", "altitude", "alt"), "z"),
}
_WAY_OUT = "name the columns t, x, y, z, qx, qy, qz, qw"
# Share of a table's quaternions that must have length 1, and how far from it they may be.
_MOST, _UNIT = 0.95, 0.05
# Where x, y, z and w stand in a quaternion, by the place of w.
_XYZW = {"last": [0, 1, 2, 3], "first": [1, 2, 3, 0]}


def fits_csv(first: str) -> bool:
    """Whether the first line is of a table with separators, not of numbers between blanks."""
    return any(separator in first for separator in ",;") or looks_like_header(first)


def fits_euroc(first: str) -> bool:
    """Whether the first line is of a table without names that starts with integer nanoseconds."""
    return fits_csv(first) and re.fullmatch(r"\d{15,}", re.split(r"[,;]", first)[0].strip()) is not None


def read_euroc(table: TextTable, times: Path | None) -> Trajectory:
    """Read poses of the IMU, or of the body that a comment names."""
    return parse(table, scalar="first", default_ns=1, frame="imu")


def read_csv(table: TextTable, times: Path | None) -> Trajectory:
    """Read poses of the body that a comment names."""
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


def write_csv(path: str | Path, trajectory: Trajectory, crs: str = "") -> None:
    """Write a table for spreadsheets and GIS, atomically: stamp, UTC if the stamps are Unix time, position, m, quaternion, body.

    crs : name of the coordinate reference system, a column of its own; empty: none
    """
    utc = utc_of(trajectory.stamps_ns)
    names = ["stamp_ns", *(["utc"] if utc else []), "x_m", "y_m", "z_m", "qx", "qy", "qz", "qw", "body"]
    lines = [",".join([*names, *(["crs"] if crs else [])])]
    for k, (stamp, pose) in enumerate(zip(trajectory.stamps_ns.tolist(), pose_texts(trajectory, "xyzw"), strict=True)):
        when = [f"{utc[k]:%Y-%m-%dT%H:%M:%S.%f}Z"] if utc else []
        lines.append(",".join([str(stamp), *when, *pose, trajectory.frame, *([crs] if crs else [])]))
    write_text(Path(path), "".join(f"{line}\n" for line in lines))


def pose_texts(trajectory: Trajectory, order: str) -> Iterator[list[str]]:
    """Cells of each pose: the position and the quaternion in the order `xyzw` or `wxyz`."""
    q = so3.to_quaternion(trajectory.poses[:, :3, :3])[:, ["xyzw".index(axis) for axis in order]]
    for position, rotation in zip(trajectory.positions.tolist(), q.tolist(), strict=True):
        yield [*(f"{v:.9f}" for v in position), *(f"{v:.12f}" for v in rotation)]


def frame_in(comments: list[str]) -> str | None:
    """The frame that a comment states as `frame: NAME`, or None."""
    for comment in comments:
        match = re.search(r"(?<![A-Za-z_])frame\s*[:=]\s*([A-Za-z_]\w*)", comment)
        if match:
            return match.group(1)
    return None


def parse(table: TextTable, scalar: str = "", default_ns: int | None = None, frame: str = "unknown") -> Trajectory:
    """Read a trajectory table by its column names, from the header or a comment, else by the values in the columns.

    scalar : position of w in quaternions without names, `first` or `last`; default_ns : unit of times without one
    frame : the body, if no comment names another
    Rows whose position or rotation is NaN or empty are dropped, with a note. Raises InputError.
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
        notes.append(f"left out: {first_of(left_out)}{hint}")
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
    """Poses (N, 4, 4), whether they have rotations, and notes, from positions (N, 3) or positions and quaternions xyzw (N, 7).

    Constant quaternions along a path that bends, and quaternions of zeros, are placeholders: tools write them for positions
    alone. Raises InputError with the line of a quaternion far from unit length.
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


class PoseColumns(NamedTuple):
    """Columns of poses in a table.

    columns : of x, y, z and, where there are rotations, qx, qy, qz, qw
    leading : number of columns before, in a table without names; notes : what was chosen
    """

    columns: list[int]
    leading: int
    notes: list[str]


def named_columns(table: TextTable) -> PoseColumns | None:
    """Pose columns by their names; None when none of them is a position.

    Raises InputError when an axis is missing, or when several bodies have positions.
    """
    path, names = table.path, table.names
    positions: dict[Prefix, dict[str, int]] = {}
    rotations: dict[Prefix, dict[str, int]] = {}
    for k, name in enumerate(names):
        kind = _kind(tokens_of(name))
        if kind is not None:
            is_rotation, prefix, axis = kind
            (rotations if is_rotation else positions).setdefault(prefix, {}).setdefault(axis, k)
    # Beside degrees a height is no position.
    positions = {prefix: axes for prefix, axes in positions.items() if [*axes] != ["z"] or "on Earth" not in prefix}
    if not positions:
        return None
    bodies = {prefix: axes for prefix, axes in positions.items() if len(axes) == 3} or positions
    # A body without a name goes first.
    prefix = () if () in bodies else next(iter(bodies))
    position = bodies.pop(prefix)
    others = [", ".join(names[k] for k in axes.values()) for axes in bodies.values()]
    chosen = ", ".join(names[k] for k in position.values())
    if others and prefix != ():
        raise InputError(
            f"{path} has positions of {len(bodies) + 1} bodies: {chosen}; {'; '.join(others[:3])}: keep the columns of "
            f"one, or {_WAY_OUT}"
        )
    if len(rotations) > 1 and prefix not in rotations:
        raise InputError(f"{path} has rotations of {len(rotations)} bodies beside one position: {_WAY_OUT}")
    rotation = rotations.get(prefix, next(iter(rotations.values()), {}))
    missing = [axis for axis in "xyz" if axis not in position]
    missing += [f"q{axis}" for axis in "xyzw" if rotation and axis not in rotation]
    if missing:
        raise InputError(f"{path}: no column for {', '.join(missing)} in the header {', '.join(names)}; {_WAY_OUT}")
    notes = [f"the position is {chosen}"] if others else []
    columns = [position[axis] for axis in "xyz"] + [rotation[axis] for axis in "xyzw" if rotation]
    return PoseColumns(columns, 0, notes)


def _kind(words: list[str]) -> tuple[bool, Prefix, str] | None:
    """Parse a column's name: whether it is of a rotation or a position, its prefix, and the axis; None for other names.

    `field.pose.pose.position.x`, `p_RS_R_x [m]`, `q_RS_w []`, `pose.orientation.w`, `tx`, `qw`, `gt_x`, `easting`.
    """
    if len(words) > 1 and words[-1] == "m":
        words = words[:-1]
    if not words:
        return None
    *before, last = words
    if last in _EARTH and _BODIES.union(_POSITIONS).issuperset(before):
        # A body of its own: beside x, y, z a column `n` is a count.
        return False, (*before, "on Earth"), _EARTH[last]
    if len(last) > 1:
        before, last = [*before, last[:-1]], last[-1]
    if last not in "xyzw":
        return None
    if before[:2] in (["p", "rs"], ["q", "rs"]):  # EuRoC
        return before[0] == "q", (), last
    if before and before[-1] in _ROTATIONS:
        return True, tuple(before[:-1]), last
    if last == "w":
        return None
    if before and before[-1] in _POSITIONS:
        return False, tuple(before[:-1]), last
    return (False, tuple(before), last) if _BODIES.issuperset(before) else None


def placed_columns(table: TextTable, scalar: str) -> PoseColumns:
    """The columns of a table without names: times, a position and, if there is one, a quaternion.

    scalar : position of the quaternion's w, `first` or `last`, or empty if unknown
    Raises InputError when no layout fits, or several do.
    """
    width = len(table.rows[0].cells)
    values = np.stack([table.numbers(k) for k in range(width)], axis=1)
    leading = _leading_times(values)
    fits = [n for n in leading if width >= n + 7 and _are_unit(values[:, n + 3 : n + 7])]
    if len(fits) > 1:
        raise table.error(0, f"{width} columns may be read in {len(fits)} ways: {_WAY_OUT} in a first line")
    if not fits and width - 3 in leading:
        return PoseColumns([width - 3, width - 2, width - 1], width - 3, [])
    if not fits and width != 8:
        raise table.error(
            0,
            f"{width} columns are no trajectory format lslam knows (12 or 16 numbers: KITTI; 8: TUM; 4: time and "
            f"position; commas: EuRoC or named columns); {_WAY_OUT} in a first line, or --format forces a format",
        )
    n = fits[0] if fits else 1
    by_motion = _scalar_by_motion(values[:, n : n + 3], values[:, n + 3 : n + 7])
    order = (by_motion or scalar) if table.separator is not None or not scalar else scalar
    if not order:
        raise table.error(
            0,
            f"a table without a header: {_WAY_OUT} (t,x,y,z,qx,qy,qz,qw), or use --format euroc for integer nanoseconds",
        )
    notes = []
    if scalar and order != scalar:
        notes.append(
            f"quaternions are read with w {order}, which fits the motion; --format euroc or tum decides otherwise"
        )
    elif by_motion not in ("", order):
        notes.append(
            f"quaternions are read with w {order}, the order of TUM, though w {by_motion} fits the motion better: --format "
            "euroc, or names of the columns, decide otherwise"
        )
    if width > n + 7:
        notes.append(f"{width} columns, of which those from column {n + 8} on are left out")
    return PoseColumns([n, n + 1, n + 2, *(n + 3 + k for k in _XYZW[order])], n, notes)


def _leading_times(values: Floats) -> list[int]:
    """Possible numbers of leading time columns in a table (N, K): one, two or three."""
    if values.shape[1] < 4:
        return []
    a, b, c = values[np.isfinite(values[:, :3]).all(axis=1), :3].T
    is_numbered = is_index(a, bool(len(b)) and b.min() >= SECOND_NS)
    rises = len(b) > 1 and bool(np.all(np.diff(b) > 0))
    pairs = [unit_of_fraction(whole, rest) is not None for whole, rest in ((a, b), (b, c))]
    may_be = [True, (is_numbered and rises) or pairs[0], is_numbered and pairs[1]]
    return [n for n, is_time in enumerate(may_be, start=1) if is_time]


def _are_unit(q: Floats) -> bool:
    """Whether quaternions (N, 4) have length 1, or are zeros everywhere, lost poses aside."""
    length = np.linalg.norm(q[np.isfinite(q).all(axis=1)], axis=1)
    if not len(length):
        return False
    return float(np.mean(np.abs(length - 1) < _UNIT)) >= _MOST or not length.any()


def _scalar_by_motion(positions: Floats, q: Floats) -> str:
    """Place of w in quaternions, `first` or `last`: a vehicle moves along one body direction. Empty when unclear."""
    good = np.isfinite(q).all(axis=1) & np.isfinite(positions).all(axis=1)
    q, steps = q[good], np.diff(positions[good], axis=0)
    path_m = np.linalg.norm(steps, axis=1).sum()
    if path_m < 1.0 or not np.abs(np.linalg.norm(q, axis=1) - 1).max(initial=0.0) < _UNIT:
        return ""
    kept = {}
    for place, columns in _XYZW.items():
        R = so3.from_quaternion(q[:-1][:, columns])
        kept[place] = float(np.linalg.norm(np.einsum("nji,nj->ni", R, steps).sum(axis=0)) / path_m)
    other, best = sorted(kept, key=kept.__getitem__)
    return best if kept[best] > 0.9 and kept[other] < kept[best] - 0.1 else ""
