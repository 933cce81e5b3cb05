"""Packets in bags are decoded as those of captures, and the others are refused in one sentence that says whose they are."""

from __future__ import annotations

import json
import struct
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from bag_builders import KINDS, SUFFIX, bag, clouds, imu, together, transforms
from packet_builders import VELODYNE, ouster_packets, types_of, velodyne_scans
from pcap_builders import START_NS, OusterSpec, ouster, ouster_imu, velodyne, write_ouster, write_pcap
from test_pcap import ATOL_M, assert_measured

from lslam.core.errors import InputError, UsageError
from lslam.core.types.sequence import Sequence
from lslam.io.readers import open_sequence
from lslam.io.readers.bag import BagSequence
from lslam.pipeline.convert.bag_writer import BagWriter


def assert_same(sequence: Sequence, capture: Sequence) -> None:
    """Scan for scan what the capture of the same packets gives."""
    np.testing.assert_array_equal(sequence.stamps_ns, capture.stamps_ns)
    assert sequence.rate_hz == capture.rate_hz
    for k in range(len(capture)):
        got, want = sequence.scan(k), capture.scan(k)
        for name in ("points", "times", "rings", "intensity"):
            np.testing.assert_array_equal(getattr(got, name), getattr(want, name))


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize(("model", "mode"), [("VLP-16", "strongest"), ("HDL-32E", "dual")])
def test_velodyne_scans_give_back_what_was_measured(tmp_path: Path, kind: str, model: str, mode: str) -> None:
    frames, shots = velodyne(model, 3.2, mode=mode)
    path = bag(tmp_path / f"a{SUFFIX[kind]}", lambda writer: velodyne_scans(writer, frames), kind)
    sequence = open_sequence(path)
    assert isinstance(sequence, BagSequence)
    assert (len(sequence), sequence.rate_hz, sequence.sensor) == (3, 10.0, model)
    assert sequence.problems == []
    assert sequence.uses["/velodyne_packets"] == "scans"
    assert_measured(sequence, shots, ATOL_M)
    assert_same(sequence, open_sequence(write_pcap(tmp_path / "a.pcap", frames)))


def test_packets_without_stamps_take_those_of_recording(tmp_path: Path) -> None:
    frames, _ = velodyne("VLP-16", 2.2)
    path = bag(tmp_path / "a.bag", lambda writer: velodyne_scans(writer, frames, 1, is_stamped=False))
    assert_same(open_sequence(path), open_sequence(write_pcap(tmp_path / "a.pcap", frames)))


@pytest.mark.parametrize("kind", ["bag", "mcap"])
def test_what_rides_along_with_packets_is_read(tmp_path: Path, kind: str) -> None:
    T = np.eye(4)
    T[:3, 3] = 0.1, 0.2, 0.3
    frames, _ = velodyne("VLP-16", 2.2)
    more = (transforms({("velodyne", "imu"): T}), imu(30, START_NS))
    path = bag(tmp_path / f"a{SUFFIX[kind]}", together(*more, lambda writer: velodyne_scans(writer, frames)), kind)
    sequence = open_sequence(path)
    assert sequence.imu is not None
    assert len(sequence.imu) == 30
    np.testing.assert_allclose(sequence.calibration.T_lidar_imu, T)
    assert sequence.problems == []


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("profile", ["LEGACY", "RNG19_RFL8_SIG16_NIR16"])
@pytest.mark.parametrize("is_in_bag", [True, False])
def test_ouster_packets_with_their_imu_and_metadata(tmp_path: Path, kind: str, profile: str, is_in_bag: bool) -> None:
    spec = OusterSpec(profile)
    frames, shots = ouster(spec, 4)
    inertial = ouster_imu(40)

    def fill(writer: BagWriter) -> None:
        if is_in_bag:
            words = writer.messages.text(json.dumps(spec.metadata()))
            writer.write("/ouster/metadata", START_NS, words)
        ouster_packets(writer, frames, "lidar")
        ouster_packets(writer, inertial, "imu")

    path = bag(tmp_path / f"a{SUFFIX[kind]}", fill, kind)
    if not is_in_bag:
        (tmp_path / "sensor.json").write_text(json.dumps(spec.metadata()))
    sequence = open_sequence(path)
    assert isinstance(sequence, BagSequence)
    assert len(sequence) == 4
    assert_measured(sequence, shots, 1e-4)
    (tmp_path / "pcap").mkdir()
    capture = open_sequence(write_ouster(tmp_path / "pcap", spec, frames + inertial))
    assert_same(sequence, capture)
    assert sequence.imu is not None
    assert capture.imu is not None
    np.testing.assert_array_equal(sequence.imu.accel, capture.imu.accel)
    np.testing.assert_array_equal(sequence.imu.stamps_ns, capture.imu.stamps_ns)
    np.testing.assert_array_equal(sequence.calibration.T_lidar_imu, capture.calibration.T_lidar_imu)
    assert not sequence.has_assumed_extrinsics
    assert sequence.problems == []
    assert (sequence.uses["/ouster/imu_packets"], sequence.uses["/ouster/lidar_packets"]) == ("IMU", "scans")
    assert (sequence.uses.get("/ouster/metadata") == "metadata") == is_in_bag


def test_another_imu_is_left_out_unless_it_is_named(tmp_path: Path) -> None:
    spec = OusterSpec()
    frames, _ = ouster(spec, 3)

    def fill(writer: BagWriter) -> None:
        ouster_packets(writer, frames, "lidar")
        ouster_packets(writer, ouster_imu(30), "imu")

    (tmp_path / "a.json").write_text(json.dumps(spec.metadata()))
    path = bag(tmp_path / "a.bag", together(fill, imu(7, START_NS)))
    sequence = open_sequence(path)
    assert sequence.imu is not None
    assert len(sequence.imu) == 30
    assert any("IMU from the sensor's packets: /imu left out" in note for note in sequence.notes)
    other = open_sequence(path, imu_topic="/imu")
    assert other.imu is not None
    assert len(other.imu) == 7
    assert isinstance(other, BagSequence)
    assert [name for name, use in other.uses.items() if use == "IMU"] == ["/imu"]


def test_ouster_packets_need_metadata(tmp_path: Path) -> None:
    frames, _ = ouster(OusterSpec(), 2)
    path = bag(tmp_path / "a.bag", lambda writer: ouster_packets(writer, frames, "lidar", "ouster_ros/msg/PacketMsg"))
    with pytest.raises(InputError, match=r"metadata are needed, as std_msgs/String on /ouster/metadata or as the only"):
        open_sequence(path)
    (tmp_path / "a.json").write_text(json.dumps(replace(OusterSpec(), beams=7).metadata()))
    with pytest.raises(InputError, match=r"/ouster/lidar_packets holds no LiDAR packets of"):
        open_sequence(path)


def test_clouds_go_before_packets_unless_these_are_named(tmp_path: Path) -> None:
    frames, shots = velodyne("VLP-16", 2.2)
    path = bag(tmp_path / "a.bag", together(clouds(3), lambda writer: velodyne_scans(writer, frames)))
    sequence = open_sequence(path)
    assert len(sequence) == 3
    assert any("raw packets on /velodyne_packets are left out, for there are clouds" in note for note in sequence.notes)
    assert_measured(open_sequence(path, lidar_topic="/velodyne_packets"), shots, ATOL_M)


def test_packets_of_two_sensors_ask_for_a_choice(tmp_path: Path) -> None:
    frames, _ = velodyne("VLP-16", 2.2)
    parts = [lambda writer, t=t: velodyne_scans(writer, frames, topic=t) for t in ("/left", "/right")]
    path = bag(tmp_path / "a.bag", together(*parts))
    with pytest.raises(UsageError, match=r"--lidar-topic /left .*\n.*--lidar-topic /right"):
        open_sequence(path)


def test_a_damaged_message_costs_its_packets_only(tmp_path: Path) -> None:
    frames, _ = velodyne("VLP-16", 3.2)

    def fill(writer: BagWriter) -> None:
        velodyne_scans(writer, frames, 20)
        types_of(writer, {**VELODYNE})

    path = bag(tmp_path / "a.bag", fill)
    data = bytearray(path.read_bytes())
    second = data.index(b"velodyne", data.index(b"velodyne", data.index(frames[0][1][:400]) - 60) + 2000)
    struct.pack_into("<I", data, second + 8, 9999)
    path.write_bytes(data)
    sequence = open_sequence(path)
    assert "is no velodyne_msgs/msg/VelodyneScan" in sequence.problems[0]
    assert len(sequence) >= 2


@pytest.mark.parametrize(
    ("kind", "topic", "maker"),
    [
        ("hesai_ros_driver/msg/UdpFrame", "/lidar_packets", "Hesai"),
        ("pandar_msgs/msg/PandarScan", "/packets", "Hesai"),
        ("rslidar_msg/msg/RslidarPacket", "/rslidar_packets", "RoboSense"),
        ("nebula_msgs/msg/NebulaPackets", "/hesai/packets", "Hesai"),
        ("nebula_msgs/msg/NebulaPackets", "/velodyne/packets", "Velodyne"),
        ("my_msgs/msg/LidarPacket", "/raw", ""),
    ],
)
def test_packets_that_are_not_decoded_are_named(tmp_path: Path, kind: str, topic: str, maker: str) -> None:
    def fill(writer: BagWriter) -> None:
        made = types_of(writer, {kind: "uint8[] data"})[kind]
        for k in range(3):
            writer.write(topic, START_NS + k, made(data=np.zeros(50, np.uint8)))

    path = bag(tmp_path / "a.mcap", fill, "mcap")
    with pytest.raises(InputError) as caught:
        open_sequence(path)
    said = str(caught.value)
    assert f"raw packets of a {maker + ' ' if maker else ''}LiDAR on {topic} ({kind}, 3 messages) and no clouds" in said
    assert "play the recording into it and record its clouds" in said


@pytest.mark.parametrize(
    ("head", "size", "maker"),
    [
        (b"\xee\xff\x01\x04", 1080, "Hesai"),
        (b"\xff\xee\x01\x04", 1262, "Hesai"),
        (b"\x55\xaa\x05\x0a", 1248, "RoboSense"),
        (b"\x55\xaa\x05\x5a", 1210, "RoboSense"),
    ],
)
def test_captures_of_others_say_the_same(tmp_path: Path, head: bytes, size: int, maker: str) -> None:
    path = write_pcap(tmp_path / "a.pcap", [(START_NS + k, head + bytes(size - 4)) for k in range(5)])
    with pytest.raises(
        InputError, match=rf"raw packets of a {maker} LiDAR and no clouds; Velodyne's .* and Ouster's .* are decoded"
    ):
        open_sequence(path)
