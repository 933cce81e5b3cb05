"""What ROS 1 bags and MCAP files share: records in chunks, indexed by walking over them.

No summary is needed, so recordings that were cut off or never indexed read as far as they are whole.
"""

from __future__ import annotations

import struct
from abc import ABC, abstractmethod
from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, ClassVar, NamedTuple

import numpy as np
from numpy.typing import NDArray

from lslam.core.errors import InputError
from lslam.io.formats.bag_chunks import IN_FILE, PACKED_BLOCK, Chunk, ChunkFile, CutOffError, Topic

# What reading a damaged record ends in.
READ_ERRORS = (CutOffError, struct.error, LookupError, ValueError, OverflowError)
_HEAD = 1 << 12  # bytes that hold the headers of a record and of its message
INDICES = 8192  # bytes of the indices of a chunk, about
_COMPRESSIONS = ("", "bz2", "lz4", "zstd")
Rows = NDArray[np.int64]


class Record(NamedTuple):
    """A record: its kind, what precedes its data as the format has it, and offset and size of the data."""

    op: int
    head: Any
    data: int
    size: int

    @property
    def end(self) -> int:
        """Offset of the next record."""
        return self.data + self.size


class ChunkedBag(ABC):
    """One file: `topics`, and `loss`, a sentence when it was cut off. Record kinds have numbers (`op`).

    NAMES : records that name channels; FOOTER : the last record, 0 in a format without one
    """

    MAGIC: ClassVar[bytes]
    MESSAGE: ClassVar[int]
    INDEX: ClassVar[int]
    CHUNK: ClassVar[int]
    CHUNK_INFO: ClassVar[int]
    NAMES: ClassVar[tuple[int, ...]]
    FOOTER: ClassVar[int] = 0

    def __init__(self, path: Path, copy: Path | None = None) -> None:
        """Open `path`, or its decompressed copy if there is one. Raises InputError for another format."""
        self.path, self.loss = path, ""
        self._file = ChunkFile(path, copy)
        self._chunks: list[Chunk] = []
        self._pieces: dict[int, list[Rows]] = defaultdict(list)  # by channel: stamps, chunk numbers, offsets
        head = self._file.part(None, 0, len(self.MAGIC))
        if len(head) < len(self.MAGIC):
            raise InputError(f"{path} is {self._misnomer(b'')}: it has {self._file.size} bytes")
        if head != self.MAGIC:
            raise InputError(f"{path} is {self._misnomer(head)}: it begins with {head[:12]!r}")
        self._file.expect(self._beside_messages)
        self._walk()
        self._find_missing_names()
        named = self._empty_topics()
        self.topics = [named[channel] for channel in sorted(named)]
        for channel, topic in named.items():
            if channel in self._pieces:
                rows = np.concatenate(self._pieces[channel])
                rows = rows[np.argsort(rows[:, 0], kind="stable")]
                topic.stamps_ns, topic.where = rows[:, 0].copy(), rows[:, 1:].copy()

    def read(self, topic: Topic, k: int, limit: int | None = None) -> bytes:
        """Bytes of message `k` of `topic`, or at least the first `limit`; raises InputError when damaged or cut off."""
        number, offset = (int(v) for v in topic.where[k])
        chunk, is_head = None if number == IN_FILE else self._chunks[number], limit is not None
        try:
            record = self._record(chunk, offset, is_head)
            while record.op in self.NAMES:  # indices may point at the name that comes before
                record = self._record(chunk, record.end, is_head)
            size = record.size if limit is None else min(limit, record.size)
            data = self._file.part(chunk, record.data, size, is_head)
            if record.op != self.MESSAGE or len(data) < size:
                raise CutOffError
        except READ_ERRORS:
            raise InputError(f"{self.path}: message {k} of {topic.name} is damaged") from None
        return data

    def expect(self, topic: Topic, is_head: bool) -> None:
        """Announce that all messages of `topic`, or only their beginnings, will be read next."""

        def places() -> Iterator[tuple[int, int]]:
            for number, offset in topic.where.tolist():
                chunk = Chunk(0, 0, 0) if number == IN_FILE else self._chunks[number]
                if chunk.compression:
                    yield chunk.position, min(PACKED_BLOCK, chunk.size) if is_head else chunk.size
                else:
                    yield chunk.position + offset, _HEAD

        self._file.expect(places)

    @abstractmethod
    def _misnomer(self, head: bytes) -> str:
        """Description of a file whose first bytes are of another format."""

    @abstractmethod
    def _record(self, chunk: Chunk | None, offset: int, is_head: bool = False) -> Record:
        """The record at `offset` of a chunk, or of the file."""

    @abstractmethod
    def _summary(self) -> int:
        """Offset of the summary as the file states it; 0 where it has none."""

    @abstractmethod
    def _near(self, info: Record) -> list[tuple[int, int]]:
        """Position and size of the records next to a chunk that the walk reads, as the summary states them."""

    @abstractmethod
    def _chunk(self, record: Record) -> Chunk:
        """Chunk that a record describes."""

    @abstractmethod
    def _index(self, record: Record) -> tuple[int, NDArray[np.unsignedinteger[Any]]]:
        """Channel of an index record, and (N, 2) stamps and offsets of that channel's messages in the preceding chunk."""

    @abstractmethod
    def _message(self, record: Record) -> tuple[int, int]:
        """Channel and stamp of a message."""

    @abstractmethod
    def _note_name(self, record: Record, data: bytes) -> None:
        """Store the channel, type and encoding that a record of `NAMES` states."""

    @abstractmethod
    def _empty_topics(self) -> dict[int, Topic]:
        """An empty topic for each channel whose name is known."""

    def _beside_messages(self) -> Iterator[tuple[int, int]]:
        """Positions and sizes of the records between the chunks, by the summary: those that `_walk` will read."""
        position, size = self._summary(), self._file.size
        self._file.expect(lambda: [(position, size - position)] if position else [])
        while 0 < position < size:
            record = self._record(None, position)
            if record.op == self.CHUNK_INFO:
                yield from self._near(record)
            position = size if record.op == self.FOOTER else record.end

    def _walk(self) -> None:
        """Collect names, chunks and indices by walking over the records; stop at the first incomplete one."""
        position, size = len(self.MAGIC), self._file.size
        unindexed: int | None = None  # the chunk that no index has followed yet
        loose: dict[int, list[tuple[int, int]]] = defaultdict(list)
        while position < size or self.FOOTER:
            try:
                record = self._record(None, position)
                if record.op != self.INDEX or record.end > size:
                    self._index_by_hand(unindexed)
                unindexed = None
                if record.end > size:
                    position = self._salvage(record, position)
                    raise CutOffError
                if record.op == self.FOOTER:
                    break
                if record.op == self.CHUNK:
                    unindexed = self._add_chunk(self._chunk(record))
                elif record.op == self.INDEX:
                    if self._chunks:
                        self._add(len(self._chunks) - 1, dict([self._index(record)]))
                elif record.op == self.MESSAGE:
                    channel, stamp = self._message(record)
                    loose[channel].append((stamp, position))
                elif record.op in self.NAMES:
                    self._note_name(record, self._file.part(None, record.data, record.size))
            except READ_ERRORS:
                lost = size - position
                self.loss = (
                    f"{self.path} is cut off: the last {lost} of its {size} bytes ({lost / size:.1%}) hold no whole "
                    "record and are lost, everything before is read"
                )
                break
            position = record.end
        self._index_by_hand(unindexed)
        self._add(IN_FILE, loose)

    def _salvage(self, record: Record, position: int) -> int:
        """Collect the complete messages of an uncompressed chunk that was cut off. Returns the end of the last one."""
        chunk = self._chunk(record) if record.op == self.CHUNK else None
        if chunk is None or chunk.compression:
            return position
        left = self._file.size - chunk.position
        return chunk.position + self._index_by_hand(self._add_chunk(replace(chunk, size=left, length=left)))

    def _add_chunk(self, chunk: Chunk) -> int:
        """Add a chunk and return its number. Raises InputError for an unknown compression."""
        if chunk.compression not in _COMPRESSIONS:
            known = "bz2, lz4 and zstd are"
            raise InputError(f"{self.path}: compression {chunk.compression!r} of its chunks is not known: {known}")
        self._chunks.append(chunk)
        return len(self._chunks) - 1

    def _add(self, chunk: int, messages: Mapping[int, Any]) -> None:
        """Add the messages of a chunk: stamps and offsets, (N, 2), by channel."""
        for channel, rows in messages.items():
            if len(rows):
                table = np.full((len(rows), 3), chunk, np.int64)
                table[:, ::2] = np.asarray(rows, np.uint64)
                self._pieces[channel].append(table)

    def _index_by_hand(self, number: int | None) -> int:
        """Collect the messages of a chunk without an index by reading it. Returns the end of the last record."""
        if number is None:
            return 0
        messages: dict[int, list[tuple[int, int]]] = defaultdict(list)

        def note(record: Record, offset: int) -> None:
            if record.op == self.MESSAGE and record.size >= 0:
                channel, stamp = self._message(record)
                messages[channel].append((stamp, offset))

        end = self._each_record(self._chunks[number], note)
        self._add(number, messages)
        return end

    def _find_missing_names(self) -> None:
        """Look up channels without a name in the summary and, if the end of the file is lost, in the chunks."""
        for channel, pieces in self._pieces.items():
            for number in range(int(pieces[0][0, 1]), -1, -1):
                topic = self._empty_topics().get(channel)
                if topic is not None and topic.type:
                    break
                chunk = self._chunks[number]

                def note(record: Record, offset: int, chunk: Chunk = chunk) -> None:
                    if record.op in self.NAMES:
                        self._note_name(record, self._file.part(chunk, record.data, record.size))

                self._each_record(chunk, note)

    def _each_record(self, chunk: Chunk, use: Callable[[Record, int], None]) -> int:
        """Call `use` on the records of a chunk and their offsets until one is damaged. Returns the end of the last intact one."""
        offset = 0
        try:
            while offset < chunk.length:
                record = self._record(chunk, offset)
                if record.end > chunk.length:
                    raise CutOffError
                use(record, offset)
                offset = record.end
        except (InputError, *READ_ERRORS):
            damage = f"{self.path}: the chunk at byte {chunk.position} is damaged and its messages are lost"
            self.loss = self.loss or damage
        return offset
