"""Bags of every kind: what was written comes back, topics and extrinsics are chosen aloud."""

from __future__ import annotations

import tracemalloc
from pathlib import Path

import numpy as np
import pytest
from bag_builders import GRAVITY, KINDS, START_NS, STEP_NS, SUFFIX, Fill, bag, clouds, imu, scan, together, transforms

from lslam.core.errors import InputError, UsageError
from lslam.core.geometry import se3
from lslam.core.types.scan import Scan
from lslam.core.types.sequence import Sequence
from lslam.io.readers import open_sequence
from lslam.io.readers.bag import BagSequence
from lslam.io.readers.kitti_raw import with_gnss, with_imu
from lslam.pipeline.convert.bag_writer import BagWriter

T_BASE_LIDAR = se3.exp(np.array([0.5, -0.1, 1.8, 0.01, -0.02, 1.5]))
T_BASE_IMU = se3.exp(np.array([-0.2, 0.3, 0.4, 0.5, 0.1, -0.7]))


def assert_scans(sequence: Sequence, count: int) -> None:
    """The scans `clouds(count)` wrote, bit for bit."""
    assert len(sequence) == count
    for k in range(count):
        want, got = scan(k), sequence.scan(k)
        assert got.stamp_ns == want.stamp_ns == sequence.stamps_ns[k]
        assert got.index == k
        for name in ("points", "intensity", "times", "rings"):
            a, b = getattr(want, name), getattr(got, name)
            assert a.dtype == b.dtype
            np.testing.assert_array_equal(a, b)


@pytest.mark.parametrize("is_zstd", [False, True])
@pytest.mark.parametrize("is_folder", [False, True])
@pytest.mark.parametrize("kind", KINDS)
def test_every_kind_gives_back_what_was_written(tmp_path: Path, kind: str, is_folder: bool, is_zstd: bool) -> None:
    if kind == "bag" and is_zstd:
        with pytest.raises(UsageError, match="--zstd is for mcap and sqlite"):
            BagWriter(tmp_path / "a.bag", kind, is_zstd)
        return
    path = tmp_path / "drive" / ("a" + (SUFFIX[kind] if kind == "bag" or not is_folder else ""))
    path.parent.mkdir()
    bag(path, together(clouds(5), imu(60)), kind, is_zstd)
    sequence = open_sequence(path.parent if kind == "bag" and is_folder else path)
    assert_scans(sequence, 5)
    assert sequence.rate_hz == 10
    assert sequence.imu is not None
    rng = np.random.default_rng(1)
    for k in range(60):
        np.testing.assert_array_equal(sequence.imu.accel[k], rng.normal(0, 1, 3) + GRAVITY)
        np.testing.assert_array_equal(sequence.imu.gyro[k], rng.normal(0, 0.1, 3))
    np.testing.assert_array_equal(sequence.imu.stamps_ns, START_NS + np.arange(60) * 10_000_000)
    assert any("s, since scan start" in note for note in sequence.notes)
    assert [p.name for p in path.parent.iterdir()] == [path.name], "nothing stays beside the bag"


def test_scans_can_be_read_in_any_order_and_again(tmp_path: Path) -> None:
    """Several scans share a compressed chunk, and only its beginning was unpacked for the headers."""
    path = bag(tmp_path / "a.mcap", clouds(12), "mcap", True)
    sequence = open_sequence(path)
    for k in (11, 0, 5, 5, 1, 10):
        np.testing.assert_array_equal(sequence.scan(k).points, scan(k).points)
    with pytest.raises(IndexError):
        sequence.scan(12)


def test_a_split_bag_is_one_recording_in_natural_order(tmp_path: Path) -> None:
    for part in (0, 2, 10):
        one = scan(part)

        def fill(writer: BagWriter, one: Scan = one) -> None:
            writer.write("/points", one.stamp_ns, writer.messages.cloud(one, "lidar"))

        bag(tmp_path / f"drive_{part}.bag", fill)
    (tmp_path / "drive_10.bag").rename(tmp_path / "drive_10.bag.active")
    (tmp_path / "notes.txt").write_text("sunny")
    sequence = open_sequence(tmp_path)
    assert isinstance(sequence, BagSequence)
    assert [p.name for p in sequence.bag.files] == ["drive_0.bag", "drive_2.bag", "drive_10.bag.active"]
    np.testing.assert_array_equal(sequence.stamps_ns, START_NS + np.array([0, 2, 10]) * STEP_NS)
    np.testing.assert_array_equal(sequence.scan(2).points, scan(10).points)
    (missing,) = sequence.problems
    assert missing.startswith("parts 1, 3, 4, 5, 6, 7, 8, 9 are missing")
    part = open_sequence(tmp_path / "drive_2.bag")
    assert len(part) == 1
    assert (
        "drive_2.bag is a bag; by their names drive_0.bag, drive_10.bag.active are other parts of it" in part.notes[0]
    )


def test_bags_of_different_days_are_not_taken_for_one_recording(tmp_path: Path) -> None:
    for name, first in (("monday", 0), ("tuesday", 864_000)):
        one = scan(first)

        def fill(writer: BagWriter, one: Scan = one) -> None:
            writer.write("/points", one.stamp_ns, writer.messages.cloud(one, "lidar"))

        bag(tmp_path / f"{name}.bag", fill)
    with pytest.raises(UsageError, match=r"tuesday\.bag begins 86400 s after monday\.bag has ended; name one"):
        open_sequence(tmp_path)
    assert len(open_sequence(tmp_path / "monday.bag")) == 1


def test_several_clouds_ask_for_a_choice(tmp_path: Path) -> None:
    path = bag(tmp_path / "a.bag", together(clouds(3, "/left/points"), clouds(2, "/right/points")))
    with pytest.raises(UsageError, match="2 topics") as caught:
        open_sequence(path)
    assert "--lidar-topic /left/points   (3 messages" in str(caught.value)
    assert "--lidar-topic /right/points  (2 messages" in str(caught.value)
    assert len(open_sequence(path, lidar_topic="/right/points")) == 2
    assert len(open_sequence(path, lidar_topic="left/points")) == 3


def test_a_topic_that_does_not_exist_names_those_that_do(tmp_path: Path) -> None:
    path = bag(tmp_path / "a.bag", together(clouds(3), imu(5)))
    with pytest.raises(UsageError, match=r"--lidar-topic /velo: the topic is not there in .*\n  --lidar-topic /points"):
        open_sequence(path, lidar_topic="/velo")
    with pytest.raises(UsageError, match="holds 5 messages of type sensor_msgs/msg/Imu, no clouds"):
        open_sequence(path, lidar_topic="/imu")
    with pytest.raises(UsageError, match="its topics are /imu"):
        open_sequence(path, gnss_topic="/fix")
    with pytest.raises(UsageError, match="is for bags"):
        open_sequence(Path(__file__).parents[3] / "sample_data", lidar_topic="/points")


def test_a_bag_without_clouds_says_what_it_has(tmp_path: Path) -> None:
    path = bag(tmp_path / "a.bag", imu(5))
    with pytest.raises(InputError, match=r"holds no clouds .* its topics are /imu \(sensor_msgs/msg/Imu, 5\)"):
        open_sequence(path)


def test_two_imus_are_listed_and_none_is_guessed(tmp_path: Path) -> None:
    path = bag(tmp_path / "a.bag", together(clouds(3), imu(5, topic="/a/imu"), imu(7, topic="/b/imu")))
    sequence = open_sequence(path)
    assert sequence.imu is None
    assert any("--imu-topic /b/imu  (7 messages" in problem for problem in sequence.problems)
    with pytest.raises(
        UsageError, match=r"IMU on 2 topics, choose one:\n  --imu-topic /a/imu  \(5 messages.*\n  --imu-topic /b"
    ):
        with_imu(sequence)
    chosen = open_sequence(path, imu_topic="/b/imu")
    assert chosen.imu is not None
    assert len(chosen.imu) == 7
    assert with_imu(chosen) is chosen


def test_the_error_about_a_missing_topic_lists_the_topics(tmp_path: Path) -> None:
    def fixes(*topics: str, status: int = 0) -> Fill:
        def fill(writer: BagWriter) -> None:
            for topic in topics:
                fix = writer.messages.fix(START_NS, np.array([49.0, 8.4, 110.0]), 1.0, "gnss")
                fix.status.status = status
                writer.write(topic, START_NS, fix)

        return fill

    two = bag(tmp_path / "a.bag", together(clouds(3), fixes("/a/fix", "/b/fix")))
    with pytest.raises(InputError, match=r"no IMU: no topic is sensor_msgs/Imu; its topics are /a/fix .*without --imu"):
        with_imu(open_sequence(two))
    with pytest.raises(UsageError, match=r"GNSS on 2 topics, choose one:\n  --gnss-topic /a/fix .*\n  --gnss-topic /b"):
        with_gnss(open_sequence(two))
    chosen = open_sequence(two, gnss_topic="/b/fix")
    assert with_gnss(chosen) is chosen
    none = bag(tmp_path / "b.bag", together(clouds(3), fixes("/fix", status=-1)))
    with pytest.raises(InputError, match=r"no GNSS: /fix holds none that can be used; .* without --gnss and --georef"):
        with_gnss(open_sequence(none))


@pytest.mark.parametrize("kind", KINDS)
def test_extrinsics_follow_the_chain_of_static_transforms(tmp_path: Path, kind: str) -> None:
    pairs = {("base", "lidar"): T_BASE_LIDAR, ("base", "box"): np.eye(4), ("box", "imu"): T_BASE_IMU}
    path = bag(tmp_path / f"a{SUFFIX[kind]}", together(transforms(pairs), clouds(2), imu(5)), kind)
    sequence = open_sequence(path)
    T = sequence.calibration.T_lidar_imu
    assert T is not None
    np.testing.assert_allclose(T, se3.inverse(T_BASE_LIDAR) @ T_BASE_IMU, atol=1e-12)
    assert not sequence.problems


def test_configured_extrinsics_have_precedence_and_missing_ones_are_noted(tmp_path: Path) -> None:
    path = bag(tmp_path / "a.bag", together(transforms({("base", "lidar"): T_BASE_LIDAR}), clouds(2), imu(5)))
    sequence = open_sequence(path)
    np.testing.assert_array_equal(sequence.calibration.T_lidar_imu, np.eye(4))
    (problem,) = sequence.problems
    assert "no transform leads from frame lidar to imu" in problem
    assert "--extrinsics" in problem
    given = open_sequence(path, extrinsics="1,2,3,0,0,0,1")
    assert given.calibration.T_lidar_imu is not None
    np.testing.assert_array_equal(given.calibration.T_lidar_imu[:3, 3], [1, 2, 3])
    assert not given.problems


def test_an_imu_without_common_time_is_reported(tmp_path: Path) -> None:
    for start in (START_NS - 10**10, START_NS + 10**10):
        path = bag(tmp_path / f"{start}.bag", together(clouds(3), imu(10, start)))
        assert "IMU: it shares no time with the scans" in open_sequence(path).problems


@pytest.mark.parametrize(("kind", "is_zstd"), [("bag", False), ("mcap", False), ("mcap", True), ("sqlite", True)])
def test_memory_does_not_grow_with_the_bag(tmp_path: Path, kind: str, is_zstd: bool) -> None:
    """Opening and reading 40 scans of half a megabyte never holds more than a chunk and some scans."""
    path = bag(tmp_path / f"a{SUFFIX[kind]}", clouds(40, n=20_000), kind, is_zstd)
    open_sequence(path).scan(0)  # imports
    tracemalloc.start()
    sequence = open_sequence(path)
    for k in range(40):
        assert len(sequence.scan(k)) == 20_000
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 7e6


@pytest.mark.parametrize("kind", KINDS)
def test_fixes_without_a_fix_are_left_out_and_unknown_errors_are_nan(tmp_path: Path, kind: str) -> None:
    def fill(writer: BagWriter) -> None:
        for k, (sigma, status) in enumerate([(0.3, 0), (np.nan, 0), (0.1, -1), (0.7, 2)]):
            stamp = START_NS + k * STEP_NS
            fix = writer.messages.fix(stamp, np.array([49.0, 8.0 + k, 110.0]), sigma, "antenna")
            fix.status.status = status
            writer.write("/fix", stamp, fix)

    T = se3.make(np.eye(3), np.array([0.0, 0, 1.5]))
    more = transforms({("antenna", "lidar"): T})
    sequence = open_sequence(bag(tmp_path / f"a{SUFFIX[kind]}", together(clouds(4), more, fill), kind))
    assert sequence.gnss is not None
    np.testing.assert_array_equal(sequence.gnss.lat_lon_alt[:, 1], [8, 9, 11])
    np.testing.assert_array_equal(sequence.gnss.sigma, [0.3, np.nan, 0.7])
    np.testing.assert_array_equal(sequence.gnss.stamps_ns, START_NS + np.array([0, 1, 3]) * STEP_NS)
    np.testing.assert_allclose(sequence.calibration.T_lidar_gnss, se3.inverse(T))


def test_truth_of_another_body_is_carried_to_the_lidar_and_odometry_is_no_truth(tmp_path: Path) -> None:
    poses = [se3.exp(np.array([k, 0.1 * k, 0, 0, 0, 0.2 * k])) for k in range(4)]

    def fill(writer: BagWriter) -> None:
        for k, T in enumerate(poses):
            stamp = START_NS + k * STEP_NS
            for topic, off in (("/odom", 9.0), ("/robot/ground_truth/pose", 0.0)):
                moved = T.copy()
                moved[0, 3] += off
                writer.write(topic, stamp, writer.messages.odometry(stamp, moved, "map", "base"))

    path = bag(tmp_path / "a.bag", together(clouds(4), transforms({("base", "lidar"): T_BASE_LIDAR}), fill))
    truth = open_sequence(path).ground_truth
    assert truth is not None
    assert truth.frame == "lidar"
    np.testing.assert_allclose(truth.poses, [T @ T_BASE_LIDAR for T in poses], atol=1e-12)
    np.testing.assert_array_equal(truth.stamps_ns, START_NS + np.arange(4) * STEP_NS)
