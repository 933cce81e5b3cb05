"""`sequence.toml`: facts that a folder of scans cannot state by itself. Reader and writer; unknown keys are errors."""

from __future__ import annotations

import tomllib
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any

import numpy as np

from lslam.core.arrays import Floats
from lslam.core.errors import InputError, input_errors, nearest
from lslam.core.geometry import so3
from lslam.core.printable import toml_text
from lslam.core.types.camera import MODELS, Lens
from lslam.core.untrusted import parse_toml
from lslam.io.formats.atomic import write_text
from lslam.io.formats.point_records import parse_record
from lslam.io.formats.time_columns import UNITS

FILE_NAME = "sequence.toml"
INSTANTS = ("scan_start", "scan_middle", "scan_end")
LENGTHS = {"m": 1.0, "cm": 0.01, "mm": 0.001}  # m
REFERENCES = ("start", "end", "absolute")
POINT_TIMES = ("field", "columns", "order", "azimuth", "none")
FRAMES = ("lidar", "cam0", "imu")
EXTRINSICS = ("T_cam0_lidar", "T_lidar_imu", "T_lidar_gnss")
_NECESSARY_CAMERA_KEYS = ("images", "intrinsics", "T_lidar_camera")  # of a camera
_LARGEST = 1e9  # of a number of a camera: seconds beyond have no stamps, pixels no image
CAMERA_KEYS = (*_NECESSARY_CAMERA_KEYS, "stamps", "model", "distortion", "time_offset_s")


def is_rate(rate_hz: float) -> bool:
    """Whether a number can be the rate of a sensor, Hz: stamps are made of it."""
    return 1e-3 < rate_hz < 1e6


def _is_text(value: Any) -> bool:
    """Whether a value is a text that is not blank."""
    return isinstance(value, str) and bool(value.strip())


def _is_number(value: Any) -> bool:
    """Whether a value is a finite number."""
    return isinstance(value, (int, float)) and not isinstance(value, bool) and bool(np.isfinite(value))


def _is_record(value: Any) -> bool:
    """Whether a value is a valid point record, see `parse_record`."""
    try:
        return isinstance(value, str) and bool(parse_record(value))
    except ValueError:
        return False


def _key(is_valid: Callable[[Any], bool], form: str) -> Any:
    """Field of `SequenceInfo` for one key, with the check of its values."""
    return field(default=None, metadata={"is_valid": is_valid, "expected": form})


def _text(form: str) -> Any:
    """Field of `SequenceInfo` whose value is a text; form : of that text, for messages."""
    return _key(_is_text, form)


def _count() -> Any:
    """Field of `SequenceInfo` whose value is a whole number above 0."""
    return _key(lambda v: isinstance(v, int) and not isinstance(v, bool) and v > 0, "a whole number above 0")


def _one_of(choices: Iterable[str]) -> Any:
    """Field of `SequenceInfo` whose value is one of the choices."""
    names = list(choices)
    return _key(lambda v: v in names, f"one of {', '.join(names)}")


@dataclass(frozen=True)
class CameraInfo:
    """What `sequence.toml` says of a camera.

    images : folder of its images, in the order of their names; stamps : file with the stamp of each, relative to the sequence
    model, intrinsics, distortion : as of `Lens`, whose size is that of the images
    T_lidar_camera : (4, 4), camera axes x right, y down, z forward; time_offset_s : added to the stamps
    """

    images: str
    intrinsics: tuple[float, float, float, float]
    T_lidar_camera: Floats
    stamps: str = ""
    model: str = "pinhole"
    distortion: tuple[float, ...] = ()
    time_offset_s: float = 0.0

    @property
    def stamps_file(self) -> str:
        """The stated file of stamps, else times.txt among the images."""
        return self.stamps or f"{self.images}/times.txt"

    def lens(self, size: tuple[int, int]) -> Lens:
        """The lens of images of `size`, width and height."""
        return Lens(self.model, size, self.intrinsics, self.distortion)

    def tree(self) -> dict[str, Any]:
        """Values for TOML."""
        matrix = [[float(value) for value in row] for row in self.T_lidar_camera]
        other = {key: getattr(self, key) for key in CAMERA_KEYS if key != "T_lidar_camera"}
        plain = {key: list(value) if isinstance(value, tuple) else value for key, value in other.items()}
        return {**{key: value for key, value in plain.items() if value not in ("", [], 0.0)}, "T_lidar_camera": matrix}


@dataclass(frozen=True)
class SequenceInfo:
    """Facts about a sequence from `sequence.toml` or the user; None where nothing is stated.

    sensor : its name, for example `HDL-64E`; rings : number of beams
    rows, cols : organised clouds, point r * cols + c is row (ring) r; rate_hz : scans per second
    motion_compensated : scans are free of motion distortion; compensated_to : the instant, one of `INSTANTS`
    vertical_correction_deg : rotation of every point about p x z that the scans still need, 0 for none
    per_point : folder of `<scan>.npz` with `t` (float32 s from the scan's stamp) and `ring` (uint16)
    point_time_unit, point_time_reference : of the points' own time field, where it does not show, one of `UNITS` and of
        `REFERENCES`: the scan's start or end, which is its stamp then, or absolute
    bin_record : what a point of a `.bin` file or of a plain array consists of, see `parse_record`
    point_unit : of the coordinates of points, one of `LENGTHS`
    point_times : what tells the times of points, one of `POINT_TIMES`
    stamps, imu, gnss, ground_truth : files, relative to the sequence folder
    ground_truth_frame : the body whose poses `ground_truth` holds, one of `FRAMES`
    lidar_topic, imu_topic, gnss_topic : which topics of a bag are read; lidar_frame : which of the LiDARs that share one, by
        the frame of their messages, or `all`; several have commas between them and are merged, the first one leads
    T_cam0_lidar, T_lidar_imu, T_lidar_gnss : (4, 4) extrinsics, written in the table `[extrinsics]`
    lidars : further LiDARs and where they sit, T_lidar_other (4, 4) by folder, or by frame or topic of a bag
    frames : further frames of the robot, T_lidar_frame (4, 4) by name
    cameras : by name
    """

    name: str | None = _text("text")
    sensor: str | None = _text("text, for example HDL-64E")
    rings: int | None = _count()
    rows: int | None = _count()
    cols: int | None = _count()
    rate_hz: float | None = _key(
        lambda v: _is_number(v) and is_rate(v), "a number above 0.001 and below a million, scans per second"
    )
    motion_compensated: bool | None = _key(lambda v: isinstance(v, bool), "true or false")
    compensated_to: str | None = _one_of(INSTANTS)
    vertical_correction_deg: float | None = _key(_is_number, "a number, degrees")
    per_point: str | None = _text("a folder")
    point_time_unit: str | None = _one_of(UNITS)
    point_time_reference: str | None = _one_of(REFERENCES)
    bin_record: str | None = _key(
        _is_record, 'columns like "x y z intensity ring:u2 time:f8", float32 where no type is named'
    )
    point_unit: str | None = _one_of(LENGTHS)
    point_times: str | None = _one_of(POINT_TIMES)
    stamps: str | None = _text("a file")
    imu: str | None = _text("a file")
    gnss: str | None = _text("a file")
    ground_truth: str | None = _text("a file")
    ground_truth_frame: str | None = _one_of(FRAMES)
    lidar_topic: str | None = _text("a topic")
    lidar_frame: str | None = _text("a frame, or all")
    imu_topic: str | None = _text("a topic")
    gnss_topic: str | None = _text("a topic")
    T_cam0_lidar: Floats | None = None
    T_lidar_imu: Floats | None = None
    T_lidar_gnss: Floats | None = None
    lidars: Mapping[str, Floats] | None = None
    frames: Mapping[str, Floats] | None = None
    cameras: Mapping[str, CameraInfo] | None = None

    def over(self, other: SequenceInfo) -> SequenceInfo:
        """Merge with `other`: its values are taken where this has none."""
        pairs = ((f.name, getattr(self, f.name), getattr(other, f.name)) for f in fields(self))
        return SequenceInfo(**{name: theirs if mine is None else mine for name, mine, theirs in pairs})


def read_sequence_toml(path: Path) -> SequenceInfo:
    """Read a `sequence.toml`. Raises InputError naming the file, the key and the nearest known key or the values allowed."""
    with input_errors(path, UnicodeDecodeError, as_what="TOML"):
        text = path.read_text(encoding="utf-8")
    return parse_sequence_toml(text, path)


def parse_sequence_toml(text: str, path: Path | str) -> SequenceInfo:
    """Parse the text of a `sequence.toml`; messages name `path`. Raises InputError for unknown keys and wrong values."""
    with input_errors(path, tomllib.TOMLDecodeError, as_what="TOML"):
        tree = parse_toml(text)
    tables = {key: tree.pop(key, {}) for key in _TABLES}
    for key, table in tables.items():
        if not isinstance(table, dict):
            raise InputError(f"{path}: {key} is a table, write [{key}] and below it {_TABLES[key]}")
    values: dict[str, Any] = {}
    for key, value in tree.items():
        if key not in _KEYS:
            raise InputError(f"{path}: unknown key {key!r}; {nearest(key, [*_KEYS, *_TABLES])}")
        if not _KEYS[key]["is_valid"](value):
            raise InputError(f"{path}: {key} = {value!r}, expected {_KEYS[key]['expected']}")
        values[key] = float(value) if key in ("rate_hz", "vertical_correction_deg") else value
    for key, value in tables["extrinsics"].items():
        if key not in EXTRINSICS:
            raise InputError(f"{path}: unknown key extrinsics.{key}; {nearest(key, EXTRINSICS)}")
        values[key] = _transform(path, f"extrinsics.{key}", value)
    for key in ("lidars", "frames"):
        if tables[key]:
            values[key] = {name: _transform(path, f"{key}.{name}", T) for name, T in tables[key].items()}
    if tables["cameras"]:
        values["cameras"] = {name: _camera(path, name, T) for name, T in tables["cameras"].items()}
    if (values.get("rows") is None) != (values.get("cols") is None):
        raise InputError(f"{path}: rows and cols of organised clouds go together, one of them is missing")
    return SequenceInfo(**values)


def write_sequence_toml(path: Path, info: SequenceInfo) -> None:
    """Write `info` to `path` atomically, without keys that are None; it reads back equal."""
    write_text(path, sequence_toml_text(info))


def sequence_toml_text(info: SequenceInfo) -> str:
    """`info` as TOML, without keys that are None."""
    tree = {f.name: getattr(info, f.name) for f in fields(info) if f.name not in (*EXTRINSICS, *_TABLES)}
    extrinsics = {key: getattr(info, key) for key in EXTRINSICS}
    tables: dict[str, Mapping[str, Floats | None]] = {
        "extrinsics": extrinsics,
        "lidars": info.lidars or {},
        "frames": info.frames or {},
    }
    for key, matrices in tables.items():
        rows = {name: np.asarray(T, np.float64).tolist() for name, T in matrices.items() if T is not None}
        tree[key] = rows or None
    tree["cameras"] = {name: camera.tree() for name, camera in (info.cameras or {}).items()} or None
    return toml_text({key: value for key, value in tree.items() if value is not None})


_KEYS = {f.name: f.metadata for f in fields(SequenceInfo) if f.metadata}
# Tables, and what a row of each looks like.
_TABLES = {
    "extrinsics": "T_lidar_imu = [...]",
    "lidars": '"FOLDER" = [T_lidar_other, 12 numbers]',
    "frames": "base_link = [T_lidar_base_link, 12 numbers]",
    "cameras": '[cameras.front] with images = "FOLDER"',
}


def _transform(path: Path | str, key: str, value: Any) -> Floats:
    """Transform (4, 4) of 3x4 or 4x4 rows, or the numbers in one list; raises InputError unless it is rigid."""
    try:
        numbers = np.asarray(value, np.float64).ravel()
    except (TypeError, ValueError):
        numbers = np.zeros(0)
    if len(numbers) not in (12, 16):
        raise InputError(f"{path}: {key} needs 3x4 or 4x4 numbers, row by row")
    T = np.eye(4)
    T[:3] = numbers[:12].reshape(3, 4)
    if not np.isfinite(numbers).all() or not so3.is_rotation(T[:3, :3], 1e-3):
        raise InputError(f"{path}: {key} is no rigid transform: its left 3x3 block is not a rotation")
    return T


def _camera(path: Path | str, name: str, table: Any) -> CameraInfo:
    """Camera of the table `[cameras.NAME]`. Raises InputError naming file and key."""
    place = f"cameras.{name}"
    if not isinstance(table, dict):
        raise InputError(
            f"{path}: {place} is a table, write [{place}] and below it {', '.join(_NECESSARY_CAMERA_KEYS)}"
        )
    for key in table:
        if key not in CAMERA_KEYS:
            raise InputError(f"{path}: unknown key {place}.{key}; {nearest(key, CAMERA_KEYS)}")
    for key in _NECESSARY_CAMERA_KEYS:
        if key not in table:
            what = "has no calibration" if key in ("intrinsics", "T_lidar_camera") else "has no images"
            raise InputError(f"{path}: camera {name} {what}: {place}.{key} is missing")
    for key in ("images", "stamps"):
        if key in table and not _is_text(table[key]):
            raise InputError(
                f"{path}: {place}.{key} = {table[key]!r}, expected a {'folder' if key == 'images' else 'file'}"
            )
    model = table.get("model", "pinhole")
    if model not in MODELS:
        raise InputError(f"{path}: {place}.model = {model!r}, expected one of {', '.join(MODELS)}")
    intrinsics = _numbers(path, f"{place}.intrinsics", table["intrinsics"], (4,), "fx, fy, cx, cy in pixels")
    if not min(intrinsics[:2]) > 0:
        raise InputError(f"{path}: {place}.intrinsics = {list(intrinsics)}: the focal lengths fx and fy are above 0")
    counts = MODELS[model]
    what = f"{' or '.join(map(str, counts))} coefficients of a {model}"
    distortion = _numbers(path, f"{place}.distortion", table.get("distortion", []), counts, what)
    (offset,) = _numbers(path, f"{place}.time_offset_s", [table.get("time_offset_s", 0.0)], (1,), "a number of seconds")
    T = _transform(path, f"{place}.T_lidar_camera", table["T_lidar_camera"])
    fx, fy, cx, cy = intrinsics
    return CameraInfo(table["images"], (fx, fy, cx, cy), T, table.get("stamps", ""), model, distortion, offset)


def _numbers(path: Path | str, key: str, value: Any, counts: tuple[int, ...], what: str) -> tuple[float, ...]:
    """A tuple of one of the `counts` of finite numbers; raises InputError that expects `what`."""
    try:
        numbers = np.asarray(value, np.float64)
    except (TypeError, ValueError, OverflowError):
        numbers = np.full(1, np.nan)
    if numbers.ndim != 1 or len(numbers) not in counts or not (np.abs(numbers) < _LARGEST).all():
        raise InputError(f"{path}: {key} = {value!r}, expected {what}")
    return tuple(numbers.tolist())
