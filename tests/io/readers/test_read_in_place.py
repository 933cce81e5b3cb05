"""Recordings in storage: the same sequence as from a disk, and of a bag no more than what is asked for and about it."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from bag_builders import START_NS, STEP_NS, Fill, bag, clouds, imu, scan, together
from point_writers import write_points
from storages import Counted, counted, stored
from stub_sequences import SAMPLE

from lslam.core.config import Config
from lslam.core.errors import InputError, StorageError, UsageError
from lslam.core.types.sequence import Sequence
from lslam.io.formats.bag_chunks import BLOCK, RangedFile
from lslam.io.readers import open_sequence
from lslam.io.remote import RemotePath
from lslam.pipeline.convert.bag_writer import BagWriter
from lslam.pipeline.resume import input_digest, listing_digest
from lslam.pipeline.run import run

IMAGE = 400_000


@pytest.fixture
def bucket() -> Iterator[RemotePath]:
    with counted() as root:
        yield root


def images(count: int, first: int) -> Fill:
    """Camera pictures, which are most of a bag and which nobody asks for."""

    def fill(writer: BagWriter) -> None:
        rng = np.random.default_rng(0)
        kind = writer.store.types["sensor_msgs/msg/CompressedImage"]
        for k in range(first, first + count):
            stamp = START_NS + k * STEP_NS // 3
            data = rng.integers(0, 256, IMAGE, np.uint8)
            header = writer.messages.header(stamp, "camera")
            writer.write("/camera", stamp, kind(header=header, format="jpeg", data=data))

    return fill


def cloud(index: int) -> Fill:
    def fill(writer: BagWriter) -> None:
        one = scan(index, 2000)
        writer.write("/points", one.stamp_ns, writer.messages.cloud(one, "lidar"))

    return fill


def fleet(writer: BagWriter) -> None:
    """As a recorder writes it: what is measured first stands first."""
    for k in range(20):
        for part in (cloud(k), imu(10, START_NS + k * STEP_NS), images(3, 3 * k)):
            part(writer)


def assert_alike(there: Sequence, here: Sequence) -> None:
    assert len(there) == len(here)
    assert np.array_equal(there.stamps_ns, here.stamps_ns)
    assert there.name == here.name
    for k in {0, 1, len(here) // 2, len(here) - 1}:
        a, b = there.scan(k), here.scan(k)
        assert a.stamp_ns == b.stamp_ns
        assert np.array_equal(a.points, b.points)
        assert a.points.flags.writeable == b.points.flags.writeable
        for name in ("intensity", "times", "rings"):
            x, y = getattr(a, name), getattr(b, name)
            assert (x is None and y is None) or np.array_equal(x, y), name
    for name, values in (
        ("ground_truth", ("stamps_ns", "poses")),
        ("imu", ("accel", "gyro")),
        ("gnss", ("stamps_ns",)),
    ):
        x, y = getattr(there, name), getattr(here, name)
        assert (x is None) == (y is None), name
        assert x is None or all(np.array_equal(getattr(x, v), getattr(y, v)) for v in values)


def test_a_kitti_folder_is_the_same_sequence(bucket: RemotePath) -> None:
    for name in ("sequences", "poses"):
        stored(SAMPLE / name, bucket / "data" / name)
    there, here = open_sequence(f"{bucket}/data"), open_sequence(SAMPLE)
    assert_alike(there, here)
    assert there.kind == here.kind == "kitti-odometry"
    assert str(there.path) == "counted://bucket/data/sequences/00"
    Counted.got.clear()
    there.scan(5)
    assert [name.rpartition("/")[2] for name, _ in Counted.got] == ["000005.bin", "000005.npz"], "one file, asked once"


@pytest.mark.parametrize("suffix", [".bin", ".npy", ".pcd", ".ply"])
def test_a_folder_of_scans_is_the_same_sequence(suffix: str, bucket: RemotePath, tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    for k in range(12):
        write_points(tmp_path / f"scan{k}{suffix}", rng.uniform(-20, 20, (300, 3)), rng.random(300))
    there, here = open_sequence(str(stored(tmp_path, bucket / tmp_path.name))), open_sequence(tmp_path)
    assert_alike(there, here)
    assert there.kind == "scan-folder"


@pytest.mark.parametrize(
    ("kind", "suffix", "is_zstd"), [("bag", ".bag", False), ("mcap", ".mcap", False), ("mcap", ".mcap", True)]
)
def test_a_bag_is_the_same_sequence(kind: str, suffix: str, is_zstd: bool, bucket: RemotePath, tmp_path: Path) -> None:
    file = bag(tmp_path / f"drive7{suffix}", together(imu(100), clouds(12)), kind, is_zstd)
    assert_alike(open_sequence(str(stored(file, bucket / file.name))), open_sequence(file))


@pytest.mark.parametrize(("kind", "suffix"), [("bag", ".bag"), ("mcap", ".mcap")])
def test_a_bag_that_was_cut_off_is_read_as_far_as_on_a_disk(
    kind: str, suffix: str, bucket: RemotePath, tmp_path: Path
) -> None:
    """Nothing can be fetched ahead then: its index is lost."""
    file = bag(tmp_path / f"drive7{suffix}", together(imu(100), clouds(12, n=4000)), kind)
    file.write_bytes(file.read_bytes()[: file.stat().st_size * 3 // 4])
    there, here = open_sequence(str(stored(file, bucket / file.name))), open_sequence(file)
    assert_alike(there, here)
    assert [p.replace(str(there.path), "") for p in there.problems] == [p.replace(str(file), "") for p in here.problems]
    assert 0 < len(here) < 12


@pytest.mark.parametrize(("kind", "suffix"), [("bag", ".bag"), ("mcap", ".mcap")])
def test_of_a_bag_only_the_topics_that_are_read_are_fetched(
    kind: str, suffix: str, bucket: RemotePath, tmp_path: Path
) -> None:
    """24 MB of pictures lie between scans and IMU: opening takes a handful of rounds, and all of it a small part of the bytes."""
    file = bag(tmp_path / f"drive7{suffix}", fleet, kind)
    size = file.stat().st_size
    place = stored(file, bucket / file.name)
    there = open_sequence(str(place))
    opened, rounds = sum(n for _, n in Counted.got), len(Counted.rounds)
    assert_alike(there, open_sequence(file))
    for k in range(len(there)):
        there.scan(k)
    whole = sum(n for _, n in Counted.got)
    print(
        f"{kind}: {opened / size:.3f} of {size / 1e6:.1f} MB to open in {rounds} rounds, {whole / size:.3f} with scans"
    )
    assert size > 20e6
    assert rounds < 15
    assert opened < 0.2 * size
    assert whole < 0.3 * size


def test_blocks_are_what_the_object_holds_whatever_is_expected(bucket: RemotePath) -> None:
    """The law: any reads after any hints give the bytes of the object, and no byte outside of it is asked for."""
    rng = np.random.default_rng(1)
    for size in (0, 1, BLOCK - 1, BLOCK, 9 * BLOCK + 17, 400 * BLOCK):
        data = rng.integers(0, 256, size, np.uint8).tobytes()
        (bucket / "x").write_bytes(data)
        file = RangedFile(bucket / "x")
        assert file.size == size
        for _ in range(60):
            if rng.random() < 0.3:
                file.expect(
                    [(int(rng.integers(-BLOCK, size + BLOCK)), int(rng.integers(0, 3 * BLOCK))) for _ in range(9)]
                )
            position, count = (
                int(rng.integers(0, size + 2)),
                int(rng.choice([0, 1, 100, BLOCK, 5 * BLOCK, 300 * BLOCK])),
            )
            assert file.read(position, count) == data[position : position + count]


def test_sqlite_says_what_can_be_read_instead(bucket: RemotePath, tmp_path: Path) -> None:
    file = bag(tmp_path / "drive7.db3", clouds(2), "sqlite")
    with pytest.raises(
        UsageError, match=r"drive7.db3: SQLite cannot be read in place from storage; \*.mcap and \*.bag are"
    ):
        open_sequence(str(stored(file, bucket / "drive7.db3")))


def test_a_missing_object_is_an_error(bucket: RemotePath) -> None:
    (bucket / "notes.txt").write_bytes(b"x")
    for name, said in (("none.bag", "no such bucket, object or folder"), ("notes.txt", "is a file: give a bag")):
        with pytest.raises(InputError, match=said):
            open_sequence(f"{bucket}/{name}")
    with pytest.raises(InputError, match=re.escape(f"{bucket} holds no scans")):
        open_sequence(str(bucket))


def test_unreachable_storage_ends_the_run_without_skipping_scans(bucket: RemotePath, tmp_path: Path) -> None:
    """A damaged scan is skipped and the run is degraded; one that cannot be fetched now can be later."""
    stored(SAMPLE / "sequences", bucket / "data" / "sequences")

    def refuse(verb: str, name: str) -> None:
        if name.endswith("000002.bin"):
            raise TimeoutError("read timed out")

    sequence = open_sequence(f"{bucket}/data/sequences/00")
    Counted.refuse = staticmethod(refuse)
    with pytest.raises(StorageError, match=r"000002.bin cannot be read: the storage does not answer \(TimeoutError"):
        run(sequence, Config(), out=tmp_path / "out")


def test_a_recording_that_is_replaced_is_another(bucket: RemotePath, tmp_path: Path) -> None:
    file = bag(tmp_path / "drive7.mcap", clouds(2), "mcap")
    place = stored(file, bucket / "drive7.mcap")
    before = input_digest(open_sequence(str(place)), None), listing_digest(RemotePath(str(place)))
    assert (input_digest(open_sequence(str(place)), None), listing_digest(RemotePath(str(place)))) == before
    stored(file, place)
    assert input_digest(open_sequence(str(place)), None) != before[0]
    assert listing_digest(RemotePath(str(place))) != before[1]
