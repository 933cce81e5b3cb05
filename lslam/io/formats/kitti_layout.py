"""Files of KITTI's layouts: OXTS packets, calibration, scans and times; and rigid transforms of others, as of a command line."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from lslam.core.arrays import Floats, Longs
from lslam.core.errors import InputError, LslamError, UsageError, cause, input_errors
from lslam.core.geometry import portable, se3, so3
from lslam.core.types.scan import Scan
from lslam.core.types.trajectory import Trajectory
from lslam.core.untrusted import is_file, whole_number
from lslam.io.formats.atomic import atomic_write, write_text
from lslam.io.formats.point_files import LABELS, write_bin, write_labels
from lslam.io.formats.text_tables import seconds_text
from lslam.io.formats.time_columns import read_stamps
from lslam.io.remote import as_path

POINTS, PER_POINT = "velodyne", "per_point"
# Columns, in the order of the devkit's dataformat.txt.
LAT, LON, ALT, ROLL, PITCH, YAW = range(6)
ACCEL, GYRO = slice(11, 14), slice(17, 20)  # ax..az and wx..wz: vehicle axes, x forward, y left, z up
POS_ACC = 23
_WIDTH = 30
_HIGHEST = 1e5  # m
# Of any of them, in its unit: no sensor says more, and squared twice it overflows.
_LARGEST = 1e9
LIDAR_TO_CAMERA = ("Tr", "Tr_velo_to_cam", "Tr_velo_cam")
_ROW = re.compile(r"-\s*\[(.*)\]\s*$")


def scan_files(folder: Path, number: int) -> tuple[Path, Path]:
    """Paths of the points of scan `number` in the sequence folder, and of their times and rings."""
    return folder / POINTS / f"{number:06d}.bin", folder / PER_POINT / f"{number:06d}.npz"


def label_file(folder: Path, number: int) -> Path:
    """Path of the classes of the points of scan `number`, in SemanticKITTI's layout."""
    return folder / LABELS / f"{number:06d}.label"


def write_scan(folder: Path, number: int, scan: Scan) -> None:
    """Write the points of a scan, their classes, and their times (s from the stamp) and rings where known.

    The file of times and rings is always written last, so its presence marks a complete scan.
    """
    cloud, beside = scan_files(folder, number)
    write_bin(cloud, scan.points, scan.intensity)
    if scan.labels is not None:
        label_file(folder, number).parent.mkdir(exist_ok=True)
        write_labels(label_file(folder, number), scan.labels)
    known: dict[str, Any] = {name: v for name, v in (("t", scan.times), ("ring", scan.rings)) if v is not None}
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
    """The 30 numbers of an OXTS packet; raises InputError for anything else, or an impossible position."""
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


def read_odometry_calib(path: str | Path) -> Floats | None:
    """`T_cam0_lidar` (4, 4) of an odometry `calib.txt`, its `Tr`; None when the file has none (as in early downloads).

    Raises InputError when the file is missing, is no calibration, or states numbers that are no rigid transform.
    """
    return _tr(as_path(path), read_entries(as_path(path)))


def read_rigid(path: str | Path) -> Floats:
    """(4, 4) transform of a raw `R:`/`T:` file: `calib_velo_to_cam.txt` is T_cam0_lidar, `calib_imu_to_velo.txt` T_lidar_imu.

    `T_cam0_lidar` of a raw day ends in the unrectified camera 0; see `read_raw_cam0_lidar` for the rectified one.
    """
    path = as_path(path)
    entries = read_entries(path)
    R, t = _entry(path, entries, "R", 9), _entry(path, entries, "T", 3)
    return _rigid(R.reshape(3, 3), t, path, "R")


def read_rectification(path: str | Path) -> Floats | None:
    """(4, 4) rotation into the rectified camera 0: `R_rect_00` of `calib_cam_to_cam.txt`, None when it has none."""
    path = as_path(path)
    entries = read_entries(path)
    if "R_rect_00" not in entries:
        return None
    return _rigid(_entry(path, entries, "R_rect_00", 9).reshape(3, 3), np.zeros(3), path, "R_rect_00")


def read_projection(path: str | Path, key: str) -> Floats:
    """(3, 4) projection `P2` of an odometry `calib.txt`, `P_rect_02` of a raw day: rectified camera 0, m, to pixels.

    Raises InputError without it, and where it is none.
    """
    path = as_path(path)
    P = _entry(path, read_entries(path), key, 12).reshape(3, 4)
    if not (P[0, 0] > 0 and P[1, 1] > 0 and np.allclose(P[2, :3], [0, 0, 1]) and abs(np.linalg.det(P[:, :3])) > 0):
        raise InputError(f"calibration {path}: {key} is no projection of a rectified camera")
    return P


def read_raw_cam0_lidar(folder: str | Path) -> Floats:
    """`T_cam0_lidar` (4, 4) of a raw day, in the rectified camera 0 when `calib_cam_to_cam.txt` is there."""
    T = read_rigid(as_path(folder) / "calib_velo_to_cam.txt")
    cameras = as_path(folder) / "calib_cam_to_cam.txt"
    rectification = read_rectification(cameras) if cameras.is_file() else None
    return T if rectification is None else np.asarray(rectification @ T)


def read_cam0_lidar(path: str | Path) -> Floats:
    """`T_cam0_lidar` of `calib.txt`, of a raw `calib_velo_to_cam.txt` or of a raw day's folder. Raises InputError without any."""
    path = as_path(path)
    if path.is_dir():
        return read_raw_cam0_lidar(path)
    entries = read_entries(path)
    if "R" in entries and "T" in entries:
        if "imu" in path.name:
            raise InputError(f"{path} is the extrinsics of the IMU: --calib needs calib_velo_to_cam.txt or calib.txt")
        return read_raw_cam0_lidar(path.parent) if path.name == "calib_velo_to_cam.txt" else read_rigid(path)
    T = _tr(path, entries)
    if T is None:
        raise InputError(f"{path} has no Tr (LiDAR to camera 0): entries are {', '.join(entries)}")
    return T


def read_entries(path: Path) -> dict[str, str]:
    """Texts of the lines `name: values` of a calibration file, by name. Raises InputError if it is missing or empty."""
    try:
        lines = path.read_text(encoding="utf-8").splitlines()
    except FileNotFoundError:
        raise InputError(f"calibration {path} does not exist") from None
    except UnicodeDecodeError:
        raise InputError(f"calibration {path} is not a text file") from None
    except OSError as error:
        raise InputError(f"calibration {path} cannot be read: {cause(error)}") from None
    entries = {}
    for line in lines:
        name, colon, values = line.partition(":")
        if not colon:
            # The first odometry download wrote "Tr 1 0 0 ..." in some sequences.
            name, _, values = line.strip().partition(" ")
        if name.strip() and values.strip():
            entries[name.strip()] = values.strip()
    if not entries:
        raise InputError(f"calibration {path} is empty")
    return entries


def _tr(path: Path, entries: dict[str, str]) -> Floats | None:
    """Transform (4, 4) from the LiDAR to camera 0 among a calibration's entries; None without one."""
    for name in LIDAR_TO_CAMERA:
        if name in entries:
            rows = _entry(path, entries, name, 12).reshape(3, 4)
            return _rigid(rows[:, :3], rows[:, 3], path, name)
    return None


def _entry(path: Path, entries: dict[str, str], name: str, count: int) -> Floats:
    """The `count` numbers of the entry `name`; raises InputError naming the calibration `path` if they are not there."""
    if name not in entries:
        raise InputError(f"calibration {path} has no entry {name}: entries are {', '.join(entries)}")
    values = _numbers(entries[name].split())
    if values is None:
        raise InputError(f"calibration {path}: {name} holds something that is no number")
    if len(values) != count or not np.isfinite(values).all():
        raise InputError(f"calibration {path}: {name} has {len(values)} numbers, {count} finite ones expected")
    return np.array(values)


def _rigid(R: Floats, t: Floats, path: Path, name: str) -> Floats:
    """(4, 4) rigid transform: seven printed digits give no exact rotation, so it is projected onto SO(3)."""
    if not so3.is_rotation(R, 1e-2):
        raise InputError(f"calibration {path}: {name} holds no rotation")
    return se3.normalise(se3.make(R, t))


def read_mcd_extrinsics(path: Path, sensor: str = "os_sensor") -> Floats | None:
    """(4, 4) T_body_sensor of `sensor`, None when the file does not name it.

    Raises InputError naming file and line when the block below the name is not a rigid 4x4 `T`.
    """
    with input_errors(path, UnicodeDecodeError):
        lines = path.read_text(encoding="utf-8").splitlines()
    begin = next((k for k, line in enumerate(lines) if line.strip() == f"{sensor}:"), None)
    if begin is None:
        return None
    has_matrix = [line.strip() for line in lines[begin + 1 : begin + 2]] == ["T:"]
    matches = [_ROW.search(line) for line in lines[begin + 2 : begin + 6]] if has_matrix else []
    rows = [_numbers(match[1].split(",")) or [] for match in matches if match]
    if [len(row) for row in rows] != [4] * 4:
        raise InputError(f"{path}, line {begin + 1}: {sensor} is not followed by 'T:' and four rows of four numbers")
    T = np.array(rows)
    if not so3.is_rotation(T[:3, :3], 1e-3) or not np.isfinite(T).all():
        raise InputError(f"{path}, line {begin + 1}: T of {sensor} is no rigid transform")
    return T


def read_transform(text: str) -> Floats:
    """(4, 4) transform of 12 or 16 numbers (rows of the matrix), of `tx,ty,tz,qx,qy,qz,qw`, or of a file with either.

    Numbers are separated by commas or spaces. A file may also be KITTI's `R:`/`T:` kind or one line `Tr: ...`.
    Raises UsageError for text that is neither numbers nor a file, InputError for a file that holds no transform.
    """
    source = f"transform {text!r}"
    refusal: type[LslamError] = UsageError
    values = _numbers(_words(text))
    if not values:
        path = Path(text)
        if not is_file(path):
            raise UsageError(f"transform {text!r} is neither numbers nor a file that exists")
        try:
            lines = path.read_text(encoding="utf-8-sig").splitlines()
        except (UnicodeDecodeError, OSError):
            raise InputError(f"{path} cannot be read as text: a transform of 12, 16 or 7 numbers is expected") from None
        values = _numbers(_words("\n".join(line for line in lines if not line.lstrip().startswith("#"))))
        if not values:
            return _transform_in_file(path)
        source, refusal = str(path), InputError
    try:
        return _transform(values)
    except ValueError as error:
        raise refusal(f"{source}: {error}") from None


def _transform_in_file(path: Path) -> Floats:
    """Transform in a file of `name: values` lines."""
    entries = read_entries(path)
    T = read_rigid(path) if "R" in entries and "T" in entries else _tr(path, entries)
    if T is None:
        raise InputError(f"{path} holds no transform: 12, 16 or 7 numbers are expected")
    return T


def _words(text: str) -> list[str]:
    """The text split at commas, semicolons, brackets and blanks."""
    return re.findall(r"[^,;\s\[\]]+", text)


def _numbers(words: list[str]) -> list[float] | None:
    """Numbers in a list of words; None if one of them is no number."""
    try:
        return [float(word) for word in words]
    except ValueError:
        return None


def _transform(values: list[float]) -> Floats:
    """Rigid transform (4, 4) of 12 or 16 numbers, rows, or 7, tx ty tz qx qy qz qw; ValueError for other or non-rigid ones."""
    if not np.isfinite(values).all():
        raise ValueError("NaN or infinity")
    if len(values) == 7:
        q = np.array(values[3:])
        if abs(np.linalg.norm(q) - 1) > 0.05:
            raise ValueError("the quaternion (last four numbers, x y z w) has not length 1")
        return se3.make(so3.from_quaternion(q), np.array(values[:3]))
    if len(values) not in (12, 16):
        raise ValueError(
            f"{len(values)} numbers; 12 or 16 (rows of the matrix) or 7 (tx,ty,tz,qx,qy,qz,qw) are expected"
        )
    T = np.vstack([np.reshape(values[:12], (3, 4)), [0, 0, 0, 1]])
    if len(values) == 16 and not np.allclose(values[12:], [0, 0, 0, 1]):
        raise ValueError("the last row of the 4x4 matrix is not 0 0 0 1")
    if not so3.is_rotation(T[:3, :3], 1e-2):
        raise ValueError("the 3x3 part is no rotation")
    return se3.normalise(T)
