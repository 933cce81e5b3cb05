"""Bags of ROS 1 and ROS 2, read without ROS.

Reading goes through an index of our own: any message can be read at any time, the files are never loaded, and recordings that
were cut off or never indexed are read as far as they are whole.
"""

from __future__ import annotations

import lzma
import struct
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import cache, cached_property
from importlib import import_module
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple, TypeVar
from zlib import error as zlib_error

import numpy as np

from lslam.core.arrays import Longs
from lslam.core.errors import InputError, OutputError, UsageError, cause, input_errors
from lslam.core.kernels.cache import cache_folder
from lslam.core.printable import first_of
from lslam.io.formats.bag_chunks import LARGEST, Topic, damage, unpack, zstd
from lslam.io.formats.bag_listing import SUFFIXES, left_out, list_bag_files, missing_parts, packing_of, suffix_of
from lslam.io.formats.bag_records import ChunkedBag
from lslam.io.formats.chunked_bags import McapFile, Ros1Bag, SqliteBag
from lslam.io.remote import RemotePath

T = TypeVar("T")

# Said once, at the beginning: where lslam's own bags keep what else is known of a sequence, as `sequence.toml`.
INFO_TOPIC = "/lslam/sequence"
_ENCODINGS = ("cdr", "ros1")
_MOST_MESSAGES = 3  # damaged messages that are named one by one
_ZSTD = b"\x28\xb5\x2f\xfd"  # ROS 2 can compress every message by itself
_ZSTD_BLOCK = 1 << 18  # more than the largest block of zstd
_TRANSFORMS = "tf2_msgs/msg/TFMessage"
_OLD_NAMES = {"tf/msg/tfMessage": _TRANSFORMS}


Recording = ChunkedBag | SqliteBag
_Reader = Callable[[Path, Path], Recording]
READERS: dict[str, _Reader] = {".bag": Ros1Bag, ".bag.active": Ros1Bag, ".mcap": McapFile, ".db3": SqliteBag}
_MAGIC: dict[bytes, _Reader] = {b"#ROSBAG": Ros1Bag, b"\x89MCAP0": McapFile, b"SQLite format 3": SqliteBag}
_PACKED_MAGIC = {
    b"\x28\xb5\x2f\xfd": "zstd",
    b"\x04\x22\x4d\x18": "lz4",
    b"\x1f\x8b": "gz",
    b"BZh": "bz2",
    b"\xfd7zXZ\0": "xz",
}
_LIBRARIES = {"lz4": "lz4.frame", "gz": "gzip", "bz2": "bz2", "xz": "lzma"}
_BLOCK = 1 << 20
# Recordings shrink to a tenth at best; what grows further was made to fill a disk.
_MOST, _LEAST = 1000, 1 << 30


@dataclass
class BagTopic:
    """One topic over all files and connections of a bag; `encoding` is `cdr` or `ros1`.

    Its messages are numbered by the time of recording, whichever part they lie in.
    """

    name: str
    type: str
    encoding: str
    parts: list[tuple[Recording, Topic]] = field(default_factory=list)

    def __len__(self) -> int:
        return sum(len(topic) for _, topic in self.parts)

    @property
    def stamps_ns(self) -> Longs:
        """(N,) when each message was recorded."""
        return np.asarray(self._rows[0], np.int64)

    def place(self, k: int) -> tuple[Recording, Topic, int]:
        """Part that holds message `k`, and the number of the message there. Raises IndexError beyond the last."""
        _, part, row = self._rows[:, k].tolist()
        return *self.parts[part], row

    @cached_property
    def _rows(self) -> Longs:
        """(3, N) of each message: time of recording (ns), part, and number within the part."""
        tables = [(t.stamps_ns, np.full(len(t), n), np.arange(len(t))) for n, (_, t) in enumerate(self.parts)]
        rows = np.concatenate([np.stack(table) for table in tables], axis=1)
        return rows[:, np.argsort(rows[0], kind="stable")]


class Header(NamedTuple):
    """Beginning of a stamped message: its stamp (ns), its frame, where the rest begins, and the byte order, `<` or `>`."""

    stamp_ns: int
    frame: str
    end: int
    order: str


class Bag:
    """All files of one recording as one bag. Messages are read on demand, from any thread."""

    def __init__(self, path: Path, files: list[Path]) -> None:
        """Open a recording's files. Raises InputError if none is readable, or files of ROS 1 and 2 hold the same topics."""
        self.path = path
        self.losses = left_out(path, files) + missing_parts(path, files)
        self.notes: list[str] = []
        every = _recordings(files, self.notes, self.losses)
        copies = _copies([recording.topics for recording in every])
        recordings = [recording for k, recording in enumerate(every) if k not in copies]
        self.losses += [recording.loss for recording in recordings if recording.loss]
        self.notes += [
            f"{every[k].path.name} is left out: all of it is in {every[n].path.name} as well" for k, n in copies.items()
        ]
        self.files = [recording.path for recording in recordings]
        # A file that was cut off may have lost the type, which the other parts tell.
        types = {(t.name, t.encoding): t.type for recording in recordings for t in recording.topics if t.type}
        topics: dict[tuple[str, str, str], BagTopic] = {}
        for recording in recordings:
            for topic in recording.topics:
                kind = topic.type or types.get((topic.name, topic.encoding), "")
                key = (topic.name, _OLD_NAMES.get(kind, kind), topic.encoding)
                topics.setdefault(key, BagTopic(*key)).parts.append((recording, topic))
        self.topics = sorted(topics.values(), key=lambda t: t.name)
        _check_encodings(path, self.topics)

    def of_type(self, *names: str) -> list[BagTopic]:
        """Topics with messages that lslam can decode, of the types whose names (`Imu`, `PointCloud2`) are given."""
        return [t for t in self.topics if len(t) and t.encoding in _ENCODINGS and t.type.rsplit("/", 1)[-1] in names]

    def message(self, topic: BagTopic, k: int, limit: int | None = None) -> bytes:
        """First bytes of message `k` of `topic`, at least `limit` if it has them. Raises InputError for a damaged one."""
        recording, part, row = topic.place(k)
        data = recording.read(part, row, limit)
        return _decompress(recording, part, row, limit) if data[:4] == _ZSTD else data

    def each(
        self, topic: BagTopic, read: Callable[[bytes], T], problems: list[str], limit: int | None = None
    ) -> Iterator[tuple[int, T]]:
        """Iterate over `topic`: the number of each message, and the result of `read` on its bytes, at least the first `limit`.

        Damaged messages are skipped. The first few are named in `problems`, the others counted.
        """
        broken: list[str] = []
        for recording, part in topic.parts:
            recording.expect(part, limit is not None)
        for k in range(len(topic)):
            try:
                value = read(self.message(topic, k, limit))
            except InputError as error:
                broken.append(str(error))
            else:
                yield k, value
        problems.extend(broken[:_MOST_MESSAGES])
        if len(broken) > _MOST_MESSAGES:
            problems.append(f"{len(broken) - _MOST_MESSAGES} more messages of {topic.name} are damaged")

    def decode(self, topic: BagTopic, data: bytes) -> Any:
        """The message as an object with the fields of its type. Raises InputError when it does not fit the type."""
        from rosbags.serde import SerdeError

        store = typestore(topic.encoding)
        try:
            if topic.encoding == "ros1":
                return store.deserialize_ros1(data, topic.type)
            return store.deserialize_cdr(memoryview(data), topic.type)
        except (SerdeError, KeyError, AssertionError) as error:
            raise InputError(f"{self.path}: a message of {topic.name} is no {topic.type}: {error}") from None


def _recordings(files: list[Path], notes: list[str], losses: list[str]) -> list[Recording]:
    """Open the files. The reasons why some cannot be opened are added to `losses`. Raises InputError where none can."""
    packed: list[str] = []
    recordings: list[Recording] = []
    failures: list[InputError] = []
    for file in files:
        try:
            with unpack_file(file) as (there, loss):
                recordings.append(_reader(file, there)(file, there))
            losses += [loss] if loss else []
            packed += [file.name] if there != file else []
        except InputError as error:
            failures.append(error)
    if not recordings:
        raise failures[0]
    losses += [f"a part of the recording is not read: {failure}" for failure in failures]
    if packed:
        are = "is" if len(packed) == 1 else "are"
        notes.append(
            f"{first_of(packed)} {are} compressed as a whole: unpacked in the user's cache for as long as the recording is read"
        )
    return recordings


def _copies(files: list[list[Topic]]) -> dict[int, int]:
    """For each file that duplicates another, by topics and times: the file that it duplicates. Of equal files the first stays.

    Converting, compressing, indexing and filtering a bag keep the names of topics and the times of recording.
    """
    counts = [sum(map(len, topics)) for topics in files]
    copies: dict[int, int] = {}
    fuller: list[int] = []
    for k in sorted(range(len(files)), key=lambda k: -counts[k]):
        whole = next((n for n in fuller if counts[k] and _is_within(files[k], files[n])), None)
        if whole is None:
            fuller.append(k)
        else:
            copies[k] = whole
    return copies


def _is_within(topics: list[Topic], others: list[Topic]) -> bool:
    """Whether every message of a file, its `topics`, is also in another file, `others`, by topic and time."""

    def has_all(stamps: Longs, others_ns: Longs) -> bool:
        is_around = len(stamps) > 0 and stamps[0] <= others_ns[0] and others_ns[-1] <= stamps[-1]
        return is_around and bool(np.isin(others_ns, stamps).all())

    return all(any(o.name == t.name and has_all(o.stamps_ns, t.stamps_ns) for o in others) for t in topics if len(t))


def _check_encodings(path: Path, topics: list[BagTopic]) -> None:
    """Raise InputError for a topic that is recorded both by ROS 1 and by ROS 2."""
    legible = [topic for topic in topics if len(topic) and topic.encoding in _ENCODINGS]
    for topic, other in pairwise(legible):
        if other.name == topic.name and other.encoding != topic.encoding:
            files = ", ".join(t.parts[0][0].path.name for t in (topic, other))
            raise InputError(
                f"{path} holds bags of ROS 1 and of ROS 2 ({files}) that are no copies of each other, and {topic.name} is in "
                "both: name one of them"
            )


def _reader(path: Path, there: Path) -> _Reader:
    """Reader class of a file, chosen by its first bytes, else by its name; `there` is the file or its decompressed copy."""
    by_name = READERS[suffix_of(path)]
    if isinstance(there, RemotePath):
        return by_name
    with there.open("rb") as stream:
        head = stream.read(16)
    return next((reader for magic, reader in _MAGIC.items() if head.startswith(magic)), by_name)


def open_bag(path: Path) -> Bag:
    """Open a ROS 1 bag, an MCAP or SQLite file, or a folder of them. Raises InputError when there is none or it is unreadable."""
    files = list_bag_files(path)
    if not files:
        raise InputError(f"{path} holds no bag: {', '.join('*' + s for s in SUFFIXES)} are read")
    return Bag(path, files)


def read_header(topic: BagTopic, data: bytes) -> Header:
    """The header that begins messages of stamped types. Raises InputError when there is none."""
    try:
        if topic.encoding == "ros1":
            _, seconds, nanoseconds, length = struct.unpack_from("<4I", data)
            at, order = 16, "<"
        else:
            order = "<" if data[1] else ">"
            seconds, nanoseconds, length = struct.unpack_from(order + "iII", data, 4)
            at = 16
        frame = data[at : at + length].split(b"\0", 1)[0].decode(errors="replace")
    except (struct.error, IndexError):
        raise InputError(f"a message of {topic.name} has no header: {len(data)} bytes") from None
    return Header(seconds * 10**9 + nanoseconds, frame.lstrip("/"), at + length, order)


@cache
def typestore(encoding: str) -> Any:
    """Standard message types of ROS. Their layout never changed, so the definitions stored in a bag are not needed."""
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    store = get_typestore(Stores.ROS1_NOETIC if encoding == "ros1" else Stores.ROS2_HUMBLE)
    if _TRANSFORMS not in store.types:
        store.register(get_types_from_msg("geometry_msgs/TransformStamped[] transforms", _TRANSFORMS))
    return store


def _decompress(recording: Recording, topic: Topic, k: int, limit: int | None) -> bytes:
    """Decompress a message compressed on its own, which begins in the first block; raises InputError if damaged."""
    packed = recording.read(topic, k, None if limit is None else _ZSTD_BLOCK)
    try:
        data = unpack("zstd", iter([packed]), LARGEST + 1 if limit is None else limit)
        if len(data) > LARGEST:
            raise ValueError(f"it unpacks to more than {LARGEST} bytes")
    except damage() as error:
        raise InputError(f"{recording.path}: message {k} of {topic.name} is damaged: {error}") from None
    return data


@contextmanager
def unpack_file(path: Path) -> Iterator[tuple[Path, str]]:
    """Decompress a file that is compressed as a whole: path of the copy, and a sentence about missing data.

    A file that is not compressed gives `path` itself. The copy is deleted after the `with`. Handles that were opened within
    stay valid until they are closed.

    Raises InputError when nothing can be unpacked, OutputError for a full disk, UsageError for storage.
    """
    kind = _kind(path)
    if not kind:
        yield path, ""
        return
    if isinstance(path, RemotePath):
        raise UsageError(f"{path} is compressed as a whole and cannot be read in place from storage: copy it")
    folder = cache_folder("bags")
    if folder is None:
        raise OutputError(f"{path} needs a folder to be unpacked in: name a folder of your own in XDG_CACHE_HOME")
    with tempfile.NamedTemporaryFile(dir=folder, suffix=".unpacked") as target:
        loss = _unpack(path, kind, target)
        target.flush()
        yield Path(target.name), loss


def _kind(path: Path) -> str:
    """Compression of a file by its first bytes. Raises InputError where its name contradicts them."""
    if isinstance(path, RemotePath):
        return packing_of(path)
    with input_errors(path), path.open("rb") as stream:
        head = stream.read(8)
    kind = next((kind for magic, kind in _PACKED_MAGIC.items() if head.startswith(magic)), "")
    if not kind and (packing := packing_of(path)):
        fact = f"begins with {head!r}" if head else "has 0 bytes"
        raise InputError(f"{path} is not compressed by {packing} as its name says: it {fact}")
    return kind


def _unpack(path: Path, kind: str, target: Any) -> str:
    """Decompress `path` of the compression `kind` into `target`; returns a sentence on missing data, empty if complete.

    Raises InputError for data that are damaged from the begin or expand suspiciously, OutputError for a full disk.
    """
    size, most = 0, max(_MOST * path.stat().st_size, _LEAST)
    library = zstd() if kind == "zstd" else import_module(_LIBRARIES[kind])
    try:
        with library.open(path, "rb") as source:
            while data := source.read1(_BLOCK):
                size += len(data)
                if size > most:
                    raise InputError(f"{path} unpacks to more than {_MOST} times its size: it is no recording")
                try:
                    target.write(data)
                except OSError as error:
                    raise OutputError(f"{path} cannot be unpacked into {target.name}: {cause(error)}") from None
    except (EOFError, ValueError, RuntimeError, OSError, lzma.LZMAError, zlib_error, zstd().ZstdError) as error:
        if not size:
            raise InputError(f"{path} cannot be unpacked: {error}") from None
        return f"{path} is damaged or cut off: {size} bytes before that are unpacked ({error})"
    return ""
