"""What a LAS or LAZ file says of its own size, held against its size: native code trusts it and aborts for want of memory.

Offsets are those of the LAS 1.4 R15 specification, and for LAZ those of Isenburg's laszip (its VLR, its chunk table).
"""

from __future__ import annotations

import os
import struct
from dataclasses import dataclass
from typing import Any, BinaryIO

_VLR, _EVLR = 54, 60  # bytes of their headers
_LASZIP = b"laszip encoded"
_LAYERED = 3  # the compressor of point formats 6 and above: every field of a chunk lies by itself
# Fields of the items of layered chunks; those of bytes are as many as the bytes.
_LAYERS = {10: 9, 11: 1, 12: 2, 13: 1}
_EXTRA_BYTES = 14
_SIZES = {2: 227, 3: 235, 4: 375, 5: 393}  # bytes of the header by minor version


@dataclass(frozen=True)
class LasSizes:
    """What holds of a file that was checked: bytes of a point, and of the points of its largest chunk, both decompressed."""

    record: int
    chunk: int = 0


@dataclass(frozen=True)
class _Laszip:
    """The record that says how points are compressed; `layers` of a chunk, 0 where it has none."""

    data: bytes
    chunk_size: int
    is_variable: bool
    layers: int


def check_las(stream: BinaryIO) -> LasSizes:
    """The sizes in the header of a LAS or LAZ file, and in its chunks. Raises ValueError saying what contradicts what."""
    size = os.fstat(stream.fileno()).st_size
    head = stream.read(393)
    if head[:4] != b"LASF":
        raise ValueError("it does not begin with LASF")
    minor = head[25] if len(head) > 25 else 0
    least = _SIZES.get(minor, 227)
    if len(head) < least:
        raise ValueError(f"its header ends after {len(head)} bytes")
    own, offset, vlrs, kind, record = struct.unpack_from("<HIIBH", head, 94)
    if not least <= own <= offset <= size or vlrs * _VLR > offset - own:
        raise ValueError(
            f"its header of {own} bytes and its {vlrs} records do not fit before its points at byte {offset}"
        )
    (count,) = struct.unpack_from("<Q", head, 247) if minor >= 4 else struct.unpack_from("<I", head, 107)
    if minor >= 4:
        first, evlrs = struct.unpack_from("<QI", head, 235)
        if evlrs and first + evlrs * _EVLR > size:
            raise ValueError(f"its {evlrs} records from byte {first} on reach beyond its {size} bytes")
    if not record:
        raise ValueError("its points have no bytes")
    if not kind & 0x80:
        if offset + count * record > size:
            raise ValueError(f"{count} points of {record} bytes from byte {offset} on reach beyond its {size} bytes")
    elif count:
        return LasSizes(
            record, record * _check_chunks(stream, _laszip(stream, own, vlrs, record), count, offset, record)
        )
    return LasSizes(record)


def _laszip(stream: BinaryIO, begin: int, vlrs: int, record: int) -> _Laszip:
    position = begin
    for _ in range(vlrs):
        stream.seek(position)
        head = stream.read(_VLR)
        if len(head) < _VLR:
            break
        user, number, length = struct.unpack_from("<16sHH", head, 2)
        if user.rstrip(b"\0") == _LASZIP and number == 22204:
            return _understood(stream.read(length), record)
        position += _VLR + length
    raise ValueError("nothing says how its points are compressed")


def _understood(data: bytes, record: int) -> _Laszip:
    if len(data) < 34:
        raise ValueError("the record of its compression is cut off")
    compressor, chunk_size, items = struct.unpack_from("<H10xI16xH", data)
    if len(data) < 34 + 6 * items:
        raise ValueError("the record of its compression is cut off")
    kinds = [struct.unpack_from("<HH", data, 34 + 6 * k) for k in range(items)]
    if sum(size for _, size in kinds) != record or chunk_size == 0:
        raise ValueError(f"its compression is of points that have not {record} bytes")
    layers = sum(size if kind == _EXTRA_BYTES else _LAYERS.get(kind, 0) for kind, size in kinds)
    return _Laszip(data, chunk_size, chunk_size == 2**32 - 1, layers if compressor == _LAYERED else 0)


def _check_chunks(stream: BinaryIO, laszip: _Laszip, count: int, offset: int, record: int) -> int:
    """The most points a chunk has."""
    size = os.fstat(stream.fileno()).st_size
    stream.seek(offset)
    begin = offset + 8
    (table,) = struct.unpack("<q", stream.read(8).ljust(8, b"\0"))
    if table == -1:  # written by what could not go back
        stream.seek(size - 8)
        (table,) = struct.unpack("<q", stream.read(8))
    if not begin <= table <= size - 8:
        raise ValueError(f"its table of chunks is said to lie at byte {table} of {size}")
    stream.seek(table)
    _, chunks = struct.unpack("<II", stream.read(8))
    # A chunk begins with one point as it is.
    if chunks * record > table - begin:
        raise ValueError(f"{chunks} chunks do not fit into {table - begin} bytes")
    if not laszip.is_variable and chunks != -(-count // laszip.chunk_size):
        raise ValueError(f"{count} points in chunks of {laszip.chunk_size} are not {chunks} chunks")
    entries = _entries(stream, laszip, offset)
    for _, length in entries:
        if length < record or begin + length > table:
            raise ValueError(f"the chunk at byte {begin} is said to have {length} bytes")
        _check_layers(stream, laszip, begin, length, record)
        begin += length
    return max((points for points, _ in entries), default=0)


def _entries(stream: BinaryIO, laszip: _Laszip, offset: int) -> list[tuple[int, int]]:
    """Points and bytes of each chunk: the table is compressed itself, how many entries it has is known by now."""
    import lazrs

    stream.seek(offset)
    found: list[Any] = lazrs.read_chunk_table(stream, lazrs.LazVlr(laszip.data))
    return [(int(points), int(length)) for points, length in found]


def _check_layers(stream: BinaryIO, laszip: _Laszip, begin: int, length: int, record: int) -> None:
    if not laszip.layers:
        return
    stream.seek(begin + record)
    need = 4 + 4 * laszip.layers
    said = stream.read(need) if record + need <= length else b""
    if len(said) < need or record + need + sum(struct.unpack_from(f"<{laszip.layers}I", said, 4)) > length:
        raise ValueError(f"the chunk at byte {begin} has less than its layers need")
