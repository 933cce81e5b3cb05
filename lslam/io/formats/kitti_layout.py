"""Files of KITTI's layouts: reads OXTS packets; writes scans, times and calibration."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lslam.core.errors import InputError
from lslam.core.geometry import portable, se3
from lslam.core.types.arrays import Floats, Longs
from lslam.core.types.trajectory import Trajectory
from lslam.core.untrusted import whole_number
from lslam.io.formats.atomic import atomic_write, write_text
from lslam.io.formats.point_files import LABELS, write_bin, write_labels
from lslam.io.formats.text_tables import seconds_text
from lslam.io.formats.time_columns import read_stamps

POINTS, PER_POINT = "velodyne", "per_point"
# Columns, in the order of the devkit's dataformat.txt.
LAT, LON, ALT, ROLL, PITCH, YAW = range(6)
ACCEL, GYRO = slice(11, 14), slice(17, 20)  # ax..az and wx..wz: vehicle axes, x forward, y left, z up
POS_ACC = 23
_WIDTH = 30
_HIGHEST = 1e5  # m
# Of any of them, in its unit: no sensor says more, and squared twice it overflows.
_LARGEST = 1e9


def scan_files(folder: Path, number: int) -> tuple[Path, Path]:
    """Paths of the points of scan `number` in the sequence folder, and of their times and rings."""
    return folder / POINTS / f"{number:06d}.bin", folder / PER_POINT / f"{number:06d}.npz"


def label_file(folder: Path, number: int) -> Path:
    """Path of the classes of the points of scan `number`, in SemanticKITTI's layout."""
    return folder / LABELS / f"{number:06d}.label"


def write_scan(
    folder: Path,
    number: int,
    points: NDArray[np.float32],
    intensity: NDArray[np.float32] | None,
    times: NDArray[np.float32] | None,
    rings: NDArray[np.uint16] | None,
    labels: NDArray[np.uint16] | None = None,
) -> None:
    """Write the points of a scan, their classes, and their times (s from the stamp) and rings where known.

    The file of times and rings is always written last, so its presence marks a complete scan.
    """
    cloud, beside = scan_files(folder, number)
    write_bin(cloud, points, intensity)
    if labels is not None:
        label_file(folder, number).parent.mkdir(exist_ok=True)
        write_labels(label_file(folder, number), labels)
    known: dict[str, Any] = {name: v for name, v in (("t", times), ("ring", rings)) if v is not None}
    with atomic_write(beside) as stream:
        np.savez_compressed(stream, **known)


def write_times(folder: Path, stamps_ns: Longs) -> None:
    """Write `times.txt`, seconds with all nine decimals."""
    write_text(folder / "times.txt", "".join(f"{seconds_text(int(stamp))}\n" for stamp in stamps_ns))


def write_calib(folder: Path, T_cam0_lidar: Floats) -> None:
    """Write `calib.txt` with the line `Tr`."""
    write_text(folder / "calib.txt", "Tr: " + " ".join(f"{v:.12e}" for v in T_cam0_lidar[:3].ravel()) + "\n")


def in_camera(truth: Trajectory, T_cam0_lidar: Floats) -> Trajectory:
    """LiDAR poses as poses of camera 0 in the frame of camera 0 at the start, as in KITTI's files."""
    poses = portable.product(portable.product(T_cam0_lidar, truth.poses), se3.inverse(T_cam0_lidar))
    return Trajectory(truth.stamps_ns, poses, "cam0", truth.has_stamps, source=truth.source)


@dataclass(frozen=True)
class Oxts:
    """Samples of one drive.

    numbers : (N,) int64 file numbers; stamps_ns : (N,) int64, the dates taken as UTC; None when the file is missing
    values : (N, 30) float64 as in dataformat.txt (deg, m, rad, m/s, m/s2, rad/s)
    problems : one sentence each
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
