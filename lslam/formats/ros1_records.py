"""ROS 1 bags (`#ROSBAG V2.0`), indexed by walking over their records: cut off and never indexed ones read as well."""

from __future__ import annotations

import struct
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from lslam.errors import InputError
from lslam.formats.bag_chunks import (
    Chunk,
    ChunkFile,
    CutOffError,
    Pairs,
    Topic,
    check_compression,
    describe_loss,
    gather,
)

MAGIC = b"#ROSBAG V2.0\n"
_MESSAGE, _INDEX, _CHUNK, _CHUNK_INFO, _CONNECTION = 2, 4, 5, 6, 7
_BROKEN = (CutOffError, struct.error, LookupError, ValueError)  # what reading a damaged record ends in
_INDICES = 8192  # of the indices of a chunk, about
_HEADER = 4096  # more than any record header but one with a message definition


class _Record(NamedTuple):
    op: int
    fields: dict[bytes, bytes]
    data: int  # offset of its data
    size: int

    @property
    def end(self) -> int:
        return self.data + self.size


class Ros1Bag:
    """One `.bag` file: `topics`, and `loss`, a sentence when it was cut off."""

    def __init__(self, path: Path, unpacked: Path | None = None) -> None:
        """Open `path`, or what it holds, where it was unpacked."""
        self.path = path
        self._file = ChunkFile(path, unpacked)
        self._chunks: list[Chunk] = []
        self._connections: dict[int, Topic] = {}
        self._pieces: dict[int, tuple[list[NDArray[np.int64]], list[Pairs]]] = {}
        self.loss = ""
        self._check_magic()
        self._file.expect(self._indexed)
        self._walk()
        self._find_missing_connections()
        for number, (stamps, where) in self._pieces.items():
            if number in self._connections:
                gather(self._connections[number], stamps, where)
        self.topics = list(self._connections.values())

    def read(self, topic: Topic, k: int, limit: int | None = None) -> bytes:
        """Message `k` of `topic`, its first `limit` bytes at the least when only these are wanted."""
        number, offset = (int(v) for v in topic.where[k])
        chunk = self._chunks[number]
        try:
            is_head = limit is not None
            record = self._record(chunk, offset, is_head)
            while record.op == _CONNECTION:  # indices may point at the connection that comes before
                record = self._record(chunk, record.end, is_head)
            size = record.size if limit is None else min(limit, record.size)
            data = self._file.part(chunk, record.data, size, is_head)
            if record.op != _MESSAGE or len(data) < size:
                raise CutOffError
            return data
        except _BROKEN:
            raise InputError(f"{self.path}: message {k} of {topic.name} is damaged") from None

    def _check_magic(self) -> None:
        try:
            magic = self._file.read(0, len(MAGIC))
        except CutOffError:
            raise InputError(f"{self.path} is no ROS 1 bag: it has {self._file.size} bytes") from None
        if magic != MAGIC:
            old = "an old version, `rosbag fix` brings it to 2.0" if magic.startswith(b"#ROSBAG") else "no ROS 1 bag"
            raise InputError(f"{self.path} is {old}: it begins with {magic[:12]!r}")

    def expect(self, topic: Topic, is_head: bool) -> None:
        """All messages of `topic` will be read next, or no more than their beginnings."""
        self._file.expect_messages(self._chunks, topic.where, is_head)

    def _indexed(self) -> Iterator[tuple[int, int]]:
        """Where the index at the end of the file says that chunks begin, before which the indices of others lie."""
        (position,) = struct.unpack("<Q", self._record(None, len(MAGIC)).fields[b"index_pos"])
        size = self._file.size
        if position:
            self._file.expect(lambda: [(position, size - position)])
        while 0 < position < size:
            record = self._record(None, position)
            if record.op == _CHUNK_INFO:
                (start,) = struct.unpack("<Q", record.fields[b"chunk_pos"])
                yield start - _INDICES, _INDICES + _HEADER
            position = record.end

    def _walk(self) -> None:
        """Note chunks, connections and indices; stop where a record is not whole."""
        position, size = len(MAGIC), self._file.size
        unindexed: int | None = None  # the chunk that no index has followed yet
        while position < size:
            try:
                record = self._record(None, position)
                if record.end > size:
                    position = self._salvage(record, position)
                    raise CutOffError
                if record.op == _CHUNK:
                    self._index_by_hand(unindexed)
                    unindexed = self._add_chunk(record)
                elif record.op == _INDEX:
                    self._add_index(record)
                    unindexed = None
                elif record.op == _CONNECTION:
                    self._add_connection(None, record)
            except _BROKEN:
                self.loss = describe_loss(self.path, position, size)
                break
            position = record.end
        self._index_by_hand(unindexed)

    def _salvage(self, record: _Record, position: int) -> int:
        """Note the whole messages of a chunk that was cut off, where it is not compressed; the end of the last one."""
        if record.op != _CHUNK or record.fields[b"compression"] != b"none":
            return position
        kept = self._file.size - record.data
        self._chunks.append(Chunk(record.data, kept, kept))
        return record.data + self._index_by_hand(len(self._chunks) - 1)

    def _record(self, chunk: Chunk | None, offset: int, is_head: bool = False) -> _Record:
        head = self._file.part(chunk, offset, _HEADER, is_head)
        (length,) = struct.unpack_from("<I", head)
        if length + 8 > len(head):
            head = self._file.part(chunk, offset, length + 8, is_head)
        fields = _fields(head[4 : 4 + length])
        (size,) = struct.unpack_from("<I", head, 4 + length)
        return _Record(fields[b"op"][0], fields, offset + length + 8, size)

    def _add_chunk(self, record: _Record) -> int:
        compression = record.fields[b"compression"].decode(errors="replace").replace("none", "")
        check_compression(self.path, compression)
        self._chunks.append(Chunk(record.data, record.size, _u32(record.fields[b"size"]), compression))
        return len(self._chunks) - 1

    def _add_index(self, record: _Record) -> None:
        entries = np.frombuffer(self._file.read(record.data, record.size), "<u4").reshape(-1, 3).astype(np.int64)
        self._add(_u32(record.fields[b"conn"]), entries[:, 0] * 10**9 + entries[:, 1], entries[:, 2])

    def _add(self, connection: int, stamps: NDArray[np.int64], offsets: NDArray[np.int64]) -> None:
        if not self._chunks:
            return  # an index of nothing
        pieces = self._pieces.setdefault(connection, ([], []))
        pieces[0].append(stamps)
        pieces[1].append(np.column_stack([np.full(len(offsets), len(self._chunks) - 1, np.int64), offsets]))

    def _add_connection(self, chunk: Chunk | None, record: _Record) -> None:
        number = _u32(record.fields[b"conn"])
        inner = _fields(self._file.part(chunk, record.data, record.size))
        package, _, name = inner.get(b"type", b"").decode(errors="replace").partition("/")
        self._connections.setdefault(
            number,
            Topic(record.fields[b"topic"].decode(errors="replace"), f"{package}/msg/{name}" if name else "", "ros1"),
        )

    def _index_by_hand(self, number: int | None) -> int:
        """Note the messages of a chunk that has no index, because the recorder was stopped before; the end of the last."""
        if number is None:
            return 0
        found: dict[int, tuple[list[int], list[int]]] = {}

        def note(record: _Record, offset: int) -> None:
            if record.op == _MESSAGE:
                seconds, nanoseconds = struct.unpack("<II", record.fields[b"time"])
                stamps, offsets = found.setdefault(_u32(record.fields[b"conn"]), ([], []))
                stamps.append(seconds * 10**9 + nanoseconds)
                offsets.append(offset)

        end = self._each_record(self._chunks[number], note)
        for connection, (stamps, offsets) in found.items():
            self._add(connection, np.array(stamps, np.int64), np.array(offsets, np.int64))
        return end

    def _find_missing_connections(self) -> None:
        """Connections stand at the end of the file and, where the end is lost, in the chunk of their first message."""
        for number, (_, where) in self._pieces.items():
            if number in self._connections or not where:
                continue
            chunk = self._chunks[int(where[0][0, 0])]

            def add(record: _Record, offset: int, chunk: Chunk = chunk) -> None:
                if record.op == _CONNECTION:
                    self._add_connection(chunk, record)

            self._each_record(chunk, add)

    def _each_record(self, chunk: Chunk, use: Callable[[_Record, int], None]) -> int:
        """Hand the records of a chunk and their offsets to `use` until one is damaged; the end of the last that was not."""
        offset = 0
        try:
            while offset < chunk.length:
                record = self._record(chunk, offset)
                if record.end > chunk.length:
                    raise CutOffError
                use(record, offset)
                offset = record.end
        except (InputError, *_BROKEN):
            self.loss = (
                self.loss or f"{self.path}: the chunk at byte {chunk.position} is damaged and its messages are lost"
            )
        return offset


def _fields(block: bytes) -> dict[bytes, bytes]:
    """The `name=value` fields of a record header."""
    fields, at = {}, 0
    while at < len(block):
        (n,) = struct.unpack_from("<I", block, at)
        name, _, value = block[at + 4 : at + 4 + n].partition(b"=")
        fields[name] = value
        at += 4 + n
    return fields


def _u32(value: bytes) -> int:
    (number,) = struct.unpack("<I", value)
    return int(number)
