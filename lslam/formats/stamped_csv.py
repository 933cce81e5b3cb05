"""CSV files of stamped numbers with named columns: `imu.csv`, where EuRoC's imu0/data.csv reads as well, and `gnss.csv`."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from lslam.errors import InputError, cause
from lslam.formats.atomic import write_text
from lslam.formats.pose_rows import parse_stamp
from lslam.types.gnss import GnssStream
from lslam.types.imu import ImuStream
from lslam.untrusted import decimal_number

TIME_COLUMNS = ("stamp_ns", "timestamp", "stamp", "time", "t", "time_s", "stamp_s")
IMU_COLUMNS = ("accel_x", "accel_y", "accel_z", "gyro_x", "gyro_y", "gyro_z")
_ALIASES = [
    *((f"accel_{axis}", f"a{axis}", f"a_rs_s_{axis}", f"acc_{axis}", f"linear_acceleration_{axis}") for axis in "xyz"),
    *((f"gyro_{axis}", f"w{axis}", f"w_rs_s_{axis}", f"g{axis}", f"angular_velocity_{axis}") for axis in "xyz"),
]
GNSS_COLUMNS = ("lat_deg", "lon_deg", "alt_m", "sigma_m")


def read_stamped_csv(
    path: Path, columns: Sequence[tuple[str, ...]], optional: Sequence[tuple[str, ...]] = ()
) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Stamps (N,) ns and values (N, K), one column per entry of `columns`, each entry its accepted names.

    Columns of `optional` follow and are NaN where the file has none. The header is the first line, a leading `#`, units
    in brackets and case aside. `stamp_ns` holds whole ns however small; what other time columns hold shows from the numbers
    (`stamps_files`). Raises InputError naming file, line and what is missing.
    """
    try:
        lines = path.read_text(encoding="utf-8-sig").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"{path} cannot be read: {cause(error)}") from None
    header = [_plain(name) for name in lines[0].split(",")] if lines else []
    time = _find(header, TIME_COLUMNS)
    if time is None:
        raise InputError(f"{path}, line 1: no time column ({', '.join(TIME_COLUMNS)}) in {', '.join(header)!r}")
    where = [_find(header, names) for names in columns]
    missing = [names[0] for names, k in zip(columns, where, strict=True) if k is None]
    if missing:
        raise InputError(f"{path}, line 1: no column {', '.join(missing)}; the file has {', '.join(header)}")
    where += [_find(header, names) for names in optional]
    parse = _nanoseconds if header[time] == "stamp_ns" else parse_stamp
    stamps: list[int] = []
    rows: list[list[float]] = []
    for number, line in enumerate(lines[1:], 2):
        cells = line.split(",")
        if not line.strip() or line.startswith("#"):
            continue
        if len(cells) != len(header):
            raise InputError(f"{path}, line {number}: {len(cells)} columns where the header has {len(header)}")
        try:
            stamps.append(parse(cells[time].strip()))
            rows.append([float("nan") if k is None else float(cells[k]) for k in where])
        except ValueError:
            raise InputError(f"{path}, line {number}: {line[:60]!r} holds something that is no number") from None
    return np.array(stamps, np.int64), np.array(rows, np.float64).reshape(len(stamps), len(where))


def write_stamped_csv(
    path: Path, names: Sequence[str], stamps_ns: NDArray[np.int64], values: NDArray[np.float64]
) -> None:
    """Write stamps (N,) as `stamp_ns` and values (N, K) under `names`, atomically; both read back exactly."""
    rows = [",".join(["stamp_ns", *names])]
    for stamp, row in zip(stamps_ns.tolist(), values.tolist(), strict=True):
        rows.append(",".join([str(stamp), *map(repr, row)]))
    write_text(path, "\n".join(rows) + "\n")


def _nanoseconds(text: str) -> int:
    stamp = decimal_number(text)
    if stamp != stamp.to_integral_value():
        raise ValueError(f"no whole number of nanoseconds: {text!r}")
    return int(stamp)


def _plain(name: str) -> str:
    return re.sub(r"\[.*?\]", "", name).strip().lstrip("#").strip().lower()


def _find(header: list[str], names: Sequence[str]) -> int | None:
    return next((header.index(name) for name in names if name in header), None)


def read_imu_csv(path: Path) -> ImuStream:
    """Read specific force (m/s2, +g up at rest) and angular rate (rad/s) in the IMU frame; nothing is converted.

    Columns are `stamp_ns` (or seconds as `t`, `time`, `timestamp`), `accel_x..z` and `gyro_x..z` or their usual aliases.
    Raises InputError naming file and line.
    """
    stamps, values = read_stamped_csv(path, _ALIASES)
    return ImuStream(stamps, values[:, :3], values[:, 3:])


def write_imu_csv(path: Path, imu: ImuStream) -> None:
    """Write `imu` atomically; it reads back exactly."""
    write_stamped_csv(path, IMU_COLUMNS, imu.stamps_ns, np.hstack([imu.accel, imu.gyro]))


def read_gnss_csv(path: Path) -> GnssStream:
    """Read fixes: `stamp_ns` (or seconds), `lat_deg`, `lon_deg`, `alt_m` (WGS84) and, if known, `sigma_m`.

    Without `sigma_m` the one-sigma error is NaN: unknown. Raises InputError naming file and line.
    """
    stamps, values = read_stamped_csv(
        path,
        [("lat_deg", "lat", "latitude"), ("lon_deg", "lon", "longitude"), ("alt_m", "alt", "altitude", "height")],
        [("sigma_m", "sigma", "pos_acc")],
    )
    return GnssStream(stamps, values[:, :3], values[:, 3])


def write_gnss_csv(path: Path, gnss: GnssStream) -> None:
    """Write `gnss` atomically; it reads back exactly."""
    write_stamped_csv(path, GNSS_COLUMNS, gnss.stamps_ns, np.hstack([gnss.lat_lon_alt, gnss.sigma[:, None]]))
