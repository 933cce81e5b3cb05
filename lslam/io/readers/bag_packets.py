"""Packets of Velodyne and Ouster sensors in bags, read like those of a capture: one scan is one revolution."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial
from itertools import groupby
from operator import itemgetter
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from lslam.core.arrays import Ints, Longs
from lslam.core.errors import InputError
from lslam.io.formats import velodyne_packets
from lslam.io.formats.bag_files import Bag, BagTopic
from lslam.io.formats.bag_streams import read_text
from lslam.io.formats.ouster_packets import OusterSensor, parse_metadata, read_metadata
from lslam.io.formats.sensor_messages import PACKET, SCANS, is_imu, read_packets
from lslam.io.readers.ground_truth import Voice
from lslam.io.readers.pcap_revolutions import SpinningSensor, metadata_beside, open_velodyne, open_with_metadata

# The frame of the points that `lslam.io.formats.ouster_packets` makes, as its driver calls it.
_OUSTER_FRAME = "os_sensor"


@dataclass(frozen=True)
class BagPackets:
    """Packets of a bag; satisfies `Packets`.

    stamps_ns, sizes, sources : (N,); places : (N, 3) which of `topics`, message of the topic, and packet of the message
    heads : (N, P) the bytes at `positions` of each
    """

    bag: Bag
    topics: tuple[BagTopic, ...]
    stamps_ns: Longs
    sizes: Longs
    sources: Longs
    places: Ints
    positions: tuple[int, ...]
    heads: NDArray[np.uint8]

    def __len__(self) -> int:
        return len(self.sizes)

    def bytes_at(self, which: Longs, positions: tuple[int, ...]) -> NDArray[np.uint8]:
        """(K, P) bytes at `positions` of the packets `which`; the positions must be among those that were kept."""
        return self.heads[which][:, [self.positions.index(p) for p in positions]]

    def payloads(self, which: Longs) -> NDArray[np.uint8]:
        """(K, size) payloads of the packets `which`, which must be of one size."""
        rows = []
        for (n, message), places in groupby(self.places[which].tolist(), itemgetter(0, 1)):
            packets = read_packets(self.topics[n], self.bag.message(self.topics[n], message))[1]
            rows.append(packets[[number for _, _, number in places]])
        return np.concatenate(rows) if rows else np.zeros((0, 0), np.uint8)


def open_packets(bag: Bag, topic: BagTopic, voice: Voice) -> tuple[SpinningSensor, str]:
    """The sensor whose packets are on `topic`, and the frame of its points.

    Raises InputError when no packet is complete or of a known model, or the metadata of an Ouster sensor are missing.
    """
    where = Path(f"{bag.path}, {topic.name}")
    if topic.type.endswith(SCANS):
        size = velodyne_packets.SIZE
        packets, frame = _gather(bag, [topic], (0, 1, 2, 3, *range(size - 6, size)), voice)
        return open_velodyne(where, packets, voice), frame
    sensor, source = _metadata(bag, topic)
    inertial = [t for t in bag.of_type(PACKET) if _namespace(t) == _namespace(topic) and is_imu(bag, t)]
    packets, _ = _gather(bag, [topic, *inertial], sensor.profile.positions, voice)
    uses = {source: "metadata", **{t.name: "IMU" for t in inertial}}
    return replace(open_with_metadata(where, packets, sensor, source, voice), uses=uses), _OUSTER_FRAME


def _gather(bag: Bag, topics: list[BagTopic], positions: tuple[int, ...], voice: Voice) -> tuple[BagPackets, str]:
    """All packets of the topics, and the first frame name; damaged messages become problems. InputError without a packet.

    positions : of the bytes in each packet to keep in memory
    """
    stamps, sizes, heads, places = [], [], [], []
    frame = ""
    for n, topic in enumerate(topics):
        read = partial(read_packets, topic)
        for k, (own, packets, of) in bag.each(topic, read, voice.problems):
            frame = frame or of
            count, size = packets.shape
            stamps.append(np.where(own == 0, topic.stamps_ns[k], own))
            sizes.append(np.full(count, size, np.int64))
            head = np.zeros((count, len(positions)), np.uint8)
            inside = [i for i, p in enumerate(positions) if p < size]
            head[:, inside] = packets[:, [positions[i] for i in inside]]
            heads.append(head)
            places.append(np.column_stack([np.full((count, 2), (n, k)), np.arange(count)]).astype(np.int32))
    if not sum(map(len, sizes)):
        raise InputError(f"{bag.path}: {topics[0].name} holds no packets that can be read")
    all_sizes = np.concatenate(sizes)
    packets_of_all = BagPackets(
        bag,
        tuple(topics),
        np.concatenate(stamps),
        all_sizes,
        np.zeros_like(all_sizes),
        np.concatenate(places),
        positions,
        np.concatenate(heads),
    )
    return packets_of_all, frame


def _metadata(bag: Bag, topic: BagTopic) -> tuple[OusterSensor, str]:
    """Metadata of an Ouster sensor, of a topic or the only JSON file beside the bag, and their source; else InputError."""
    named = [t for t in bag.of_type("String") if "metadata" in t.name.rsplit("/", 1)[-1]]
    own = [t for t in named if _namespace(t) == _namespace(topic)] or named
    if len(own) == 1 and (text := read_text(bag, own[0].name)) is not None:
        return parse_metadata(text, f"{bag.path}, {own[0].name}"), own[0].name
    beside = sorted(bag.path.glob("*.json")) if bag.path.is_dir() else list(metadata_beside(bag.path))
    if len(beside) == 1:
        return read_metadata(beside[0]), beside[0].name
    raise InputError(
        f"{bag.path}: for the Ouster packets of {topic.name} the sensor's metadata are needed, as std_msgs/String on "
        f"{_namespace(topic)}/metadata or as the only *.json beside the bag; there are {len(own)} and {len(beside)}"
    )


def _namespace(topic: BagTopic) -> str:
    """Name of a topic without its last part."""
    return topic.name.rpartition("/")[0]
