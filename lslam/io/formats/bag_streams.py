"""Sensor streams of a bag as arrays: IMU samples, satellite fixes, static transforms and poses."""

from __future__ import annotations

import struct
from array import array
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import islice
from typing import Any

import numpy as np

from lslam.core.arrays import Floats, Longs
from lslam.core.errors import InputError
from lslam.core.geometry import se3, so3
from lslam.io.formats.bag_files import Bag, BagTopic, read_header

Transforms = dict[tuple[str, str], Floats]

# sensor_msgs/Imu behind its header, float64: orientation 4, covariance 9, angular velocity 3, covariance 9, acceleration 3.
_IMU_BYTES, _GYRO, _ACCEL = 37 * 8, 13 * 8, 25 * 8

_LARGEST = 1e9  # m, no pose on this planet; NaN is not less either


@dataclass(frozen=True)
class Stream:
    """Stamped rows of one topic.

    stamps_ns : (N,) int64, of the headers; values : (N, K) float64; frame : of the first message; topic : its name

    recorded_ns : (N,) int64, when the messages were recorded
    """

    stamps_ns: Longs
    values: Floats
    frame: str
    topic: str
    recorded_ns: Longs


# What a message says: its stamp, ns, its frame and its numbers; None where it says nothing that can be used.
_Row = tuple[int, str, Sequence[float]] | None


def read_imu(bag: Bag, topic: BagTopic, problems: list[str]) -> Stream:
    """Samples (N, 6) of a sensor_msgs/Imu topic: acceleration, m/s2, and angular velocity, rad/s; nothing is converted.

    Messages that are damaged are left out and named in `problems`.
    """

    def sample(data: bytes) -> _Row:
        header = read_header(topic, data)
        at = header.end if topic.encoding == "ros1" else 4 + -(-(header.end - 4) // 8) * 8
        if len(data) < at + _IMU_BYTES:
            raise InputError(f"{bag.path}: a message of {topic.name} has {len(data)} bytes, too few for an Imu")
        accel, gyro = (struct.unpack_from(f"{header.order}3d", data, at + offset) for offset in (_ACCEL, _GYRO))
        return header.stamp_ns, header.frame, accel + gyro

    return _read(bag, topic, problems, 6, sample)


def read_fixes(bag: Bag, topic: BagTopic, problems: list[str]) -> Stream:
    """Fixes (N, 4) of a NavSatFix topic: latitude, longitude (deg), height (m), one-sigma (m, NaN when unknown).

    Without a fix (status below 0, NaN) a message is left out.
    """

    def fix(data: bytes) -> _Row:
        message = bag.decode(topic, data)
        position = [float(message.latitude), float(message.longitude), float(message.altitude)]
        if message.status.status < 0 or not np.isfinite(position).all():
            return None
        variance = (float(message.position_covariance[0]) + float(message.position_covariance[4])) / 2
        is_known = message.position_covariance_type > 0 and variance >= 0
        sigma = float(np.sqrt(variance)) if is_known else np.nan
        return stamp_of(message), message.header.frame_id.lstrip("/"), [*position, sigma]

    return _read(bag, topic, problems, 4, fix)


def read_poses(bag: Bag, topic: BagTopic, problems: list[str]) -> Stream:
    """Poses T_world_body (N, 4, 4) of an Odometry or PoseStamped topic; its frame is that of the body."""

    def pose(data: bytes) -> _Row:
        message = bag.decode(topic, data)
        own = message.pose.pose if hasattr(message.pose, "pose") else message.pose
        body = getattr(message, "child_frame_id", "").lstrip("/")
        return stamp_of(message), body, _numbers(topic, own.position, own.orientation)

    stream = _read(bag, topic, problems, 7, pose)
    return replace(stream, values=_poses(stream.values))


def read_twists(bag: Bag, topic: BagTopic, problems: list[str]) -> Stream:
    """Speeds (N, 9) of an Odometry or TwistStamped topic: m/s along x, rad/s about z, and the pose of the same message.

    The pose is position, m, and quaternion xyzw, NaN of a TwistStamped. The stream's frame is that of the twist.
    """

    def twist(data: bytes) -> _Row:
        message = bag.decode(topic, data)
        own = getattr(message.twist, "twist", message.twist)
        body = getattr(message, "child_frame_id", message.header.frame_id).lstrip("/")
        pose = getattr(message, "pose", None)
        place = [np.nan] * 7 if pose is None else _numbers(topic, pose.pose.position, pose.pose.orientation)
        return stamp_of(message), body, [float(own.linear.x), float(own.angular.z), *place]

    return _read(bag, topic, problems, 9, twist)


def _read(bag: Bag, topic: BagTopic, problems: list[str], width: int, row_of: Callable[[bytes], _Row]) -> Stream:
    """Rows of `width` numbers, made by `row_of` from the messages of a topic."""
    stamps, messages, values = array("q"), array("q"), array("d")
    frame = ""
    for k, row in bag.each(topic, row_of, problems):
        if row is not None:
            stamps.append(row[0])
            messages.append(k)
            frame = frame or row[1]
            values.extend(row[2])
    recorded_ns = topic.stamps_ns[np.array(messages, np.int64)]
    table = np.array(values, np.float64).reshape(-1, width)
    return Stream(np.array(stamps, np.int64), table, frame, topic.name, recorded_ns)


def is_static(topic: BagTopic) -> bool:
    """Whether the transforms of a topic are static."""
    return topic.name.rsplit("/", 1)[-1] == "tf_static"


def read_transforms(bag: Bag, topic: BagTopic, problems: list[str], most: int | None = None) -> Transforms:
    """`T_parent_child` (N, 4, 4) by (parent, child), from the first `most` messages of a TFMessage topic; None: all."""
    rows_of: dict[tuple[str, str], list[list[float]]] = {}

    def note(data: bytes) -> None:
        for t in bag.decode(topic, data).transforms:
            pair = (t.header.frame_id.lstrip("/"), t.child_frame_id.lstrip("/"))
            row = _numbers(topic, t.transform.translation, t.transform.rotation)
            rows_of.setdefault(pair, []).append(row)

    for _ in islice(bag.each(topic, note, problems), most):
        pass
    return {pair: _poses(np.array(rows, np.float64)) for pair, rows in rows_of.items()}


def read_text(bag: Bag, name: str) -> str | None:
    """The text of the last std_msgs/String on topic `name`, None when there is none."""
    text = None
    for topic in bag.of_type("String"):
        if topic.name == name:
            for _, data in bag.each(topic, bytes, []):
                text = str(bag.decode(topic, data).data)
    return text


def chain(transforms: Transforms, a: str, b: str) -> Floats | None:
    """(4, 4) `T_a_b` along static transforms, forwards and backwards; None when no chain connects the two frames."""
    if a == b:
        return np.eye(4)
    known = {a: np.eye(4)}
    waiting = [a]
    while waiting:
        here = waiting.pop(0)
        for (parent, child), T in transforms.items():
            for origin, target, step in ((parent, child, T), (child, parent, se3.inverse(T))):
                if origin == here and target not in known:
                    known[target] = known[here] @ step
                    waiting.append(target)
    return known.get(b)


def stamp_of(message: Any) -> int:
    """Header stamp of a decoded message, ns."""
    stamp = message.header.stamp
    return int(stamp.sec) * 10**9 + int(stamp.nanosec)


def _numbers(topic: BagTopic, p: Any, q: Any) -> list[float]:
    """Position and quaternion (7,) of a pose message; raises InputError where they are not finite."""
    row = [p.x, p.y, p.z, q.x, q.y, q.z, q.w]
    if not all(abs(v) < _LARGEST for v in row):
        raise InputError(f"a message of {topic.name} holds no pose: {row}")
    return row


def _poses(table: Floats) -> Floats:
    """Poses (N, 4, 4) of positions and quaternions (N, 7); a zero quaternion, of an unknown rotation, gives the identity."""
    length = np.linalg.norm(table[:, 3:], axis=1, keepdims=True)
    # Drivers publish (0, 0, 0, 0) where they do not know a rotation.
    quaternions = np.where(length > 0, table[:, 3:] / np.where(length > 0, length, 1), [0.0, 0.0, 0.0, 1.0])
    return se3.make(so3.from_quaternion(quaternions), table[:, :3])
