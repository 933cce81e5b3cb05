"""Parts of a recording: compressed as files, of several kinds, missing, copied, out of order; what is not read is named."""

from __future__ import annotations

import bz2
import gzip
import lzma
from collections.abc import Callable
from pathlib import Path
from typing import Any

import lz4.frame
import numpy as np
import pytest
from bag_builders import GRAVITY, KINDS, START_NS, STEP_NS, SUFFIX, Fill, bag, clouds, imu, scan, together
from rosbags.rosbag1 import Writer
from rosbags.typesys import Stores, get_typestore

from lslam.core.errors import InputError, UsageError
from lslam.core.types.sequence import Sequence
from lslam.io.formats import bag_files
from lslam.io.formats.bag_chunks import zstd
from lslam.io.readers import open_sequence
from lslam.io.readers.bag import BagSequence
from lslam.pipeline.convert.bag_writer import BagMessages, BagWriter

PACKERS: dict[str, Callable[[bytes], bytes]] = {
    ".zstd": lambda data: bytes(zstd().compress(data)),
    ".zst": lambda data: bytes(zstd().compress(data[:5000]) + zstd().compress(data[5000:])),
    ".lz4": lz4.frame.compress,
    ".gz": gzip.compress,
    ".bz2": bz2.compress,
    ".xz": lzma.compress,
}


@pytest.fixture(autouse=True)
def cache(tmp_path_factory: pytest.TempPathFactory, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Where parts are unpacked."""
    folder = tmp_path_factory.mktemp("cache")
    monkeypatch.setenv("XDG_CACHE_HOME", str(folder))
    return folder


def some(*indices: int, topic: str = "/points") -> Fill:
    """The scans of these numbers, and a sample of the IMU with each."""

    def fill(writer: BagWriter) -> None:
        for k in indices:
            one = scan(k)
            writer.write(topic, one.stamp_ns, writer.messages.cloud(one, "lidar"))
            sample = writer.messages.imu(one.stamp_ns, GRAVITY + k, np.full(3, 0.1 * k), "lidar")
            writer.write("/imu", one.stamp_ns, sample)

    return fill


def part(folder: Path, name: str, indices: range | tuple[int, ...]) -> Path:
    folder.mkdir(exist_ok=True)
    kind = next(k for k, suffix in SUFFIX.items() if name.endswith(suffix))
    return bag(folder / name, some(*indices), kind)


def pack(path: Path, ending: str) -> Path:
    packed = path.with_name(path.name + ending)
    packed.write_bytes(PACKERS[ending](path.read_bytes()))
    path.unlink()
    return packed


def assert_scans(sequence: Sequence, indices: range | list[int]) -> None:
    """These scans, bit for bit, and the samples of the IMU beside them."""
    assert [round((s - START_NS) / STEP_NS) for s in sequence.stamps_ns.tolist()] == list(indices)
    for k, index in enumerate(indices):
        np.testing.assert_array_equal(sequence.scan(k).points, scan(index).points)
    assert sequence.imu is not None
    np.testing.assert_allclose(sequence.imu.accel[:, 2], 9.81 + np.array(indices))


def left_out(sequence: Sequence, *words: str) -> bool:
    return any(all(w in sentence for w in words) for sentence in sequence.notes)


@pytest.mark.parametrize("ending", PACKERS)
@pytest.mark.parametrize("kind", KINDS)
def test_parts_that_are_compressed_as_files_are_read(tmp_path: Path, cache: Path, kind: str, ending: str) -> None:
    folder = tmp_path / "rec"
    for k in range(3):
        path = part(folder, f"rec_{k}{SUFFIX[kind]}", range(4 * k, 4 * k + 4))
        if k < 2:
            pack(path, ending)
    sequence = open_sequence(folder)
    assert_scans(sequence, range(12))
    assert not sequence.problems
    assert left_out(sequence, f"rec_0{SUFFIX[kind]}{ending}, rec_1{SUFFIX[kind]}{ending} are compressed as a whole")
    assert not list((cache / "lslam" / "bags").iterdir()), "nothing stays in the cache"


def test_one_file_may_be_compressed_and_its_name_need_not_tell(tmp_path: Path) -> None:
    packed = pack(part(tmp_path, "drive.bag", range(3)), ".gz")
    sequence = open_sequence(packed)
    assert_scans(sequence, range(3))
    assert sequence.name == "drive"
    assert_scans(open_sequence(packed.rename(tmp_path / "other.db3")), range(3))


@pytest.mark.parametrize(
    "names", [("a_0.mcap", "a_1.db3", "a_2.mcap"), ("a_0.bag", "a_1.bag.gz"), ("x.db3", "y.mcap.lz4")]
)
def test_parts_may_be_of_several_kinds(tmp_path: Path, names: tuple[str, ...]) -> None:
    for k, name in enumerate(names):
        ending = next((e for e in PACKERS if name.endswith(e)), "")
        path = part(tmp_path / "rec", name.removesuffix(ending), range(3 * k, 3 * k + 3))
        if ending:
            pack(path, ending)
    sequence = open_sequence(tmp_path / "rec")
    assert_scans(sequence, range(3 * len(names)))
    assert not sequence.problems


def test_a_copy_in_another_kind_is_left_out_and_named(tmp_path: Path) -> None:
    for name in ("a_0.mcap", "b_0.db3", "c.bag"):
        part(tmp_path / "rec", name, range(6))
    part(tmp_path / "rec", "a_1.mcap", range(6, 9))
    bag(tmp_path / "rec" / "clouds.mcap", clouds(4), "mcap")
    sequence = open_sequence(tmp_path / "rec")
    assert isinstance(sequence, BagSequence)
    assert_scans(sequence, range(9))
    assert [p.name for p in sequence.bag.files] == ["a_0.mcap", "a_1.mcap"]
    assert not sequence.problems
    for name in ("b_0.db3", "c.bag", "clouds.mcap"):
        assert left_out(sequence, f"{name} is left out: all of it is in a_0.mcap as well")


def test_a_part_that_is_there_compressed_and_plain_is_read_once(tmp_path: Path) -> None:
    path = part(tmp_path / "rec", "rec_0.mcap", range(5))
    plain = path.read_bytes()
    pack(path, ".zstd")
    path.write_bytes(plain)
    sequence = open_sequence(tmp_path / "rec")
    assert_scans(sequence, range(5))
    assert sequence.problems == ["rec_0.mcap.zstd is left out: rec_0.mcap is the same part, not compressed"]


def test_recordings_of_the_same_time_are_no_parts(tmp_path: Path) -> None:
    """Two robots, say: their clouds lie between each other."""
    for name, late in (("left.bag", 0), ("right.bag", STEP_NS // 3)):

        def fill(writer: BagWriter, late: int = late) -> None:
            for k in range(6):
                one = scan(k, stamp_ns=START_NS + k * STEP_NS + late)
                writer.write("/points", one.stamp_ns, writer.messages.cloud(one, "lidar"))

        bag(tmp_path / name, fill)
    with pytest.raises(UsageError, match=r"right\.bag and left\.bag hold /points of the same 0\.5 s; name one of them"):
        open_sequence(tmp_path)


def test_topics_of_both_versions_of_ros_are_refused(tmp_path: Path) -> None:
    part(tmp_path / "rec", "a.bag", range(3))
    part(tmp_path / "rec", "b.mcap", range(3, 6))
    with pytest.raises(InputError, match=r"ROS 1 and of ROS 2 \(a\.bag, b\.mcap\).*/imu is in both: name one"):
        open_sequence(tmp_path / "rec")


@pytest.mark.parametrize(
    ("numbers", "words"),
    [
        ((0, 1, 3), "part 2 is missing: the parts in {folder} are numbered from 0 (rec_0.mcap) to 3 (rec_3.mcap)"),
        ((0, 4), "parts 1, 2, 3 are missing"),
        ((2, 3), "the first part in {folder} is rec_2.mcap: those before it are missing"),
        ((1,), "the first part in {folder} is rec_1.mcap: those before it are missing"),
        ((0, 1, 2), ""),
    ],
)
def test_a_number_that_is_missing_is_named(tmp_path: Path, numbers: tuple[int, ...], words: str) -> None:
    for n in numbers:
        part(tmp_path / "rec", f"rec_{n}.mcap", range(2 * n, 2 * n + 2))
    sequence = open_sequence(tmp_path / "rec")
    assert_scans(sequence, [k for n in numbers for k in (2 * n, 2 * n + 1)])
    assert len(sequence.problems) == (words != "")
    assert words.format(folder=tmp_path / "rec") in "".join(sequence.problems)


def test_parts_of_ros_1_are_numbered_behind_their_time(tmp_path: Path) -> None:
    for n in (0, 2):
        part(tmp_path / "rec", f"drive_2024-05-01-10-0{n}-00_{n}.bag", range(3 * n, 3 * n + 3))
    assert "part 1 is missing" in open_sequence(tmp_path / "rec").problems[0]
    (beside,) = [
        s for s in open_sequence(tmp_path / "rec" / "drive_2024-05-01-10-00-00_0.bag").notes if "is a bag" in s
    ]
    assert "by its name drive_2024-05-01-10-02-00_2.bag is another part" in beside


def test_what_the_metadata_list_and_is_not_there_is_named(tmp_path: Path) -> None:
    folder = tmp_path / "rec"
    pack(part(folder, "rec_0.db3", range(3)), ".zstd")
    part(folder, "rec_1.db3", range(3, 6))
    names = ["rec_0.db3.zstd", "rec/rec_1.db3.zstd", "rec_2.db3.zstd"]
    listed = "".join(f"    - {name}\n" for name in names)
    (folder / "metadata.yaml").write_text(
        f"rosbag2_bagfile_information:\n  version: 4\n  relative_file_paths:\n{listed}"
    )
    sequence = open_sequence(folder)
    assert_scans(sequence, range(6))
    assert sequence.problems == [f"{folder}/metadata.yaml lists 3 files, of which rec_2.db3.zstd is not there"]
    for text in ("[" * 3000, "a: *b", "rosbag2_bagfile_information: 3", "\0"):
        (folder / "metadata.yaml").write_text(text)
        assert not open_sequence(folder).problems


def test_a_part_that_cannot_be_read_is_named_and_the_others_are_read(tmp_path: Path) -> None:
    folder = tmp_path / "rec"
    part(folder, "rec_0.mcap", range(3))
    (folder / "rec_1.mcap").write_bytes(b"")
    (folder / "rec_2.mcap.7z").write_bytes(b"7z")
    part(folder, "rec_3.mcap", range(3, 6))
    sequence = open_sequence(folder)
    assert_scans(sequence, range(6))
    said = "\n".join(sequence.problems)
    assert f"a part of the recording is not read: {folder}/rec_1.mcap is no MCAP file: it has 0 bytes" in said
    assert "rec_2.mcap.7z is not read: .7z is no ending of a bag" in said
    assert "part 2 is missing" in said


@pytest.mark.parametrize("ending", PACKERS)
def test_of_a_compressed_file_that_was_cut_off_the_beginning_is_read(tmp_path: Path, ending: str) -> None:
    whole = bag(tmp_path / "a.mcap", together(clouds(40, n=6000), imu(20)), "mcap")
    packed = pack(whole, ending)
    data = packed.read_bytes()
    packed.write_bytes(data[: int(0.7 * len(data))])
    sequence = open_sequence(packed)
    assert 15 <= len(sequence) <= 30
    np.testing.assert_array_equal(sequence.scan(14).points, scan(14, 6000).points)
    assert f"{packed} is damaged or cut off: " in "".join(sequence.problems)
    packed.write_bytes(data[:20])
    with pytest.raises(InputError, match=r"cannot be unpacked|is no MCAP file"):
        open_sequence(packed)


def test_what_unpacks_without_end_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(bag_files, "_LEAST", 1 << 20)
    monkeypatch.setattr(bag_files, "_MOST", 10)
    path = tmp_path / "a.mcap.zstd"
    path.write_bytes(zstd().compress(bytes(1 << 24)))
    with pytest.raises(InputError, match="unpacks to more than 10 times its size"):
        open_sequence(path)


# -- order


def test_parts_are_put_in_order_by_the_times_of_recording(tmp_path: Path) -> None:
    for name, indices in (("zero.mcap", range(3)), ("b.mcap", range(3, 6)), ("a.mcap", range(6, 9))):
        part(tmp_path / "rec", name, indices)
    sequence = open_sequence(tmp_path / "rec")
    assert_scans(sequence, range(9))
    assert not sequence.problems


def test_connections_of_one_topic_are_merged_by_the_times_of_recording(tmp_path: Path) -> None:
    """Two publishers in turns, for ten seconds: one after the other they would go back in time."""
    store: Any = get_typestore(Stores.ROS1_NOETIC)

    def write(make: Callable[[int], Any], topic: str, writer: Writer) -> None:
        kind = make(START_NS).__msgtype__
        links = [writer.add_connection(topic, kind, typestore=store, callerid=f"/n{n}") for n in range(2)]
        for k in range(60):
            stamp = START_NS + k * 2 * STEP_NS
            writer.write(links[k % 2], stamp, store.serialize_ros1(make(stamp), kind))

    def cloud(stamp: int) -> Any:
        return BagMessages(store).cloud(scan((stamp - START_NS) // STEP_NS, 50, stamp_ns=stamp), "lidar")

    def sample(stamp: int) -> Any:
        return BagMessages(store).imu(stamp, GRAVITY + (stamp - START_NS) * 1e-9, np.zeros(3), "lidar")

    def fix(stamp: int) -> Any:
        return BagMessages(store).fix(stamp, np.array([49, 8 + (stamp - START_NS) * 1e-15, 110]), 1.0, "lidar")

    def pose(stamp: int) -> Any:
        T = np.eye(4)
        T[0, 3] = (stamp - START_NS) * 1e-9
        return BagMessages(store).odometry(stamp, T, "world", "lidar")

    with Writer(tmp_path / "a.bag") as writer:
        for topic, make in (("/points", cloud), ("/imu", sample), ("/fix", fix), ("/ground_truth", pose)):
            write(make, topic, writer)
    sequence = open_sequence(tmp_path / "a.bag")
    assert not sequence.problems
    seconds = 0.2 * np.arange(60)
    np.testing.assert_array_equal(sequence.scan(7).points, scan(14, 50).points)
    assert sequence.imu is not None
    np.testing.assert_allclose(sequence.imu.accel[:, 0], seconds, atol=1e-9)
    assert sequence.gnss is not None
    np.testing.assert_allclose(sequence.gnss.lat_lon_alt[:, 1], 8 + 1e-6 * seconds)
    assert sequence.ground_truth is not None
    np.testing.assert_allclose(sequence.ground_truth.positions[:, 0], seconds, atol=1e-9)


def test_some_messages_may_come_late_at_the_seam_of_two_parts(tmp_path: Path) -> None:
    part(tmp_path / "rec", "rec_0.mcap", (0, 1, 2, 3, 6))
    part(tmp_path / "rec", "rec_1.mcap", (4, 5, 7))
    sequence = open_sequence(tmp_path / "rec")
    assert_scans(sequence, range(8))
    assert not sequence.problems
