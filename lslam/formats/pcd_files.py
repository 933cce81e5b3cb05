"""PCD files of the Point Cloud Library, version 0.7: ascii, binary and binary_compressed, read and written."""

from __future__ import annotations

import io
import re
import struct
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lslam.errors import InputError, UsageError, cause
from lslam.formats.atomic import atomic_write
from lslam.formats.point_cloud import AXES, float_table, organised, packed_columns
from lslam.untrusted import whole_number

ENCODINGS = ("binary", "ascii", "binary_compressed")
_KINDS = {"F": (4, 8), "I": (1, 2, 4, 8), "U": (1, 2, 4, 8)}
# Words of a line of text: digits, a char that was streamed as it is, and bytes that are no digits.
_DIGITS = rb"([-+]?(?:\d+\.?\d*(?:[eE][-+]?\d+)?|\.\d+(?:[eE][-+]?\d+)?|nan|inf))"
_CHAR, _BYTES, _END = rb"([\s\S])", rb"([\s\S]{0,8}?)", rb" ?\r?(?:\n|\Z)"
_KEYS = ("VERSION", "FIELDS", "SIZE", "TYPE", "COUNT", "WIDTH", "HEIGHT", "VIEWPOINT", "POINTS", "DATA")


@dataclass(frozen=True)
class _Header:
    names: list[str]
    counts: list[int]
    dtype: np.dtype[Any]  # of one point, its fields numbered
    points: int
    shape: tuple[int, int]  # rows and columns
    encoding: str
    size: int  # bytes of the header itself

    @property
    def codes(self) -> list[np.dtype[Any]]:
        """Types of the numbers of each field."""
        return [self.dtype[k].base for k in range(len(self.names))]


def pcd_columns(path: Path) -> dict[str, NDArray[Any]]:
    """The points of a PCD file by field; they stay in the order and the frame of the file (VIEWPOINT is not applied, as in PCL).

    Raises InputError naming the file and the place: a header that lies, data that end early.
    """
    try:
        data = path.read_bytes()
    except OSError as error:
        raise InputError(f"{path} cannot be read: {cause(error)}") from None
    header = _read_header(path, data)
    body = memoryview(data)[header.size :]
    if header.encoding == "binary" or not header.points:
        columns = packed_columns(path, "PCD", header.names, header.dtype, header.points, body)
    else:
        columns = (_ascii_columns if header.encoding == "ascii" else _compressed_columns)(path, header, body)
    columns.pop("_", None)
    height, width = header.shape
    return columns | (organised(height, width) if height * width == header.points else {})


def write_pcd(
    path: Path, points: NDArray[Any], intensity: NDArray[Any] | None = None, encoding: str = "binary"
) -> None:
    """Write points (N, 3), m, and intensity (N,) as float32, atomically, in one of `ENCODINGS`."""
    if encoding not in ENCODINGS:
        raise UsageError(f"unknown PCD encoding {encoding!r}; known: {', '.join(ENCODINGS)}")
    table = float_table(points, intensity)
    with atomic_write(path) as stream:
        stream.write(pcd_header(len(table), ["x", "y", "z", "intensity"][: table.shape[1]], encoding))
        if encoding == "binary":
            stream.write(table.data)
        elif encoding == "ascii":
            np.savetxt(stream, table, fmt="%.9g")
        else:
            stream.write(_compress(np.ascontiguousarray(table.T).view(np.uint8).ravel()))


def pcd_header(count: int, names: Sequence[str], encoding: str = "binary") -> bytes:
    """Header of `count` points of float32 fields."""
    k = len(names)
    return (
        "# .PCD v0.7 - Point Cloud Data file format\n"
        f"VERSION 0.7\nFIELDS {' '.join(names)}\nSIZE {' '.join(['4'] * k)}\nTYPE {' '.join(['F'] * k)}\n"
        f"COUNT {' '.join(['1'] * k)}\nWIDTH {count}\nHEIGHT 1\nVIEWPOINT 0 0 0 1 0 0 0\nPOINTS {count}\nDATA {encoding}\n"
    ).encode()


def _read_header(path: Path, data: bytes) -> _Header:
    entries: dict[str, list[str]] = {}
    stream = io.BytesIO(data)
    number = 0
    while "DATA" not in entries:
        line = stream.readline(65536)
        number += 1
        if not line:
            raise InputError(f"{path}: PCD header ends at line {number} without DATA")
        words = line.split(b"#")[0].decode("ascii", "replace").split()
        if not words:
            continue
        if words[0] not in _KEYS:
            raise InputError(f"{path}, line {number}: {words[0][:40]!r} is no PCD header entry")
        entries[words[0]] = words[1:]
    return _check_header(path, entries, stream.tell())


def _check_header(path: Path, entries: dict[str, list[str]], size: int) -> _Header:
    names = entries.get("FIELDS", [])
    sizes, kinds = entries.get("SIZE", []), entries.get("TYPE", [])
    repeats = entries.get("COUNT", ["1"] * len(names))
    if not names:
        raise InputError(f"{path}: PCD header has no FIELDS")
    if not len(names) == len(sizes) == len(kinds) == len(repeats):
        raise InputError(
            f"{path}: PCD header contradicts itself: {len(names)} FIELDS, {len(sizes)} SIZE, {len(kinds)} TYPE, "
            f"{len(repeats)} COUNT"
        )
    codes: list[str] = []
    for name, length, kind in zip(names, sizes, kinds, strict=True):
        if kind not in _KINDS or whole_number(length) not in _KINDS[kind]:
            raise InputError(f"{path}: PCD field {name!r} has TYPE {kind} with SIZE {length}, which does not exist")
        codes.append(f"<{kind.lower()}{length}")
    counts = [_number(path, "COUNT", c) for c in repeats]
    if not any(counts):
        raise InputError(f"{path}: PCD header has no FIELDS")
    shapes = [() if count == 1 else (count,) for count in counts]
    try:
        dtype = np.dtype([(str(k), code, shape) for k, (code, shape) in enumerate(zip(codes, shapes, strict=True))])
    except ValueError:
        raise InputError(f"{path}: PCD header says {sum(counts)} numbers a point: too many") from None
    width = _number(path, "WIDTH", *entries.get("WIDTH", ["0"]))
    height = _number(path, "HEIGHT", *entries.get("HEIGHT", ["1"]))
    points = _number(path, "POINTS", *entries.get("POINTS", [str(width * height)]))
    # Some writers leave one of them at 0.
    points = points or width * height
    if width * height and points != width * height:
        raise InputError(f"{path}: PCD header lies: POINTS {points} is not WIDTH {width} x HEIGHT {height}")
    encoding = entries["DATA"][0].lower() if entries["DATA"] else ""
    if encoding not in ENCODINGS:
        raise InputError(f"{path}: PCD DATA {encoding!r} is unknown; known: {', '.join(ENCODINGS)}")
    return _Header(names, counts, dtype, points, (height, width), encoding, size)


def _number(path: Path, key: str, *words: str) -> int:
    value = whole_number(words[0]) if len(words) == 1 else None
    if value is None:
        raise InputError(f"{path}: PCD {key} {' '.join(words)!r} is no whole number")
    return value


def _ascii_columns(path: Path, header: _Header, body: memoryview) -> dict[str, NDArray[Any]]:
    width = sum(header.counts)
    lines = bytes(body).split(b"\n")
    while lines and not lines[-1].strip():
        lines.pop()
    unread: set[int] = set()
    try:
        if len(lines) < header.points:
            raise ValueError(f"header says {header.points} points, the file holds {len(lines)} lines of them")
        table = np.loadtxt([line.decode("ascii") for line in lines[: header.points]], np.float64, ndmin=2)
    except ValueError as error:
        mixed = _rows_with_raw_bytes(header, bytes(body))
        if mixed is None:
            raise InputError(f"{path}: PCD ascii data (counted from the first point) cannot be read: {error}") from None
        table, unread = mixed
    if table.shape != (header.points, width):
        raise InputError(f"{path}: PCD ascii lines hold {table.shape[1]} numbers where FIELDS and COUNT say {width}")
    columns, k = {}, 0
    for name, count, code in zip(header.names, header.counts, header.codes, strict=True):
        values = table[:, k] if count == 1 else table[:, k : k + count]
        # Text holds the digits that it holds, whatever type its header names.
        as_read = name.lower() in AXES or code.kind != "f"
        label = f"{name} (bytes in place of digits)" if k in unread else name
        columns[label] = values if as_read else values.astype(code)
        k += count
    return columns


def _rows_with_raw_bytes(header: _Header, body: bytes) -> tuple[NDArray[np.float64], set[int]] | None:
    """Numbers of lines in which columns hold bytes in place of digits, a blank or the end of a line among them.

    C++ streams a char so: all columns of one byte are read as that. Any other one column of a few bytes is left NaN and named.
    """
    if 2 * sum(header.counts) * header.points > len(body) + 1:
        return None
    sizes = np.repeat([code.itemsize for code in header.codes], header.counts)
    is_axis = np.repeat([name.lower() in AXES for name in header.names], header.counts)
    chars = set(np.flatnonzero(sizes == 1).tolist())
    others = [{k} for k in np.flatnonzero((sizes > 1) & ~is_axis).tolist()]
    for raw in [chars, *others] if chars else others:
        pattern = _CHAR if raw == chars else _BYTES
        line = re.compile(b" ".join(pattern if k in raw else _DIGITS for k in range(len(sizes))) + _END, re.IGNORECASE)
        rows = _matches(line, body, header.points)
        if len(rows) == header.points:
            words = np.array(rows, object)
            for k in raw:
                words[:, k] = [word[0] if raw == chars else np.nan for word in words[:, k]]
            return words.astype(np.float64), set() if raw == chars else raw
    return None


def _matches(line: re.Pattern[bytes], body: bytes, count: int) -> list[tuple[bytes, ...]]:
    """Groups of `line` in lines that follow each other, as far as they match."""
    rows: list[tuple[bytes, ...]] = []
    position = 0
    while len(rows) < count and (match := line.match(body, position)):
        rows.append(match.groups())
        position = match.end()
    return rows


def _compressed_columns(path: Path, header: _Header, body: memoryview) -> dict[str, NDArray[Any]]:
    if len(body) < 8:
        raise InputError(f"{path}: PCD compressed data end before their two sizes")
    packed, plain = struct.unpack("<II", body[:8])
    if plain != header.points * header.dtype.itemsize or packed > len(body) - 8:
        raise InputError(
            f"{path}: PCD compressed data are {len(body) - 8} bytes for {plain}, the header needs {packed} for "
            f"{header.points * header.dtype.itemsize}"
        )
    from lslam.kernels.lzf import decompress

    out = np.empty(plain, np.uint8)
    source = np.frombuffer(body[8 : 8 + packed], np.uint8).copy()
    if decompress(source, out) != plain:
        raise InputError(f"{path}: PCD compressed data are damaged")
    columns, at = {}, 0
    for name, count, code in zip(header.names, header.counts, header.codes, strict=True):
        size = header.points * count * code.itemsize
        values = out[at : at + size].view(code)
        columns[name] = values if count == 1 else values.reshape(header.points, count)
        at += size
    return columns


def _compress(plain: NDArray[np.uint8]) -> bytes:
    from lslam.kernels.lzf import compress

    target = np.empty(len(plain) + len(plain) // 32 + 16, np.uint8)
    size = compress(plain, target, np.full(65536, -1, np.int64))
    return struct.pack("<II", size, len(plain)) + target[:size].tobytes()
