"""Recordings in parts, compressed as files, with packets, with halves of revolutions and with transforms on /tf."""

from __future__ import annotations

import gzip
import json
from pathlib import Path

import lz4.frame
import numpy as np
from bag_builders import START_NS, STEP_NS, Fill, bag, clouds, imu, scan, together, transforms
from fuzz.cases import Files, Parser
from fuzz.sequences import read_sequence
from packet_builders import ouster_packets, velodyne_scans
from pcap_builders import OusterSpec, ouster, ouster_imu, velodyne

from lslam.core.types.scan import Scan
from lslam.io.formats.bag_chunks import zstd
from lslam.pipeline.convert.bag_writer import BagWriter

_METADATA = (
    b"rosbag2_bagfile_information:\n  version: 4\n  relative_file_paths:\n    - rec_0.mcap\n    - rec_1.db3.zstd\n"
)


def _some(begin: int) -> Fill:
    def fill(writer: BagWriter) -> None:
        for k in range(begin, begin + 2):
            one = scan(k, 40)
            writer.write("/points", one.stamp_ns, writer.messages.cloud(one, "lidar"))

    return fill


def _parts(folder: Path) -> list[Files]:
    mcap = bag(folder / "rec_0.mcap", _some(0), "mcap").read_bytes()
    sqlite = bytes(zstd().compress(bag(folder / "rec_1.db3", _some(2), "sqlite").read_bytes()))
    packed = lz4.frame.compress(bag(folder / "rec_2.mcap", _some(4), "mcap").read_bytes())
    good = {"rec_0.mcap": mcap, "rec_1.db3.zstd": sqlite, "metadata.yaml": _METADATA}
    return [
        good,
        good | {"rec_3.mcap.lz4": packed, "rec_4.mcap.7z": b"7z"},
        {"rec_1.db3.zstd": sqlite, "rec_2.mcap.lz4": packed[: len(packed) // 2]},
        {"a.bag": gzip.compress(mcap), "b.db3": mcap, "metadata.yaml": b"[" * 400},
    ]


def _packed(folder: Path) -> list[Files]:
    whole = gzip.compress(bag(folder / "a.bag", together(clouds(3, n=40), imu(8))).read_bytes())
    return [{"a.bag.gz": data} for data in (whole, whole[: len(whole) // 2], b"\x1f\x8b", b"")]


def _velodyne(folder: Path) -> list[Files]:
    frames, _ = velodyne("VLP-16", 2.2)
    return [{"a.bag": bag(folder / "a.bag", lambda writer: velodyne_scans(writer, frames)).read_bytes()}]


def _ouster(folder: Path) -> list[Files]:
    spec = OusterSpec()
    frames, _ = ouster(spec, 3)

    def fill(writer: BagWriter) -> None:
        ouster_packets(writer, frames, "lidar")
        ouster_packets(writer, ouster_imu(10), "imu")

    path = bag(folder / "a.mcap", fill, "mcap")
    return [{"a.mcap": path.read_bytes(), "a.json": json.dumps(spec.metadata()).encode()}]


def _halves(folder: Path) -> list[Files]:
    def fill(writer: BagWriter) -> None:
        for k in range(3):
            one = scan(k, 400)
            assert one.times is not None
            left = one.points[:, 1] > 0
            for mask in (left, ~left):
                half = Scan(one.points[mask], one.stamp_ns, k, None, one.times[mask], None)
                writer.write("/points", one.stamp_ns, writer.messages.cloud(half, "lidar"))
            tree = {("base", "lidar"): np.eye(4), ("base", "imu"): np.eye(4)}
            writer.write("/tf", one.stamp_ns, writer.messages.transforms(START_NS + k * STEP_NS, tree))

    return [{"a.bag": bag(folder / "a.bag", together(fill, imu(8))).read_bytes()}]


def _two(folder: Path) -> list[Files]:
    """Two LiDARs on one topic, and an odd name of the further one in sequence.toml."""
    links = transforms({("front", "rear"): np.eye(4)})
    fill = together(links, clouds(3, frame="front", n=40), clouds(3, frame="rear", n=40))
    data = bag(folder / "a.mcap", fill, "mcap").read_bytes()
    bare = bag(
        folder / "b.mcap", together(clouds(3, frame="front", n=40), clouds(3, frame="rear", n=40)), "mcap"
    ).read_bytes()
    toml = b"[lidars]\nrear = [1, 0, 0, 2, 0, 1, 0, 0, 0, 0, 1, 0]\n"
    return [{"a.mcap": data}, {"a.mcap": bare, "sequence.toml": toml}, {"a.mcap": bare}]


PARSERS = [
    Parser("parts of a recording", read_sequence, _parts),
    Parser("bag, gz", lambda folder: read_sequence(folder / "a.bag.gz"), _packed),
    Parser("Velodyne packets, bag", lambda folder: read_sequence(folder / "a.bag"), _velodyne),
    Parser("Ouster packets, MCAP", lambda folder: read_sequence(folder / "a.mcap"), _ouster, trees=("a.json",)),
    Parser("two LiDARs, MCAP", lambda folder: read_sequence(folder / "a.mcap", lidar_frame="all"), _two),
    Parser("halves and /tf, bag", lambda folder: read_sequence(folder / "a.bag"), _halves),
]
