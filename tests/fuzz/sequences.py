"""Recordings: bags of every kind, KITTI's two layouts and folders of scans, read as a run reads them."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
from bag_builders import bag, clouds, imu, together, transforms
from fuzz.cases import Files, Parser, files_in
from pcap_builders import velodyne, write_pcap
from point_writers import packed, revolution
from sequence_builders import T_CAM0_LIDAR, kitti_root, raw_drive, scans

from lslam.core.errors import InputError
from lslam.core.geometry import se3
from lslam.io.formats.bag_files import INFO_TOPIC
from lslam.io.readers import open_sequence
from lslam.pipeline.convert.bag_writer import BagMessages, BagWriter

_SCANS = 3


def read_sequence(path: Path, lidar_frame: str | None = None) -> None:
    """Open it and read all its scans; a scan that is refused does not end it."""
    sequence = open_sequence(path, lidar_frame=lidar_frame)
    refused: list[InputError] = []
    for k in range(len(sequence)):
        try:
            sequence.scan(k)
        except InputError as error:
            refused.append(error)
    if refused:
        raise refused[0]


def _beside(writer: BagWriter) -> None:
    """What else a bag may hold: fixes, poses, and what lslam says of it."""
    pose = se3.make(np.eye(3), np.array([1.0, 2.0, 3.0]))
    for k in range(3):
        stamp = 1_700_000_000_123_456_789 + k * 100_000_000
        writer.write("/fix", stamp, writer.messages.fix(stamp, np.array([49.0, 8.4, 110.0]), 0.5, "gnss"))
        writer.write("/odom", stamp, writer.messages.odometry(stamp, pose, "world", "lidar"))
    writer.write(INFO_TOPIC, 1_700_000_000_000_000_000, writer.messages.text('name = "a"\nrings = 4\n'))


def _bag(suffix: str, kind: str, is_zstd: bool) -> Callable[[Path], list[Files]]:
    def make(folder: Path) -> list[Files]:
        name = f"a{suffix}"
        parts = (transforms({("lidar", "imu"): np.eye(4)}), clouds(_SCANS, n=40), imu(8), _beside)
        whole = bag(folder / name, together(*parts), kind, is_zstd).read_bytes()
        cut = [whole[: len(whole) * k // 7] for k in range(7)]
        return [{name: data} for data in (whole, *cut, b"", whole[:13])]

    return make


def _packed_bag(compression: str) -> Callable[[Path], list[Files]]:
    """ROS 1 bags with compressed chunks, which `BagWriter` does not write."""

    def make(folder: Path) -> list[Files]:
        from rosbags.rosbag1 import Writer
        from rosbags.typesys import Stores, get_typestore

        store, path = get_typestore(Stores.ROS1_NOETIC), folder / "a.bag"
        kind = "sensor_msgs/msg/PointCloud2"
        writer = Writer(path)
        writer.set_compression(Writer.CompressionFormat[compression.upper()])
        with writer:
            connection = writer.add_connection("/points", kind, typestore=store)
            from bag_builders import scan

            for k in range(_SCANS):
                one = scan(k, 40)
                message = BagMessages(store).cloud(one, "lidar")
                writer.write(connection, one.stamp_ns, bytes(store.serialize_ros1(message, kind)))
        return [{"a.bag": path.read_bytes()}]

    return make


def _bag_parser(name: str, file: str, make: Callable[[Path], list[Files]]) -> Parser:
    return Parser(name, lambda folder: read_sequence(folder / file), make)


def _capture(folder: Path) -> list[Files]:
    """Revolutions of a Velodyne sensor, one after the other, with missing ones, and less than one."""
    frames, _ = velodyne("VLP-16", 2.3, rate_hz=60.0)
    per = len(frames) // 2
    kept = [frames, frames[: per // 2], frames[: per // 2] + frames[per:], frames[:3]]
    made = [{"a.pcap": write_pcap(folder / f"{k}.pcap", some).read_bytes()} for k, some in enumerate(kept)]
    return [*made, {"a.pcap": b""}, {"a.pcap": made[0]["a.pcap"][:24]}]


def _records(folder: Path) -> list[Files]:
    """Scans whose points are six float32, by their values and as stated."""
    scans_ = {f"{k}.bin": packed(revolution(k, turns=20, rings=4), "x y z intensity ring time") for k in range(_SCANS)}
    stated = b'bin_record = "x:f4 y z intensity ring time:>f4"\npoint_unit = "cm"\n'
    far = {name: (100 * np.frombuffer(data, "<f4")).astype("<f4").tobytes() for name, data in scans_.items()}
    return [scans_ | {"sequence.toml": stated}, scans_, far, scans_ | {"1.bin": scans_["1.bin"][:-9]}]


def _kitti(folder: Path) -> list[Files]:
    sequence = kitti_root(folder / "kitti", _SCANS)
    (sequence / "imu.csv").write_bytes(_IMU)
    return [files_in(folder / "kitti")]


def _raw(folder: Path) -> list[Files]:
    raw_drive(folder / "raw", _SCANS)
    return [files_in(folder / "raw")]


_IMU = b"stamp_ns,accel_x,accel_y,accel_z,gyro_x,gyro_y,gyro_z\n" + b"".join(
    b"%d,0.1,0.2,9.81,0,0.01,0\n" % (k * 10**7) for k in range(12)
)
_GNSS = b"stamp_ns,lat_deg,lon_deg,alt_m,sigma_m\n0,49.0,8.4,110,0.5\n100000000,49.00001,8.4,110,0.5\n"
_TOML = """name = "drive"
sensor = "VLP-16"
rings = 16
rate_hz = 10.0
motion_compensated = false
vertical_correction_deg = 0.1
per_point = "per_point"
stamps = "times.txt"
imu = "imu.csv"
gnss = "gnss.csv"
ground_truth = "gt.tum"
ground_truth_frame = "imu"
[extrinsics]
T_lidar_imu = [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0]
T_cam0_lidar = [[0, -1, 0, 0], [0, 0, -1, 0], [1, 0, 0, 0], [0, 0, 0, 1]]
"""
_TUM = b"".join(b"%d.%d %d 0 0 0 0 0 1\n" % (0, k, k) for k in range(_SCANS))
_MCD = """body:
  os_sensor:
    T:
    - [0.99996760, 0.00337376, 0.00733070, -0.01]
    - [-0.00334220, 0.99998510, -0.00431300, 0.02]
    - [-0.00734514, 0.00428836, 0.99996383, 0.06]
    - [0, 0, 0, 1]
"""
_NUMBERED = b"num,t,x,y,z,qx,qy,qz,qw\n" + b"".join(b"%d,17.%d,%d,0,0,0,0,0,1\n" % (k, k, k) for k in range(_SCANS))


def _folder(suffix: str) -> Callable[[Path], list[Files]]:
    def make(folder: Path) -> list[Files]:
        scans(folder / "plain", _SCANS, suffix)
        bare = files_in(folder / "plain")
        points = folder / "plain" / "per_point"
        points.mkdir()
        for k in range(_SCANS):
            np.savez(points / f"{k:06d}.npz", t=np.zeros(300, np.float32), ring=np.zeros(300, np.uint16))
        times = {"times.txt": b"0.0\n0.1\n0.2\n"}
        full = (
            files_in(folder / "plain") | times | {"sequence.toml": _TOML.encode(), "imu.csv": _IMU, "gnss.csv": _GNSS}
        )
        tr = "Tr: " + " ".join(map(repr, T_CAM0_LIDAR[:3].ravel().tolist())) + "\n"
        kitti_truth = b"1 0 0 0 0 1 0 0 0 0 1 0\n" * _SCANS
        return [
            full | {"gt.tum": _TUM},
            bare,
            bare | {"calib.txt": tr.encode(), "poses.txt": kitti_truth},
            bare | {"pose_inW.csv": _NUMBERED, "hhs_calib.yaml": _MCD.encode()},
            {name.replace("00000", "167040390223528122"): data for name, data in bare.items()},
            bare | {"times.csv": b"stamp\n1670403902235281229\n1670403902335281229\n1670403902435281229\n"},
            bare | {"times.txt": b"1e300\n"} | {"gt.txt": b""},
        ]

    return make


PARSERS = [
    _bag_parser("ROS 1 bag", "a.bag", _bag(".bag", "bag", False)),
    _bag_parser("ROS 1 bag, bz2", "a.bag", _packed_bag("bz2")),
    _bag_parser("ROS 1 bag, lz4", "a.bag", _packed_bag("lz4")),
    _bag_parser("MCAP", "a.mcap", _bag(".mcap", "mcap", False)),
    _bag_parser("MCAP, zstd", "a.mcap", _bag(".mcap", "mcap", True)),
    _bag_parser("SQLite bag", "a.db3", _bag(".db3", "sqlite", False)),
    _bag_parser("SQLite bag, zstd", "a.db3", _bag(".db3", "sqlite", True)),
    _bag_parser("capture", "a.pcap", _capture),
    Parser("folder of records", read_sequence, _records, trees=("sequence.toml",)),
    Parser("KITTI odometry", lambda f: read_sequence(f / "sequences" / "07"), _kitti,
           tables=("sequences/07/times.txt", "sequences/07/calib.txt", "poses/07.txt")),
    Parser("KITTI raw", lambda f: read_sequence(f / "2011_09_26" / "2011_09_26_drive_0005_sync"), _raw,
           tables=("2011_09_26/2011_09_26_drive_0005_sync/oxts/timestamps.txt", "2011_09_26/calib_velo_to_cam.txt",
                   "2011_09_26/2011_09_26_drive_0005_sync/oxts/data/0000000001.txt")),
    *(
        Parser(f"folder of {suffix}", read_sequence, _folder(suffix), trees=("sequence.toml",),
               tables=("times.txt", "imu.csv", "gnss.csv", "gt.tum"))
        for suffix in (".bin", ".pcd", ".ply", ".npy")
    ),
]  # fmt: skip
