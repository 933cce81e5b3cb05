"""PLY point files: ascii and binary of both byte orders read, binary little endian written."""

from __future__ import annotations

from dataclasses import dataclass
from mmap import mmap
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lslam.core.errors import InputError, input_errors
from lslam.core.untrusted import whole_number
from lslam.io.formats.atomic import atomic_write
from lslam.io.formats.point_cloud import beyond, packed_columns, text_columns

_TYPES = {
    "char": "i1",
    "int8": "i1",
    "uchar": "u1",
    "uint8": "u1",
    "short": "i2",
    "int16": "i2",
    "ushort": "u2",
    "uint16": "u2",
    "int": "i4",
    "int32": "i4",
    "uint": "u4",
    "uint32": "u4",
    "float": "f4",
    "float32": "f4",
    "double": "f8",
    "float64": "f8",
}
_NAMES = {code: name for name, code in _TYPES.items() if not name[-1].isdigit()}
_ORDERS = {"ascii": "=", "binary_little_endian": "<", "binary_big_endian": ">"}


@dataclass
class _Element:
    """One element of a PLY header, such as `vertex`: its name, number of rows and properties."""

    name: str
    count: int
    properties: list[tuple[str, str]]  # name, numpy code; code "list" for lists


def ply_columns(path: Path, data: bytes | mmap | None = None) -> dict[str, NDArray[Any]]:
    """The vertices of a PLY file by property; other elements are ignored. Raises InputError naming the file and the line.

    data : its content if already read; columns of a mapped binary file are mapped, too
    """
    if data is None:
        with input_errors(path):
            data = path.read_bytes()
    encoding, elements, size = _read_header(path, data)
    order = _ORDERS[encoding]
    body = memoryview(data)[size:]
    start = 0
    for element in elements:
        codes = [code for _, code in element.properties]
        if "list" in codes and (element.name == "vertex" or encoding != "ascii"):
            raise InputError(f"{path}: PLY element {element.name!r} has a list property where points are expected")
        if element.name == "vertex":
            if encoding == "ascii" and element.count:
                return _ascii_columns(path, element, body, start, element is elements[-1])
            names = [name for name, _ in element.properties]
            dtype = np.dtype([(str(k), order + code) for k, code in enumerate(codes)])
            is_last = element is elements[-1]
            return packed_columns(path, "PLY", names, dtype, element.count, body, start, is_last=is_last)
        record = sum(np.dtype(code).itemsize for code in codes if code != "list")
        start += element.count * (record if encoding != "ascii" else 1)
    raise InputError(f"{path}: PLY header has no element 'vertex'")


def write_ply_mesh(path: Path, vertices: NDArray[Any], triangles: NDArray[Any], comment: str = "") -> None:
    """Write a surface of vertices (V, 3), m, as float32 and triangles (F, 3), binary little endian, atomically."""
    faces = np.empty(len(triangles), np.dtype([("n", "u1"), ("v", "<i4", 3)]))
    faces["n"], faces["v"] = 3, triangles
    element = f"element face {len(faces)}\nproperty list uchar int vertex_indices\nend_header\n".encode()
    kind = np.dtype([(axis, "<f4") for axis in "xyz"])
    header = ply_header(len(vertices), kind, comment).replace(b"end_header\n", element)
    with atomic_write(path) as stream:
        stream.write(header)
        stream.write(np.ascontiguousarray(vertices, "<f4").data)
        stream.write(faces.tobytes())


def ply_header(count: int, kind: np.dtype[Any], comment: str = "") -> bytes:
    """Header of `count` binary little-endian vertices, records of `kind`, packed."""
    comments = "".join(f"comment {line}\n" for line in comment.splitlines())
    properties = "".join(f"property {_NAMES[kind[name].str[1:]]} {name}\n" for name in kind.names or ())
    return f"ply\nformat binary_little_endian 1.0\n{comments}element vertex {count}\n{properties}end_header\n".encode(
        "utf-8", "backslashreplace"
    )


def _read_header(path: Path, data: bytes | mmap) -> tuple[str, list[_Element], int]:
    """Encoding, elements and size in bytes of a PLY header; raises InputError naming the line."""
    if data[:4] not in (b"ply\n", b"ply\r"):
        raise InputError(f"{path}: no PLY file, its first line is not 'ply'")
    encoding, elements, position, number = "", list[_Element](), 0, 0
    while True:
        end = data.find(b"\n", position)
        number += 1
        if end < 0 or end - position > 65536:
            raise InputError(f"{path}: PLY header ends at line {number} without end_header")
        words = data[position:end].decode("ascii", "replace").split()
        position = end + 1
        if words == ["end_header"]:
            break
        if number == 1 or not words or words[0] in ("comment", "obj_info"):
            continue
        if words[0] == "format" and len(words) == 3 and words[1] in _ORDERS:
            encoding = words[1]
        elif words[0] == "element" and len(words) == 3 and (count := whole_number(words[2])) is not None:
            elements.append(_Element(words[1], count, []))
        elif words[0] == "property" and elements and len(words) == 3 and words[1] in _TYPES:
            elements[-1].properties.append((words[2], _TYPES[words[1]]))
        elif words[0] == "property" and elements and len(words) == 5 and words[1] == "list":
            elements[-1].properties.append((words[4], "list"))
        else:
            raise InputError(f"{path}, line {number}: bad PLY header entry {' '.join(words)[:60]!r}")
    if not encoding:
        raise InputError(f"{path}: PLY header has no format; known: {', '.join(_ORDERS)}")
    return encoding, elements, position


def _ascii_columns(
    path: Path, element: _Element, body: memoryview, start: int, is_last: bool
) -> dict[str, NDArray[Any]]:
    """Columns by property of `element`, `start` lines behind the header; raises InputError for too few or bad lines.

    is_last : no element follows, so that more lines give the column of `beyond`
    """
    every = [line for line in bytes(body).split(b"\n") if line.strip()][start:]
    lines = every[: element.count]
    if len(lines) < element.count:
        raise InputError(f"{path}: PLY header says {element.count} points, the file holds {len(lines)}")
    try:
        table = np.loadtxt([line.decode("ascii") for line in lines], np.float64, ndmin=2)
    except ValueError as error:
        raise InputError(f"{path}: PLY ascii data (counted from the first point) cannot be read: {error}") from None
    if table.shape[1] != len(element.properties):
        raise InputError(
            f"{path}: PLY ascii lines hold {table.shape[1]} numbers for {len(element.properties)} properties"
        )
    names, codes = zip(*element.properties, strict=True)
    columns = text_columns(table, names, [np.dtype(code) for code in codes])
    return columns | (beyond(element.count, len(every) - element.count) if is_last else {})
