"""Whose raw packets a recording holds, by their first bytes or by the names of messages, and what to say of those not decoded."""

from __future__ import annotations

import re

# First bytes of data packets, by the makers' manuals and drivers.
_FIRST_BYTES = {b"\xee\xff": "Hesai", b"\x55\xaa\x05": "RoboSense", b"\xa5\xff\x00\x5a": "RoboSense"}
_WORDS = {"Hesai": r"hesai|pandar", "RoboSense": r"rslidar|robosense", "Velodyne": "velodyne", "Ouster": "ouster"}


def maker_by_bytes(data: bytes, size: int) -> str:
    """The maker of a packet of `size` bytes that begins so, of those not decoded; empty where it may be anybody's."""
    if data.startswith(b"\xff\xee") and size != 1206:  # as Velodyne's, but for their size
        return "Hesai"
    return next((maker for head, maker in _FIRST_BYTES.items() if data.startswith(head)), "")


def maker_by_name(*names: str) -> str:
    """The maker by the names of a topic and its type; empty where they do not tell."""
    text = " ".join(names).lower()
    return next((maker for maker, words in _WORDS.items() if re.search(words, text)), "")


def is_packets(kind: str) -> bool:
    """Whether messages of this type hold raw packets, by its name."""
    return re.search(r"packet|(velodyne|pandar|rslidar)scan|udpframe", kind.rsplit("/", 1)[-1].lower()) is not None


def not_decoded(maker: str, where: str = "") -> str:
    """What a recording holds and the way out, after `holds`; `where` says topic, type and number."""
    whose = f"a {maker} LiDAR" if maker else "a LiDAR"
    driver = f"{maker}'s own driver" if maker else "the sensor's driver"
    return (
        f"raw packets of {whose}{where} and no clouds; Velodyne's (in bags VelodyneScan) and Ouster's (PacketMsg) are decoded, "
        f"of these {driver} makes PointCloud2: play the recording into it and record its clouds, or export them as PCD or PLY"
    )
