"""Bags that were cut off, never indexed, damaged, or written by something unusual."""

from __future__ import annotations

import contextlib
import sqlite3
import struct
import tracemalloc
from collections.abc import Callable
from pathlib import Path
from typing import Any

import lz4.frame
import numpy as np
import pytest
from bag_builders import KINDS, START_NS, STEP_NS, SUFFIX, bag, clouds, imu, scan, together, transforms
from rosbags.rosbag1 import Writer
from rosbags.typesys import Stores, get_typestore

from lslam.core.errors import InputError, LslamError
from lslam.core.types.sequence import Sequence
from lslam.io.readers import open_sequence
from lslam.io.readers.bag_topics import put_in_order
from lslam.io.readers.ground_truth import Voice
from lslam.pipeline.convert.bag_writer import BagMessages, BagWriter

CLOUD = "sensor_msgs/msg/PointCloud2"


def attempt(action: Callable[[], Any], *words: str) -> Any:
    """What `action` gives, or None where it ends in an InputError, which then says all of `words`."""
    try:
        return action()
    except InputError as error:
        missing = [w for w in words if w not in str(error)]
    assert not missing
    return None


def assert_prefix(sequence: Sequence) -> None:
    """Whole scans from the first on, bit for bit."""
    for k in range(len(sequence)):
        got, want = sequence.scan(k), scan(k, 6000)
        assert got.stamp_ns == want.stamp_ns
        np.testing.assert_array_equal(got.points, want.points)
        np.testing.assert_array_equal(got.rings, want.rings)


# 6000 points are 120 kB a scan: ten of them and more to a chunk of 1 MB.
@pytest.mark.parametrize(("kind", "is_zstd"), [("bag", False), ("mcap", False), ("mcap", True)])
def test_what_is_whole_of_a_cut_bag_is_read_wherever_it_was_cut(tmp_path: Path, kind: str, is_zstd: bool) -> None:
    whole = bag(tmp_path / f"a{SUFFIX[kind]}", together(clouds(30, n=6000), imu(20)), kind, is_zstd).read_bytes()
    cut = tmp_path / f"cut{SUFFIX[kind]}"
    counts = []
    for share in np.linspace(0.02, 0.999, 15):
        cut.write_bytes(whole[: int(share * len(whole))])
        sequence = attempt(lambda: open_sequence(cut), str(cut))
        if sequence is None:
            counts.append(0)
            continue
        (loss,) = [p for p in sequence.problems if "cut off" in p]
        assert f"of its {cut.stat().st_size} bytes" in loss
        assert_prefix(sequence)
        counts.append(len(sequence))
    assert counts == sorted(counts)
    assert counts[0] == 0
    assert counts[-1] == 30
    assert len(set(counts)) >= (3 if is_zstd else 13), "chunk by chunk, message by message where nothing is compressed"


def test_a_cut_sqlite_bag_is_read_up_to_the_cut(tmp_path: Path) -> None:
    path = bag(tmp_path / "a.db3", clouds(30, n=6000), "sqlite")
    whole = path.read_bytes()
    path.write_bytes(whole[: len(whole) // 2])
    sequence = open_sequence(path)
    assert any("is cut off: it has" in p for p in sequence.problems)
    readable = 0
    for k in range(len(sequence)):
        got = attempt(lambda k=k: sequence.scan(k), "is damaged")
        if got is not None:
            np.testing.assert_array_equal(got.points, scan(k, 6000).points)
            readable += 1
    assert 5 <= readable < 30


def test_a_ros1_bag_that_was_never_indexed_is_read_whole(tmp_path: Path) -> None:
    """The recorder died: the header says index_pos 0, and connections and chunk infos at the end are missing."""
    path = bag(tmp_path / "a.bag", clouds(30, n=6000))
    data = bytearray(path.read_bytes())
    at = data.index(b"index_pos=") + len(b"index_pos=")
    (end,) = struct.unpack_from("<Q", data, at)
    struct.pack_into("<Q", data, at, 0)
    for name in ("b.bag", "b.bag.active"):
        (tmp_path / name).write_bytes(data[:end])
        sequence = open_sequence(tmp_path / name)
        assert len(sequence) == 30
        assert_prefix(sequence)
        assert not sequence.problems


def test_a_chunk_without_its_index_is_indexed_by_hand(tmp_path: Path) -> None:
    """Cut just behind the last chunk: its index records, which follow it, are gone."""
    path = bag(tmp_path / "a.bag", clouds(30, n=6000))
    data = path.read_bytes()
    index_data = data.rindex(b"op=\x04")  # of the last chunk's index
    path.write_bytes(data[: index_data - 8])
    sequence = open_sequence(path)
    assert len(sequence) == 30
    assert_prefix(sequence)


@pytest.mark.parametrize("shift", [7, 10**8])
def test_a_wrong_index_is_reported(tmp_path: Path, shift: int) -> None:
    path = bag(tmp_path / "a.bag", clouds(3))
    data = bytearray(path.read_bytes())
    field = data.rindex(b"op=\x04")  # of the last index; the length of its header stands 8 bytes before
    (length,) = struct.unpack_from("<I", data, field - 8)
    begin = field + length  # of the entries: seconds, nanoseconds, offset
    for k in range(3):
        (offset,) = struct.unpack_from("<I", data, begin + 12 * k + 8)
        struct.pack_into("<I", data, begin + 12 * k + 8, offset + shift)
    path.write_bytes(data)
    with pytest.raises(InputError, match="none of the 3 messages of /points can be read; where its index is wrong"):
        open_sequence(path)


@pytest.mark.parametrize("compression", ["bz2", "lz4"])
def test_compressed_ros1_bags(tmp_path: Path, compression: str) -> None:
    store = get_typestore(Stores.ROS1_NOETIC)
    writer = Writer(tmp_path / "a.bag")
    writer.set_compression(Writer.CompressionFormat[compression.upper()])
    with writer:
        connection = writer.add_connection("/points", CLOUD, typestore=store)
        for k in range(12):
            message = BagMessages(store).cloud(scan(k, 6000), "lidar")
            writer.write(connection, scan(k).stamp_ns, store.serialize_ros1(message, CLOUD))
    sequence = open_sequence(tmp_path / "a.bag")
    assert len(sequence) == 12
    assert_prefix(sequence)


def test_a_damaged_chunk_costs_its_own_scans_only(tmp_path: Path) -> None:
    path = bag(tmp_path / "a.mcap", clouds(30, n=6000), "mcap", True)
    data = bytearray(path.read_bytes())
    frames = [k for k in range(len(data)) if data[k : k + 4] == b"\x28\xb5\x2f\xfd"]
    assert len(frames) >= 3
    middle = frames[1] + (frames[2] - frames[1]) // 2
    data[middle : middle + 4000] = bytes(4000)
    path.write_bytes(data)
    sequence = open_sequence(path)
    good = bad = 0
    for k in range(len(sequence)):
        got = attempt(lambda k=k: sequence.scan(k), "the chunk at byte", str(path))
        if got is None:
            bad += 1
        else:
            np.testing.assert_array_equal(got.points, scan(round((got.stamp_ns - START_NS) / STEP_NS), 6000).points)
            good += 1
    assert good >= 15
    assert bad + good == len(sequence)
    assert bad or any("damaged" in p for p in sequence.problems)


# -- MCAP files by hand


def record(op: int, content: bytes) -> bytes:
    return struct.pack("<BQ", op, len(content)) + content


def text(words: str) -> bytes:
    return struct.pack("<I", len(words)) + words.encode()


def names(schema: str = "sensor_msgs/msg/PointCloud2", topic: str = "/points") -> bytes:
    channel = struct.pack("<HH", 7, 3 if schema else 0) + text(topic) + text("cdr") + text("")
    return (record(3, struct.pack("<H", 3) + text(schema) + text("") + text("")) if schema else b"") + record(
        4, channel
    )


def messages(store: Any, count: int) -> list[bytes]:
    parts = []
    for k in range(count):
        one = scan(k, 6000)
        data = bytes(store.serialize_cdr(BagMessages(store).cloud(one, "lidar"), CLOUD))
        parts.append(record(5, struct.pack("<HIQQ", 7, k, one.stamp_ns, one.stamp_ns) + data))
    return parts


def mcap(path: Path, *parts: bytes) -> Path:
    magic = b"\x89MCAP0\r\n"
    end = record(15, bytes(4)) + record(2, bytes(20)) + magic
    path.write_bytes(magic + record(1, text("ros2") + text("by hand")) + b"".join(parts) + end)
    return path


@pytest.fixture
def store() -> Any:
    return get_typestore(Stores.ROS2_HUMBLE)


def chunk(records: bytes, compression: str = "") -> bytes:
    packed = lz4.frame.compress(records) if compression else records
    head = struct.pack("<QQQI", START_NS, START_NS, len(records), 0)
    return record(6, head + text(compression) + struct.pack("<Q", len(packed)) + packed)


def test_mcap_without_chunks_without_definitions_and_without_a_summary(tmp_path: Path, store: Any) -> None:
    sequence = open_sequence(mcap(tmp_path / "a.mcap", names(), *messages(store, 3)))
    assert len(sequence) == 3
    assert_prefix(sequence)
    assert not sequence.problems


@pytest.mark.parametrize("compression", ["", "lz4"])
def test_mcap_chunks_without_message_indices(tmp_path: Path, store: Any, compression: str) -> None:
    parts = messages(store, 6)
    chunks = [chunk(names() + b"".join(parts[:4]), compression), chunk(b"".join(parts[4:]), compression)]
    sequence = open_sequence(mcap(tmp_path / "a.mcap", *chunks))
    assert len(sequence) == 6
    assert_prefix(sequence)


def test_an_unknown_compression_is_named(tmp_path: Path, store: Any) -> None:
    with pytest.raises(InputError, match="compression 'brotli' of its chunks is not known"):
        open_sequence(mcap(tmp_path / "a.mcap", chunk(names() + b"".join(messages(store, 1)), "brotli")))


def test_missing_type_definitions_are_a_clear_sentence(tmp_path: Path, store: Any) -> None:
    path = mcap(tmp_path / "a.mcap", names(schema="", topic="/lidar"), *messages(store, 2))
    with pytest.raises(InputError, match=r"lacks the type definition of /lidar .* schemas"):
        open_sequence(path)


def test_raw_packets_are_a_clear_sentence(tmp_path: Path, store: Any) -> None:
    path = mcap(tmp_path / "a.mcap", names("hesai_ros_driver/msg/UdpFrame", "/packets"), *messages(store, 2))
    sentence = r"raw packets of a Hesai LiDAR on /packets \(hesai_ros_driver/msg/UdpFrame, 2 m.*driver"
    with pytest.raises(InputError, match=sentence):
        open_sequence(path)


def test_sqlite_of_the_first_version_without_definitions(tmp_path: Path, store: Any) -> None:
    path = tmp_path / "old.db3"
    with sqlite3.connect(path) as db:
        db.execute("CREATE TABLE topics(id INTEGER PRIMARY KEY, name TEXT, type TEXT, serialization_format TEXT)")
        db.execute("CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id INTEGER, timestamp INTEGER, data BLOB)")
        db.execute("INSERT INTO topics VALUES (4, '/points', 'sensor_msgs/msg/PointCloud2', 'cdr')")
        for k, message in enumerate(messages(store, 3)):
            db.execute("INSERT INTO messages VALUES (?, 4, ?, ?)", (9 - k, START_NS + k, message[31:]))
    db.close()
    sequence = open_sequence(path)
    assert len(sequence) == 3
    assert_prefix(sequence)


# -- stamps


def stamped(stamps: list[int]) -> Any:
    def fill(writer: BagWriter) -> None:
        for k, stamp in enumerate(stamps):
            one = scan(k, stamp_ns=stamp)
            writer.write("/points", START_NS + k * STEP_NS, writer.messages.cloud(one, "lidar"))

    return fill


@pytest.mark.parametrize("kind", KINDS)
def test_zero_stamps_give_way_to_the_times_of_recording(tmp_path: Path, kind: str) -> None:
    sequence = open_sequence(bag(tmp_path / f"a{SUFFIX[kind]}", stamped([0] * 4), kind))
    np.testing.assert_array_equal(sequence.stamps_ns, START_NS + np.arange(4) * STEP_NS)
    assert sequence.scan(2).stamp_ns == sequence.stamps_ns[2]
    assert any("no stamps in their headers: the times of recording" in p for p in sequence.problems)


def test_jitter_is_sorted_and_repeated_stamps_are_dropped_with_a_note(tmp_path: Path) -> None:
    steps = [0, 1, 3, 2, 4, 4, 5, 6]
    sequence = open_sequence(bag(tmp_path / "a.bag", stamped([START_NS + s * STEP_NS for s in steps])))
    np.testing.assert_array_equal((sequence.stamps_ns - START_NS) // STEP_NS, [0, 1, 2, 3, 4, 5, 6])
    for k, message in enumerate([0, 1, 3, 2, 4, 6, 7]):
        np.testing.assert_array_equal(sequence.scan(k).points, scan(message).points)
    said = " ".join(sequence.problems)
    assert "out of order in 1 places, by up to 0.100 s: sorted" in said
    assert "repeat a stamp 1 times" in said


def test_what_follows_a_clock_that_was_set_back_a_little_is_dropped_and_what_comes_late_is_not() -> None:
    """Half a second back at 100 Hz: samples of two times would lie between each other, as jitter never does."""
    regular = 10_000_000 * np.arange(300, dtype=np.int64)
    set_back, late_batch, two_threads, backwards = (regular.copy() for _ in range(4))
    set_back[150:] -= 503_000_000
    late_batch[100:120] = np.roll(late_batch[100:120], 8)
    two_threads[200:220] = np.concatenate([regular[201:220:2], regular[200:220:2]])
    backwards[50:60] = backwards[50:60][::-1]
    for stamps, kept, words in (
        (set_back, np.r_[0:150, 200:300], "go back in time by 0.493 s at message 150: 50 of 300 are dropped"),
        (late_batch, np.arange(300), "out of order in 12 places, by up to 0.190 s: sorted"),
        (two_threads, np.arange(300), "out of order in 10 places, by up to 0.190 s: sorted"),
        (backwards, np.arange(300), "out of order in 9 places, by up to 0.090 s: sorted"),
    ):
        voice = Voice([], [])
        order, ordered = put_in_order(stamps, stamps, "samples", voice)
        np.testing.assert_array_equal(np.sort(order), kept)
        np.testing.assert_array_equal(ordered, np.sort(stamps[kept]))
        assert [p for p in voice.problems if words in p] == voice.problems, voice.problems


# -- what is no bag


def test_what_is_no_bag_is_one_sentence(tmp_path: Path) -> None:
    for name, data, words in (
        ("empty.bag", b"", "is no ROS 1 bag: it has 0 bytes"),
        ("old.bag", b"#ROSBAG V1.2\n" + bytes(50), "rosbag fix"),
        ("text.bag", b"hello, this is text", "is no ROS 1 bag: it begins with"),
        ("empty.mcap", b"", "is no MCAP file: it has 0 bytes"),
        ("text.mcap", b"hello, this is text", "is no MCAP file"),
        ("text.db3", b"hello, this is text" * 99, "cannot be read as a ROS 2 bag in SQLite"),
    ):
        (tmp_path / name).write_bytes(data)
        with pytest.raises(InputError, match=words) as caught:
            open_sequence(tmp_path / name)
        assert str(tmp_path / name) in str(caught.value)
    folder = tmp_path / "packed"
    folder.mkdir()
    (folder / "a.db3.zstd").write_bytes(b"")
    with pytest.raises(InputError, match=r"a\.db3\.zstd is not compressed by zstd as its name says: it has 0 bytes"):
        open_sequence(folder)
    database = tmp_path / "other.db3"
    with sqlite3.connect(database) as db:
        db.execute("CREATE TABLE birds(name TEXT)")
    with pytest.raises(InputError, match="its tables are birds"):
        open_sequence(database)


@pytest.mark.parametrize(("kind", "is_zstd"), [("bag", False), ("mcap", False), ("mcap", True), ("sqlite", False)])
def test_flipped_bytes_are_errors_of_ours_or_nothing_at_all(tmp_path: Path, kind: str, is_zstd: bool) -> None:
    parts = (transforms({("lidar", "imu"): np.eye(4)}), clouds(6, n=60), imu(10))
    path = bag(tmp_path / f"a{SUFFIX[kind]}", together(*parts), kind, is_zstd)
    whole = np.frombuffer(path.read_bytes(), np.uint8)
    rng = np.random.default_rng(5)
    opened = 0
    for k in range(200):
        broken = whole.copy()
        where = rng.integers(0, len(whole) if k % 2 else min(len(whole), 6000), 4)
        broken[where] = rng.integers(0, 256, 4) if k % 3 else 255
        path.write_bytes(broken.tobytes())
        try:
            sequence = open_sequence(path)
        except LslamError:
            continue
        opened += 1
        for index in range(len(sequence)):
            with contextlib.suppress(InputError):
                sequence.scan(index)
    assert opened > 20


@pytest.mark.parametrize("field", [b"time=", b"conn="])
def test_a_record_without_its_fields_costs_the_rest_of_its_chunk(tmp_path: Path, field: bytes) -> None:
    """The chunk has no index, so its records are walked over; the one with the message says nothing of when or what."""
    path = bag(tmp_path / "a.bag", clouds(3, n=60))
    data = path.read_bytes()
    data = data[: data.index(b"op=\x04") - 8]
    at = data.rindex(b"op=\x02")
    at = data.index(field, at) if field in data[at : at + 60] else data.rindex(field, 0, at)
    path.write_bytes(data[:at] + b"x" + data[at + 1 :])
    sequence = open_sequence(path)
    assert len(sequence) == 2
    assert "is damaged and its messages are lost" in "".join(sequence.problems)


def test_a_name_that_is_cut_off_in_a_chunk_costs_the_chunk(tmp_path: Path, store: Any) -> None:
    short = record(4, struct.pack("<HH", 7, 3)) + b"".join(messages(store, 1))
    with pytest.raises(InputError, match=r"a\.mcap"):
        open_sequence(mcap(tmp_path / "a.mcap", chunk(short)))


def test_what_unpacks_to_more_than_it_says_takes_no_memory(tmp_path: Path, store: Any) -> None:
    honest = names() + b"".join(messages(store, 1))
    packed = lz4.frame.compress(honest + bytes(300_000_000))
    head = struct.pack("<QQQI", START_NS, START_NS, len(honest), 0)
    path = mcap(tmp_path / "a.mcap", record(6, head + text("lz4") + struct.pack("<Q", len(packed)) + packed))
    tracemalloc.start()
    with pytest.raises(InputError):
        open_sequence(path)
    most = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert most < 100_000_000


def test_a_type_that_one_part_lost_is_taken_from_another(tmp_path: Path, store: Any) -> None:
    parts = messages(store, 4)
    mcap(tmp_path / "a_0.mcap", names(schema=""), *parts[:2])
    mcap(tmp_path / "a_1.mcap", names(), *parts[2:])
    sequence = open_sequence(tmp_path)
    assert len(sequence) == 4
    assert_prefix(sequence)
