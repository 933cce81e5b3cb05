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
from lslam.formats.point_cloud import AXES, organised
from lslam.untrusted import whole_number

ENCODINGS = ("binary", "ascii", "binary_compressed")
_KINDS = {"F": (4, 8), "I": (1, 2, 4, 8), "U": (1, 2, 4, 8)}
_KEYS = ("VERSION", "FIELDS", "SIZE", "TYPE", "COUNT", "WIDTH", "HEIGHT", "VIEWPOINT", "POINTS", "DATA")


@dataclass(frozen=True)
class _Header:
    names: list[str]
    dtypes: list[np.dtype[Any]]
    counts: list[int]
    points: int
    shape: tuple[int, int]  # rows and columns
    encoding: str
    size: int  # bytes of the header itself

    @property
    def record(self) -> int:
        """Bytes of one point."""
        return sum(d.itemsize * c for d, c in zip(self.dtypes, self.counts, strict=True))


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
    if header.points == 0:
        return {name: np.zeros(0, kind) for name, kind in zip(header.names, header.dtypes, strict=True)}
    read = {"ascii": _ascii_columns, "binary": _binary_columns}.get(header.encoding, _compressed_columns)
    columns = {name: values for name, values in read(path, header, body).items() if name != "_"}
    height, width = header.shape
    return columns | (organised(height, width) if height * width == header.points else {})


def write_pcd(
    path: Path, points: NDArray[Any], intensity: NDArray[Any] | None = None, encoding: str = "binary"
) -> None:
    """Write points (N, 3), m, and intensity (N,) as float32, atomically, in one of `ENCODINGS`."""
    if encoding not in ENCODINGS:
        raise UsageError(f"unknown PCD encoding {encoding!r}; known: {', '.join(ENCODINGS)}")
    names = ["x", "y", "z"] if intensity is None else ["x", "y", "z", "intensity"]
    table = np.empty((len(points), len(names)), np.float32)
    table[:, :3] = points
    if intensity is not None:
        table[:, 3] = intensity
    with atomic_write(path) as stream:
        stream.write(pcd_header(len(table), names, encoding))
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
    dtypes = []
    for name, length, kind in zip(names, sizes, kinds, strict=True):
        if kind not in _KINDS or whole_number(length) not in _KINDS[kind]:
            raise InputError(f"{path}: PCD field {name!r} has TYPE {kind} with SIZE {length}, which does not exist")
        dtypes.append(np.dtype(f"<{kind.lower()}{length}"))
    counts = [_number(path, "COUNT", c) for c in repeats]
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
    return _Header(names, dtypes, counts, points, (height, width), encoding, size)


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
        found = _rows_with_raw_bytes(header, bytes(body))
        if found is None:
            raise InputError(f"{path}: PCD ascii data (counted from the first point) cannot be read: {error}") from None
        table, unread = found
    if table.shape != (header.points, width):
        raise InputError(f"{path}: PCD ascii lines hold {table.shape[1]} numbers where FIELDS and COUNT say {width}")
    columns, k = {}, 0
    for name, dtype, count in zip(header.names, header.dtypes, header.counts, strict=True):
        values = table[:, k] if count == 1 else table[:, k : k + count]
        # Text holds the digits that it holds, whatever type its header names.
        as_read = name.lower() in AXES or dtype.kind != "f"
        label = f"{name} (bytes in place of digits)" if k in unread else name
        columns[label] = values if as_read else values.astype(dtype)
        k += count
    return columns


def _rows_with_raw_bytes(header: _Header, body: bytes) -> tuple[NDArray[np.float64], set[int]] | None:
    """Numbers of lines in which columns hold bytes in place of digits, a blank or the end of a line among them; what is left NaN.

    C++ streams a char so: all columns of one byte are read as that. Any other one column of a few bytes is left NaN.
    """
    sizes = np.repeat([dtype.itemsize for dtype in header.dtypes], header.counts)
    names = np.repeat(header.names, header.counts)
    if 2 * len(sizes) * header.points > len(body) + 1:
        return None
    single = set(np.flatnonzero(sizes == 1).tolist())
    others = [{k} for k in range(len(sizes)) if sizes[k] > 1 and str(names[k]).lower() not in AXES]
    for raw in [single, *others] if single else others:
        table = _match_rows(header.points, body, len(sizes), raw, raw == single)
        if table is not None:
            return table, set() if raw == single else raw
    return None


def _match_rows(points: int, body: bytes, width: int, raw: set[int], is_char: bool) -> NDArray[np.float64] | None:
    number = rb"([-+]?(?:\d+\.?\d*(?:[eE][-+]?\d+)?|\.\d+(?:[eE][-+]?\d+)?|nan|inf))"
    other = rb"([\s\S])" if is_char else rb"([\s\S]{0,8}?)"
    words = [other if k in raw else number for k in range(width)]
    line = re.compile(b" ".join(words) + rb" ?\r?(?:\n|\Z)", re.IGNORECASE)
    table, position = np.empty((points, width)), 0
    for row in table:
        match = line.match(body, position)
        if match is None:
            return None
        row[:] = [
            float(word) if k not in raw else word[0] if is_char else np.nan for k, word in enumerate(match.groups())
        ]
        position = match.end()
    return table


def _binary_columns(path: Path, header: _Header, body: memoryview) -> dict[str, NDArray[Any]]:
    need = header.points * header.record
    if len(body) < need:
        raise InputError(
            f"{path}: PCD header says {header.points} points of {header.record} bytes, the file holds "
            f"{len(body) // header.record if header.record else 0}"
        )
    columns, offset = {}, 0
    for name, dtype, count in zip(header.names, header.dtypes, header.counts, strict=True):
        shape, strides = (header.points, count), (header.record, dtype.itemsize)
        columns[name] = np.ndarray(
            shape[:1] if count == 1 else shape, dtype, body, offset, strides[:1] if count == 1 else strides
        )
        offset += dtype.itemsize * count
    return columns


def _compressed_columns(path: Path, header: _Header, body: memoryview) -> dict[str, NDArray[Any]]:
    if len(body) < 8:
        raise InputError(f"{path}: PCD compressed data end before their two sizes")
    packed, plain = struct.unpack("<II", body[:8])
    if plain != header.points * header.record or packed > len(body) - 8:
        raise InputError(
            f"{path}: PCD compressed data are {len(body) - 8} bytes for {plain}, the header needs {packed} for "
            f"{header.points * header.record}"
        )
    from lslam.kernels.lzf import decompress

    out = np.empty(plain, np.uint8)
    source = np.frombuffer(body[8 : 8 + packed], np.uint8).copy()
    if decompress(source, out) != plain:
        raise InputError(f"{path}: PCD compressed data are damaged")
    columns, offset = {}, 0
    for name, dtype, count in zip(header.names, header.dtypes, header.counts, strict=True):
        length = header.points * dtype.itemsize * count
        values = out[offset : offset + length].view(dtype)
        columns[name] = values if count == 1 else values.reshape(header.points, count)
        offset += length
    return columns


def _compress(plain: NDArray[np.uint8]) -> bytes:
    from lslam.kernels.lzf import compress

    target = np.empty(len(plain) + len(plain) // 32 + 16, np.uint8)
    size = compress(plain, target, np.full(65536, -1, np.int64))
    return struct.pack("<II", size, len(plain)) + target[:size].tobytes()
