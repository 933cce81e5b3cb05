"""Cloud Optimized Point Clouds (COPC 1.0): LAZ whose chunks are nodes of an octree, which programs read from coarse to fine."""

from __future__ import annotations

import io
import struct
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lslam.core.arrays import Ints, Longs

SUFFIX = ".copc.laz"
# Record of LAS 1.4 that tells of the octree; it has to be the first, behind the header.
USER_ID, INFO, HIERARCHY = "copc", 1, 1000
INFO_BYTES = 160
_CELLS = 128  # of a node along each axis, with one point each
_MOST = 1 << 16  # points of a node that is not divided
_DEEPEST = 21  # level: numbers of three axes fit into 64 bits
_INFO_AT = 375 + 54
_EVLR = struct.Struct("<2x16sHQ32s")


def is_copc(path: Path) -> bool:
    """Whether a file of this name is a COPC."""
    return path.name.lower().endswith(SUFFIX)


def octree(axes: Sequence[Ints], edge: int) -> tuple[Longs, Ints]:
    """Nodes of points in a cube of `edge` steps; axes : x, y, z (N,) of the points, whole steps from its lowest corner.

    A node with many points keeps the first one of each of its cells, and its eight children get the others, down to cells as
    small as a step. Returns the keys (K, 4) of the nodes, their level and x, y, z in it, and the node (N,) of each point.
    """
    count = len(axes[0])
    keys, node_of, rest = [np.zeros((0, 4), np.int64)], np.zeros(count, np.int32), np.arange(count, dtype=np.int32)
    level = nodes = 0
    while len(rest):
        size = edge / 2**level
        packed, first, node, sizes = np.unique(
            _box_numbers(axes, rest, size, 1 << level, 1 << level),
            return_index=True,
            return_inverse=True,
            return_counts=True,
        )
        is_kept = sizes[node] <= _MOST
        if size > _CELLS and level < _DEEPEST:
            cells = _box_numbers(axes, rest, size / _CELLS, _CELLS << level, _CELLS)
            is_kept[np.unique(node * _CELLS**3 + cells, return_index=True)[1]] = True
        else:
            is_kept[:] = True
        boxes = [_boxes(axis[rest[first]], size, 1 << level) for axis in axes]
        keys.append(np.column_stack([np.full(len(packed), level), *boxes]))
        node_of[rest[is_kept]] = nodes + node[is_kept]
        rest, nodes, level = rest[~is_kept], nodes + len(packed), level + 1
    return np.concatenate(keys) if count else np.zeros((1, 4), np.int64), node_of


def _boxes(steps: Ints, size: float, most: int) -> Longs:
    """(N,) number of the box of `size` steps that each coordinate lies in; the last of `most` has its far side."""
    return np.minimum((steps / size).astype(np.int64), most - 1)


def _box_numbers(axes: Sequence[Ints], some: Ints, size: float, most: int, side: int) -> Longs:
    """(M,) number of the box of each of the points `some`, in the cube of `side` boxes along each axis that it belongs to."""
    packed = np.zeros(len(some), np.int64)
    for axis in axes:
        packed *= side
        packed += _boxes(axis[some], size, most) % side
    return packed


def copc_bytes(header: Any, record: Any, laszip_record: Any) -> io.BytesIO:
    """Content of a COPC file.

    header, record : laspy's, of the whole cloud; the header's first record is that of the octree
    laszip_record : class of laspy's record about the compression
    """
    import lazrs

    form = header.point_format
    laszip = lazrs.LazVlr.new_for_compression(form.id, form.num_extra_bytes, use_variable_size_chunks=True)
    header.vlrs.append(laszip_record(laszip.record_data()))
    header.are_points_compressed = True
    count, step = len(record), float(header.scales[0])
    lowest = [int(record[axis].min()) if count else 0 for axis in "XYZ"]
    axes = [np.asarray(record[axis], np.int32) - np.int32(least) for axis, least in zip("XYZ", lowest, strict=True)]
    # The cube begins where the points do, since some programs take it from the header alone.
    edge = max([1, *(int(axis.max()) for axis in axes if count)])
    keys, node_of = octree(axes, edge)
    order = np.argsort(node_of, kind="stable").astype(np.int32)
    counts = np.bincount(node_of, minlength=len(keys))
    header.partial_reset()
    if count:
        header.grow(record)
    stream = io.BytesIO()
    header.write_to(stream)
    compressor, ends = lazrs.LasZipCompressor(stream, laszip), np.cumsum(counts)
    compressor.reserve_offset_to_chunk_table()
    for begin, end in zip(ends - counts, ends, strict=True):
        if begin:
            compressor.finish_current_chunk()
        compressor.compress_many(record.array[order[begin:end]].tobytes())
    compressor.done()
    end = stream.seek(0, io.SEEK_END)
    stream.seek(header.offset_to_point_data)
    sizes = np.array([size for _, size in lazrs.read_chunk_table(stream, laszip)], np.int64)
    begins = header.offset_to_point_data + 8 + np.cumsum(sizes) - sizes
    pages = _pages(keys, begins, sizes, counts)
    stream.seek(end)
    stream.write(_EVLR.pack(USER_ID.encode(), HIERARCHY, len(pages), b"") + pages)
    times = record["gps_time"] if count else np.zeros(1)
    half = edge * step / 2
    middle = np.array(lowest) * step + np.asarray(header.offsets) + half
    info = struct.pack(
        "<5d2Q2d", *middle, half, 2 * half / _CELLS, end + _EVLR.size, len(pages), times.min(), times.max()
    )
    header.number_of_evlrs, header.start_of_first_evlr = 1, end
    stream.seek(0)
    header.write_to(stream, ensure_same_size=True)
    stream.seek(_INFO_AT)
    stream.write(info)
    return stream


def _pages(keys: Longs, begins: Longs, sizes: Longs, counts: NDArray[np.int64]) -> bytes:
    """Bytes of the hierarchy page: per node its key (4,), offset in the file, size in bytes and number of points."""
    kind = np.dtype([("key", "<i4", (4,)), ("offset", "<u8"), ("size", "<i4"), ("count", "<i4")])
    table = np.zeros(len(keys), kind)
    table["key"], table["count"] = keys, counts
    table["offset"], table["size"] = begins, sizes
    return table.tobytes()
