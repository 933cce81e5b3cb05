"""Several LiDARs of one robot: named, one taken by default, merged into the sweeps of one on demand."""

from __future__ import annotations

from collections.abc import Sequence as Listed
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from bag_builders import START_NS, STEP_NS, Fill, bag, imu, scan, together, transforms
from numpy.typing import NDArray
from rosbags.rosbag1 import Writer as Writer1
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from stub_sequences import Stub
from test_bag_clouds import CUSTOM, POINT

from lslam.core.config.input import PreprocessConfig
from lslam.core.errors import InputError, UsageError
from lslam.core.geometry import se3
from lslam.core.types.scan import Scan
from lslam.core.types.sequence import Sequence, StatedTimes, select
from lslam.io.formats.kitti_layout import write_scan, write_times
from lslam.io.readers import open_sequence
from lslam.odometry.frontend.point_times import with_point_times
from lslam.pipeline.convert.bag_writer import BagMessages, BagWriter
from lslam.pipeline.resume import input_digest
from lslam.registration.preprocessing.views import RINGS_APART, FurtherLidar, MergedLidars, with_rings

T_FRONT_REAR = se3.exp(np.array([-1.6, 0.4, -0.2, 0.0, 0.05, 2.9]))
TREE = {("base", "front"): se3.exp(np.array([1.0, 0, 2, 0, 0.1, 0])),
        ("base", "rear"): se3.exp(np.array([1.0, 0, 2, 0, 0.1, 0])) @ T_FRONT_REAR}  # fmt: skip
COUNT = 6


def sweeps(
    count: int, shift_ns: int = 0, step_ns: int = STEP_NS, seed: int = 0, start_ns: int = START_NS
) -> list[Scan]:
    """Sweeps that last `step_ns`, of points farther than 2 m."""
    made = []
    for k in range(count):
        one = scan(seed + k, stamp_ns=start_ns + shift_ns + k * step_ns)
        far = one.points + np.where(one.points[:, :1] > 0, 2, -2).astype(np.float32)
        times = (np.arange(len(one)) * (1e-9 * step_ns / len(one))).astype(np.float32)
        made.append(replace(one, index=k, points=far, times=times))
    return made


def of(topic: str, frame: str, scans: Listed[Scan]) -> Fill:
    def fill(writer: BagWriter) -> None:
        for one in scans:
            writer.write(topic, one.stamp_ns, writer.messages.cloud(one, frame))

    return fill


def in_turns(path: Path, rear: Listed[Scan], *more: Fill, kind: str = "mcap") -> Path:
    """Front and rear on one topic, in the order of their stamps."""
    both = sorted(
        [("front", s) for s in sweeps(COUNT)] + [("rear", s) for s in rear], key=lambda pair: pair[1].stamp_ns
    )
    return bag(path, together(*more, *(of("/points", frame, [one]) for frame, one in both)), kind)


def measured(scans: Listed[Scan]) -> NDArray[np.float64]:
    """(M, 4) instant, s since START_NS, and place of all points, in the order of time."""
    rows = [
        np.column_stack([1e-9 * (s.stamp_ns - START_NS) + np.asarray(s.times, np.float64), s.points]) for s in scans
    ]
    table = np.concatenate(rows)
    return np.asarray(table[np.lexsort((table[:, 1], np.round(table[:, 0], 7)))])


def rear_part(sequence: Sequence) -> list[Scan]:
    """The points of the second LiDAR, back in its own frame."""
    parts = []
    for k in range(len(sequence)):
        merged = sequence.scan(k)
        assert merged.rings is not None
        part = merged.select(merged.rings >= RINGS_APART)
        back = part.points @ T_FRONT_REAR[:3, :3] - T_FRONT_REAR[:3, :3].T @ T_FRONT_REAR[:3, 3]
        parts.append(replace(part, points=back.astype(np.float32)))
    return parts


def test_by_default_one_of_two_lidars_on_a_topic_is_read_and_the_other_is_named(tmp_path: Path) -> None:
    path = in_turns(tmp_path / "a.mcap", sweeps(COUNT - 1, 50_000_000, seed=50), transforms(TREE))
    sequence = open_sequence(path)
    assert sequence.stamps_ns.tolist() == [START_NS + k * STEP_NS for k in range(COUNT)]
    assert sequence.rate_hz == 10
    np.testing.assert_array_equal(sequence.scan(2).points, sweeps(COUNT)[2].points)
    (problem,) = sequence.problems
    assert (
        "/points holds the scans of 2 LiDARs in turns: those of front (6 messages) are read, those of rear (5)"
        in problem
    )
    assert "--lidar-frame rear takes another one, --lidar-frame all merges them" in problem
    rear = open_sequence(path, lidar_frame="/rear")
    assert rear.stamps_ns[0] == START_NS + 50_000_000
    np.testing.assert_array_equal(rear.scan(0).points, sweeps(1, seed=50)[0].points)
    assert not rear.problems
    for opened, frame in ((sequence, "front"), (rear, "rear")):
        assert "scans from /points (sensor_msgs/msg/PointCloud2, 11 messages), frame " + frame in opened.notes
    with pytest.raises(
        UsageError, match=r"no message of /points is of 'top'; .*\n  --lidar-frame front  \(6 messages\)\n  --l"
    ):
        open_sequence(path, lidar_frame="top")
    with pytest.raises(UsageError, match="--lidar-frame is for bags"):
        open_sequence(Path(__file__).parents[3] / "sample_data", lidar_frame="all")


def test_a_frame_that_is_renamed_on_the_way_is_one_lidar(tmp_path: Path) -> None:
    scans = sweeps(COUNT)
    path = bag(tmp_path / "a.bag", together(of("/points", "velodyne", scans[:2]), of("/points", "lidar", scans[2:])))
    for wanted in (None, "all"):
        sequence = open_sequence(path, lidar_frame=wanted)
        assert len(sequence) == COUNT
        assert "the frame of the scans changes from velodyne to lidar at message 2" in sequence.problems[0]
    assert len(open_sequence(path, lidar_frame="velodyne")) == 2


@pytest.mark.parametrize(("shift_ns", "step_ns"), [(0, STEP_NS), (50_000_000, STEP_NS), (-13_000_000, STEP_NS // 2),
                                                   (7_000_000, 2 * STEP_NS), (2_000_000, 93_000_000)])  # fmt: skip
@pytest.mark.parametrize("topics", [("/points", "/points"), ("/front", "/rear")])
def test_every_point_of_the_other_lidar_is_in_the_sweep_of_its_instant(
    tmp_path: Path, shift_ns: int, step_ns: int, topics: tuple[str, str]
) -> None:
    rear = sweeps(COUNT * STEP_NS // step_ns + 2, shift_ns - step_ns, step_ns, seed=50)
    fills = (of(topics[0], "front", sweeps(COUNT)), of(topics[1], "rear", rear))
    if topics[0] == topics[1]:
        sequence = open_sequence(in_turns(tmp_path / "a.mcap", rear, transforms(TREE)), lidar_frame="front,rear")
    else:
        sequence = open_sequence(
            bag(tmp_path / "a.bag", together(transforms(TREE), *fills)), lidar_topic="/front,/rear"
        )
    assert sequence.stamps_ns.tolist() == [START_NS + k * STEP_NS for k in range(COUNT)]
    assert not sequence.problems
    for k, one in enumerate(sweeps(COUNT)):
        merged = sequence.scan(k)
        np.testing.assert_array_equal(merged.points[: len(one)], one.points)
        np.testing.assert_array_equal(np.asarray(merged.times)[: len(one)], one.times)
        assert merged.times is not None
        assert merged.times.min() >= -1e-9
        assert merged.times.max() < 0.1 + 1e-9, "no point belongs to the next sweep"
    truth, got = measured(rear), measured(rear_part(sequence))
    truth = truth[(truth[:, 0] > -1e-10) & (truth[:, 0] < 1e-9 * COUNT * STEP_NS - 1e-10)]
    assert len(got) == len(truth), "none is lost, none is there twice"
    np.testing.assert_allclose(got[:, 0], truth[:, 0], atol=2e-8)
    np.testing.assert_allclose(got[:, 1:], truth[:, 1:], atol=2e-5)


def test_scans_without_times_go_with_the_nearest_sweep_at_their_offset(tmp_path: Path) -> None:
    """Jitter of some milliseconds about the stamps of the leading LiDAR, and twice as many scans."""
    late = [-3_000_000, 47_000_000, 2_000_000, 51_000_000, 0, 44_000_000]
    rear = [replace(one, times=None, stamp_ns=START_NS + STEP_NS * (1 + k // 2) + late[k])
            for k, one in enumerate(sweeps(6, seed=50))]  # fmt: skip
    sequence = open_sequence(in_turns(tmp_path / "a.mcap", rear, transforms(TREE)), lidar_frame="front,rear")
    assert any("rear of /points: no per-point times: its points are taken to be of" in p for p in sequence.problems)
    parts = rear_part(sequence)
    # 51 ms after one stamp are nearer to the next.
    assert [len(part) // 400 for part in parts] == [0, 2, 1, 3, 0, 0]
    np.testing.assert_allclose(np.unique(np.asarray(parts[1].times)), [-0.003, 0.047], atol=1e-8)
    np.testing.assert_allclose(np.unique(np.asarray(parts[3].times)), [-0.049, 0, 0.044], atol=1e-8)


def test_compensated_clouds_of_one_instant_stay_without_times(tmp_path: Path) -> None:
    front, rear = ([replace(one, times=None) for one in sweeps(COUNT, seed=seed)] for seed in (0, 50))
    path = bag(tmp_path / "a.bag", together(transforms(TREE), of("/a", "front", front), of("/b", "rear", rear)))
    (tmp_path / "sequence.toml").write_text('motion_compensated = true\nlidar_topic = "/a, /b"\n')
    sequence = open_sequence(path)
    merged = sequence.scan(3)
    assert merged.times is None
    assert len(merged) == 800
    assert not sequence.problems


def test_no_clock_is_sought_in_the_order_of_points_of_several_lidars() -> None:
    front, rear = ([replace(one, times=None) for one in sweeps(COUNT, seed=seed, start_ns=0)] for seed in (0, 50))
    sequence = merged_of([*front], [*rear])
    assert with_point_times(sequence, PreprocessConfig()) is sequence
    assert any("rear: no per-point times" in problem for problem in sequence.problems)
    sequence.stated_times = StatedTimes("order")
    with pytest.raises(InputError, match="point_times = 'order' is of one LiDAR, and several are merged"):
        with_point_times(sequence, PreprocessConfig())


def test_without_extrinsics_lidars_are_not_merged(tmp_path: Path) -> None:
    rear = sweeps(COUNT, seed=50)
    path = in_turns(tmp_path / "a.mcap", rear)
    with pytest.raises(InputError, match=r"rear of /points cannot be merged with front of /points, there is no /tf_static that "
                                         r'leads from frame front to rear: state .*\[lidars\] "rear" = '):  # fmt: skip
        open_sequence(path, lidar_frame="all")
    T = [[float(v) for v in row] for row in T_FRONT_REAR]
    (tmp_path / "sequence.toml").write_text(f'lidar_frame = "all"\n[lidars]\nrear = {T}\n')
    assert len(measured(rear_part(open_sequence(path)))) == COUNT * 400
    swapped = open_sequence(path, lidar_frame="rear,front").scan(0)
    T_rear_front = se3.inverse(T_FRONT_REAR)
    np.testing.assert_allclose(
        swapped.points[400:], se3.apply(T_rear_front, sweeps(1)[0].points.astype(np.float64)), atol=1e-4
    )


def test_two_topics_of_one_frame_are_merged_as_stated_only(tmp_path: Path) -> None:
    """Two drivers that were started alike both say velodyne: that does not make them one place."""
    fills = (of("/a", "velodyne", sweeps(COUNT)), of("/b", "velodyne", sweeps(COUNT, seed=50)))
    path = bag(tmp_path / "a.bag", together(transforms({("base", "velodyne"): T_FRONT_REAR}), *fills))
    with pytest.raises(InputError, match=r'both are of frame velodyne: state .*\[lidars\] "/b" = '):
        open_sequence(path, lidar_topic="/a,/b")
    (tmp_path / "sequence.toml").write_text('[lidars]\n"/b" = [1,0,0,0, 0,1,0,0, 0,0,1,0]\n')
    merged = open_sequence(path, lidar_topic="/a,/b").scan(1)
    np.testing.assert_array_equal(merged.points[400:], sweeps(COUNT, seed=50)[1].points)


def test_livox_lidars_of_one_topic_are_told_apart_by_their_id(tmp_path: Path) -> None:
    store = get_typestore(Stores.ROS1_NOETIC)
    kind = "livox_ros_driver/msg/CustomMsg"
    store.register(get_types_from_msg(POINT, "livox_ros_driver/msg/CustomPoint"))
    store.register(get_types_from_msg(CUSTOM.format(package="livox_ros_driver"), kind))
    point: Any = store.types["livox_ros_driver/msg/CustomPoint"]
    cls: Any = store.types[kind]
    with Writer1(tmp_path / "a.bag") as writer:
        connection = writer.add_connection("/livox/lidar", kind, typestore=store)
        for k in range(2 * COUNT):
            stamp, one = START_NS + k * STEP_NS // 2, sweeps(1, seed=k % 2 * 50)[0]
            points = [
                point(offset_time=int(1e9 * one.times[i]), x=x, y=y, z=z, reflectivity=1, tag=0, line=i % 6)  # type: ignore[index]
                for i, (x, y, z) in enumerate(one.points)
            ]
            message = cls(
                header=BagMessages(store).header(stamp, "livox_frame"), timebase=stamp, point_num=400, lidar_id=3 + k % 2,
                rsvd=np.zeros(3, np.uint8), points=points,
            )  # fmt: skip
            writer.write(connection, stamp, store.serialize_ros1(message, kind))
    sequence = open_sequence(tmp_path / "a.bag")
    assert len(sequence) == COUNT
    assert "those of livox_frame:3 (6 messages) are read, those of livox_frame:4 (6) are not" in sequence.problems[0]
    other = open_sequence(tmp_path / "a.bag", lidar_frame="livox_frame:4")
    np.testing.assert_array_equal(other.scan(0).points, sweeps(1, seed=50)[0].points)
    with pytest.raises(InputError, match="both are of frame livox_frame"):
        open_sequence(tmp_path / "a.bag", lidar_frame="all")
    T = [[float(v) for v in row] for row in T_FRONT_REAR]
    (tmp_path / "sequence.toml").write_text(f'[lidars]\n"livox_frame:4" = {T}\n')
    merged = open_sequence(tmp_path / "a.bag", lidar_frame="all")
    assert [len(merged.scan(k)) for k in range(3)] == [600, 800, 800], "the second one begins in the middle of a sweep"


def folder_of(path: Path, scans: Listed[Scan], toml: str = "") -> Path:
    """A KITTI-like folder with times and rings beside."""
    for k, one in enumerate(scans):
        (path / "velodyne").mkdir(parents=True, exist_ok=True)
        (path / "per_point").mkdir(exist_ok=True)
        assert one.rings is not None
        assert one.intensity is not None
        assert one.times is not None
        write_scan(path, k, replace(one, labels=None))
    write_times(path, np.array([one.stamp_ns for one in scans]))
    (path / "sequence.toml").write_text(f'per_point = "per_point"\nvertical_correction_deg = 0\n{toml}')
    return path


def test_folders_are_merged_as_sequence_toml_says(tmp_path: Path) -> None:
    start = 5 * 10**9
    rear = sweeps(COUNT, 30_000_000, seed=50, start_ns=start)
    T = [[float(v) for v in row] for row in T_FRONT_REAR]
    folder_of(tmp_path / "rear", rear)
    front = folder_of(tmp_path / "front", sweeps(COUNT, start_ns=start), f'[lidars]\n"../rear" = {T}\n')
    sequence = open_sequence(front)
    assert sequence.kind == "scan-folder" or sequence.kind == "kitti-odometry"
    assert any("merged: 6 of 6 scans of ../rear, at (" in note for note in sequence.notes)
    got, truth = measured(rear_part(sequence)), measured(rear)
    assert len(got) == COUNT * 400 - 120, "the last 30 ms lie beyond the last sweep"
    np.testing.assert_allclose(got[:, 1:], truth[: len(got), 1:], atol=2e-5)
    np.testing.assert_allclose(got[:, 0], truth[: len(got), 0], atol=2e-8)
    before = input_digest(sequence, None)
    assert input_digest(open_sequence(front), None) == before
    (tmp_path / "rear" / "velodyne" / "000001.bin").touch()
    assert input_digest(open_sequence(front), None) != before, "another input: a run does not go on with it"
    (tmp_path / "front" / "sequence.toml").write_text(f'[lidars]\n"../left" = {T}\n')
    with pytest.raises(InputError, match=r"left, named by lidars of .*sequence.toml, does not exist"):
        open_sequence(front)


def merged_of(front: list[Scan | str], rear: list[Scan | str]) -> MergedLidars:
    one, two = Stub(front, motion_compensated=False), Stub(rear, motion_compensated=False)
    return MergedLidars(one, [FurtherLidar("rear", two, T_FRONT_REAR)])


def test_a_damaged_scan_of_the_other_lidar_costs_its_own_points_only(caplog: pytest.LogCaptureFixture) -> None:
    rear: list[Scan | str] = [*sweeps(COUNT, seed=50, start_ns=0)]
    rear[2] = "message 2 is damaged"
    sequence = merged_of([*sweeps(COUNT, start_ns=0)], rear)
    assert [len(sequence.scan(k)) for k in range(COUNT)] == [800, 800, 400, 800, 800, 800]
    assert "rear: left out of the sweeps: message 2 is damaged" in caplog.text


def test_invalid_points_of_the_other_lidar_do_not_become_a_place() -> None:
    rear = sweeps(COUNT, seed=50, start_ns=0)
    rear[1].points[:5] = [[0, 0, 0], [np.nan, 1, 1], [0.3, 0.2, 0.1], [np.inf, 0, 0], [0, 3, 0]]
    merged = merged_of([*sweeps(COUNT, start_ns=0)], [*rear]).scan(1)
    assert len(merged) == 796
    np.testing.assert_allclose(merged.points[400], se3.apply(T_FRONT_REAR, np.array([[0.0, 3, 0]]))[0], atol=1e-5)


def test_each_scan_is_read_once_in_a_pass_and_any_order_gives_the_same() -> None:
    front, rear = sweeps(30, start_ns=0), sweeps(30, 41_000_000, seed=50, start_ns=0)
    sequence = merged_of([*front], [*rear])
    other: Any = sequence.further_lidars[0].scans
    other.scans = [replace(one, stamp_ns=one.stamp_ns) for one in rear]
    other.reads.clear()
    forwards = [sequence.scan(k) for k in range(30)]
    assert sorted(other.reads) == sorted(set(other.reads)), "no scan is decoded twice"
    assert max(len(source.cache) for source in sequence._sources) <= 4, "memory does not grow"
    for k in (29, 3, 17, 0):
        again = sequence.scan(k)
        np.testing.assert_array_equal(again.points, forwards[k].points)
        np.testing.assert_array_equal(again.times, forwards[k].times)
    chosen = select(sequence, 4, 3, 2)
    np.testing.assert_array_equal(chosen.scan(1).points, forwards[6].points)


def test_scans_say_which_lidar_measured_each_point() -> None:
    merged = merged_of([*sweeps(COUNT, start_ns=0)], [*sweeps(COUNT, 50_000_000, seed=50, start_ns=0)]).scan(1)
    assert merged.lidars is not None
    assert np.bincount(merged.lidars).tolist() == [400, 400]
    alone = merged.of_leading()
    assert alone is not None
    np.testing.assert_array_equal(alone.points, sweeps(2, start_ns=0)[1].points)
    assert (alone.lidars, alone.of_leading(), sweeps(1)[0].of_leading()) == (None, None, None)


def test_rings_are_found_sensor_by_sensor_and_stay_distinct() -> None:
    front, rear = sweeps(COUNT, start_ns=0), sweeps(COUNT, seed=50, start_ns=0)
    ringed = with_rings(merged_of([*front], [*rear]))
    rings = ringed.scan(0).rings
    assert rings is not None
    assert np.unique(rings).tolist() == [0, 1, 2, 3, 512, 513, 514, 515]
    assert [note for note in ringed.notes if "rings: 4" in note] == [
        "rings: 4, the ring field of the points", "rear: rings: 4, the ring field of the points"
    ]  # fmt: skip


class Late(Stub):
    """Recorded on another day."""

    @property
    def stamps_ns(self) -> NDArray[np.int64]:
        return super().stamps_ns + 10**14


def test_lidars_that_share_no_time_are_refused() -> None:
    front = Stub([*sweeps(3, start_ns=0)], motion_compensated=False)
    rear = FurtherLidar("rear", Late([*sweeps(3, start_ns=10**14)], motion_compensated=False), np.eye(4))
    with pytest.raises(InputError, match="the scans of rear share no time with those of the leading LiDAR"):
        MergedLidars(front, [rear])


def test_the_imu_stays_with_the_leading_lidar(tmp_path: Path) -> None:
    tree = {**TREE, ("front", "imu"): se3.exp(np.array([0.1, 0.2, 0.3, 0, 0, 1.0]))}
    path = in_turns(tmp_path / "a.bag", sweeps(COUNT, seed=50), transforms(tree), imu(60), kind="bag")
    merged = open_sequence(path, lidar_frame="rear,front", imu=True)
    assert merged.imu is not None
    np.testing.assert_allclose(
        merged.calibration.T_lidar_imu, se3.inverse(T_FRONT_REAR) @ tree["front", "imu"], atol=1e-12
    )
