"""Random access to recordings: the index of a topic, and the compressed chunks of ROS 1 bags and MCAP files."""

from __future__ import annotations

import bz2
import contextlib
import os
import struct
import sys
import threading
from bisect import bisect_left
from collections import OrderedDict
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any
from zlib import crc32

import numpy as np
from numpy.typing import NDArray

from lslam.core.arrays import Longs
from lslam.core.errors import InputError, input_errors
from lslam.io.remote import RemotePath

BLOCK = 1 << 15
# Blocks asked for together, and blocks kept: 2 and 8 MB.
_AHEAD, _KEPT = 64, 256
LARGEST = 1 << 29  # bytes of a compressed chunk or message when it is unpacked; recorders make a thousandth of it
PACKED_BLOCK = 1 << 18  # compressed bytes read at a time when only the beginning of a chunk is wanted
IN_FILE = -1  # chunk number of a message that lies in the file itself
Pairs = NDArray[np.int64]


class RangedFile:
    """Bytes of an object in storage, `size` of them, readable from any thread."""

    def __init__(self, path: RemotePath) -> None:
        self.path, self.size = path, path.stat().st_size
        self._blocks: OrderedDict[int, bytes] = OrderedDict()
        self._expected: list[int] = []
        self._lock = threading.Lock()

    def expect(self, ranges: Iterable[tuple[int, int]]) -> None:
        """Announce the (position, size) ranges that will be read next, in any order; earlier announcements are forgotten.

        Each range is prefetched once. A second read of it is a request of its own.
        """
        last = max(self.size - 1, 0) // BLOCK
        numbers = {
            k
            for position, size in ranges
            if size > 0
            for k in range(max(position, 0) // BLOCK, min((position + size - 1) // BLOCK, last) + 1)
        }
        with self._lock:
            self._expected = sorted(numbers)

    def read(self, position: int, size: int) -> bytes:
        """Read `size` bytes from `position`, fewer at the end of the object."""
        size = min(size, self.size - position)
        if size <= 0:
            return b""
        first, last = position // BLOCK, (position + size - 1) // BLOCK
        with self._lock:
            if size >= BLOCK and first not in self._blocks and not self._expected[self._due(first)]:
                return self.path.read_ranges([(position, position + size)])[0]
            data = b"".join(self._block(k, last) for k in range(first, last + 1))
        return data[position - first * BLOCK :][:size]

    def _due(self, number: int) -> slice:
        """Announced blocks to fetch together with this one; none if this one was not announced."""
        at = bisect_left(self._expected, number)
        return slice(at, at + _AHEAD if self._expected[at : at + 1] == [number] else at)

    def _block(self, number: int, last: int) -> bytes:
        """Block `number` of the object; a fetch includes the blocks up to `last` and the announced ones."""
        if number not in self._blocks:
            due = self._due(number)
            wanted = np.array(sorted({*range(number, last + 1), *self._expected[due]} - self._blocks.keys()))
            del self._expected[due]
            runs = np.split(wanted, np.flatnonzero(np.diff(wanted) > 1) + 1)
            while len(self._blocks) > max(_KEPT - len(wanted), 0):
                self._blocks.popitem(last=False)
            parts = self.path.read_ranges([(int(r[0]) * BLOCK, min(int(r[-1] + 1) * BLOCK, self.size)) for r in runs])
            for run, data in zip(runs, parts, strict=True):
                for n, k in enumerate(run.tolist()):
                    self._blocks[k] = data[n * BLOCK : (n + 1) * BLOCK]
        self._blocks.move_to_end(number)
        return self._blocks[number]


class CutOffError(Exception):
    """Raised when a file ends before the data that it should hold."""


@dataclass(frozen=True)
class Chunk:
    """A run of records within a file.

    position, size : of its bytes in the file; length : of its records, once decompressed
    compression : empty, bz2, lz4 or zstd; crc : of the records, 0 when there is none
    """

    position: int
    size: int
    length: int
    compression: str = ""
    crc: int = 0


@dataclass
class Topic:
    """One topic of one file.

    type : as ROS 2 writes it, `sensor_msgs/msg/Imu`; empty when the file does not say
    encoding : how messages are serialised, `cdr` or `ros1`
    stamps_ns : (N,) int64, when they were recorded; where : (N, 2) int64, chunk number and offset, or row number
    """

    name: str
    type: str
    encoding: str
    stamps_ns: Longs = field(default_factory=lambda: np.zeros(0, np.int64))
    where: Pairs = field(default_factory=lambda: np.zeros((0, 2), np.int64))

    def __len__(self) -> int:
        return len(self.stamps_ns)


class ChunkFile:
    """Random access to a file and to its chunks, from any thread; the last decompressed chunk is cached."""

    def __init__(self, path: Path, copy: Path | None = None) -> None:
        """Open `path`, or its decompressed copy `copy` if there is one."""
        self.path = path
        with input_errors(path):
            self._ranged = RangedFile(path) if isinstance(path, RemotePath) else None
            self._file = None if self._ranged else (copy or path).open("rb")
        self.size = os.fstat(self._file.fileno()).st_size if self._file else self._ranged.size if self._ranged else 0
        self._kept: tuple[int, bytes] = (-1, b"")

    def read(self, position: int, size: int) -> bytes:
        """Read `size` bytes from `position`. Raises CutOffError when the file ends before."""
        if size < 0 or position + size > self.size:
            raise CutOffError
        data = self._read(position, size)
        while len(data) < size:  # a signal, or more than the 2 GB one call reads
            more = self._read(position + len(data), size - len(data))
            if not more:
                raise CutOffError
            data += more
        return data

    def _read(self, position: int, size: int) -> bytes:
        """Read `size` bytes from `position` of the file on disk or in storage, fewer at its end."""
        if self._ranged:
            return self._ranged.read(position, size)
        assert self._file is not None
        return os.pread(self._file.fileno(), size, position)

    def expect(self, ranges: Callable[[], Iterable[tuple[int, int]]]) -> None:
        """Announce the (position, size) ranges of a file in storage that will be read next, as `RangedFile.expect`.

        It is only a hint, so wrong positions raise no error here.
        """
        if self._ranged:
            with contextlib.suppress(CutOffError, struct.error, LookupError, ValueError, InputError):
                self._ranged.expect(ranges())

    def part(self, chunk: Chunk | None, offset: int, size: int, is_head: bool = False) -> bytes:
        """Read at most `size` bytes of the records of `chunk` from `offset`. If `chunk` is None, read from the file itself.

        is_head : a hint: only the beginnings of the chunk's messages will be read

        Raises InputError when the chunk cannot be decompressed.
        """
        if chunk is None:
            return self.read(offset, max(min(size, self.size - offset), 0))
        if not chunk.compression:
            return self.read(chunk.position + offset, max(min(size, chunk.length - offset), 0))
        return self._decompress(chunk, min(offset + size, chunk.length) if is_head else chunk.length)[
            offset : offset + size
        ]

    def _decompress(self, chunk: Chunk, least: int) -> bytes:
        """Decompressed records of a chunk, at least the first `least` bytes. Raises InputError for a damaged one."""
        kept, records = self._kept
        if kept == chunk.position and len(records) >= least:
            return records
        # Of a chunk that is wanted whole one byte more shows that it unpacks to more than it should.
        is_whole = least >= chunk.length // 2
        step = max(chunk.size, 1) if is_whole else PACKED_BLOCK
        pieces = (self.read(chunk.position + k, min(step, chunk.size - k)) for k in range(0, chunk.size, step))
        try:
            if is_whole and chunk.length > LARGEST:
                raise ValueError(f"it is said to hold {chunk.length} bytes")
            records = unpack(chunk.compression, pieces, chunk.length + 1 if is_whole else least)
            if is_whole and (len(records) != chunk.length or (chunk.crc and crc32(records) != chunk.crc)):
                raise ValueError("its length or its checksum is not what the file says")
        except damage() as error:
            raise InputError(
                f"{self.path}: the chunk at byte {chunk.position} is damaged and its messages are lost: {error}"
            ) from None
        self._kept = (chunk.position, records)
        return records


def unpack(compression: str, pieces: Iterator[bytes], most: int) -> bytes:
    """Decompress `pieces`, one frame or several, up to `most` bytes.

    The limit matters: a few bytes may decompress to any number.

    Raises EOFError when the data end before that, and the errors of the decompressors (`damage`).
    """
    records, size, engine = list[bytes](), 0, None
    while size < most:
        if engine is None or engine.eof:
            data = (engine.unused_data if engine else b"") or next(pieces, b"")
            if not data:
                break
            engine = _codec(compression)()
        else:
            data = next(pieces, b"") if engine.needs_input else b""
            if not data and engine.needs_input:
                raise EOFError("it is cut off")
        records.append(engine.decompress(data, max_length=most - size))
        size += len(records[-1])
    return b"".join(records)


def _codec(name: str) -> Callable[[], Any]:
    """Decompressor class for `bz2`, `lz4` or zstd (any other name), whose `decompress` takes a `max_length`."""
    if name == "bz2":
        return bz2.BZ2Decompressor
    if name == "lz4":
        import lz4.frame

        return lz4.frame.LZ4FrameDecompressor  # type: ignore[no-any-return]
    return zstd().ZstdDecompressor  # type: ignore[no-any-return]


def damage() -> tuple[type[Exception], ...]:
    """Exception types that the decompressors raise on damaged data."""
    return (OSError, EOFError, ValueError, RuntimeError, zstd().ZstdError)


def zstd() -> Any:
    """The zstd module: Python's own from 3.14 on, else the backport."""
    if sys.version_info >= (3, 14):
        from compression import zstd
    else:
        from backports import zstd
    return zstd
