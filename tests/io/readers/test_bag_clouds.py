"""Clouds as the drivers of Velodyne, Ouster, Hesai, RoboSense and Livox publish them, and as they should not."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from bag_builders import KINDS, START_NS, STEP_NS, SUFFIX, bag, raw_cloud
from numpy.typing import NDArray
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Writer2
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from lslam.core.errors import InputError
from lslam.core.types.scan import Scan, Span
from lslam.core.types.sequence import Sequence
from lslam.io.readers import open_sequence
from lslam.io.readers.point_times import TimeRule
from lslam.odometry.frontend.register_scans import sweep_of
from lslam.pipeline.convert.bag_writer import BagMessages, BagWriter

N = 800
XYZI = [("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("intensity", "<f4")]
# Seconds since scan start, what every driver's field below says in its own way.
SECONDS = np.linspace(0, 0.0999, N)


def table(dtype: list[Any] | dict[str, Any], **columns: NDArray[Any]) -> NDArray[Any]:
    """`N` points of `dtype`, in padded structs too."""
    rng = np.random.default_rng(3)
    rows = np.zeros(N, np.dtype(dtype))
    for axis in "xyz":
        rows[axis] = rng.uniform(-50, 50, N)
    for name, values in columns.items():
        rows[name] = values
    return rows


def opened(
    path: Path, rows: NDArray[Any], kind: str = "bag", headers: list[int] | None = None, **more: Any
) -> Sequence:
    """A bag of two such clouds, at `headers`."""
    stamps = headers or [START_NS, START_NS + STEP_NS]

    def fill(writer: BagWriter) -> None:
        for stamp in stamps:
            writer.write("/points", stamp, raw_cloud(writer.store, stamp, rows, **more))

    return open_sequence(bag(path / f"a{SUFFIX[kind]}", fill, kind))


def check(scan: Scan, rows: NDArray[Any], stamp_ns: int, tolerance_s: float) -> None:
    np.testing.assert_array_equal(scan.points, np.column_stack([rows[a].astype(np.float32) for a in "xyz"]))
    assert scan.times is not None
    np.testing.assert_allclose(scan.times, SECONDS, atol=tolerance_s)
    assert abs(scan.stamp_ns - stamp_ns) <= tolerance_s * 1e9
    assert scan.rings is not None
    np.testing.assert_array_equal(scan.rings, np.arange(N) % 16)


RING = np.arange(N) % 16
NS = np.round(SECONDS * 1e9)
LAYOUTS: dict[str, tuple[list[Any] | dict[str, Any], dict[str, NDArray[Any]], int, float, str]] = {
    # field types, columns, header - scan start in ns, tolerance in s, what is said
    "velodyne": (
        [*XYZI, ("ring", "<u2"), ("time", "<f4")],
        {"ring": RING, "time": SECONDS - SECONDS[-1]}, round(SECONDS[-1] * 1e9), 1e-7, "s, relative to the scan's end",
    ),
    "ouster": (
        {"names": ["x", "y", "z", "intensity", "t", "reflectivity", "ring", "ambient", "range"],
         "formats": ["<f4"] * 4 + ["<u4", "<u2", "<u2", "<u2", "<u4"], "offsets": [0, 4, 8, 16, 20, 24, 26, 28, 32],
         "itemsize": 48},
        {"ring": RING, "t": NS}, 0, 1e-8, "ns, since scan start",
    ),
    "hesai": (
        {"names": ["x", "y", "z", "intensity", "timestamp", "ring"], "formats": ["<f4"] * 4 + ["<f8", "<u2"],
         "offsets": [0, 4, 8, 16, 24, 32], "itemsize": 48},
        {"ring": RING, "timestamp": START_NS / 1e9 + SECONDS}, 0, 5e-7, "s, absolute",
    ),
    "livox": (
        [*XYZI, ("tag", "u1"), ("line", "u1"), ("timestamp", "<f8")],
        {"line": RING, "timestamp": START_NS + NS}, 0, 5e-7, "ns, absolute",
    ),
    "robosense": (
        [*XYZI, ("ring", "<u2"), ("timestamp", "<f8")],
        {"ring": RING, "timestamp": START_NS / 1e9 + SECONDS}, round(SECONDS[-1] * 1e9), 5e-7, "s, absolute",
    ),
}  # fmt: skip


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("sensor", LAYOUTS)
def test_every_drivers_times_become_seconds_since_scan_start(tmp_path: Path, sensor: str, kind: str) -> None:
    dtype, columns, late_ns, tolerance, words = LAYOUTS[sensor]
    rows = table(dtype, **columns)
    # Only the first scan has absolute times near its header; the second one's header is the same instant here.
    sequence = opened(tmp_path, rows, kind, [START_NS + late_ns, START_NS + late_ns + STEP_NS])
    check(sequence.scan(0), rows, START_NS, tolerance)
    assert any(words in note for note in sequence.notes), sequence.notes
    assert abs(int(sequence.stamps_ns[0]) - START_NS) <= tolerance * 1e9
    assert any("scans moved by -0.0999" in note for note in sequence.notes) == (late_ns > 0)
    assert not any("moved by -0.0000" in note for note in sequence.notes)
    assert not sequence.problems


@pytest.mark.parametrize(
    ("clock_s", "field", "unit"),
    [(4.5, "<f8", 1.0), (3000.0, "<u4", 1e-6), (946684800.0, "<f8", 1.0), (946684800.0, "<f8", 1e-9)],
)
def test_times_of_another_epoch_are_relative_to_the_scan(
    tmp_path: Path, clock_s: float, field: str, unit: float
) -> None:
    """Since the sensor was switched on, since the hour, since 2000: the stamps of the headers stay."""
    values = (clock_s + SECONDS) / unit
    rows = table([*XYZI, ("ring", "<u2"), ("timestamp", field)], ring=RING, timestamp=values)
    sequence = opened(tmp_path, rows)
    check(sequence.scan(1), rows, START_NS + STEP_NS, 1e-6)
    assert any("absolute" in note for note in sequence.notes), sequence.notes
    assert sequence.stamps_ns[1] == START_NS + STEP_NS


@pytest.mark.parametrize(("field", "unit"), [("<f8", 1.0), ("<f8", 1e-9)])
def test_a_clock_that_starts_with_the_recording_is_a_clock(tmp_path: Path, field: str, unit: float) -> None:
    """As in a simulator: the first scan alone looks as if its times were relative to it."""
    headers = [k * STEP_NS for k in range(6)]

    def fill(writer: BagWriter) -> None:
        for stamp in headers:
            rows = table([*XYZI, ("ring", "<u2"), ("timestamp", field)], ring=RING,
                         timestamp=np.round((stamp / 1e9 + SECONDS) / unit, 9))  # fmt: skip
            writer.write("/points", stamp, raw_cloud(writer.store, stamp, rows))

    sequence = open_sequence(bag(tmp_path / "a.bag", fill))
    assert sequence.stamps_ns.tolist() == headers
    for k in (0, 5):
        scan = sequence.scan(k)
        assert scan.times is not None
        assert abs(scan.stamp_ns - headers[k]) <= 1000
        np.testing.assert_allclose(scan.times, SECONDS, atol=1e-6)


def test_a_sequence_tells_how_its_times_are_meant(tmp_path: Path) -> None:
    rows = table([*XYZI, ("ring", "<u2"), ("t", "<u4")], ring=RING, t=NS)
    rule = getattr(opened(tmp_path, rows), "time_rule", None)
    assert isinstance(rule, TimeRule)
    assert (rule.field, rule.ns_per_unit, rule.is_absolute, rule.is_before_stamp) == ("t", 1.0, False, False)


def test_missing_times_are_noted(tmp_path: Path) -> None:
    sequence = opened(tmp_path, table([*XYZI, ("ring", "<u2")], ring=RING))
    assert sequence.scan(0).times is None
    assert any("have no times" in note for note in sequence.notes)


def test_invalid_times_are_reported_and_not_used(tmp_path: Path) -> None:
    sequence = opened(tmp_path, table([*XYZI, ("time", "<f4")], time=SECONDS * 1e4))
    assert sequence.scan(0).times is None
    (problem,) = sequence.problems
    for part in ("no deskew", "'time'", "float32", "0 to 999", str(START_NS)):
        assert part in problem


def test_times_about_the_stamp_leave_it_in_the_middle(tmp_path: Path) -> None:
    """As lslam writes scans of KITTI raw: a clock at either end is not meant, and nothing moves."""
    rows = table([*XYZI, ("time", "<f4")], time=SECONDS - 0.05)
    sequence = opened(tmp_path, rows)
    assert any("s, relative to the scan's middle" in note for note in sequence.notes), sequence.notes
    scan = sequence.scan(1)
    assert scan.stamp_ns == sequence.stamps_ns[1] == START_NS + STEP_NS
    np.testing.assert_array_equal(scan.times, rows["time"])
    assert sweep_of(sequence) == scan.span


STATED: list[tuple[NDArray[Any], str, int, str]] = [
    # what the field holds, sequence.toml, header - scan start in ns, what is said
    (SECONDS * 1e4, "point_time_unit = 'us'", 0, "us, since scan start, as stated"),
    (SECONDS, "point_time_reference = 'end'", 99_900_000, "s, relative to the scan's end, as stated"),
    (SECONDS - SECONDS[-1], "point_time_reference = 'end'", 99_900_000, "s, relative to the scan's end, as stated"),
]


@pytest.mark.parametrize(("values", "toml", "late_ns", "words"), STATED)
def test_configured_facts_about_times_are_used(
    tmp_path: Path, values: NDArray[Any], toml: str, late_ns: int, words: str
) -> None:
    (tmp_path / "sequence.toml").write_text(toml)
    rows = table([*XYZI, ("time", "<f4")], time=values)
    sequence = opened(tmp_path, rows, headers=[START_NS + late_ns, START_NS + late_ns + STEP_NS])
    assert any(words in note for note in sequence.notes), sequence.notes
    scan = sequence.scan(0)
    assert abs(scan.stamp_ns - START_NS) < 100
    assert scan.times is not None
    np.testing.assert_allclose(scan.times, SECONDS * (0.01 if "us" in toml else 1), atol=1e-7)


@pytest.mark.parametrize("kind", KINDS)
def test_big_endian_clouds_in_padded_rows(tmp_path: Path, kind: str) -> None:
    dtype = [("x", ">f4"), ("y", ">f4"), ("z", ">f8"), ("time", ">f4"), ("ring", ">u2")]
    rows = table(dtype, time=SECONDS, ring=RING)
    sequence = opened(tmp_path, rows, kind, height=4, padding=13)
    check(sequence.scan(1), rows, START_NS + STEP_NS, 1e-7)
    for values in (sequence.scan(0).points, sequence.scan(0).times):
        assert values is not None
        assert values.dtype == np.dtype("=f4"), "native byte order, kernels want it"


@pytest.mark.parametrize(("height", "is_by_rows"), [(16, True), (N // 16, False)])
def test_organised_clouds_without_a_ring_field_have_rings_all_the_same(
    tmp_path: Path, height: int, is_by_rows: bool
) -> None:
    sequence = opened(tmp_path, table(XYZI), height=height)
    rows, cols = np.divmod(np.arange(N), N // height)
    np.testing.assert_array_equal(sequence.scan(0).rings, rows if is_by_rows else cols)


def test_points_that_are_not_finite_leave_with_their_time_and_ring(tmp_path: Path) -> None:
    rows = table([*XYZI, ("ring", "<u2"), ("time", "<f4")], ring=RING, time=SECONDS, intensity=np.arange(N))
    rows["x"][::3], rows["z"][1] = np.nan, np.inf
    rows["time"][5] = np.nan
    good = np.isfinite(rows["x"]) & np.isfinite(rows["z"]) & np.isfinite(rows["time"])
    scan = opened(tmp_path, rows).scan(0)
    assert len(scan) == good.sum() < N
    np.testing.assert_array_equal(scan.rings, RING[good])
    np.testing.assert_array_equal(scan.times, rows["time"][good])
    np.testing.assert_array_equal(scan.intensity, np.arange(N)[good])


def test_clouds_without_points_are_empty_scans_and_the_rule_waits_for_points(tmp_path: Path) -> None:
    rows = table([*XYZI, ("time", "<f4")], time=SECONDS)

    def fill(writer: BagWriter) -> None:
        for k, points in enumerate((rows[:0], rows, rows[:0])):
            stamp = START_NS + k * STEP_NS
            writer.write("/points", stamp, raw_cloud(writer.store, stamp, points))

    sequence = open_sequence(bag(tmp_path / "a.bag", fill))
    assert [len(sequence.scan(k)) for k in range(3)] == [0, N, 0]
    assert sweep_of(sequence) == sequence.scan(1).span == Span(0.0, float(rows["time"][-1]))
    np.testing.assert_array_equal(sequence.scan(1).times, rows["time"])


def test_fields_and_data_that_contradict_each_other_name_the_message(tmp_path: Path) -> None:
    def fill(writer: BagWriter) -> None:
        good = raw_cloud(writer.store, START_NS, table(XYZI))
        writer.write("/points", START_NS, good)
        for k, changes in enumerate(({"width": N + 1}, {"point_step": 10}, {"fields": good.fields[:2]}), 1):
            stamp = START_NS + k * STEP_NS
            cloud = raw_cloud(writer.store, stamp, table(XYZI))
            for name, value in changes.items():
                setattr(cloud, name, value)
            writer.write("/points", stamp, cloud)

    sequence = open_sequence(bag(tmp_path / "a.bag", fill))
    assert len(sequence.scan(0)) == N
    for k, words in ((1, "needs 12816 bytes and has 12800"), (2, "lies beyond its 10 bytes"), (3, "no field z")):
        with pytest.raises(InputError, match=f"a.bag, /points, message {k}: .*{words}"):
            sequence.scan(k)


POINT = "uint32 offset_time\nfloat32 x\nfloat32 y\nfloat32 z\nuint8 reflectivity\nuint8 tag\nuint8 line"
CUSTOM = (
    "std_msgs/Header header\nuint64 timebase\nuint32 point_num\nuint8 lidar_id\nuint8[3] rsvd\n"
    "{package}/CustomPoint[] points"
)


@pytest.mark.parametrize("frame", ["livox", "livox_frame", "l", "livox_frame_"])
@pytest.mark.parametrize("ros", [1, 2])
def test_livox_custom_messages_in_both_serialisations(tmp_path: Path, ros: int, frame: str) -> None:
    """rosbags serialises, frames of every length shift the alignment of what follows."""
    package = "livox_ros_driver" if ros == 1 else "livox_ros_driver2"
    store = get_typestore(Stores.ROS1_NOETIC if ros == 1 else Stores.ROS2_HUMBLE)
    kind = f"{package}/msg/CustomMsg"
    store.register(get_types_from_msg(POINT, f"{package}/msg/CustomPoint"))
    store.register(get_types_from_msg(CUSTOM.format(package=package), kind))
    rows = table(XYZI)
    point: Any = store.types[f"{package}/msg/CustomPoint"]
    points = [
        point(offset_time=int(NS[k]), x=r["x"], y=r["y"], z=r["z"], reflectivity=k % 250, tag=16, line=k % 6)
        for k, r in enumerate(rows)
    ]
    writer: Any = Writer1(tmp_path / "a.bag")
    if ros == 2:
        writer = Writer2(tmp_path / "a", version=9, storage_plugin=StoragePlugin.MCAP)
    with writer:
        connection = writer.add_connection("/livox/lidar", kind, typestore=store)
        for k in range(2):
            stamp = START_NS + k * STEP_NS
            cls: Any = store.types[kind]
            message = cls(
                header=BagMessages(store).header(stamp + 5000, frame), timebase=stamp, point_num=N, lidar_id=1,
                rsvd=np.zeros(3, np.uint8), points=points,
            )  # fmt: skip
            data = store.serialize_ros1(message, kind) if ros == 1 else store.serialize_cdr(message, kind)
            writer.write(connection, stamp, data)
    sequence = open_sequence(tmp_path / ("a.bag" if ros == 1 else "a"))
    for k in range(2):
        scan = sequence.scan(k)
        assert scan.stamp_ns == START_NS + k * STEP_NS == sequence.stamps_ns[k], "timebase, not the header's stamp"
        np.testing.assert_array_equal(scan.points, np.column_stack([rows[a] for a in "xyz"]))
        np.testing.assert_allclose(scan.times, SECONDS, atol=1e-8)
        np.testing.assert_array_equal(scan.rings, np.arange(N) % 6)
        np.testing.assert_array_equal(scan.intensity, np.arange(N) % 250)
    assert not sequence.problems
