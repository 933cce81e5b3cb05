"""`lslam info BAG` lists the topics as `ros2 bag info` does, and says which of them are used."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from bag_builders import KINDS, START_NS, SUFFIX, bag, clouds, imu, together, transforms
from calling import assert_one_sentence, lslam, strict_json
from rosbags.highlevel import AnyReader

from lslam.io.formats.bag_files import Bag, open_bag
from lslam.pipeline.convert.bag_writer import BagWriter
from lslam.pipeline.doctor.inspect import examine_bag


def other(writer: BagWriter) -> None:
    """A topic that lslam has no use for."""
    for k in range(4):
        stamp = START_NS + k * 250_000_000
        writer.write("/rosout", stamp, writer.messages.text("hello"))


FILL = together(transforms({("lidar", "imu"): np.eye(4)}), clouds(6), imu(40), other)
WITHOUT_CLOUDS = together(imu(40), other)


def by_name(facts: dict[str, Any]) -> dict[str, dict[str, Any]]:
    return {topic["name"]: topic for topic in facts["topics"]}


@pytest.mark.parametrize("kind", KINDS)
def test_every_topic_is_there_with_what_rosbags_says_of_it(tmp_path: Path, kind: str) -> None:
    path = bag(tmp_path / ("a" if kind == "sqlite" else f"a{SUFFIX[kind]}"), FILL, kind)
    facts = strict_json(lslam("info", path, "--quick", "--json").stdout)["bag"]
    topics = by_name(facts)
    with AnyReader([path]) as reader:
        assert {(c.topic, c.msgtype, c.msgcount) for c in reader.connections} == {
            (name, topic["type"], topic["messages"]) for name, topic in topics.items()
        }
        assert facts["messages"] == reader.message_count
        assert facts["start_ns"] == reader.start_time
        assert facts["duration_s"] == pytest.approx((reader.end_time - 1 - reader.start_time) * 1e-9, abs=2e-9)
    assert {name: topic["used_for"] for name, topic in topics.items()} == {
        "/points": "scans", "/imu": "IMU", "/tf_static": "extrinsics", "/rosout": None,
    }  # fmt: skip
    rates = {name: topic["rate_hz"] for name, topic in topics.items()}
    assert rates == {
        "/points": pytest.approx(10), "/imu": pytest.approx(100), "/tf_static": None, "/rosout": pytest.approx(4),
    }  # fmt: skip
    assert facts["size_bytes"] == sum(Path(file).stat().st_size for file in facts["files"])
    assert facts["start_utc"] == "2023-11-14T22:13:20.123456+00:00"
    page = lslam("info", path, "--quick")
    assert page.returncode == 0, page.stderr
    rows = [line.split() for line in page.stdout.splitlines()]
    assert ["/points", "sensor_msgs/msg/PointCloud2", "6", "10.0", "Hz", "scans"] in rows
    assert ["/rosout", "std_msgs/msg/String", "4", "4.0", "Hz", "-"] in rows
    assert ["/tf_static", "tf2_msgs/msg/TFMessage", "1", "extrinsics"] in rows


@pytest.mark.parametrize("kind", KINDS)
def test_no_message_is_read_for_it(tmp_path: Path, kind: str, monkeypatch: pytest.MonkeyPatch) -> None:
    opened = open_bag(bag(tmp_path / f"a{SUFFIX[kind]}", FILL, kind))

    def refuse(*_: Any, **__: Any) -> bytes:
        raise AssertionError("a message was read")

    monkeypatch.setattr(Bag, "message", refuse)
    for recording in {id(part): part for topic in opened.topics for part, _ in topic.parts}.values():
        monkeypatch.setattr(recording, "read", refuse, raising=False)
    assert by_name(examine_bag(opened, {}))["/imu"]["messages"] == 40


def test_a_bag_without_clouds_lists_what_it_has_and_then_says_what_is_missing(tmp_path: Path) -> None:
    path = bag(tmp_path / "a.mcap", WITHOUT_CLOUDS, "mcap")
    done = lslam("info", path)
    assert done.returncode == 3
    assert "/imu" in done.stdout
    assert "/rosout" in done.stdout
    assert "1 file" in done.stdout
    assert_one_sentence(done.stderr)
    told = lslam("info", path, "--json")
    assert told.returncode == 3
    facts = strict_json(told.stdout)
    assert by_name(facts["bag"])["/imu"] == {
        "name": "/imu", "type": "sensor_msgs/msg/Imu", "messages": 40, "rate_hz": pytest.approx(100), "used_for": None,
    }  # fmt: skip
    assert facts["error"] in told.stderr


def test_parts_of_a_recording_are_counted_together(tmp_path: Path) -> None:
    folder = tmp_path / "parts"
    folder.mkdir()
    bag(folder / "a_0.bag", together(clouds(3), imu(10)))
    bag(folder / "a_1.bag", imu(10, START_NS + 100_000_000))
    facts = strict_json(lslam("info", folder, "--quick", "--json").stdout)["bag"]
    assert len(facts["files"]) == 2
    topic = by_name(facts)["/imu"]
    assert (topic["messages"], topic["rate_hz"]) == (20, pytest.approx(100))


def test_a_bag_that_cannot_be_opened_is_told_once(tmp_path: Path) -> None:
    (tmp_path / "a.bag").write_bytes(b"no bag at all")
    done = lslam("info", tmp_path / "a.bag")
    assert (done.returncode, done.stdout) == (3, "")
    assert_one_sentence(done.stderr)
