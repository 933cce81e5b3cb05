"""PCD files of the Point Cloud Library, version 0.7: ascii, binary and binary_compressed are read, binary is written."""

from __future__ import annotations

import io
import math
import re
import struct
from collections.abc import Mapping
from dataclasses import dataclass
from itertools import accumulate
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lslam.core.arrays import Floats
from lslam.core.errors import InputError, input_errors
from lslam.core.untrusted import whole_number
from lslam.io.formats.point_cloud import AXES, beyond, packed_columns, ring_column, text_columns

ENCODINGS = ("binary", "ascii", "binary_compressed")
_KINDS = {"F": (4, 8), "I": (1, 2, 4, 8), "U": (1, 2, 4, 8)}
# Words of a line of text: digits, a char that was streamed as it is, and bytes that are no digits.
_DIGITS = rb"([-+]?(?:\d+\.?\d*(?:[eE][-+]?\d+)?|\.\d+(?:[eE][-+]?\d+)?|nan|inf))"
_CHAR, _BYTES, _END = rb"([\s\S])", rb"([\s\S]{0,8}?)", rb" ?\r?(?:\n|\Z)"
_KEYS = ("VERSION", "FIELDS", "SIZE", "TYPE", "COUNT", "WIDTH", "HEIGHT", "VIEWPOINT", "POINTS", "DATA")


@dataclass(frozen=True)
class _Header:
    """Header of a PCD file."""

    names: list[str]
    dtype: np.dtype[Any]  # of one point, its fields numbered; those that repeat are arrays
    points: int
    shape: tuple[int, int]  # rows and columns
    encoding: str
    size: int  # bytes of the header itself

    @property
    def kinds(self) -> list[np.dtype[Any]]:
        """Types of the fields."""
        return [self.dtype[k] for k in range(len(self.names))]


def pcd_columns(path: Path) -> dict[str, NDArray[Any]]:
    """Read the fields of a PCD file, in its own frame (VIEWPOINT is ignored, as in PCL). Raises InputError naming the place."""
    with input_errors(path):
        data = path.read_bytes()
    header = _read_header(path, data)
    body = memoryview(data)[header.size :]
    if header.encoding == "binary" or not header.points:
        columns = packed_columns(path, "PCD", header.names, header.dtype, header.points, body)
    else:
        columns = (_ascii_columns if header.encoding == "ascii" else _compressed_columns)(path, header, body)
    columns.pop("_", None)
    height, width = header.shape
    return columns | (ring_column(height, width) if height * width == header.points else {})


def pcd_header(count: int, kind: np.dtype[Any]) -> bytes:
    """Header of `count` binary little-endian points, records of `kind`, packed."""
    names = kind.names or ()
    sizes = " ".join(str(kind[name].itemsize) for name in names)
    types = " ".join(kind[name].kind.upper() for name in names)
    return (
        "# .PCD v0.7 - Point Cloud Data file format\n"
        f"VERSION 0.7\nFIELDS {' '.join(names)}\nSIZE {sizes}\nTYPE {types}\n"
        f"COUNT {' '.join('1' for _ in names)}\nWIDTH {count}\nHEIGHT 1\nVIEWPOINT 0 0 0 1 0 0 0\nPOINTS {count}\nDATA binary\n"
    ).encode()


def packed_colour(columns: Mapping[str, NDArray[Any]]) -> dict[str, NDArray[Any]]:
    """Columns with red, green and blue as the one field `rgb` of the Point Cloud Library: three bytes within a float32."""
    if not {"red", "green", "blue"} <= set(columns):
        return dict(columns)
    red, green, blue = (columns[name].astype(np.uint32) for name in ("red", "green", "blue"))
    others = {name: values for name, values in columns.items() if name not in ("red", "green", "blue")}
    return {"rgb": ((red << 16) | (green << 8) | blue).view(np.float32), **others}


def _read_header(path: Path, data: bytes) -> _Header:
    """Parse the header of a PCD file; raises InputError naming the line."""
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
    """Header of the parsed entries, `size` bytes long; raises InputError where they contradict each other."""
    names = entries.get("FIELDS", [])
    sizes, types = entries.get("SIZE", []), entries.get("TYPE", [])
    repeats = entries.get("COUNT", ["1"] * len(names))
    if not names:
        raise InputError(f"{path}: PCD header has no FIELDS")
    if not len(names) == len(sizes) == len(types) == len(repeats):
        raise InputError(
            f"{path}: PCD header contradicts itself: {len(names)} FIELDS, {len(sizes)} SIZE, {len(types)} TYPE, "
            f"{len(repeats)} COUNT"
        )
    kinds: list[tuple[str, str, tuple[int, ...]]] = []
    for name, length, kind, repeat in zip(names, sizes, types, repeats, strict=True):
        if kind not in _KINDS or whole_number(length) not in _KINDS[kind]:
            raise InputError(f"{path}: PCD field {name!r} has TYPE {kind} with SIZE {length}, which does not exist")
        count = _number(path, "COUNT", repeat)
        kinds.append((str(len(kinds)), f"<{kind.lower()}{length}", () if count == 1 else (count,)))
    if not any(math.prod(shape) for _, _, shape in kinds):
        raise InputError(f"{path}: PCD header has no FIELDS")
    try:
        dtype = np.dtype(kinds)
    except ValueError:
        numbers = sum(math.prod(shape) for _, _, shape in kinds)
        raise InputError(f"{path}: PCD header says {numbers} numbers a point: too many") from None
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
    return _Header(names, dtype, points, (height, width), encoding, size)


def _number(path: Path, key: str, *words: str) -> int:
    """The whole number of a header line; raises InputError naming the key for anything else."""
    value = whole_number(words[0]) if len(words) == 1 else None
    if value is None:
        raise InputError(f"{path}: PCD {key} {' '.join(words)!r} is no whole number")
    return value


def _ascii_columns(path: Path, header: _Header, body: memoryview) -> dict[str, NDArray[Any]]:
    """Columns by name of ASCII data; raises InputError for too few lines or unreadable numbers."""
    width = sum(math.prod(kind.shape) for kind in header.kinds)
    lines = bytes(body).split(b"\n")
    while lines and not lines[-1].strip():
        lines.pop()
    unread: set[int] = set()
    more = beyond(header.points, len(lines) - header.points)
    try:
        if len(lines) < header.points:
            raise ValueError(f"header says {header.points} points, the file holds {len(lines)} lines of them")
        table = np.loadtxt([line.decode("ascii") for line in lines[: header.points]], np.float64, ndmin=2)
    except ValueError as error:
        mixed = _rows_with_raw_bytes(header, bytes(body))
        if mixed is None:
            raise InputError(f"{path}: PCD ascii data (counted from the first point) cannot be read: {error}") from None
        (table, unread), more = mixed, {}
    if table.shape != (header.points, width):
        raise InputError(f"{path}: PCD ascii lines hold {table.shape[1]} numbers where FIELDS and COUNT say {width}")
    starts = accumulate((math.prod(kind.shape) for kind in header.kinds[:-1]), initial=0)
    fields = zip(header.names, starts, strict=True)
    labels = [f"{name} (bytes in place of digits)" if k in unread else name for name, k in fields]
    return text_columns(table, labels, header.kinds) | more


def _rows_with_raw_bytes(header: _Header, body: bytes) -> tuple[Floats, set[int]] | None:
    """Numbers of ASCII lines in which columns have raw bytes in place of digits, among them blanks and line ends.

    C++ streams write a char so. Columns of one byte are therefore read as raw bytes. Other such columns become NaN, and their
    indices are returned. None if no such reading fits.
    """
    counts = [math.prod(kind.shape) for kind in header.kinds]
    if 2 * sum(counts) * header.points > len(body) + 1:
        return None
    sizes = np.repeat([kind.base.itemsize for kind in header.kinds], counts)
    is_axis = np.repeat([name.lower() in AXES for name in header.names], counts)
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
    """Groups of the pattern `line` in at most `count` consecutive lines, up to the first that does not match."""
    rows: list[tuple[bytes, ...]] = []
    position = 0
    while len(rows) < count and (match := line.match(body, position)):
        rows.append(match.groups())
        position = match.end()
    return rows


def _compressed_columns(path: Path, header: _Header, body: memoryview) -> dict[str, NDArray[Any]]:
    """Columns by name of binary_compressed data (LZF); raises InputError for damaged data."""
    if len(body) < 8:
        raise InputError(f"{path}: PCD compressed data end before their two sizes")
    packed, plain = struct.unpack("<II", body[:8])
    if plain != header.points * header.dtype.itemsize or packed > len(body) - 8:
        raise InputError(
            f"{path}: PCD compressed data are {len(body) - 8} bytes for {plain}, the header needs {packed} for "
            f"{header.points * header.dtype.itemsize}"
        )
    from lslam.io.kernels import decompress

    out = np.empty(plain, np.uint8)
    source = np.frombuffer(body[8 : 8 + packed], np.uint8).copy()
    if decompress(source, out) != plain:
        raise InputError(f"{path}: PCD compressed data are damaged")
    columns, at = {}, 0
    for name, kind in zip(header.names, header.kinds, strict=True):
        end = at + header.points * kind.itemsize
        columns[name] = out[at:end].view(kind.base).reshape(header.points, *kind.shape)
        at = end
    return columns
