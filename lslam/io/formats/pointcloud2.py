"""Clouds in messages, `sensor_msgs/PointCloud2` and Livox's `CustomMsg`, as arrays: no loop over points."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lslam.core.errors import InputError
from lslam.io.formats.point_cloud import PointCloud, cloud_from_fields, organised

# sensor_msgs/PointField
TYPES = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 8: "f8"}
_LIVOX = [
    ("offset_time", "u4"),
    ("x", "f4"),
    ("y", "f4"),
    ("z", "f4"),
    ("reflectivity", "u1"),
    ("tag", "u1"),
    ("line", "u1"),
]


def decode_pointcloud2(message: Any, where: Path) -> PointCloud:
    """Decode the points of a PointCloud2; points without finite coordinates are left out.

    Rows may be padded and numbers big-endian. An organised cloud without a ring field gets its rows (its columns, where there
    are fewer of them) as rings. Raises InputError naming `where` when fields and data contradict each other.
    """
    height, width, step = int(message.height), int(message.width), int(message.point_step)
    if not height * width:
        return PointCloud(np.zeros((0, 3), np.float32))
    row_step = max(int(message.row_step), width * step) if height > 1 else width * step
    needed = (height - 1) * row_step + width * step
    if len(message.data) < needed:
        raise InputError(
            f"{where}: a cloud of {height} x {width} points of {step} bytes needs {needed} bytes and has {len(message.data)}"
        )
    dtype = _dtype(message, where)
    table = np.ndarray((height, width), dtype, np.ascontiguousarray(message.data).data, 0, (row_step, step)).reshape(-1)
    columns: dict[str, NDArray[Any]] = {name: _native(table[name]) for name in dtype.names or ()}
    return _finite(cloud_from_fields(where, columns | organised(height, width)))


def decode_livox(data: bytes, start: int, is_ros1: bool, order: str, where: Path) -> tuple[PointCloud, int]:
    """Decode a Livox CustomMsg whose header ends at `start`: points, and `timebase`, ns. Raises InputError when it is cut off."""
    at = _livox_body(start, is_ros1)
    try:
        timebase = int(np.frombuffer(data, f"{order}u8", 1, at)[0])
        count = int(np.frombuffer(data, f"{order}u4", 1, at + 16)[0])
        padding = [] if is_ros1 else [("padding", "u1")]
        padded = data[at + 20 :] + bytes(len(padding))  # behind the last point there is none
        table = np.frombuffer(padded, [(name, order + kind) for name, kind in _LIVOX + padding], count)
    except ValueError:
        raise InputError(f"{where}: a Livox message of {len(data)} bytes is cut off") from None
    columns = {name: _native(table[name]) for name in ("x", "y", "z", "reflectivity", "offset_time", "line", "tag")}
    return _finite(cloud_from_fields(where, columns)), timebase


def livox_id(data: bytes, start: int, is_ros1: bool) -> int | None:
    """LiDAR number (`lidar_id`) of a Livox CustomMsg whose header ends at `start`; None when it is cut off before that."""
    at = _livox_body(start, is_ros1) + 12
    return data[at] if at < len(data) else None


def _livox_body(start: int, is_ros1: bool) -> int:
    """Offset of the first number of a CustomMsg. CDR aligns numbers relative to the end of its 4-byte header."""
    return start if is_ros1 else 4 + -(-(start - 4) // 8) * 8


def _dtype(message: Any, where: Path) -> np.dtype[Any]:
    order = ">" if message.is_bigendian else "<"
    step = int(message.point_step)
    fields: dict[str, tuple[Any, int]] = {}
    for f in message.fields:
        if f.datatype not in TYPES:
            continue
        kind = np.dtype(order + TYPES[f.datatype])
        if f.offset + kind.itemsize > step:
            raise InputError(f"{where}: field {f.name!r} of the cloud lies beyond its {step} bytes per point")
        # A count that reaches beyond the point is not believed.
        is_repeated = f.count > 1 and f.offset + f.count * kind.itemsize <= step
        fields[f.name] = ((kind, (f.count,)) if is_repeated else kind, int(f.offset))
    kinds, offsets = zip(*fields.values(), strict=True) if fields else ((), ())
    return np.dtype({"names": list(fields), "formats": list(kinds), "offsets": list(offsets), "itemsize": step})


def _native(values: NDArray[Any]) -> NDArray[Any]:
    return values.astype(values.dtype.newbyteorder("="), copy=False)


def _finite(cloud: PointCloud) -> PointCloud:
    finite = np.asarray(np.isfinite(cloud.points).all(axis=1))
    return cloud if finite.all() else cloud.select(finite)
