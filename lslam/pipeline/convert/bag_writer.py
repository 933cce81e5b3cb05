"""Bags of ROS 1 and ROS 2, written without ROS, and arrays as their messages."""

from __future__ import annotations

import contextlib
import os
import shutil
import sqlite3
from collections.abc import Mapping
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lslam.core.arrays import Floats, Longs
from lslam.core.errors import OutputError, UsageError, cause, output_errors
from lslam.core.geometry import so3
from lslam.core.types.scan import Scan
from lslam.io.formats.bag_files import INFO_TOPIC, typestore
from lslam.io.formats.sensor_messages import TYPES

# What belongs to the whole of a run.
MAP_TOPIC, PATH_TOPIC = "/map", "/path"
OF_THE_RUN = ("/tf_static", INFO_TOPIC, MAP_TOPIC, PATH_TOPIC)
_CODES = {np.dtype(name): code for code, name in TYPES.items()}  # of sensor_msgs/PointField
_UNKNOWN = np.r_[-1.0, np.zeros(8)]  # sensor_msgs/Imu: a first covariance of -1 means that there is no such reading
_DIAGONAL, _NO_COVARIANCE = 2, 0  # sensor_msgs/NavSatFix


class BagWriter:
    """Writes a bag, whole or not at all: a ROS 1 `.bag`, or a ROS 2 folder, or a single file when `path` ends in .mcap or .db3.

    kind : bag, mcap or sqlite; is_zstd : compress, mcap and sqlite only
    Raises OutputError when it cannot be written, UsageError for a compression the kind does not have.
    """

    def __init__(self, path: Path, kind: str, is_zstd: bool = False) -> None:
        if is_zstd and kind == "bag":
            raise UsageError("--zstd is for mcap and sqlite: ROS 1 does not know it")
        self.path, self.kind = path, kind
        self.store = typestore("ros1" if kind == "bag" else "cdr")
        self.messages = BagMessages(self.store)
        self._part = path.with_name(path.name + ".part")
        self._connections: dict[str, Any] = {}
        with output_errors(path):
            shutil.rmtree(self._part, ignore_errors=True)
            self._part.mkdir(parents=True)
            self._writer = _writer(self._part / path.name, kind, is_zstd)

    def __enter__(self) -> BagWriter:
        return self

    def write(self, topic: str, stamp_ns: int, message: Any) -> None:
        """Write a message, an object of `store.types`. Raises OutputError for a full disk or a time before 1970."""
        if stamp_ns < 0:
            raise OutputError(f"{self.path} cannot hold the time {stamp_ns} ns: times of bags begin in 1970")
        kind = message.__msgtype__
        try:
            if topic not in self._connections:
                more = _quality_of_service(self.kind) if topic in OF_THE_RUN else {}
                self._connections[topic] = self._writer.add_connection(topic, kind, typestore=self.store, **more)
            serialise = self.store.serialize_ros1 if self.kind == "bag" else self.store.serialize_cdr
            self._writer.write(self._connections[topic], stamp_ns, serialise(message, kind))
        except (OSError, sqlite3.Error) as error:
            raise OutputError(f"{self.path} cannot be written: {cause(error)}") from None

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Close the bag and move it to its path; after an exception in the block, delete what was written."""
        try:
            if kind is not None:
                with contextlib.suppress(Exception):
                    self._writer.abort()
                return
            self._writer.close()
            made = self._part / self.path.name
            if made.is_dir() and self.path.suffix in (".mcap", ".db3"):
                made = next(p for p in made.iterdir() if p.suffix == self.path.suffix)
            os.replace(made, self.path)
        except (OSError, sqlite3.Error) as failure:
            raise OutputError(f"{self.path} cannot be written: {cause(failure)}") from None
        finally:
            shutil.rmtree(self._part, ignore_errors=True)


def _writer(path: Path, kind: str, is_zstd: bool) -> Any:
    """Open writer of rosbags for the kind: `bag`, `mcap` or `sqlite`."""
    from rosbags.rosbag1 import Writer as Writer1
    from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin
    from rosbags.rosbag2 import Writer as Writer2

    writer: Any = Writer1(path)
    if kind != "bag":
        # The newest metadata with the notation of QoS that ROS 2 had before Jazzy.
        plugin = StoragePlugin.MCAP if kind == "mcap" else StoragePlugin.SQLITE3
        writer = Writer2(path, version=8, storage_plugin=plugin)
        if is_zstd:
            mode = CompressionMode.STORAGE if kind == "mcap" else CompressionMode.MESSAGE
            writer.set_compression(mode, CompressionFormat.ZSTD)
    writer.open()
    return writer


def _quality_of_service(kind: str) -> dict[str, Any]:
    """Quality of service by which late subscribers get the last message of a topic."""
    if kind == "bag":
        return {"latching": 1}
    from rosbags.interfaces import Qos, QosDurability, QosHistory, QosLiveliness, QosReliability, QosTime

    never = QosTime(2147483647, 4294967295)
    quality = Qos(
        QosHistory.KEEP_LAST,
        1,
        QosReliability.RELIABLE,
        QosDurability.TRANSIENT_LOCAL,
        never,
        never,
        QosLiveliness.AUTOMATIC,
        never,
        False,
    )
    return {"offered_qos_profiles": [quality]}


class BagMessages:
    """Arrays as messages of a ROS; `store` has its message types."""

    def __init__(self, store: Any) -> None:
        self._types = store.types

    def cloud(self, scan: Scan, frame: str) -> Any:
        """PointCloud2 of a scan: x, y, z, and if known intensity, ring, label and `time`, s from the stamp."""
        columns: dict[str, NDArray[Any]] = {axis: scan.points[:, k] for k, axis in enumerate("xyz")}
        optional = {"intensity": scan.intensity, "ring": scan.rings, "time": scan.times, "label": scan.labels}
        columns |= {name: values for name, values in optional.items() if values is not None}
        is_dense = bool(np.isfinite(scan.points).all())
        return self._cloud(self.header(scan.stamp_ns, frame, scan.index), columns, is_dense)

    def points(
        self, stamp_ns: int, places: NDArray[np.floating[Any]], intensity: NDArray[np.float32] | None, frame: str
    ) -> Any:
        """PointCloud2 of finite positions (N, 3), m, and optional intensities (N,), as float32."""
        columns: dict[str, NDArray[Any]] = {axis: places[:, k].astype(np.float32) for k, axis in enumerate("xyz")}
        if intensity is not None:
            columns["intensity"] = intensity.astype(np.float32)
        return self._cloud(self.header(stamp_ns, frame), columns, True)

    def _cloud(self, head: Any, columns: Mapping[str, NDArray[Any]], is_dense: bool) -> Any:
        """PointCloud2 with header `head` and one little-endian field per column, packed; the column x must exist."""
        dtype = np.dtype([(name, values.dtype.newbyteorder("<")) for name, values in columns.items()])
        table = np.empty(len(columns["x"]), dtype)
        for name, values in columns.items():
            table[name] = values
        assert dtype.fields is not None
        field, places = self._types["sensor_msgs/msg/PointField"], dtype.fields
        return self._types["sensor_msgs/msg/PointCloud2"](
            header=head,
            height=1,
            width=len(table),
            fields=[
                field(name=name, offset=int(places[name][1]), datatype=_CODES[values.dtype], count=1)
                for name, values in columns.items()
            ],
            is_bigendian=False,
            point_step=dtype.itemsize,
            row_step=dtype.itemsize * len(table),
            data=table.view(np.uint8).reshape(-1),
            is_dense=is_dense,
        )

    def imu(self, stamp_ns: int, accel: Floats, gyro: Floats, frame: str) -> Any:
        """Imu message: specific force (3,), m/s2, and angular rate (3,), rad/s; no orientation."""
        return self._types["sensor_msgs/msg/Imu"](
            header=self.header(stamp_ns, frame),
            orientation=self._quaternion([0, 0, 0, 1]),
            orientation_covariance=_UNKNOWN,
            angular_velocity=self._vector(gyro),
            angular_velocity_covariance=np.zeros(9),
            linear_acceleration=self._vector(accel),
            linear_acceleration_covariance=np.zeros(9),
        )

    def fix(self, stamp_ns: int, lat_lon_alt: Floats, sigma: float, frame: str) -> Any:
        """NavSatFix of latitude, longitude (deg), height (m), (3,), with one sigma, m, NaN when it is unknown."""
        is_known = bool(np.isfinite(sigma))
        latitude, longitude, altitude = (float(v) for v in lat_lon_alt)
        return self._types["sensor_msgs/msg/NavSatFix"](
            header=self.header(stamp_ns, frame),
            status=self._types["sensor_msgs/msg/NavSatStatus"](status=0, service=1),
            latitude=latitude,
            longitude=longitude,
            altitude=altitude,
            position_covariance=np.eye(3).ravel() * (sigma**2 if is_known else 0.0),
            position_covariance_type=_DIAGONAL if is_known else _NO_COVARIANCE,
        )

    def odometry(
        self, stamp_ns: int, T_world_body: Floats, frame: str, body: str, covariance: Floats | None = None
    ) -> Any:
        """Odometry message: a pose (4, 4) of `body` in `frame`, without velocity.

        covariance : (6, 6) of t' = t + d[:3], R' = exp(d[3:]) R in axes of `frame`, which is how ROS has it; None where unknown
        """
        types = self._types
        known = np.zeros(36) if covariance is None else np.ascontiguousarray(covariance, np.float64).ravel()
        zero = types["geometry_msgs/msg/Twist"](linear=self._vector(np.zeros(3)), angular=self._vector(np.zeros(3)))
        return types["nav_msgs/msg/Odometry"](
            header=self.header(stamp_ns, frame),
            child_frame_id=body,
            pose=types["geometry_msgs/msg/PoseWithCovariance"](pose=self._pose(T_world_body), covariance=known),
            twist=types["geometry_msgs/msg/TwistWithCovariance"](twist=zero, covariance=np.zeros(36)),
        )

    def path(self, stamps_ns: Longs, poses: Floats, frame: str) -> Any:
        """Path message of poses (N, 4, 4) in `frame` at their stamps (N,), with the last stamp."""
        posed = self._types["geometry_msgs/msg/PoseStamped"]
        return self._types["nav_msgs/msg/Path"](
            header=self.header(int(stamps_ns[-1]), frame),
            poses=[
                posed(header=self.header(stamp, frame), pose=self._pose(T))
                for stamp, T in zip(stamps_ns.tolist(), poses, strict=True)
            ],
        )

    def transforms(self, stamp_ns: int, tree: Mapping[tuple[str, str], Floats]) -> Any:
        """TFMessage of `T_parent_child` (4, 4) by (parent, child)."""
        types = self._types
        return types["tf2_msgs/msg/TFMessage"](
            transforms=[
                types["geometry_msgs/msg/TransformStamped"](
                    header=self.header(stamp_ns, parent),
                    child_frame_id=child,
                    transform=types["geometry_msgs/msg/Transform"](
                        translation=self._vector(T[:3, 3]), rotation=self._rotation(T)
                    ),
                )
                for (parent, child), T in tree.items()
            ]
        )

    def text(self, words: str) -> Any:
        """String message."""
        return self._types["std_msgs/msg/String"](data=words)

    def header(self, stamp_ns: int, frame: str, number: int = 0) -> Any:
        """Header with a stamp, a frame and, in ROS 1, a sequence number."""
        kind = self._types["std_msgs/msg/Header"]
        seconds, nanoseconds = divmod(int(stamp_ns), 10**9)
        stamp = self._types["builtin_interfaces/msg/Time"](sec=seconds, nanosec=nanoseconds)
        counted = {"seq": number} if "seq" in kind.__dataclass_fields__ else {}
        return kind(stamp=stamp, frame_id=frame, **counted)

    def _pose(self, T: Floats) -> Any:
        """Pose message of T (4, 4)."""
        types = self._types
        return types["geometry_msgs/msg/Pose"](
            position=types["geometry_msgs/msg/Point"](**self._xyz(T[:3, 3])), orientation=self._rotation(T)
        )

    def _vector(self, v: Floats) -> Any:
        """Vector3 message of v (3,)."""
        return self._types["geometry_msgs/msg/Vector3"](**self._xyz(v))

    @staticmethod
    def _xyz(v: Floats) -> dict[str, float]:
        """Coordinates (3,) by the names x, y, z."""
        return dict(zip("xyz", (float(c) for c in v), strict=True))

    def _rotation(self, T: Floats) -> Any:
        """Quaternion message of the rotation in T (4, 4)."""
        return self._quaternion(so3.to_quaternion(T[:3, :3]).tolist())

    def _quaternion(self, q: list[float]) -> Any:
        """Quaternion message of x, y, z, w."""
        x, y, z, w = (float(v) for v in q)
        return self._types["geometry_msgs/msg/Quaternion"](x=x, y=y, z=z, w=w)
