"""One point cloud as files hold it: positions and the fields lslam knows by their usual names."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lslam.errors import InputError

AXES = ("x", "y", "z")
INTENSITY_NAMES = ("intensity", "intensities", "i", "reflectivity", "reflectance", "scalar_intensity", "remission")
RING_NAMES = ("ring", "rings", "channel", "line", "laser_id", "scalar_ring")
# docs/conventions.md, "Per-point times".
TIME_NAMES = (
    "t", "time", "times", "timestamp", "timestamps", "time_stamp", "offset_time", "time_offset", "timeoffset", "stamp",
)  # fmt: skip


@dataclass(frozen=True)
class PointCloud:
    """What a point file holds.

    points : (N, 3) float32 (of maps float64), m; intensity : (N,) float32 or None; rings : (N,) uint16 or None
    times : (N,) per-point times as stored, of any type and unit, or None; time_field : their name in the file
    """

    points: NDArray[Any]
    intensity: NDArray[np.float32] | None = None
    rings: NDArray[np.uint16] | None = None
    times: NDArray[Any] | None = None
    time_field: str = ""

    def __len__(self) -> int:
        return len(self.points)


def cloud_from_fields(
    path: Path, columns: Mapping[str, NDArray[Any]], kind: type[np.floating[Any]] = np.float32
) -> PointCloud:
    """Collect x, y, z and the fields known by name (case does not matter) from one array per field.

    kind : of the points: float32 for scans, float64 for maps

    Raises InputError naming the file and the fields it has when x, y or z is missing.
    """
    lower = {name.lower(): name for name in columns}
    missing = [axis for axis in "xyz" if axis not in lower]
    if missing:
        raise InputError(f"{path}: no field {', '.join(missing)}; the file has {', '.join(columns) or 'no fields'}")
    points = np.empty((len(columns[lower["x"]]), 3), kind)
    for k, axis in enumerate("xyz"):
        points[:, k] = columns[lower[axis]]
    intensity = _first(lower, INTENSITY_NAMES)
    ring = _first(lower, RING_NAMES)
    time = _first(lower, TIME_NAMES)
    return PointCloud(
        points,
        None if intensity is None else np.ascontiguousarray(columns[intensity], np.float32),
        None if ring is None else _as_rings(path, ring, columns[ring]),
        None if time is None else np.ascontiguousarray(columns[time]),
        time or "",
    )


def _first(lower: Mapping[str, str], names: tuple[str, ...]) -> str | None:
    return next((lower[name] for name in names if name in lower), None)


def _as_rings(path: Path, name: str, values: NDArray[Any]) -> NDArray[np.uint16]:
    if np.can_cast(values.dtype, np.uint16):
        return values.astype(np.uint16)
    if len(values) and not (np.isfinite(values).all() and values.min() >= 0 and values.max() <= 65535):
        raise InputError(f"{path}: field {name!r} holds no ring numbers (0 to 65535)")
    return values.astype(np.uint16)
