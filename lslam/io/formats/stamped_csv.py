"""CSV files of stamped numbers with named columns: `imu.csv`, as EuRoC's imu0/data.csv, `gnss.csv` and `wheels.csv`."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from lslam.core.arrays import Floats, Longs
from lslam.core.errors import InputError
from lslam.core.printable import first_of
from lslam.core.types.gnss import GnssStream
from lslam.core.types.imu import ImuStream, WheelStream
from lslam.io.formats.atomic import write_text
from lslam.io.formats.text_tables import read_table
from lslam.io.formats.time_columns import find_clock, unread_columns

TIME_COLUMNS = "stamp_ns, timestamp, stamp, time, t, time_s, or sec and nanosec"
IMU_COLUMNS = ("accel_x", "accel_y", "accel_z", "gyro_x", "gyro_y", "gyro_z")
_STEMS = (
    ("accel_", "a", "a_rs_s_", "acc_", "acc", "linear_acceleration_"),
    ("gyro_", "w", "w_rs_s_", "g", "gyr_", "gyr", "gyro", "angular_velocity_"),
)
_ALIASES = [tuple(stem + axis for stem in stems) for stems in _STEMS for axis in "xyz"]
GNSS_COLUMNS = ("lat_deg", "lon_deg", "alt_m", "sigma_m")
WHEEL_COLUMNS = ("speed", "yaw_rate")


def read_stamped_csv(
    path: Path,
    columns: Sequence[tuple[str, ...]],
    optional: Sequence[tuple[str, ...]] = (),
    notes: list[str] | None = None,
) -> tuple[Longs, Floats]:
    """Stamps (N,) ns and values (N, K), one column per entry of `columns`, each entry its accepted names.

    Columns of `optional` follow and are NaN where the file has none. The header is the first line; a leading `#` or `%`,
    units in brackets, case and prefixes that end in a point or slash (`field.linear_acceleration.x`) are ignored.
    The time is one column or two (`time_columns`). Decisions and omissions are added to `notes`. Raises InputError naming file,
    line and what is missing.
    """
    table = read_table(path)
    spellings = [_spellings(name) for name in table.names]
    where = [
        next((k for name in names for k, spelt in enumerate(spellings) if name in spelt), None)
        for names in (*columns, *optional)
    ]
    header = ", ".join(table.names)
    table.check_widths(len(table.names), "the header")
    columns_read = [k for k in where if k is not None]
    clock = find_clock(table, columns_read)
    if clock is None:
        raise InputError(f"{path}, line 1: no time column ({TIME_COLUMNS}) in {header!r}")
    missing = [names[0] for names, k in zip(columns, where, strict=False) if k is None]
    if missing:
        raise InputError(f"{path}, line 1: no column {', '.join(missing)}; the file has {header}")
    values = np.full((len(table.rows), len(where)), np.nan)
    values[:, [k is not None for k in where]] = table.values(columns_read)
    rest = unread_columns(table, clock.columns.union(columns_read))
    order = _order(clock.stamps_ns, values)
    said = [clock.note, rest and f"columns left out: {first_of(rest)}"]
    if order is not None:
        copies = f", {len(values) - len(order)} copies left out" if len(order) < len(values) else ""
        said.append(f"its rows are in another order than their stamps: sorted{copies}")
    if notes is not None:
        notes += [f"{path.name}: {sentence}" for sentence in said if sentence]
    return (clock.stamps_ns, values) if order is None else (clock.stamps_ns[order], values[order])


def _order(stamps: Longs, values: Floats) -> NDArray[np.intp] | None:
    """Row order by stamp, duplicates once. None where rows are in order already, or where a clock was set back."""
    order = np.argsort(stamps, kind="stable")
    rows = np.column_stack([stamps - stamps.min(initial=0), values])[order]
    own = np.ones(len(rows), bool)
    own[1:] = ~np.isclose(rows[1:], rows[:-1], 0, 0, equal_nan=True).all(axis=1)
    order = order[own]
    steps = np.diff(stamps[order])
    if not len(steps) or bool((np.diff(stamps) > 0).all()):
        return None
    usual, joined = np.median(steps), steps[np.diff(order) != 1]
    was_set_back = steps.min() < 0.5 * usual or (len(joined) and np.median(joined) > 1.5 * usual)
    return None if was_set_back else order


def write_stamped_csv(path: Path, names: Sequence[str], stamps_ns: Longs, values: Floats) -> None:
    """Write stamps (N,) as `stamp_ns` and values (N, K) under `names`, atomically; both read back exactly."""
    rows = [",".join(["stamp_ns", *names])]
    for stamp, row in zip(stamps_ns.tolist(), values.tolist(), strict=True):
        rows.append(",".join([str(stamp), *map(repr, row)]))
    write_text(path, "\n".join(rows) + "\n")


def _spellings(name: str) -> list[str]:
    """The names that a column may go by: without units, and each of its endings after a point or slash.

    >>> _spellings("field.linear_acceleration.x [m/s^2]")
    ['x', 'linear_acceleration_x', 'field_linear_acceleration_x']
    """
    words = [word for word in re.split(r"[./]", re.sub(r"[\[(].*?[\])]", "", name).strip(" #%\"'").lower()) if word]
    return ["_".join(words[k:]).strip() for k in reversed(range(len(words)))]


def read_imu_csv(path: Path, notes: list[str] | None = None) -> ImuStream:
    """Read specific force (m/s2, +g up at rest) and angular rate (rad/s) in the IMU frame; nothing is converted.

    Columns are `stamp_ns` (or seconds as `t`, `time`, `timestamp`), `accel_x..z` and `gyro_x..z` or their usual aliases.
    Raises InputError naming file and line.
    """
    stamps, values = read_stamped_csv(path, _ALIASES, notes=notes)
    return ImuStream(stamps, values[:, :3], values[:, 3:])


def write_imu_csv(path: Path, imu: ImuStream) -> None:
    """Write `imu` atomically; it reads back exactly."""
    write_stamped_csv(path, IMU_COLUMNS, imu.stamps_ns, np.hstack([imu.accel, imu.gyro]))


def read_gnss_csv(path: Path, notes: list[str] | None = None) -> GnssStream:
    """Read fixes: `stamp_ns` (or seconds), `lat_deg`, `lon_deg`, `alt_m` (WGS84) and, if known, `sigma_m`.

    Without `sigma_m` the one-sigma error is NaN: unknown. Raises InputError naming file and line.
    """
    stamps, values = read_stamped_csv(
        path,
        [
            ("lat_deg", "lat", "latitude"),
            ("lon_deg", "lon", "longitude"),
            ("alt_m", "alt", "altitude", "height", "h", "ele"),
        ],
        [("sigma_m", "sigma", "pos_acc")],
        notes,
    )
    return GnssStream(stamps, values[:, :3], values[:, 3])


def write_gnss_csv(path: Path, gnss: GnssStream) -> None:
    """Write `gnss` atomically; it reads back exactly."""
    write_stamped_csv(path, GNSS_COLUMNS, gnss.stamps_ns, np.hstack([gnss.lat_lon_alt, gnss.sigma[:, None]]))


def read_wheels_csv(path: Path, wheelbase_m: float | None = None, notes: list[str] | None = None) -> WheelStream:
    """Read speeds of wheels, m/s: `stamp_ns` (or seconds), `speed`, or `left` and `right`, their mean; nothing is converted.

    The yaw rate is in `yaw_rate`, rad/s, or follows from `steering`, rad, of front wheels `wheelbase_m` before the axle, by a
    kinematic bicycle. Raises InputError naming file and line, or what is missing.
    """
    either = [("speed", "v", "velocity", "linear_x", "speed_m_s"), ("left", "speed_left"), ("right", "speed_right")]
    turns = [("yaw_rate", "angular_z", "wz", "omega", "yaw_rate_rad_s"), ("steering", "steering_angle", "steering_rad")]
    stamps, values = read_stamped_csv(path, [], [*either, *turns], notes)
    speed, left, right, yaw_rate, steering = values.T
    if np.isnan(speed).all():
        speed = 0.5 * (left + right)
    if not len(stamps) or np.isnan(speed).all():
        raise InputError(f"{path}: no line has a speed of wheels: column speed, in m/s, or left and right")
    if np.isnan(yaw_rate).all() and not np.isnan(steering).all():
        if wheelbase_m is None:
            raise InputError(
                f"{path}: steering turns by the distance of the axles: state it by --set wheels.wheelbase_m=2.7"
            )
        yaw_rate = speed * np.tan(steering) / wheelbase_m
    return WheelStream(stamps, speed, None if np.isnan(yaw_rate).all() else yaw_rate)


def write_wheels_csv(path: Path, wheels: WheelStream) -> None:
    """Write `wheels` atomically; it reads back exactly, but for the frame."""
    measured = [wheels.speed] if wheels.yaw_rate is None else [wheels.speed, wheels.yaw_rate]
    write_stamped_csv(path, WHEEL_COLUMNS[: len(measured)], wheels.stamps_ns, np.column_stack(measured))
