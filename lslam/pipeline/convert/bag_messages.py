"""Arrays as messages for `BagWriter`. `store` is the writer's own, with the message types of its ROS."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lslam.core.geometry import so3
from lslam.core.types.arrays import Floats, Longs
from lslam.core.types.scan import Scan
from lslam.io.formats.sensor_messages import TYPES

_CODES = {np.dtype(name): code for code, name in TYPES.items()}  # of sensor_msgs/PointField
_UNKNOWN = np.r_[-1.0, np.zeros(8)]  # sensor_msgs/Imu: a first covariance of -1 means that there is no such reading
_DIAGONAL_KNOWN, _NO_COVARIANCE = 2, 0  # sensor_msgs/NavSatFix


def cloud(store: Any, scan: Scan, frame: str) -> Any:
    """PointCloud2 of a scan: x, y, z, and if known intensity, ring, label and `time`, s from the stamp."""
    columns: dict[str, NDArray[Any]] = {axis: scan.points[:, k] for k, axis in enumerate("xyz")}
    optional = {"intensity": scan.intensity, "ring": scan.rings, "time": scan.times, "label": scan.labels}
    columns |= {name: values for name, values in optional.items() if values is not None}
    is_dense = bool(np.isfinite(scan.points).all())
    return _cloud(store, header(store, scan.stamp_ns, frame, scan.index), columns, is_dense)


def points(
    store: Any, stamp_ns: int, places: NDArray[np.floating[Any]], intensity: NDArray[np.float32] | None, frame: str
) -> Any:
    """PointCloud2 of finite positions (N, 3), m, and optional intensities (N,), as float32."""
    columns: dict[str, NDArray[Any]] = {axis: places[:, k].astype(np.float32) for k, axis in enumerate("xyz")}
    if intensity is not None:
        columns["intensity"] = intensity.astype(np.float32)
    return _cloud(store, header(store, stamp_ns, frame), columns, True)


def _cloud(store: Any, head: Any, columns: Mapping[str, NDArray[Any]], is_dense: bool) -> Any:
    """PointCloud2 with these columns, packed."""
    dtype = np.dtype([(name, values.dtype.newbyteorder("<")) for name, values in columns.items()])
    table = np.empty(len(columns["x"]), dtype)
    for name, values in columns.items():
        table[name] = values
    assert dtype.fields is not None
    field, places = store.types["sensor_msgs/msg/PointField"], dtype.fields
    return store.types["sensor_msgs/msg/PointCloud2"](
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


def imu(store: Any, stamp_ns: int, accel: Floats, gyro: Floats, frame: str) -> Any:
    """Imu message: specific force (3,), m/s2, and angular rate (3,), rad/s; no orientation."""
    return store.types["sensor_msgs/msg/Imu"](
        header=header(store, stamp_ns, frame),
        orientation=_quaternion(store, [0, 0, 0, 1]),
        orientation_covariance=_UNKNOWN,
        angular_velocity=_vector(store, gyro),
        angular_velocity_covariance=np.zeros(9),
        linear_acceleration=_vector(store, accel),
        linear_acceleration_covariance=np.zeros(9),
    )


def fix(store: Any, stamp_ns: int, lat_lon_alt: Floats, sigma: float, frame: str) -> Any:
    """NavSatFix message: latitude, longitude (deg) and height (m), with a one-sigma error, m, NaN when it is unknown."""
    is_known = bool(np.isfinite(sigma))
    latitude, longitude, altitude = (float(v) for v in lat_lon_alt)
    return store.types["sensor_msgs/msg/NavSatFix"](
        header=header(store, stamp_ns, frame),
        status=store.types["sensor_msgs/msg/NavSatStatus"](status=0, service=1),
        latitude=latitude,
        longitude=longitude,
        altitude=altitude,
        position_covariance=np.eye(3).ravel() * (sigma**2 if is_known else 0.0),
        position_covariance_type=_DIAGONAL_KNOWN if is_known else _NO_COVARIANCE,
    )


def odometry(
    store: Any, stamp_ns: int, T_world_body: Floats, frame: str, body: str, covariance: Floats | None = None
) -> Any:
    """Odometry message: a pose (4, 4) of `body` in `frame`, without velocity.

    covariance : (6, 6) of t' = t + d[:3], R' = exp(d[3:]) R in axes of `frame`, which is how ROS has it; None where unknown
    """
    types = store.types
    known = np.zeros(36) if covariance is None else np.ascontiguousarray(covariance, np.float64).ravel()
    zero = types["geometry_msgs/msg/Twist"](linear=_vector(store, np.zeros(3)), angular=_vector(store, np.zeros(3)))
    return types["nav_msgs/msg/Odometry"](
        header=header(store, stamp_ns, frame),
        child_frame_id=body,
        pose=types["geometry_msgs/msg/PoseWithCovariance"](pose=_pose(store, T_world_body), covariance=known),
        twist=types["geometry_msgs/msg/TwistWithCovariance"](twist=zero, covariance=np.zeros(36)),
    )


def path(store: Any, stamps_ns: Longs, poses: Floats, frame: str) -> Any:
    """Path message of poses (N, 4, 4) in `frame` at their stamps (N,), with the last stamp."""
    posed = store.types["geometry_msgs/msg/PoseStamped"]
    return store.types["nav_msgs/msg/Path"](
        header=header(store, int(stamps_ns[-1]), frame),
        poses=[
            posed(header=header(store, stamp, frame), pose=_pose(store, T))
            for stamp, T in zip(stamps_ns.tolist(), poses, strict=True)
        ],
    )


def transforms(store: Any, stamp_ns: int, tree: Mapping[tuple[str, str], Floats]) -> Any:
    """TFMessage of `T_parent_child` (4, 4) by (parent, child)."""
    types = store.types
    return types["tf2_msgs/msg/TFMessage"](
        transforms=[
            types["geometry_msgs/msg/TransformStamped"](
                header=header(store, stamp_ns, parent),
                child_frame_id=child,
                transform=types["geometry_msgs/msg/Transform"](
                    translation=_vector(store, T[:3, 3]), rotation=_rotation(store, T)
                ),
            )
            for (parent, child), T in tree.items()
        ]
    )


def text(store: Any, words: str) -> Any:
    """String message."""
    return store.types["std_msgs/msg/String"](data=words)


def header(store: Any, stamp_ns: int, frame: str, number: int = 0) -> Any:
    """Header with a stamp, a frame and, in ROS 1, a sequence number."""
    kind = store.types["std_msgs/msg/Header"]
    seconds, nanoseconds = divmod(int(stamp_ns), 10**9)
    stamp = store.types["builtin_interfaces/msg/Time"](sec=seconds, nanosec=nanoseconds)
    counted = {"seq": number} if "seq" in kind.__dataclass_fields__ else {}
    return kind(stamp=stamp, frame_id=frame, **counted)


def _pose(store: Any, T: Floats) -> Any:
    types = store.types
    return types["geometry_msgs/msg/Pose"](
        position=types["geometry_msgs/msg/Point"](**_xyz(T[:3, 3])), orientation=_rotation(store, T)
    )


def _vector(store: Any, v: Floats) -> Any:
    return store.types["geometry_msgs/msg/Vector3"](**_xyz(v))


def _xyz(v: Floats) -> dict[str, float]:
    return dict(zip("xyz", (float(c) for c in v), strict=True))


def _rotation(store: Any, T: Floats) -> Any:
    return _quaternion(store, so3.to_quaternion(T[:3, :3]).tolist())


def _quaternion(store: Any, q: list[float]) -> Any:
    x, y, z, w = (float(v) for v in q)
    return store.types["geometry_msgs/msg/Quaternion"](x=x, y=y, z=z, w=w)
