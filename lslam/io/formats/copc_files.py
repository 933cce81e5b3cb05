"""Cloud Optimized Point Clouds (COPC 1.0): LAZ whose chunks are nodes of an octree, which programs read from coarse to fine."""

from __future__ import annotations

import io
import struct
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lslam.core.types.arrays import Floats, Longs

SUFFIX = ".copc.laz"
# Record of LAS 1.4 that tells of the octree; it has to be the first, behind the header.
USER_ID, INFO, HIERARCHY = "copc", 1, 1000
INFO_BYTES = 160
_CELLS = 128  # of a node along each axis, with one point each
_MOST = 1 << 16  # points of a node that is not divided
_INFO_AT = 375 + 54
_EVLR_AT, _EVLR = 235, struct.Struct("<2x16sHQ32s")


def is_copc(path: Path) -> bool:
    """Whether a file of this name is a COPC."""
    return path.name.lower().endswith(SUFFIX)


def octree(points: Floats, low: Floats, edge: float, finest: float) -> tuple[Longs, Longs]:
    """Nodes of points (N, 3), m, in the cube of the corner `low` (3,) and of this edge.

    A node with many points keeps the first one of each of its cells, and its eight children have the others, down to cells as
    small as `finest`, m. Returns the keys (K, 4) of the nodes, their level and x, y, z in it, and the node (N,) of each point.
    """
    keys, node_of, rest = [], np.zeros(len(points), np.int64), np.arange(len(points))
    level = count = 0
    while len(rest):
        size = edge / 2**level
        places = np.clip((points[rest] - low) / size, 0, np.nextafter(2.0**level, 0))
        boxes = places.astype(np.int64)
        packed, first, node, sizes = np.unique(
            _packed(boxes, 1 << level), return_index=True, return_inverse=True, return_counts=True
        )
        is_kept = sizes[node] <= _MOST
        if size / _CELLS > finest:
            cells = _packed(((places - boxes) * _CELLS).astype(np.int64), _CELLS)
            is_kept[np.unique(node * _CELLS**3 + cells, return_index=True)[1]] = True
        else:
            is_kept[:] = True
        keys.append(np.column_stack([np.full(len(packed), level), boxes[first]]))
        node_of[rest[is_kept]] = count + node[is_kept]
        rest, count, level = rest[~is_kept], count + len(packed), level + 1
    return np.concatenate(keys) if keys else np.zeros((1, 4), np.int64), node_of


def _packed(cells: Longs, side: int) -> Longs:
    """(N,) number of each of the cells (N, 3) in a cube of `side` cells along each axis, which are at most 2**21."""
    return np.asarray((cells[:, 0] * side + cells[:, 1]) * side + cells[:, 2])


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
    points = np.column_stack([record.x, record.y, record.z]).astype(np.float64)
    low, high = (points.min(0), points.max(0)) if len(points) else (np.zeros(3), np.zeros(3))
    step = float(header.scales[0])
    # The cube begins where the points do, since some programs take it from the header alone.
    edge = max(float((high - low).max()), step)
    keys, node_of = octree(points, low, edge, step)
    order = np.argsort(node_of, kind="stable")
    counts = np.bincount(node_of, minlength=len(keys))
    table = record.array[order]
    header.partial_reset()
    if len(table):
        header.grow(record)
    stream = io.BytesIO()
    header.write_to(stream)
    compressor, ends = lazrs.LasZipCompressor(stream, laszip), np.cumsum(counts)
    compressor.reserve_offset_to_chunk_table()
    for begin, end in zip(ends - counts, ends, strict=True):
        if begin:
            compressor.finish_current_chunk()
        compressor.compress_many(table[begin:end].tobytes())
    compressor.done()
    end = stream.seek(0, io.SEEK_END)
    stream.seek(header.offset_to_point_data)
    sizes = np.array([size for _, size in lazrs.read_chunk_table(stream, laszip)], np.int64)
    begins = header.offset_to_point_data + 8 + np.cumsum(sizes) - sizes
    pages = _pages(keys, begins, sizes, counts)
    stream.seek(end)
    stream.write(_EVLR.pack(USER_ID.encode(), HIERARCHY, len(pages), b"") + pages)
    times = record["gps_time"] if len(table) else np.zeros(1)
    info = [
        *(low + edge / 2),
        edge / 2,
        edge / _CELLS,
        end + _EVLR.size,
        len(pages),
        float(times.min()),
        float(times.max()),
    ]
    header.number_of_evlrs, header.start_of_first_evlr = 1, end
    stream.seek(0)
    header.write_to(stream, ensure_same_size=True)
    stream.seek(_INFO_AT)
    stream.write(struct.pack("<5d2Q2d", *info))
    return stream


def _pages(keys: Longs, begins: Longs, sizes: Longs, counts: NDArray[np.int64]) -> bytes:
    """The nodes, with the place, the bytes and the points of their chunks."""
    kind = np.dtype([("key", "<i4", (4,)), ("offset", "<u8"), ("size", "<i4"), ("count", "<i4")])
    table = np.zeros(len(keys), kind)
    table["key"], table["count"] = keys, counts
    table["offset"], table["size"] = begins, sizes
    return table.tobytes()
