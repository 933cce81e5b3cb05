"""Speeds of wheels in bags and CSV files, and what is said of those that cannot be used."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from bag_builders import START_NS, Fill, bag, clouds, together, transforms

from lslam.core.errors import InputError, LslamError, UsageError
from lslam.core.geometry import se3, so3
from lslam.core.types.imu import WheelStream
from lslam.io.formats.stamped_csv import read_wheels_csv, write_wheels_csv
from lslam.io.readers import open_sequence
from lslam.io.readers.wheels import read_wheels
from lslam.pipeline.convert.bag_writer import BagMessages, BagWriter

T_BASE_LIDAR = se3.make(so3.exp(np.array([0.0, 0.0, 0.3])), np.array([0.8, 0.1, 1.7]))
SPEED, YAW_RATE, COUNT = 3.0, 0.4, 60


def twist_of(store: Any, speed: float, yaw_rate: float) -> Any:
    vector = store.types["geometry_msgs/msg/Vector3"]
    return store.types["geometry_msgs/msg/Twist"](
        linear=vector(x=speed, y=0.0, z=0.0), angular=vector(x=0.0, y=0.0, z=yaw_rate)
    )


def odometry(speed: float, yaw_rate: float) -> Fill:
    """Wheels on an arc of `SPEED` and `YAW_RATE`, whose twists say what is given."""

    def fill(writer: BagWriter) -> None:
        store = writer.store
        for k in range(COUNT):
            pose = se3.exp(0.02 * k * np.array([SPEED, 0.0, 0.0, 0.0, 0.0, YAW_RATE]))
            message = BagMessages(store).odometry(START_NS + 20_000_000 * k, pose, "odom", "base")
            kind = store.types["geometry_msgs/msg/TwistWithCovariance"]
            message.twist = kind(twist=twist_of(store, speed, yaw_rate), covariance=np.zeros(36))
            writer.write("/odom", START_NS + 20_000_000 * k, message)

    return fill


def twists(writer: BagWriter) -> None:
    kind = writer.store.types["geometry_msgs/msg/TwistStamped"]
    for k in range(COUNT):
        stamp = START_NS + 20_000_000 * k
        header = writer.messages.header(stamp, "base")
        writer.write("/odom", stamp, kind(header=header, twist=twist_of(writer.store, SPEED, YAW_RATE)))


def wheels_of(path: Path, source: str = "/odom", frame: str = "", wheelbase_m: float | None = None) -> WheelStream:
    return read_wheels(open_sequence(path), source, frame, wheelbase_m, [], [])


@pytest.mark.parametrize(
    "fill", [odometry(SPEED, YAW_RATE), odometry(0.0, 0.0), twists], ids=["twist", "poses", "stamped"]
)
def test_a_topic_tells_speed_yaw_rate_and_place(fill: Fill, tmp_path: Path) -> None:
    tree = transforms({("base", "lidar"): T_BASE_LIDAR})
    wheels = wheels_of(bag(tmp_path / "a.bag", together(clouds(12), tree, fill)))
    assert len(wheels) == COUNT
    assert wheels.yaw_rate is not None
    np.testing.assert_allclose(wheels.speed, SPEED, atol=1e-6)
    np.testing.assert_allclose(wheels.yaw_rate, YAW_RATE, atol=1e-6)
    np.testing.assert_allclose(wheels.T_lidar_base, se3.inverse(T_BASE_LIDAR), atol=1e-9)


def test_a_place_that_nothing_tells_is_said(tmp_path: Path) -> None:
    notes: list[str] = []
    sequence = open_sequence(bag(tmp_path / "a.bag", together(clouds(12), twists)))
    assert read_wheels(sequence, "/odom", "", None, notes, []).T_lidar_base is None
    assert any("nothing says where base sits" in note for note in notes)


@pytest.mark.parametrize(
    ("source", "error", "words"), [("/wheels", UsageError, "is not there"), ("/points", UsageError, "PointCloud2")]
)
def test_another_topic_is_refused(source: str, error: type[LslamError], words: str, tmp_path: Path) -> None:
    path = bag(tmp_path / "a.bag", together(clouds(12), twists))
    with pytest.raises(error, match=words):
        wheels_of(path, source)


def test_a_frame_that_is_unknown_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="nothing says where frame axle sits"):
        wheels_of(bag(tmp_path / "a.bag", together(clouds(12), twists)), frame="axle")


def test_a_file_reads_back(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    for yaw_rate in (rng.normal(size=9), None):
        wheels = WheelStream(np.arange(9) * 10_000_000, rng.normal(size=9), yaw_rate)
        write_wheels_csv(tmp_path / "wheels.csv", wheels)
        again = read_wheels_csv(tmp_path / "wheels.csv")
        np.testing.assert_array_equal(again.speed, wheels.speed)
        np.testing.assert_array_equal(again.stamps_ns, wheels.stamps_ns)
        assert (again.yaw_rate is None) == (yaw_rate is None)
        if again.yaw_rate is not None:
            np.testing.assert_array_equal(again.yaw_rate, yaw_rate)


def test_two_wheels_and_a_steering_angle(tmp_path: Path) -> None:
    path = tmp_path / "wheels.csv"
    path.write_text("t,left,right,steering\n0.0,1.0,3.0,0.1\n0.1,2.0,4.0,-0.1\n")
    wheels = read_wheels_csv(path, 2.5)
    assert wheels.yaw_rate is not None
    np.testing.assert_allclose(wheels.speed, [2.0, 3.0])
    np.testing.assert_allclose(wheels.yaw_rate, [2.0 * np.tan(0.1) / 2.5, -3.0 * np.tan(0.1) / 2.5])
    with pytest.raises(InputError, match="wheelbase_m"):
        read_wheels_csv(path)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("t,torque\n0.0,1.0\n", "no line has a speed of wheels"),
        ("t,speed\n0.0,1.0\n", "has 1 readings"),
        ("t,speed\n0.0,nan\n0.1,nan\n", "no line has a speed of wheels"),
        ("t,speed\n5000.0,1.0\n5000.1,1.0\n5000.2,1.0\n", "no scan lies there"),
    ],
)
def test_a_file_that_tells_no_motion_is_refused(text: str, words: str, tmp_path: Path) -> None:
    path = tmp_path / "scans"
    path.mkdir()
    for k in range(3):
        np.zeros((50, 4), np.float32).tofile(path / f"{k:06d}.bin")
    (path / "wheels.csv").write_text(text)
    with pytest.raises(InputError, match=words):
        wheels_of(path, "wheels.csv")
    with pytest.raises(InputError, match="has no such file"):
        wheels_of(path, "other.csv")


def test_readings_that_cannot_be_used_are_left_out_and_said(tmp_path: Path) -> None:
    path = tmp_path / "scans"
    path.mkdir()
    for k in range(3):
        np.zeros((50, 4), np.float32).tofile(path / f"{k:06d}.bin")
    (path / "wheels.csv").write_text("t,speed\n0.0,1.0\n0.1,nan\n0.2,1.0\n0.25,-1e300\n0.3,2.0\n")
    problems: list[str] = []
    wheels = read_wheels(open_sequence(path), "wheels.csv", "", None, [], problems)
    assert wheels.speed.tolist() == [1.0, 1.0, 2.0]
    assert any("2 of 5 readings" in problem for problem in problems)
