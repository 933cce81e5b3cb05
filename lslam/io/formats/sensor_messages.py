"""Messages of LiDARs as arrays, without a loop over points: clouds, Livox's own, and packets of Velodyne and Ouster."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lslam.core.arrays import Longs
from lslam.core.errors import InputError
from lslam.io.formats import velodyne_packets
from lslam.io.formats.bag_files import Bag, BagTopic, read_header
from lslam.io.formats.ouster_packets import IMU_SIZE
from lslam.io.formats.point_cloud import PointCloud, cloud_from_fields, ring_column

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
# velodyne_msgs: a header, and packets of a stamp and 1206 bytes. Ouster's, whatever their package: the bytes alone.
SCANS, PACKET = "VelodyneScan", "PacketMsg"
_PACKET_BYTES = 8 + velodyne_packets.SIZE  # of velodyne_msgs/VelodynePacket
# First bytes of data packets, by the makers' manuals and drivers.
_FIRST_BYTES = {b"\xee\xff": "Hesai", b"\x55\xaa\x05": "RoboSense", b"\xa5\xff\x00\x5a": "RoboSense"}
_WORDS = {"Hesai": r"hesai|pandar", "RoboSense": r"rslidar|robosense", "Velodyne": "velodyne", "Ouster": "ouster"}


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
    return _finite(cloud_from_fields(where, columns | ring_column(height, width)))


def decode_livox(data: bytes, start: int, is_ros1: bool, order: str, where: Path) -> tuple[PointCloud, int]:
    """Points of a Livox CustomMsg of ROS 1 or 2, whose header ends at `start`, and `timebase`, ns; InputError if cut off."""
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
    """Structured type of the fields of a PointCloud2; raises InputError for a field beyond the point."""
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
    """The values in the machine's byte order."""
    return values.astype(values.dtype.newbyteorder("="), copy=False)


def _finite(cloud: PointCloud) -> PointCloud:
    """The cloud without points that are not finite."""
    finite = np.asarray(np.isfinite(cloud.points).all(axis=1))
    return cloud if finite.all() else cloud.select(finite)


def can_decode(topic: BagTopic) -> bool:
    """Whether a topic holds packets that lslam can decode."""
    package, name = topic.type.partition("/")[0], topic.type.rsplit("/", 1)[-1]
    return (name == SCANS and package.startswith("velodyne")) or (name == PACKET and package.startswith("ouster"))


def packet_topics(bag: Bag) -> list[BagTopic]:
    """Topics of LiDAR packets that lslam can decode."""
    return [t for t in bag.of_type(SCANS, PACKET) if can_decode(t) and not is_imu(bag, t)]


def read_packets(topic: BagTopic, data: bytes) -> tuple[Longs, NDArray[np.uint8], str]:
    """Stamps (P,), ns, 0 if unknown, bytes (P, size) and frame of a message's packets; InputError when it is cut off."""
    is_ros1 = topic.encoding == "ros1"
    try:
        if topic.type.endswith(PACKET):
            at, order = (0, "<") if is_ros1 else (4, "<" if data[1] else ">")
            size = int(np.frombuffer(data, f"{order}u4", 1, at)[0])
            return np.zeros(1, np.int64), np.frombuffer(data, np.uint8, size, at + 4)[None], ""
        header = read_header(topic, data)
        # Numbers of CDR lie at multiples of their size, counted from behind its first four bytes.
        at, gap = (header.end, 0) if is_ros1 else (-(-header.end // 4) * 4, -_PACKET_BYTES % 4)
        word = f"{header.order}u4"
        count = int(np.frombuffer(data, word, 1, at)[0])
        fields: Any = [
            ("s", word),
            ("ns", word),
            ("data", np.uint8, velodyne_packets.SIZE),
            ("gap", np.uint8, gap),
        ]
        table = np.frombuffer(data[at + 4 :] + bytes(gap), fields, count)
    except (ValueError, IndexError):
        raise InputError(f"a message of {topic.name} with {len(data)} bytes is no {topic.type}") from None
    stamps = table["s"].astype(np.int64) * 10**9 + table["ns"]
    return np.where(stamps == 0, header.stamp_ns, stamps), table["data"], header.frame


def is_imu(bag: Bag, topic: BagTopic) -> bool:
    """Whether a topic of Ouster packets is that of its IMU, judged by the size of the first readable packet."""
    if not topic.type.endswith(PACKET):
        return False
    for k in range(min(len(topic), 5)):
        try:
            return bool(read_packets(topic, bag.message(topic, k))[1].shape[1] == IMU_SIZE)
        except InputError:
            continue
    return False


def maker_by_bytes(data: bytes, size: int) -> str:
    """Maker of an undecodable packet, by its `size` and first bytes; empty where several makers fit."""
    if data.startswith(b"\xff\xee") and size != 1206:  # as Velodyne's, but for their size
        return "Hesai"
    return next((maker for head, maker in _FIRST_BYTES.items() if data.startswith(head)), "")


def maker_by_name(*names: str) -> str:
    """Maker by the names of a topic and its type; empty if unclear."""
    text = " ".join(names).lower()
    return next((maker for maker, words in _WORDS.items() if re.search(words, text)), "")


def is_packets(kind: str) -> bool:
    """Whether messages of this type hold raw packets, by its name."""
    return re.search(r"packet|(velodyne|pandar|rslidar)scan|udpframe", kind.rsplit("/", 1)[-1].lower()) is not None


def decoding_advice(maker: str, where: str = "") -> str:
    """What to do about packets that cannot be decoded; the text follows `holds`, `where` comes after the maker."""
    whose = f"a {maker} LiDAR" if maker else "a LiDAR"
    driver = f"{maker}'s own driver" if maker else "the sensor's driver"
    return (
        f"raw packets of {whose}{where} and no clouds; Velodyne's (in bags VelodyneScan) and Ouster's (PacketMsg) are decoded, "
        f"of these {driver} makes PointCloud2: play the recording into it and record its clouds, or export them as PCD or PLY"
    )
