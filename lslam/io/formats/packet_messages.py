"""Packets of Velodyne and Ouster sensors as their ROS drivers put them into messages, of both versions of ROS."""

from __future__ import annotations

import re
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lslam.core.errors import InputError
from lslam.core.types.arrays import Longs
from lslam.io.formats import velodyne_packets
from lslam.io.formats.bag_files import Bag, BagTopic, read_header
from lslam.io.formats.ouster_packets import IMU_SIZE

# velodyne_msgs: a header, and packets of a stamp and 1206 bytes. Ouster's, whatever their package: the bytes alone.
SCANS, PACKET = "VelodyneScan", "PacketMsg"
_PACKET_BYTES = 8 + velodyne_packets.SIZE  # of velodyne_msgs/VelodynePacket
# First bytes of data packets, by the makers' manuals and drivers.
_FIRST_BYTES = {b"\xee\xff": "Hesai", b"\x55\xaa\x05": "RoboSense", b"\xa5\xff\x00\x5a": "RoboSense"}
_WORDS = {"Hesai": r"hesai|pandar", "RoboSense": r"rslidar|robosense", "Velodyne": "velodyne", "Ouster": "ouster"}


def is_decoded(topic: BagTopic) -> bool:
    """Whether a topic holds packets that lslam can decode."""
    package, name = topic.type.partition("/")[0], topic.type.rsplit("/", 1)[-1]
    return (name == SCANS and package.startswith("velodyne")) or (name == PACKET and package.startswith("ouster"))


def packet_topics(bag: Bag) -> list[BagTopic]:
    """Topics of LiDAR packets that lslam can decode."""
    return [t for t in bag.of_type(SCANS, PACKET) if is_decoded(t) and not is_imu(bag, t)]


def read_packets(topic: BagTopic, data: bytes) -> tuple[Longs, NDArray[np.uint8], str]:
    """Packets of a message: stamps (P,), ns, 0 if unknown; bytes (P, size); and the frame.

    Raises InputError when it is cut off.
    """
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
    """Maker by the names of a topic and its type; empty where they do not tell."""
    text = " ".join(names).lower()
    return next((maker for maker, words in _WORDS.items() if re.search(words, text)), "")


def is_packets(kind: str) -> bool:
    """Whether messages of this type hold raw packets, by its name."""
    return re.search(r"packet|(velodyne|pandar|rslidar)scan|udpframe", kind.rsplit("/", 1)[-1].lower()) is not None


def not_decoded(maker: str, where: str = "") -> str:
    """Text for messages about packets that cannot be decoded, and what to do; it follows `holds`.

    `where` is inserted after the maker.
    """
    whose = f"a {maker} LiDAR" if maker else "a LiDAR"
    driver = f"{maker}'s own driver" if maker else "the sensor's driver"
    return (
        f"raw packets of {whose}{where} and no clouds; Velodyne's (in bags VelodyneScan) and Ouster's (PacketMsg) are decoded, "
        f"of these {driver} makes PointCloud2: play the recording into it and record its clouds, or export them as PCD or PLY"
    )
