"""Packets in messages as the drivers of Velodyne and Ouster make them, for bags of tests."""

from __future__ import annotations

from typing import Any

import numpy as np
from rosbags.typesys import get_types_from_msg

from lslam.pipeline.convert.bag_writer import BagWriter

Frame = tuple[int, bytes]  # when it arrived, ns, and what
VELODYNE = {
    "velodyne_msgs/msg/VelodynePacket": "builtin_interfaces/Time stamp\nuint8[1206] data",
    "velodyne_msgs/msg/VelodyneScan": "std_msgs/Header header\nvelodyne_msgs/VelodynePacket[] packets",
}
OUSTER = "ouster_sensor_msgs/msg/PacketMsg"


def types_of(writer: BagWriter, definitions: dict[str, str]) -> Any:
    for name, text in definitions.items():
        if name not in writer.store.types:
            writer.store.register(get_types_from_msg(text, name))
    return writer.store.types


def velodyne_scans(
    writer: BagWriter,
    frames: list[Frame],
    per_message: int = 30,
    topic: str = "/velodyne_packets",
    is_stamped: bool = True,
) -> None:
    types = types_of(writer, VELODYNE)
    for begin in range(0, len(frames), per_message):
        group = frames[begin : begin + per_message]
        packets = [
            types["velodyne_msgs/msg/VelodynePacket"](
                stamp=writer.messages.header(at if is_stamped else 0, "").stamp,
                data=np.frombuffer(data, np.uint8),
            )
            for at, data in group
        ]
        head = writer.messages.header(group[0][0] if is_stamped else 0, "velodyne")
        writer.write(topic, group[-1][0], types["velodyne_msgs/msg/VelodyneScan"](header=head, packets=packets))


def ouster_packets(writer: BagWriter, frames: list[Frame], name: str, package: str = OUSTER) -> None:
    types = types_of(writer, {package: "uint8[] buf"})
    for at, data in sorted(frames, key=lambda frame: frame[0]):
        writer.write(f"/ouster/{name}_packets", at, types[package](buf=np.frombuffer(data, np.uint8)))
