"""KITTI raw's `oxts` folder: one file of 30 numbers per sample of the OXTS RT3003 (GNSS and IMU)."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from lslam.core.errors import InputError
from lslam.core.types.arrays import Floats, Longs
from lslam.core.untrusted import whole_number
from lslam.io.formats.time_columns import read_stamps

# Columns, in the order of the devkit's dataformat.txt.
LAT, LON, ALT, ROLL, PITCH, YAW = range(6)
ACCEL, GYRO = slice(11, 14), slice(17, 20)  # ax..az and wx..wz: vehicle axes, x forward, y left, z up
POS_ACC = 23
_WIDTH = 30
_HIGHEST = 1e5  # m
# Of any of them, in its unit: no sensor says more, and squared twice it overflows.
_LARGEST = 1e9


@dataclass(frozen=True)
class Oxts:
    """Samples of one drive.

    numbers : (N,) int64 file numbers; stamps_ns : (N,) int64, the dates taken as UTC; None when the file is missing
    values : (N, 30) float64 as in dataformat.txt (deg, m, rad, m/s, m/s2, rad/s)
    problems : what was found wrong, one sentence each
    """

    numbers: Longs
    stamps_ns: Longs | None
    values: Floats
    problems: list[str]


def read_oxts(folder: Path) -> Oxts | None:
    """Read `folder` (with `data/*.txt` and `timestamps.txt`); None when it does not exist or holds no samples.

    Samples without a stamp are dropped and named in `problems`. Raises InputError naming the file that is not 30 numbers.
    """
    files = sorted((folder / "data").glob("*.txt"))
    files = [f for f in files if whole_number(f.stem) is not None]
    if not files:
        return None
    values = np.empty((len(files), _WIDTH))
    for k, path in enumerate(files):
        values[k] = _read_sample(path)
    numbers = np.array([int(f.stem) for f in files], np.int64)
    problems: list[str] = []
    stamps_file = folder / "timestamps.txt"
    if not stamps_file.exists():
        return Oxts(numbers, None, values, [f"{stamps_file} is missing: OXTS samples have no time"])
    stamps = read_stamps(stamps_file)
    # Line k belongs to file number k: files may be missing in the middle of a drive.
    rows = numbers if numbers[-1] < len(stamps) else np.arange(len(numbers))
    keep = rows < len(stamps)
    if not keep.all() or len(stamps) != len(files):
        problems.append(f"{folder}: {len(files)} OXTS samples but {len(stamps)} stamps, the common part is used")
    return Oxts(numbers[keep], stamps[rows[keep]], values[keep], problems)


def _read_sample(path: Path) -> Floats:
    try:
        words = path.read_text(encoding="utf-8").split()
        values = np.array([float(w) for w in words], np.float64)
    except (OSError, UnicodeDecodeError, ValueError) as error:
        raise InputError(f"{path} is no OXTS sample: {error}") from None
    if len(values) != _WIDTH or not (np.abs(values) < _LARGEST).all():
        raise InputError(
            f"{path} is no OXTS sample: {len(values)} numbers where {_WIDTH} finite ones of its size belong"
        )
    if not (np.abs(values[:2]) <= [90, 180]).all() or abs(values[2]) > _HIGHEST:
        raise InputError(f"{path} is no OXTS sample: it begins with no latitude, longitude and height")
    return values
