"""`[cameras.NAME]` of `sequence.toml`: where the images of a camera are, how its lens projects, where and when it looked."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from lslam.core.errors import InputError, nearest
from lslam.core.types.arrays import Floats
from lslam.core.types.camera import MODELS, Lens

_NEEDED = ("images", "intrinsics", "T_lidar_camera")
_LARGEST = 1e9  # of any number: seconds beyond have no stamps, pixels no image
_KEYS = (*_NEEDED, "stamps", "model", "distortion", "time_offset_s")


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
        other = {key: getattr(self, key) for key in _KEYS if key != "T_lidar_camera"}
        plain = {key: list(value) if isinstance(value, tuple) else value for key, value in other.items()}
        return {**{key: value for key, value in plain.items() if value not in ("", [], 0.0)}, "T_lidar_camera": matrix}


def camera_of(path: Path | str, name: str, table: Any, rigid: Callable[[Path | str, str, Any], Floats]) -> CameraInfo:
    """Camera of the table `[cameras.NAME]`; `rigid` checks its transform. Raises InputError naming file and key."""
    place = f"cameras.{name}"
    if not isinstance(table, dict):
        raise InputError(f"{path}: {place} is a table, write [{place}] and below it {', '.join(_NEEDED)}")
    for key in table:
        if key not in _KEYS:
            raise InputError(f"{path}: unknown key {place}.{key}; {nearest(key, _KEYS)}")
    for key in _NEEDED:
        if key not in table:
            what = "has no calibration" if key in ("intrinsics", "T_lidar_camera") else "has no images"
            raise InputError(f"{path}: camera {name} {what}: {place}.{key} is missing")
    for key in ("images", "stamps"):
        if key in table and not (isinstance(table[key], str) and table[key].strip()):
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
    T = rigid(path, f"{place}.T_lidar_camera", table["T_lidar_camera"])
    fx, fy, cx, cy = intrinsics
    return CameraInfo(table["images"], (fx, fy, cx, cy), T, table.get("stamps", ""), model, distortion, offset)


def _numbers(path: Path | str, key: str, value: Any, counts: tuple[int, ...], what: str) -> tuple[float, ...]:
    try:
        numbers = np.asarray(value, np.float64)
    except (TypeError, ValueError, OverflowError):
        numbers = np.full(1, np.nan)
    if numbers.ndim != 1 or len(numbers) not in counts or not (np.abs(numbers) < _LARGEST).all():
        raise InputError(f"{path}: {key} = {value!r}, expected {what}")
    return tuple(numbers.tolist())
