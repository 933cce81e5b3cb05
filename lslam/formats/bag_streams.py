"""What rides along in a bag: IMU, satellite fixes, static transforms and poses, from messages to arrays."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lslam.errors import InputError
from lslam.formats.bag_files import Bag, BagTopic, read_header
from lslam.geometry import se3, so3

Floats = NDArray[np.float64]
Transforms = dict[tuple[str, str], Floats]

# sensor_msgs/Imu behind its header, float64: orientation 4, covariance 9, angular velocity 3, covariance 9, acceleration 3.
_IMU_BYTES, _GYRO, _ACCEL = 37 * 8, 13 * 8, 25 * 8

_LARGEST = 1e9  # m, no pose on this planet; NaN is not less either


@dataclass(frozen=True)
class Stream:
    """Stamped rows of one topic: stamps_ns (N,) int64 of the headers, values (N, K) float64, frame of the first, its name.

    recorded_ns : (N,) int64, when the messages were recorded
    """

    stamps_ns: NDArray[np.int64]
    values: Floats
    frame: str
    topic: str
    recorded_ns: NDArray[np.int64]


def read_imu(bag: Bag, topic: BagTopic, broken: list[str]) -> Stream:
    """Samples (N, 6) of a sensor_msgs/Imu topic: acceleration, m/s2, and angular velocity, rad/s; nothing is converted.

    Messages that are damaged are left out, the reasons go to `broken`.
    """
    stamps: list[int] = []
    kept: list[int] = []
    rows: list[bytes] = []
    frame, order = "", "<"
    for k, data in bag.numbered(topic, broken):
        try:
            header = read_header(topic, data)
        except InputError as error:
            broken.append(str(error))
            continue
        at = header.end if topic.encoding == "ros1" else 4 + -(-(header.end - 4) // 8) * 8
        if len(data) < at + _IMU_BYTES:
            broken.append(f"{bag.path}: a message of {topic.name} has {len(data)} bytes, too few for an Imu")
            continue
        frame, order = frame or header.frame, header.order
        kept.append(k)
        stamps.append(header.stamp_ns)
        rows.append(data[at + _ACCEL : at + _ACCEL + 24] + data[at + _GYRO : at + _GYRO + 24])
    values = np.frombuffer(b"".join(rows), f"{order}f8").reshape(-1, 6).astype(np.float64)
    return Stream(np.array(stamps, np.int64), values, frame, topic.name, recorded_ns(bag, topic, kept))


def read_fixes(bag: Bag, topic: BagTopic, broken: list[str]) -> Stream:
    """Fixes (N, 4) of a NavSatFix topic: latitude, longitude (deg), height (m), one-sigma (m, NaN when unknown).

    Without a fix (status below 0, NaN) a message is left out.
    """
    stamps: list[int] = []
    kept: list[int] = []
    rows: list[list[float]] = []
    frame = ""
    for k, data in bag.numbered(topic, broken):
        try:
            fix = bag.decode(topic, data)
        except InputError as error:
            broken.append(str(error))
            continue
        position = [float(fix.latitude), float(fix.longitude), float(fix.altitude)]
        if fix.status.status < 0 or not np.isfinite(position).all():
            continue
        frame = frame or fix.header.frame_id.lstrip("/")
        variance = (float(fix.position_covariance[0]) + float(fix.position_covariance[4])) / 2
        is_known = fix.position_covariance_type > 0 and variance >= 0
        kept.append(k)
        stamps.append(stamp_of(fix))
        rows.append([*position, float(np.sqrt(variance)) if is_known else np.nan])
    return Stream(
        np.array(stamps, np.int64),
        np.array(rows, np.float64).reshape(-1, 4),
        frame,
        topic.name,
        recorded_ns(bag, topic, kept),
    )


def read_poses(bag: Bag, topic: BagTopic, broken: list[str]) -> Stream:
    """Poses T_world_body (N, 4, 4) of an Odometry or PoseStamped topic; its frame is that of the body."""
    stamps: list[int] = []
    kept: list[int] = []
    rows: list[list[float]] = []
    body = ""
    for k, data in bag.numbered(topic, broken):
        try:
            message = bag.decode(topic, data)
            pose = message.pose.pose if hasattr(message.pose, "pose") else message.pose
            row = _numbers(topic, pose.position, pose.orientation)
        except InputError as error:
            broken.append(str(error))
            continue
        body = body or getattr(message, "child_frame_id", "").lstrip("/")
        kept.append(k)
        stamps.append(stamp_of(message))
        rows.append(row)
    return Stream(np.array(stamps, np.int64), _poses(rows), body, topic.name, recorded_ns(bag, topic, kept))


def recorded_ns(bag: Bag, topic: BagTopic, messages: list[int]) -> NDArray[np.int64]:
    """When `messages` (N,) of a topic were recorded, ns."""
    return np.array(bag.recorded_ns(topic), np.int64)[messages]


def is_static(topic: BagTopic) -> bool:
    """Whether transforms of this topic hold for good."""
    return topic.name.rsplit("/", 1)[-1] == "tf_static"


def read_transforms(bag: Bag, topic: BagTopic, broken: list[str]) -> Transforms:
    """`T_parent_child` (N, 4, 4) by (parent, child), all that a TFMessage topic says of a pair, as it was recorded."""
    found: dict[tuple[str, str], list[list[float]]] = {}
    for data in bag.messages(topic, broken):
        try:
            for t in bag.decode(topic, data).transforms:
                pair = (t.header.frame_id.lstrip("/"), t.child_frame_id.lstrip("/"))
                row = _numbers(topic, t.transform.translation, t.transform.rotation)
                found.setdefault(pair, []).append(row)
        except InputError as error:
            broken.append(str(error))
    return {pair: _poses(rows) for pair, rows in found.items()}


def read_text(bag: Bag, name: str) -> str | None:
    """The text of the last std_msgs/String on topic `name`, None when there is none."""
    texts = [
        str(bag.decode(topic, data).data)
        for topic in bag.of_type("String")
        if topic.name == name
        for data in bag.messages(topic, [])
    ]
    return texts[-1] if texts else None


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
    row = [p.x, p.y, p.z, q.x, q.y, q.z, q.w]
    if not all(abs(v) < _LARGEST for v in row):
        raise InputError(f"a message of {topic.name} holds no pose: {row}")
    return row


def _poses(rows: list[list[float]]) -> Floats:
    table = np.array(rows, np.float64).reshape(-1, 7)
    length = np.linalg.norm(table[:, 3:], axis=1, keepdims=True)
    # Drivers publish (0, 0, 0, 0) where they do not know a rotation.
    quaternions = np.where(length > 0, table[:, 3:] / np.where(length > 0, length, 1), [0.0, 0.0, 0.0, 1.0])
    return se3.make(so3.from_quaternion(quaternions), table[:, :3])
