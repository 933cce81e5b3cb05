"""Trajectories as tables whose columns have names: EuRoC ground truth, MCD, and what people export."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from lslam.errors import InputError
from lslam.formats.pose_rows import (
    Row,
    check_finite,
    check_increasing,
    frame_in,
    poses_from_quaternions,
    seconds_to_ns,
    write_lines,
)
from lslam.geometry import so3
from lslam.types.trajectory import Trajectory

# Names after lower case and without units, prefixes and punctuation.
TIME = ("t", "time", "timestamp", "stamp", "sec", "secs", "seconds", "timens", "nsec")
POSITION = {axis: (axis, f"t{axis}", f"p{axis}", f"pos{axis}", f"position{axis}", f"prsr{axis}") for axis in "xyz"}
ROTATION = {
    axis: (f"q{axis}", f"quat{axis}", f"orientation{axis}", f"rotation{axis}", f"rot{axis}", f"qrs{axis}")
    for axis in "xyzw"
}
UNITS_NS = {"ns": 1, "us": 1_000, "ms": 1_000_000, "s": 1_000_000_000}


def looks_like_header(line: str) -> bool:
    """Whether the first field of `line` is a name and no number."""
    field = re.split(r"[,;\s]+", line.strip())[0]
    return bool(re.match(r"[A-Za-z_]", field)) and field.lower() not in ("nan", "inf", "infinity")


def is_table(first: str) -> bool:
    """Whether the first line is of a table and not of numbers between blanks."""
    return any(separator in first for separator in ",;") or looks_like_header(first)


def fits_euroc(first: str) -> bool:
    """A bare table that starts with integer nanoseconds."""
    return is_table(first) and re.fullmatch(r"\d{15,}", re.split(r"[,;]", first)[0].strip()) is not None


def fits_csv(first: str) -> bool:
    """Any other table."""
    return is_table(first)


def read_euroc(path: Path, rows: list[Row], comments: list[str], times: Path | None) -> Trajectory:
    """Poses of the IMU, if no comment names another body."""
    return parse(path, rows, comments, is_euroc=True)


def read_csv(path: Path, rows: list[Row], comments: list[str], times: Path | None) -> Trajectory:
    """Poses of the body that a comment names."""
    return parse(path, rows, comments, is_euroc=False)


def write_euroc(path: str | Path, trajectory: Trajectory) -> None:
    """Write a EuRoC csv, atomically: integer ns, position, quaternion wxyz."""
    lines = [
        "#timestamp [ns],p_RS_R_x [m],p_RS_R_y [m],p_RS_R_z [m],q_RS_w [],q_RS_x [],q_RS_y [],q_RS_z []",
        f"# frame: {trajectory.frame}",
    ]
    q = np.roll(so3.to_quaternion(trajectory.poses[:, :3, :3]), 1, axis=-1)
    for stamp, p, r in zip(trajectory.stamps_ns.tolist(), trajectory.positions.tolist(), q.tolist(), strict=True):
        lines.append(",".join([str(stamp), *(f"{v:.9f}" for v in p), *(f"{v:.12f}" for v in r)]))
    write_lines(path, lines)


def parse(path: Path, rows: list[Row], comments: list[str], is_euroc: bool) -> Trajectory:
    """Read a table with named columns, or EuRoC's order when it has no names and `is_euroc`.

    A header may be a comment. The time unit is the one in the column's name, else ns for EuRoC, else by size.
    """
    header, unit_names, data = _header(path, rows, comments, is_euroc)
    if not data:
        raise InputError(f"{path} has a header but no poses")
    separator = _separator(data[0].text)
    columns = _columns(path, header, is_euroc)
    table = [[field.strip() for field in row.text.split(separator)] for row in data]
    width = max(columns.values()) + 1
    for row, fields in zip(data, table, strict=True):
        if len(fields) < width or (header and len(fields) < len(header)):
            raise InputError(f"{path}, line {row.number}: {len(fields)} columns, {max(width, len(header))} expected")
    time = columns["t"]
    scale = _scale(unit_names[time] if time < len(unit_names) else "", table[0][time], is_euroc)
    stamps = np.array(
        [seconds_to_ns(f[time], path, r.number, scale) for r, f in zip(data, table, strict=True)], np.int64
    )
    check_increasing(stamps, data, path)
    values = _values(path, data, table, [columns[name] for name in ("x", "y", "z", "qx", "qy", "qz", "qw")])
    return Trajectory(
        stamps_ns=stamps,
        poses=poses_from_quaternions(values[:, :3], values[:, 3:], data, path),
        frame=frame_in(comments) or ("imu" if is_euroc else "unknown"),
        source=str(path),
    )


def _header(path: Path, rows: list[Row], comments: list[str], is_euroc: bool) -> tuple[list[str], list[str], list[Row]]:
    """Column names, the same with their units, and the lines of data."""
    text = ""
    if looks_like_header(rows[0].text):
        text, rows = rows[0].text, rows[1:]
    else:
        named = [
            c.lstrip("# ") for c in comments if re.search(r"time|stamp", c, re.IGNORECASE) and re.search("[,;]", c)
        ]
        text = named[0] if named else ""
    if not text and not is_euroc:
        raise InputError(
            f"{path}, line {rows[0].number}: a table without a header: name the columns (t,x,y,z,qx,qy,qz,qw), "
            "or use --format euroc for integer nanoseconds"
        )
    full = [name.strip().lower() for name in text.split(_separator(text))] if text else []
    return [_plain(name) for name in full], full, rows


def _separator(text: str) -> str | None:
    return next((s for s in (",", ";", "\t") if s in text), None)


def _plain(name: str) -> str:
    """`p_RS_R_x [m]` -> `prsrx`; `pose.position.x` -> `positionx`."""
    name = re.sub(r"[\[(].*?[\])]", "", name)
    name = re.sub(r"_(ns|us|ms|s|m)$", "", name.strip())
    name = re.sub(r"^(field\.)?(pose\.)*", "", name)
    return re.sub(r"[^a-z0-9]", "", name)


def _columns(path: Path, header: list[str], is_euroc: bool) -> dict[str, int]:
    if not header:
        return {"t": 0, "x": 1, "y": 2, "z": 3, "qw": 4, "qx": 5, "qy": 6, "qz": 7}
    wanted = {"t": TIME, **POSITION, **{f"q{axis}": names for axis, names in ROTATION.items()}}
    columns, missing = {}, []
    for key, names in wanted.items():
        found = [header.index(name) for name in names if name in header]
        if found:
            columns[key] = found[0]
        else:
            missing.append(key)
    if missing and is_euroc and len(header) >= 8:
        return _columns(path, [], is_euroc)
    if missing:
        raise InputError(
            f"{path}: no column for {', '.join(missing)} in the header {', '.join(header)}; "
            "name the columns t, x, y, z, qx, qy, qz, qw"
        )
    return columns


def _scale(name: str, first: str, is_euroc: bool) -> int:
    """Nanoseconds in one unit of the time column."""
    unit = re.search(r"[\[(_ ](ns|us|ms|s)[\])]?$", name.strip())
    if unit:
        return UNITS_NS[unit.group(1)]
    if is_euroc:
        return 1
    try:
        size = abs(float(first))
    except ValueError:
        return UNITS_NS["s"]
    # Unix time in 2001..2286 has 10 digits before the point in s, 13 in ms, 16 in us, 19 in ns.
    for limit, name_of_unit in ((1e17, "ns"), (1e14, "us"), (1e11, "ms")):
        if size >= limit:
            return UNITS_NS[name_of_unit]
    return UNITS_NS["s"]


def _values(path: Path, data: list[Row], table: list[list[str]], columns: list[int]) -> np.ndarray:
    values = np.empty((len(data), len(columns)))
    for i, (row, fields) in enumerate(zip(data, table, strict=True)):
        try:
            values[i] = [float(fields[c]) for c in columns]
        except ValueError:
            raise InputError(f"{path}, line {row.number}: not a number in {row.text[:60]!r}") from None
    check_finite(values, data, path)
    return values
