"""Bags with records in chunks: ROS 1 bags (`#ROSBAG V2.0`) and MCAP files."""

from __future__ import annotations

import sqlite3
import struct
import threading
from pathlib import Path
from typing import Any
from urllib.parse import quote

import numpy as np
from numpy.typing import NDArray

from lslam.core.errors import InputError, UsageError
from lslam.io.formats.bag_chunks import Chunk, Topic
from lslam.io.formats.bag_records import INDICES, ChunkedBag, Record
from lslam.io.remote import RemotePath

# Of MCAP.
_SCHEMA, _CHANNEL = 3, 4
_FOOTER_SIZE = 29  # bytes of the record, its prefix included
_PREFIX = 9  # bytes before the content of a record: op and length
_STAMPS = 22  # bytes before the data of a message: channel, sequence, log time, publish time
_CHUNK_HEAD = 64  # more than what stands before the records of a chunk
_HEADER = 4096  # of ROS 1: more than any record header but one with a message definition
_TABLES = {"topics", "messages"}


class Ros1Bag(ChunkedBag):
    """One `.bag` file. The head of a record is its fields by name; channels are called connections."""

    MAGIC = b"#ROSBAG V2.0\n"
    MESSAGE, INDEX, CHUNK, CHUNK_INFO, NAMES = 2, 4, 5, 6, (7,)

    def __init__(self, path: Path, copy: Path | None = None) -> None:
        """Open `path`, or what it holds, where it was unpacked."""
        self._connections: dict[int, Topic] = {}
        super().__init__(path, copy)

    def _misnomer(self, head: bytes) -> str:
        """Reason, for a message, why a file with these first bytes is none of this format."""
        is_old = head.startswith(b"#ROSBAG")
        return "an old version, `rosbag fix` brings it to 2.0" if is_old else "no ROS 1 bag"

    def _record(self, chunk: Chunk | None, offset: int, is_head: bool = False) -> Record:
        """The record at `offset` of a chunk (None: of the file), with its header fields by name."""
        head = self._file.part(chunk, offset, _HEADER, is_head)
        (length,) = struct.unpack_from("<I", head)
        if length + 8 > len(head):
            head = self._file.part(chunk, offset, length + 8, is_head)
        fields = _fields(head[4 : 4 + length])
        (size,) = struct.unpack_from("<I", head, 4 + length)
        return Record(fields[b"op"][0], fields, offset + length + 8, size)

    def _summary(self) -> int:
        """Position of the summary in the file; 0 without one."""
        return _number(self._record(None, len(self.MAGIC)).head[b"index_pos"])

    def _near(self, info: Record) -> list[tuple[int, int]]:
        # Before a chunk lie the indices of the one before.
        """Ranges (position, size) to read about a chunk: its head and the indices beside it; info : its record in the summary."""
        return [(_number(info.head[b"chunk_pos"]) - INDICES, INDICES + _HEADER)]

    def _chunk(self, record: Record) -> Chunk:
        """The chunk that a chunk record describes."""
        compression = record.head[b"compression"].decode(errors="replace").replace("none", "")
        return Chunk(record.data, record.size, _number(record.head[b"size"]), compression)

    def _index(self, record: Record) -> tuple[int, NDArray[np.unsignedinteger[Any]]]:
        """Channel of an index record, and stamps (ns) and offsets (N, 2) of its messages."""
        entries = np.frombuffer(self._file.read(record.data, record.size), "<u4").reshape(-1, 3).astype(np.uint64)
        stamps = entries[:, 0] * 10**9 + entries[:, 1]
        return _number(record.head[b"conn"]), np.column_stack([stamps, entries[:, 2]])

    def _message(self, record: Record) -> tuple[int, int]:
        """Channel and stamp (ns) of a message record."""
        seconds, nanoseconds = struct.unpack("<II", record.head[b"time"])
        return _number(record.head[b"conn"]), seconds * 10**9 + nanoseconds

    def _note_name(self, record: Record, data: bytes) -> None:
        """Store the topic of a connection record under its number."""
        package, _, name = _fields(data).get(b"type", b"").decode(errors="replace").partition("/")
        kind = f"{package}/msg/{name}" if name else ""
        topic = Topic(record.head[b"topic"].decode(errors="replace"), kind, "ros1")
        self._connections.setdefault(_number(record.head[b"conn"]), topic)

    def _empty_topics(self) -> dict[int, Topic]:
        """Topics by channel, their messages not added yet."""
        return self._connections


def _fields(block: bytes) -> dict[bytes, bytes]:
    """Fields `name=value` of a record header, as bytes by name."""
    fields, at = {}, 0
    while at < len(block):
        (n,) = struct.unpack_from("<I", block, at)
        name, _, value = block[at + 4 : at + 4 + n].partition(b"=")
        fields[name] = value
        at += 4 + n
    return fields


def _number(value: bytes) -> int:
    """Integer in a field of 4 or 8 bytes."""
    (number,) = struct.unpack("<Q" if len(value) == 8 else "<I", value)
    return int(number)


class McapFile(ChunkedBag):
    """One `.mcap` file. The head of a record is the first bytes of its content, of a message all that is not data."""

    MAGIC = b"\x89MCAP0\r\n"
    MESSAGE, INDEX, CHUNK, CHUNK_INFO, NAMES, FOOTER = 5, 7, 6, 8, (_SCHEMA, _CHANNEL), 2

    def __init__(self, path: Path, copy: Path | None = None) -> None:
        """Open `path`, or what it holds, where it was unpacked."""
        self._schemas: dict[int, str] = {}
        self._channels: dict[int, tuple[int, str, str]] = {}
        super().__init__(path, copy)

    def _misnomer(self, head: bytes) -> str:
        """Reason, for a message, why a file with these first bytes is none of this format."""
        return "no MCAP file"

    def _record(self, chunk: Chunk | None, offset: int, is_head: bool = False) -> Record:
        """The record at `offset` of a chunk (None: of the file); is_head : only the beginnings of messages will be read."""
        head = self._file.part(chunk, offset, _PREFIX + _STAMPS, is_head)
        op, length = struct.unpack_from("<BQ", head)
        before = _STAMPS if op == self.MESSAGE else 0
        return Record(op, head[_PREFIX:], offset + _PREFIX + before, length - before)

    def _summary(self) -> int:
        """Position of the summary in the file; 0 without one."""
        footer = self._file.size - len(self.MAGIC) - _FOOTER_SIZE
        return int(struct.unpack_from("<Q", self._file.read(footer, _FOOTER_SIZE), _PREFIX)[0])

    def _near(self, info: Record) -> list[tuple[int, int]]:
        """Ranges (position, size) to read about a chunk: its head and the indices behind it; info : its record in the summary."""
        start, size = struct.unpack_from("<2Q", self._file.read(info.data, info.size), 16)
        return [(start, _CHUNK_HEAD), (start + size, INDICES)]

    def _chunk(self, record: Record) -> Chunk:
        """The chunk that a chunk record describes."""
        head = self._file.part(None, record.data, _CHUNK_HEAD)
        _, _, length, crc = struct.unpack_from("<QQQI", head)
        compression, at = _text(head, 28)
        (size,) = struct.unpack_from("<Q", head, at)
        return Chunk(record.data + at + 8, size, length, compression, crc)

    def _index(self, record: Record) -> tuple[int, NDArray[np.unsignedinteger[Any]]]:
        """Channel of an index record, and stamps (ns) and offsets (N, 2) of its messages."""
        data = self._file.read(record.data, record.size)
        return int.from_bytes(data[:2], "little"), np.frombuffer(data, "<u8", offset=6).reshape(-1, 2)

    def _message(self, record: Record) -> tuple[int, int]:
        """Channel and stamp (ns) of a message record."""
        channel, _, stamp = struct.unpack_from("<HIQ", record.head)
        return channel, stamp

    def _note_name(self, record: Record, data: bytes) -> None:
        """Store the schema or channel that the record defines, by its number."""
        (number,) = struct.unpack_from("<H", data)
        if record.op == _SCHEMA:
            self._schemas[number] = _text(data, 2)[0]
            return
        (schema,) = struct.unpack_from("<H", data, 2)
        name, at = _text(data, 4)
        self._channels[number] = (schema, name, _text(data, at)[0])

    def _empty_topics(self) -> dict[int, Topic]:
        """Topics by channel, their messages not added yet."""
        return {
            channel: Topic(name, _type(self._schemas.get(schema, "")), encoding)
            for channel, (schema, name, encoding) in self._channels.items()
        }


def _type(name: str) -> str:
    """Message type spelled as ROS 2 does; MCAP files may hold messages of ROS 1."""
    return name.replace("/", "/msg/") if name.count("/") == 1 else name


def _text(data: bytes, at: int) -> tuple[str, int]:
    """A text preceded by its length, at byte `at`, and the byte behind it."""
    (length,) = struct.unpack_from("<I", data, at)
    end = at + 4 + length
    return data[at + 4 : end].decode(errors="replace"), end


class SqliteBag:
    """One `.db3` file: `topics`, and `loss`, a sentence when it was cut off."""

    def __init__(self, path: Path, copy: Path | None = None) -> None:
        """Open `path` or its decompressed copy. Raises InputError when damaged, UsageError in object storage."""
        if isinstance(path, RemotePath):
            raise UsageError(
                f"{path}: SQLite cannot be read in place from storage; *.mcap and *.bag are: `lslam convert` makes an MCAP file "
                "of a copy, or run the copy"
            )
        self.path, self._on_disk = path, copy or path
        self.loss = ""
        self._lock = threading.Lock()
        try:
            # Nothing is written beside the file, neither a lock nor a journal.
            self._db = sqlite3.connect(
                f"file:{quote(str(self._on_disk.resolve()))}?immutable=1", uri=True, check_same_thread=False
            )
            # SQLite then opens files that are shorter than their header says; nothing can be changed all the same.
            self._db.execute("PRAGMA writable_schema = ON")
            names = {str(name) for (name,) in self._db.execute("SELECT name FROM sqlite_master WHERE type = 'table'")}
            if not names >= _TABLES:
                raise InputError(f"{path} is no ROS 2 bag: its tables are {', '.join(sorted(names)) or 'none'}")
            rows = self._db.execute("SELECT id, name, type, serialization_format FROM topics ORDER BY id").fetchall()
        except sqlite3.Error as error:
            raise InputError(f"{path} cannot be read as a ROS 2 bag in SQLite: {error}") from None
        self._topics = {
            number: Topic(_word(name), _word(kind), _word(encoding)) for number, name, kind, encoding in rows
        }
        self._index()
        self.topics = list(self._topics.values())
        if path.with_name(path.name + "-wal").is_file():
            self.loss = self.loss or f"{path}-wal holds messages that were never merged: `ros2 bag reindex` does that"

    def expect(self, topic: Topic, is_head: bool) -> None:
        """Do nothing: a file on a disk needs no prefetching."""

    def read(self, topic: Topic, k: int, limit: int | None = None) -> bytes:
        """Bytes of message `k` of `topic`, or at least the first `limit`; raises InputError when damaged."""
        row = int(topic.where[k, 0])
        try:
            with self._lock, self._db.blobopen("messages", "data", row, readonly=True) as blob:
                return blob.read(-1 if limit is None else limit)
        except sqlite3.Error as error:
            raise InputError(f"{self.path}: message {k} of {topic.name} is damaged: {error}") from None

    def _index(self) -> None:
        """Read stamps and row numbers of all messages; the data itself stays on disk."""
        entries_of: dict[int, list[tuple[int, int]]] = {number: [] for number in self._topics}
        try:
            for row, topic, stamp in self._db.execute("SELECT id, topic_id, timestamp FROM messages ORDER BY id"):
                if topic in entries_of and isinstance(stamp, int) and isinstance(row, int):
                    entries_of[topic].append((stamp, row))
        except sqlite3.Error as error:
            self.loss = (
                f"{self.path} is damaged ({error}): {sum(map(len, entries_of.values()))} messages up to there are read"
            )
        size, stated = self._sizes()
        if size < stated:
            self.loss = (
                f"{self.path} is cut off: it has {size} of {stated} bytes, {(stated - size) / stated:.1%} are lost; "
                f"{sum(map(len, entries_of.values()))} messages are listed, those that reach beyond the cut cannot be read"
            )
        for number, entries in entries_of.items():
            table = np.array(sorted(entries), np.int64).reshape(-1, 2)
            self._topics[number].stamps_ns = table[:, 0].copy()
            self._topics[number].where = np.column_stack([table[:, 1], np.zeros(len(table), np.int64)])

    def _sizes(self) -> tuple[int, int]:
        """Size of the file and the size that its header states, bytes (SQLite's file format, 1.3)."""
        with self._on_disk.open("rb") as file:
            header = file.read(100)
        page, pages = int.from_bytes(header[16:18], "big"), int.from_bytes(header[28:32], "big")
        return self._on_disk.stat().st_size, pages * (65536 if page == 1 else page)


def _word(value: object) -> str:
    """Text of a column; empty if it holds something else."""
    return value if isinstance(value, str) else ""
