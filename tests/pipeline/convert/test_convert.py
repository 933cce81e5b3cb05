"""What is converted reads back the same, whichever way it went; nothing is half-written."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rosbags.highlevel import AnyReader
from stub_sequences import StampedInTheMiddle, sample
from two_lidars import two_lidars

from lslam.core.config import load_config
from lslam.core.errors import InputError, OutputExistsError, UsageError
from lslam.core.geometry import se3
from lslam.core.types.scan import Scan
from lslam.core.types.sequence import Calibration, Sequence, select
from lslam.io.formats.sensor_messages import decode_pointcloud2
from lslam.io.formats.sequence_toml import FILE_NAME, read_sequence_toml
from lslam.io.readers import open_sequence
from lslam.pipeline.convert.bag_writer import BagWriter
from lslam.pipeline.convert.convert_run import convert_run
from lslam.pipeline.convert.convert_sequence import convert_sequence
from lslam.pipeline.rebuild import EarlierRun
from lslam.simulation.record import record
from lslam.simulation.scenarios import SimulatedDrive, simulate
from lslam.simulation.sensors import GnssModel

NAMES = {"bag": "a.bag", "mcap": "a.mcap", "sqlite": "a"}


@pytest.fixture(scope="module")
def distorted() -> SimulatedDrive:
    """Sweeps with times and rings, an IMU, fixes, a camera and the truth."""
    drive = simulate("block", count=4, motion_compensated=False, imu="icm20948", gnss=GnssModel(5.0))
    assert drive.imu is not None
    assert drive.gnss is not None
    return drive


def assert_same(want: Sequence, got: Sequence) -> None:
    assert len(got) == len(want)
    assert got.name == want.name
    assert got.rate_hz == want.rate_hz
    assert bool(got.motion_compensated) == bool(want.motion_compensated)
    for k in range(len(want)):
        a, b = want.scan(k), got.scan(k)
        assert a.stamp_ns == b.stamp_ns == got.stamps_ns[k]
        for name in ("points", "intensity", "times", "rings"):
            np.testing.assert_array_equal(getattr(a, name), getattr(b, name), err_msg=name)
    for name in ("stamps_ns", "accel", "gyro"):
        np.testing.assert_array_equal(getattr(want.imu, name), getattr(got.imu, name))
    for name in ("stamps_ns", "lat_lon_alt", "sigma"):
        np.testing.assert_array_equal(getattr(want.gnss, name), getattr(got.gnss, name))
    for name, T in vars(want.calibration).items():
        np.testing.assert_array_equal(T, getattr(got.calibration, name))
    assert want.ground_truth is not None
    assert got.ground_truth is not None
    np.testing.assert_array_equal(want.ground_truth.stamps_ns, got.ground_truth.stamps_ns)
    np.testing.assert_allclose(want.ground_truth.poses, got.ground_truth.poses, atol=1e-11)


def converted(sequence: Sequence, kind: str, out: Path) -> Path:
    convert_sequence(sequence, kind, out)
    return out


@pytest.mark.parametrize(("kind", "is_zstd"), [("bag", 0), ("mcap", 0), ("mcap", 1), ("sqlite", 0), ("sqlite", 1)])
def test_to_a_bag_and_on_to_kitti_and_back(distorted: Sequence, tmp_path: Path, kind: str, is_zstd: bool) -> None:
    if kind == "mcap":
        distorted = StampedInTheMiddle(distorted)
    done = convert_sequence(distorted, kind, tmp_path / NAMES[kind], is_zstd=bool(is_zstd))
    assert (done.scans, done.unreadable) == (4, 0)
    through_bag = open_sequence(tmp_path / NAMES[kind])
    assert through_bag.kind == "bag"
    assert not through_bag.problems
    assert_same(distorted, through_bag)
    convert_sequence(through_bag, "kitti", tmp_path / "k")
    through_kitti = open_sequence(tmp_path / "k")
    assert through_kitti.kind == "kitti-odometry"
    assert not through_kitti.problems
    assert_same(distorted, through_kitti)
    assert sorted(p.name for p in tmp_path.iterdir()) == sorted([NAMES[kind], "k"]), "nothing stays beside"


# What ROS 1 nodes compare before they listen (`rosmsg md5`).
MD5 = {
    "sensor_msgs/msg/PointCloud2": "1158d486dd51d683ce2f1be655c3c181",
    "sensor_msgs/msg/Imu": "6a62c6daae103f4ff57a132d6f95cec2",
    "sensor_msgs/msg/NavSatFix": "2d3a8cd499b9b4a0249fb98fd05cfa48",
    "nav_msgs/msg/Odometry": "cd5e73d190d741a2f92e81eda573aca7",
    "tf2_msgs/msg/TFMessage": "94810edda583a504dfda3829e70d7eec",
    "std_msgs/msg/String": "992ce8a1687cec8c8bd883ec73ca41d1",
}


@pytest.mark.parametrize("kind", NAMES)
def test_another_reader_finds_what_ros_expects(distorted: SimulatedDrive, tmp_path: Path, kind: str) -> None:
    """rosbags' own reader: types with their definitions, messages in the order of time, headers that say the same."""
    convert_sequence(distorted, kind, tmp_path / NAMES[kind])
    with AnyReader([tmp_path / NAMES[kind]]) as reader:
        types = {c.topic: c.msgtype for c in reader.connections}
        assert sorted(types.values()) == sorted(MD5)
        if kind == "bag":
            assert {c.msgtype: c.digest for c in reader.connections} == MD5
        stamps = []
        for connection, stamp, data in reader.messages():
            message: Any = reader.deserialize(data, connection.msgtype)
            stamps.append(stamp)
            if hasattr(message, "header"):
                assert message.header.stamp.sec * 10**9 + message.header.stamp.nanosec == stamp
            if connection.topic == "/points":
                names = [field.name for field in message.fields]
                assert names == ["x", "y", "z", "intensity", "ring", "time", "label"]
                assert message.row_step == message.width * message.point_step == len(message.data)
        assert stamps == sorted(stamps)
        assert types["/tf_static"] == "tf2_msgs/msg/TFMessage"
        latched = [getattr(c.ext, "latching", None) == 1 or "TRANSIENT_LOCAL" in str(c.ext) for c in reader.connections]
        assert sum(latched) == 2


def test_a_truth_denser_than_the_scans_and_without_a_camera_keeps_its_stamps(tmp_path: Path) -> None:
    whole = sample(6)
    part = replace(whole, scans=whole.scans[:3], calibration=Calibration())
    back = open_sequence(converted(part, "kitti", tmp_path / "k"))
    assert back.ground_truth is not None
    assert part.ground_truth is not None
    np.testing.assert_array_equal(back.ground_truth.stamps_ns, part.ground_truth.stamps_ns)
    np.testing.assert_allclose(back.ground_truth.poses, part.ground_truth.poses, atol=2e-9)
    assert back.motion_compensated is True


def test_extrinsics_a_reader_assumed_do_not_become_facts(distorted: Sequence, tmp_path: Path) -> None:
    with BagWriter(tmp_path / "a.bag", "bag") as writer:
        for k in range(2):
            scan = distorted.scan(k)
            writer.write("/points", scan.stamp_ns, writer.messages.cloud(scan, "velodyne"))
            zero = np.zeros(3)
            writer.write("/imu", scan.stamp_ns, writer.messages.imu(scan.stamp_ns, zero, zero, "imu"))
    first = open_sequence(tmp_path / "a.bag")
    assert first.calibration.T_lidar_imu is not None
    back = open_sequence(converted(first, "kitti", tmp_path / "k"))
    assert back.calibration.T_lidar_imu is None


def test_frames_of_the_robot_go_with_a_recording(tmp_path: Path) -> None:
    T_lidar_base = se3.exp(np.array([-1.0, 0.5, -1.7, 0.1, 0.0, 0.3]))
    source = sample(2)
    source.calibration = replace(source.calibration, frames={"base_link": T_lidar_base})
    bag = open_sequence(converted(source, "mcap", tmp_path / "a.mcap"))
    for back in (bag, open_sequence(converted(bag, "kitti", tmp_path / "k"))):
        np.testing.assert_allclose(back.calibration.T_lidar("base_link"), T_lidar_base, atol=1e-12)
        assert back.calibration.frames.keys() == {"base_link"}


def exact_points(drive: SimulatedDrive, scan: Scan) -> np.ndarray:
    """Every point where the exact motion has it at the scan's stamp."""
    assert scan.times is not None
    stamp = scan.stamp_ns / 1e9
    T_stamp_point = se3.relative(drive.vehicle.poses(np.array([stamp])), drive.vehicle.poses(stamp + scan.times))
    moved: np.ndarray = np.einsum("nij,nj->ni", T_stamp_point[:, :3, :3], scan.points) + T_stamp_point[:, :3, 3]
    return moved


def test_a_run_in_a_bag_has_deskewed_scans_of_what_was_registered(distorted: SimulatedDrive, tmp_path: Path) -> None:
    truth = distorted.ground_truth
    assert truth is not None
    run = EarlierRun(tmp_path, {}, load_config(None), truth, ("ok", "ok", "bridged", "ok"), None)
    done = convert_run(run, distorted, "bag", tmp_path / "a.bag")
    assert (done.poses, done.clouds, done.map_points) == (4, 3, 0)
    with AnyReader([tmp_path / "a.bag"]) as reader:
        clouds = {
            stamp: reader.deserialize(data, c.msgtype) for c, stamp, data in reader.messages() if c.topic == "/points"
        }
    assert list(clouds) == truth.stamps_ns[[0, 1, 3]].tolist()
    scan = distorted.scan(1)
    points = decode_pointcloud2(clouds[scan.stamp_ns], tmp_path / "a.bag").points
    off = np.linalg.norm(points - exact_points(distorted, scan), axis=1)
    assert off.max() < 0.03 < 0.5 < np.linalg.norm(scan.points - points, axis=1).max()


@pytest.mark.parametrize("instant", ["scan_start", "scan_middle"])
def test_deskewed_scans_put_every_point_where_the_exact_motion_does(
    distorted: SimulatedDrive, tmp_path: Path, instant: str
) -> None:
    source: Sequence = distorted if instant == "scan_start" else StampedInTheMiddle(distorted)
    convert_sequence(source, "kitti", tmp_path / "k", trajectory=distorted.ground_truth)
    back = open_sequence(tmp_path / "k")
    assert back.motion_compensated is True
    assert read_sequence_toml(back.path / FILE_NAME).compensated_to == instant
    before, after = source.scan(1), back.scan(1)
    assert before.times is not None
    assert after.times is None
    np.testing.assert_array_equal(after.rings, before.rings)
    wanted = exact_points(distorted, before)
    off = np.linalg.norm(after.points - wanted, axis=1)
    assert np.linalg.norm(before.points - wanted, axis=1).max() > (0.5 if instant == "scan_start" else 0.25)
    assert off.max() < 0.03, "poses 0.1 s apart are all there is between"


def test_deskewing_needs_times_and_a_motion(distorted: SimulatedDrive, tmp_path: Path) -> None:
    truth = distorted.ground_truth
    assert truth is not None
    with pytest.raises(InputError, match="no per-point times"):
        convert_sequence(sample(2), "bag", tmp_path / "a.bag", trajectory=truth)
    with pytest.raises(InputError, match="no stamped poses"):
        convert_sequence(distorted, "bag", tmp_path / "a.bag", trajectory=replace(truth, has_stamps=False))
    outside = replace(truth, stamps_ns=truth.stamps_ns + 10**12)
    with pytest.raises(InputError, match="none of its 4 scans"):
        convert_sequence(distorted, "bag", tmp_path / "a.bag", trajectory=outside)
    assert not list(tmp_path.iterdir())


def test_damaged_scans_are_left_out_and_counted(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    stub = sample(4)
    stub.scans[1] = "scan 1 is damaged"
    done = convert_sequence(stub, "mcap", tmp_path / "a.mcap")
    assert (done.scans, done.unreadable) == (3, 1)
    assert "scan 1 is damaged" in caplog.text
    np.testing.assert_array_equal(open_sequence(tmp_path / "a.mcap").stamps_ns, [0, 200_000_000, 300_000_000])


def test_nothing_is_left_of_a_conversion_that_fails_and_the_old_one_stays(tmp_path: Path) -> None:
    out = tmp_path / "a.bag"
    convert_sequence(sample(2), "bag", out)
    before = out.read_bytes()
    for kind, name in (("bag", "a.bag"), ("kitti", "k"), ("sqlite", "s")):
        with pytest.raises(InputError, match="none of its 1 scans"):
            convert_sequence(sample_of_damage(), kind, tmp_path / name, overwrite=True)
    assert out.read_bytes() == before
    assert [p.name for p in tmp_path.iterdir()] == ["a.bag"]


def sample_of_damage() -> Sequence:
    stub = sample(1)
    stub.scans[0] = "damaged"
    return stub


REFUSED: list[tuple[str, str, bool, type[Exception], str]] = [
    ("bag", "a", False, UsageError, "ends in .bag"),
    ("bag", "a.mcap", False, UsageError, "not for --to bag"),
    ("mcap", "a.db3", False, UsageError, "not for --to mcap"),
    ("kitti", "k", True, UsageError, "--zstd is for mcap and sqlite"),
    ("pcap", "k", False, UsageError, "no layout 'pcap'"),
    ("mcap", "there", False, OutputExistsError, "--overwrite"),
]


@pytest.mark.parametrize(("kind", "name", "is_zstd", "error", "words"), REFUSED)
def test_what_cannot_be_is_refused_before_anything_is_written(
    tmp_path: Path, kind: str, name: str, is_zstd: bool, error: type[Exception], words: str
) -> None:
    (tmp_path / "there").mkdir()
    with pytest.raises(error, match=words):
        convert_sequence(sample(1), kind, tmp_path / name, is_zstd=is_zstd)
    assert [p.name for p in tmp_path.iterdir()] == ["there"]


def test_a_sequence_is_not_written_over_itself(tmp_path: Path) -> None:
    path = converted(sample(2), "bag", tmp_path / "a.bag")
    with pytest.raises(UsageError, match="holds the sequence itself"):
        convert_sequence(open_sequence(path), "bag", path, overwrite=True)
    assert len(open_sequence(path)) == 2


@pytest.mark.parametrize("way", ["topics", "frames"])
def test_merged_lidars_are_written_each_by_itself_and_read_as_merged(tmp_path: Path, way: str) -> None:
    """In a bag of other tools every LiDAR keeps its scans; the bag says which of them lslam merges."""
    drive = two_lidars("block", 4, 50.0)
    record(drive, tmp_path / "drive")
    merged = open_sequence(tmp_path / "drive")
    done = convert_sequence(merged, "mcap", tmp_path / "a.mcap", lidars=way)
    assert (done.scans, done.unreadable) == (7, 0)
    again = open_sequence(tmp_path / "a.mcap")
    np.testing.assert_array_equal(again.stamps_ns, merged.stamps_ns)
    for k in range(4):
        before, after = merged.scan(k), again.scan(k)
        np.testing.assert_array_equal(after.points, before.points)
        np.testing.assert_array_equal(after.times, before.times)
        np.testing.assert_array_equal(after.rings, before.rings)
    chosen = {"lidar_topic": "/lidar_rear/points"} if way == "topics" else {"lidar_frame": "lidar_rear"}
    rear = open_sequence(tmp_path / "a.mcap", **chosen)
    np.testing.assert_array_equal(rear.scan(1).points, drive.further[0].scan(1).points)
    for kind, part in (("kitti", merged), ("mcap", select(merged, 1)), ("mcap", drive)):
        with pytest.raises(UsageError, match=f"--lidars {way} is for whole recordings of several LiDARs"):
            convert_sequence(part, kind, tmp_path / "b.mcap" if kind == "mcap" else tmp_path / "b", lidars=way)
