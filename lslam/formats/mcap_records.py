"""MCAP files, indexed by walking over their records: no summary is needed, so those that were cut off read as well."""

from __future__ import annotations

import struct
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from lslam.errors import InputError
from lslam.formats.bag_chunks import (
    IN_FILE,
    Chunk,
    ChunkFile,
    CutOffError,
    Pairs,
    Topic,
    check_compression,
    describe_loss,
    gather,
)

MAGIC = b"\x89MCAP0\r\n"
_FOOTER, _SCHEMA, _CHANNEL, _MESSAGE, _CHUNK, _INDEX, _CHUNK_INDEX = 2, 3, 4, 5, 6, 7, 8
_FOOTER_SIZE = 29  # bytes of the record, its prefix included
_INDICES = 8192  # of the indices of a chunk, about
_PREFIX = 9  # bytes before the content of a record: op and length
_STAMPS = 22  # bytes before the data of a message: channel, sequence, log time, publish time


class McapFile:
    """One `.mcap` file: `topics`, and `loss`, a sentence when it was cut off."""

    def __init__(self, path: Path, unpacked: Path | None = None) -> None:
        """Open `path`, or what it holds, where it was unpacked."""
        self.path = path
        self._file = ChunkFile(path, unpacked)
        self._chunks: list[Chunk] = []
        self._schemas: dict[int, str] = {}
        self._channels: dict[int, tuple[int, str, str]] = {}
        self._pieces: dict[int, tuple[list[NDArray[np.int64]], list[Pairs]]] = {}
        self._loose: dict[int, tuple[list[int], list[int]]] = {}  # messages outside chunks
        self.loss = ""
        self._check_magic()
        self._file.expect(self._indexed)
        self._walk()
        for channel, (stamps, offsets) in self._loose.items():
            self._add(channel, IN_FILE, np.array(stamps, np.uint64).astype(np.int64), np.array(offsets, np.int64))
        self._find_missing_channels()
        self.topics = [self._topic(number) for number in sorted(self._channels)]

    def read(self, topic: Topic, k: int, limit: int | None = None) -> bytes:
        """Message `k` of `topic`, its first `limit` bytes at the least when only these are wanted."""
        number, offset = (int(v) for v in topic.where[k])
        chunk = None if number == IN_FILE else self._chunks[number]
        try:
            is_head = limit is not None
            op, length = struct.unpack("<BQ", self._file.part(chunk, offset, _PREFIX, is_head))
            if op != _MESSAGE:
                raise CutOffError
            size = length - _STAMPS if limit is None else min(limit, length - _STAMPS)
            data = self._file.part(chunk, offset + _PREFIX + _STAMPS, size, is_head)
            if len(data) < size:
                raise CutOffError
        except (CutOffError, struct.error):
            raise InputError(f"{self.path}: message {k} of {topic.name} is damaged") from None
        return data

    def _check_magic(self) -> None:
        try:
            magic = self._file.read(0, len(MAGIC))
        except CutOffError:
            raise InputError(f"{self.path} is no MCAP file: it has {self._file.size} bytes") from None
        if magic != MAGIC:
            raise InputError(f"{self.path} is no MCAP file: it begins with {magic!r}")

    def expect(self, topic: Topic, is_head: bool) -> None:
        """All messages of `topic` will be read next, or no more than their beginnings."""
        self._file.expect_messages(self._chunks, topic.where, is_head)

    def _indexed(self) -> Iterator[tuple[int, int]]:
        """Where the summary at the end of the file says that records lie beside the messages: what the walk will read."""
        footer = self._file.size - len(MAGIC) - _FOOTER_SIZE
        (position,) = struct.unpack_from("<Q", self._file.read(footer, _FOOTER_SIZE), _PREFIX)
        end = footer
        self._file.expect(lambda: [(position, end - position)])
        while 0 < position < end:
            op, length = struct.unpack("<BQ", self._file.read(position, _PREFIX))
            if op == _CHUNK_INDEX:
                start, size, *_ = struct.unpack_from("<2Q", self._file.read(position + _PREFIX, length), 16)
                yield start, 64
                yield start + size, _INDICES
            position += _PREFIX + length

    def _walk(self) -> None:
        """Note schemas, channels, chunks and indices; stop where a record is not whole."""
        position, size = len(MAGIC), self._file.size
        unindexed: int | None = None  # the chunk that no index has followed yet
        while True:
            try:
                op, length = struct.unpack("<BQ", self._file.read(position, _PREFIX))
                content = position + _PREFIX
                if content + length > size:
                    self._index_by_hand(unindexed)
                    unindexed = None
                    position = self._salvage(op, content, position)
                    raise CutOffError
                if op != _INDEX:
                    self._index_by_hand(unindexed)
                    unindexed = None
                if op == _FOOTER:
                    return
                if op == _CHUNK:
                    unindexed = self._add_chunk(content, length)
                elif op == _INDEX:
                    self._add_index(content, length)
                    unindexed = None
                elif op == _MESSAGE:
                    channel, _, stamp = struct.unpack("<HIQ", self._file.read(content, 14))
                    self._note(self._loose, channel, stamp, position)
                elif op in (_SCHEMA, _CHANNEL):
                    self._add_names(op, self._file.read(content, length))
            except (CutOffError, struct.error, ValueError):
                self._index_by_hand(unindexed)
                self.loss = describe_loss(self.path, position, size)
                return
            position = content + length

    def _salvage(self, op: int, content: int, position: int) -> int:
        """Note the whole messages of a chunk that was cut off, where it is not compressed; the end of the last one."""
        if op != _CHUNK:
            return position
        number = self._add_chunk(content, self._file.size - content)
        chunk = self._chunks[number]
        if chunk.compression:
            self._chunks.pop()
            return position
        kept = self._file.size - chunk.position
        self._chunks[number] = Chunk(chunk.position, kept, kept)
        return chunk.position + self._index_by_hand(number)

    def _add_chunk(self, position: int, length: int) -> int:
        head = self._file.read(position, min(length, 64))
        _, _, unpacked, crc = struct.unpack_from("<QQQI", head)
        compression, at = _text(head, 28)
        (packed,) = struct.unpack_from("<Q", head, at)
        check_compression(self.path, compression)
        self._chunks.append(Chunk(position + at + 8, packed, unpacked, compression, crc))
        return len(self._chunks) - 1

    def _add_index(self, position: int, length: int) -> None:
        data = self._file.read(position, length)
        (channel,) = struct.unpack_from("<H", data)
        if not self._chunks:
            return  # an index of nothing
        entries = np.frombuffer(data, "<u8", offset=6).reshape(-1, 2).astype(np.int64)
        self._add(channel, len(self._chunks) - 1, entries[:, 0], entries[:, 1])

    def _add(self, channel: int, chunk: int, stamps: NDArray[np.int64], offsets: NDArray[np.int64]) -> None:
        if not len(stamps):
            return
        pieces = self._pieces.setdefault(channel, ([], []))
        pieces[0].append(stamps)
        pieces[1].append(np.column_stack([np.full(len(offsets), chunk, np.int64), offsets]))

    def _add_names(self, op: int, data: bytes) -> None:
        (number,) = struct.unpack_from("<H", data)
        if op == _SCHEMA:
            self._schemas[number] = _text(data, 2)[0]
            return
        (schema,) = struct.unpack_from("<H", data, 2)
        name, at = _text(data, 4)
        self._channels[number] = (schema, name, _text(data, at)[0])

    def _topic(self, channel: int) -> Topic:
        schema, name, encoding = self._channels[channel]
        kind = self._schemas.get(schema, "")
        if kind.count("/") == 1:  # ROS 1 messages in MCAP
            kind = kind.replace("/", "/msg/")
        topic = Topic(name, kind, encoding)
        gather(topic, *self._pieces.get(channel, ([], [])))
        return topic

    def _index_by_hand(self, number: int | None) -> int:
        """Note the messages of a chunk that no index follows; the end of the last record."""
        if number is None:
            return 0
        chunk = self._chunks[number]
        found: dict[int, tuple[list[int], list[int]]] = {}

        def note(op: int, offset: int, length: int) -> None:
            if op == _MESSAGE and length >= _STAMPS:
                channel, _, stamp = struct.unpack("<HIQ", self._file.part(chunk, offset + _PREFIX, 14))
                self._note(found, channel, stamp, offset)

        end = self._each_record(chunk, note)
        for channel, (stamps, offsets) in found.items():
            self._add(channel, number, np.array(stamps, np.uint64).astype(np.int64), np.array(offsets, np.int64))
        return end

    @staticmethod
    def _note(found: dict[int, tuple[list[int], list[int]]], channel: int, stamp: int, offset: int) -> None:
        stamps, offsets = found.setdefault(channel, ([], []))
        stamps.append(stamp)
        offsets.append(offset)

    def _find_missing_channels(self) -> None:
        """Names stand in the summary and, where the end of the file is lost, in the chunks before the first message."""
        for channel, (_, where) in self._pieces.items():
            if channel in self._channels and self._channels[channel][0] in self._schemas:
                continue
            number = int(where[0][0, 0])
            for k in range(number + 1) if number != IN_FILE else ():
                chunk = self._chunks[k]

                def add(op: int, offset: int, length: int, chunk: Chunk = chunk) -> None:
                    if op in (_SCHEMA, _CHANNEL):
                        self._add_names(op, self._file.part(chunk, offset + _PREFIX, length))

                self._each_record(chunk, add)

    def _each_record(self, chunk: Chunk, use: Callable[[int, int, int], None]) -> int:
        """Hand op, offset and length of the records of a chunk to `use` until one is damaged; the end of the last."""
        offset = 0
        try:
            while offset < chunk.length:
                op, length = struct.unpack("<BQ", self._file.part(chunk, offset, _PREFIX))
                if offset + _PREFIX + length > chunk.length:
                    raise CutOffError
                use(op, offset, length)
                offset += _PREFIX + length
        except (InputError, CutOffError, struct.error, ValueError, OverflowError):
            self.loss = (
                self.loss or f"{self.path}: the chunk at byte {chunk.position} is damaged and its messages are lost"
            )
        return offset


def _text(data: bytes, at: int) -> tuple[str, int]:
    (length,) = struct.unpack_from("<I", data, at)
    end = at + 4 + length
    return data[at + 4 : end].decode(errors="replace"), end
