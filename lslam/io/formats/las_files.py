"""LAS 1.4 and LAZ files, what every GIS reads: written block by block, read whole. The only file that knows laspy.

Sizes in the header are first checked against the size of the file. The native decoder trusts them, and would abort when
memory runs out. Offsets are those of the LAS 1.4 R15 specification, and for LAZ those of Isenburg's laszip (its VLR, its
chunk table).
"""

from __future__ import annotations

import os
import struct
from collections.abc import Collection, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import date
from pathlib import Path
from typing import TYPE_CHECKING, Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from lslam.core import __version__
from lslam.core.arrays import Floats, Longs
from lslam.core.errors import InputError, OutputError, cause
from lslam.core.extras import importing
from lslam.core.labels import asprs_table
from lslam.core.types.cloud import BLOCK, TIME_NS, ArrayCloud, Cloud, CloudBlock, Columns, in_memory
from lslam.io.formats.atomic import atomic_write
from lslam.io.formats.copc_files import INFO, INFO_BYTES, USER_ID, copc_bytes, is_copc
from lslam.io.formats.text_tables import is_unix_time

if TYPE_CHECKING:
    import lazrs

_VLR, _EVLR = 54, 60  # bytes of their headers
_LASZIP = b"laszip encoded"
_LAYERED_COMPRESSOR = 3  # the compressor of point formats 6 and above: every field of a chunk lies by itself
# Fields of the items of layered chunks; those of bytes are as many as the bytes.
_LAYERS = {10: 9, 11: 1, 12: 2, 13: 1}
_EXTRA_BYTES = 14
_SIZES = {2: 227, 3: 235, 4: 375, 5: 393}  # bytes of the header by minor version
SCALE = 0.001  # m
_WAY_OUT = "install it with: pip install laspy lazrs"
_REACH = 2**31 - 1
_REACH_NS = 2**63 - 1
_LAST_SOURCE = 2**16 - 1
_COLOURS = ("red", "green", "blue")
_ABOUT = {  # 32 characters at most
    "scan": "number of the scan",
    "ring": "number of the beam",
    "range": "m from the sensor",
    "observations": "number of points averaged",
    "class": "class of the recording",
}
_BLOCK = 1 << 26  # bytes of points decompressed at a time
_GPS_EPOCH_S = 315_964_800  # Unix time of 1980-01-06
_LAS_OFFSET_S = 1_000_000_000
# s that GPS is ahead of UTC, from the Unix time on at which it grew (IERS, Bulletin C); before 1999 nothing counts as Unix time.
_LEAPS = np.array(
    [
        (915_148_800, 13),
        (1_136_073_600, 14),
        (1_230_768_000, 15),
        (1_341_100_800, 16),
        (1_435_708_800, 17),
        (1_483_228_800, 18),
    ]
)


def check_las(stream: BinaryIO) -> tuple[int, int]:
    """Bytes of a point, and of the largest decompressed chunk. Raises ValueError naming the sizes that contradict each other."""
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
        return record, record * _check_chunks(stream, *_laszip(stream, own, vlrs, record), count, offset, record)
    return record, 0


def _laszip(stream: BinaryIO, begin: int, vlrs: int, record: int) -> tuple[lazrs.LazVlr, int]:
    """Compression scheme of points, and layers of a chunk (0 without); raises ValueError if the file does not state it.

    begin : byte of the first of `vlrs` variable length records; record : bytes of a point, which the scheme must have
    """
    import lazrs

    position = begin
    for _ in range(vlrs):
        stream.seek(position)
        head = stream.read(_VLR)
        if len(head) < _VLR:
            break
        user, number, length = struct.unpack_from("<16sHH", head, 2)
        if user.rstrip(b"\0") == _LASZIP and number == 22204:
            data = stream.read(length)
            laszip = lazrs.LazVlr(data)
            if laszip.item_size() != record or laszip.chunk_size() == 0:
                raise ValueError(f"its compression is of points that have not {record} bytes")
            compressor, items = struct.unpack_from("<H30xH", data)
            kinds = list(struct.iter_unpack("<HHH", data[34 : 34 + 6 * items]))
            layers = sum(size if kind == _EXTRA_BYTES else _LAYERS.get(kind, 0) for kind, size, _ in kinds)
            return laszip, layers if compressor == _LAYERED_COMPRESSOR else 0
        position += _VLR + length
    raise ValueError("nothing says how its points are compressed")


def _check_chunks(stream: BinaryIO, laszip: lazrs.LazVlr, layers: int, count: int, offset: int, record: int) -> int:
    """Largest number of points of a chunk. Raises ValueError if the chunk table contradicts the file.

    layers : of a chunk, 0 without; count : points of the file; offset : byte at which they begin; record : bytes of a point
    The position in the stream changes.
    """
    import lazrs

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
    if not laszip.uses_variable_size_chunks() and chunks != -(-count // laszip.chunk_size()):
        raise ValueError(f"{count} points in chunks of {laszip.chunk_size()} are not {chunks} chunks")
    # The table is compressed itself; how many entries it has is known by now.
    stream.seek(offset)
    entries = lazrs.read_chunk_table(stream, laszip)
    for _, length in entries:
        if length < record or begin + length > table:
            raise ValueError(f"the chunk at byte {begin} is said to have {length} bytes")
        if layers:
            _check_layers(stream, layers, begin, length, record)
        begin += length
    return max((points for points, _ in entries), default=0)


def _check_layers(stream: BinaryIO, layers: int, begin: int, length: int, record: int) -> None:
    """Raise ValueError if a chunk's `length`, bytes, at `begin` is too short for its layers."""
    stream.seek(begin + record)
    need = 4 + 4 * layers
    said = stream.read(need) if record + need <= length else b""
    if len(said) < need or record + need + sum(struct.unpack_from(f"<{layers}I", said, 4)) > length:
        raise ValueError(f"the chunk at byte {begin} has less than its layers need")


def write_las(path: Path, cloud: Cloud, wkt: str = "") -> None:
    """Write a cloud, m, as LAS 1.4 (point format 6, with colours 7); `.laz` compresses it, `.copc.laz` holds it in memory too.

    Coordinates are millimetres about an offset, the floor of the smallest ones. Intensities are 16 bits: 0..1 and 0..255
    are spread over them, larger values are kept. The file is dated 1970, so the same cloud gives the same bytes.

    Columns that LAS has take its fields: times `gps_time`, adjusted standard GPS time where the clock tells Unix time, else its
    own seconds, marked as week time; scans `point_source_id`; classes, in groups of `lslam.core.labels.ASPRS`,
    `classification`; colours. Classes as they are, scans of more than 16 bits (0 there), and the rest are extra dimensions.

    wkt : coordinate reference system of the points; empty: none

    Raises OutputError when the file cannot be written, or the cloud is wider than the millimetres of LAS reach (2147 km).
    """
    with importing("laspy", _WAY_OUT):
        import laspy
        import lazrs  # noqa: F401
    low, high, largest, first_ns = _survey(cloud)
    offset = np.floor(low)
    if np.any(high - offset > SCALE * _REACH):
        raise OutputError(f"{path}: the map is wider than LAS can hold in millimetres: crop it with --crop")
    is_unix = is_unix_time(first_ns)
    header = _header(laspy, offset, wkt, cloud.column_types, is_unix)
    factor = 65535.0 if largest <= 1.0 else 257.0 if largest <= 255.0 else 1.0

    def record_of(block: CloudBlock | ArrayCloud) -> Any:
        record = laspy.ScaleAwarePointRecord.zeros(len(block), header=header)
        steps = np.rint((block.points - offset) / SCALE)
        record["X"], record["Y"], record["Z"] = steps.astype(np.int32).T
        if block.intensity is not None:
            record["intensity"] = np.clip(np.rint(block.intensity * factor), 0, 65535).astype(np.uint16)
        for name, values in _fields(block.columns, is_unix).items():
            record[name] = values
        record["return_number"] = record["number_of_returns"] = np.ones(len(block), np.uint8)
        return record

    with atomic_write(path) as stream:
        if is_copc(path):
            header.vlrs.insert(0, laspy.vlrs.vlr.VLR(USER_ID, INFO, "COPC info VLR", bytes(INFO_BYTES)))
            laszip = laspy.vlrs.known.LasZipVlr
            stream.write(copc_bytes(header, record_of(in_memory(cloud)), laszip).getbuffer())
            return
        compressed = path.suffix.lower() == ".laz"
        with laspy.open(stream, mode="w", header=header, do_compress=compressed, closefd=False) as writer:
            for block in cloud.blocks():
                writer.write_points(record_of(block))


def read_las(path: Path) -> tuple[ArrayCloud, str]:
    """Read points (m), 16-bit intensities and WKT (empty if none) of a LAS or LAZ file. Raises InputError if it is damaged."""
    with _open_reader(path) as (reader, size):
        blocks = [
            (np.column_stack([block.x, block.y, block.z]), np.asarray(block.intensity, np.float32))
            for block in reader.chunk_iterator(size)
        ]
        header = reader.header
    points = np.concatenate([np.zeros((0, 3)), *(points for points, _ in blocks)])
    intensity = np.concatenate([np.zeros(0, np.float32), *(values for _, values in blocks)])
    texts = [vlr.string for vlr in header.vlrs if type(vlr).__name__ == "WktCoordinateSystemVlr"]
    return ArrayCloud(points, intensity), texts[0].rstrip("\0") if texts else ""


@dataclass(frozen=True)
class LasCloud:
    """A LAS or LAZ file that lslam wrote, with the columns of its points, read block by block; satisfies `Cloud`."""

    path: Path
    count: int
    column_types: Mapping[str, np.dtype[Any]]
    is_unix: bool
    has_intensity: bool = True

    def __len__(self) -> int:
        return self.count

    def blocks(self) -> Iterator[CloudBlock]:
        """The points, in the coordinates of the file. Raises InputError if it is damaged."""
        with _open_reader(self.path) as (reader, size):
            for block in reader.chunk_iterator(min(size, BLOCK)):
                columns = {name: self._column(block, name, kind) for name, kind in self.column_types.items()}
                points = np.column_stack([block.x, block.y, block.z])
                yield CloudBlock(points, np.asarray(block.intensity, np.float32), columns)

    def _column(self, block: Any, name: str, kind: np.dtype[Any]) -> NDArray[Any]:
        """Values of the column `name`, of type `kind`, from a block of laspy; times are ns."""
        if name == TIME_NS:
            seconds = np.asarray(block["gps_time"], np.float64)
            return unix_time_ns(seconds) if self.is_unix else np.rint(1e9 * seconds).astype(np.int64)
        if name in _COLOURS:
            return (np.asarray(block[name]) // 257).astype(kind)
        return np.asarray(block["point_source_id" if name == "scan" and kind.itemsize == 2 else name], kind)


def open_las(path: Path, attributes: Collection[str]) -> LasCloud:
    """Open a map of lslam whose points have these `attributes`, as its note names them. Raises InputError if it is damaged."""
    with _open_reader(path) as (reader, _):
        header = reader.header
    kinds = {d.name: d.dtype for d in header.point_format.dimensions if d.dtype is not None}
    types: dict[str, np.dtype[Any]] = {name: np.dtype(np.uint8) for name in _COLOURS if name in kinds}
    types |= {TIME_NS: np.dtype(np.int64)} if "time" in attributes else {}
    types |= {"scan": np.dtype(kinds.get("scan", np.uint16))} if "scan" in attributes else {}
    types |= {name: np.dtype(kinds[name]) for name in attributes if name not in ("time", "scan") and name in kinds}
    return LasCloud(path, header.point_count, types, int(header.global_encoding.gps_time_type) == 1)


@contextmanager
def _open_reader(path: Path) -> Iterator[tuple[Any, int]]:
    """Context of a laspy reader and the number of points it may decompress at once. Errors inside become InputError."""
    with importing("laspy", _WAY_OUT):
        import laspy
        import lazrs  # noqa: F401
    try:
        with path.open("rb") as stream:
            record, largest = check_las(stream)
            stream.seek(0)
            # On all cores whole chunks are decompressed at once, however large they are.
            backend = laspy.LazBackend.LazrsParallel if largest <= _BLOCK else laspy.LazBackend.Lazrs
            with laspy.open(stream, closefd=False, laz_backend=backend) as reader:
                yield reader, max(_BLOCK // record, 1)
    except OSError as error:
        raise InputError(f"{path} cannot be read: {cause(error)}") from None
    except BaseException as error:  # laspy and lazrs raise whatever a damaged byte leads to, Rust its panics
        if not isinstance(error, Exception) and type(error).__name__ != "PanicException":
            raise
        raise InputError(f"{path} cannot be read as LAS: {error}") from None


def is_extra(name: str, kind: np.dtype[Any]) -> bool:
    """Whether a column of this type is an extra dimension; classes are one beside their own field, as are wide scan numbers."""
    return name not in (*_COLOURS, TIME_NS, "scan") or (name == "scan" and kind.itemsize > 2)


def _fields(columns: Columns, is_unix: bool) -> dict[str, NDArray[Any]]:
    """Values of LAS fields and extra dimensions, by name; is_unix : times are Unix time."""
    fields: dict[str, NDArray[Any]] = {name: v for name, v in columns.items() if is_extra(name, v.dtype)}
    if TIME_NS in columns:
        fields["gps_time"] = gps_time_s(columns[TIME_NS], is_unix)
    for name in set(_COLOURS).intersection(columns):
        fields[name] = columns[name].astype(np.uint16) * 257
    if "class" in columns:
        fields["classification"] = asprs_table()[columns["class"]]
    if "scan" in columns:
        fields["point_source_id"] = np.where(columns["scan"] <= _LAST_SOURCE, columns["scan"], 0).astype(np.uint16)
    return fields


def _header(laspy: Any, offset: Floats, wkt: str, types: Mapping[str, np.dtype[Any]], is_unix: bool) -> Any:
    """laspy header for points of these column types; offset : (3,) m; is_unix : whether their times are Unix time."""
    header = laspy.LasHeader(version="1.4", point_format=7 if set(_COLOURS) & set(types) else 6)
    own = _fields({name: np.zeros(0, kind) for name, kind in types.items()}, is_unix)
    known = set(header.point_format.dimension_names)
    header.add_extra_dims(
        [laspy.ExtraBytesParams(n, v.dtype.name, _ABOUT.get(n, "")) for n, v in own.items() if n not in known]
    )
    if TIME_NS in types and is_unix:
        header.global_encoding.gps_time_type = laspy.header.GpsTimeType.STANDARD
    header.scales, header.offsets = np.full(3, SCALE), offset
    header.creation_date = date(1970, 1, 1)  # laspy would put today's
    header.system_identifier = "lslam"
    header.generating_software = f"lslam {__version__}"
    # Format 6 has to say WKT, also when there is none.
    header.global_encoding.wkt = True
    if wkt:
        header.vlrs.append(laspy.vlrs.known.WktCoordinateSystemVlr(wkt))
    return header


def _survey(cloud: Cloud) -> tuple[Floats, Floats, float, int]:
    """Smallest and largest coordinates (3,), m, the largest intensity and the earliest time, ns; zeros for nothing."""
    low, high, largest, first_ns = np.full(3, np.inf), np.full(3, -np.inf), 0.0, _REACH_NS
    for block in cloud.blocks():
        low, high = np.minimum(low, block.points.min(0)), np.maximum(high, block.points.max(0))
        if block.intensity is not None:
            largest = max(largest, float(block.intensity.max()))
        first_ns = min(first_ns, int(block.columns[TIME_NS].min()) if TIME_NS in block.columns else 0)
    return (low, high, largest, first_ns) if np.isfinite(low).all() else (np.zeros(3), np.zeros(3), 0.0, 0)


def gps_time_s(stamps_ns: Longs, is_unix: bool) -> Floats:
    """(N,) adjusted standard GPS time, s since 1980-01-06 less 1e9, of Unix times (N,), ns; of another clock its own seconds.

    >>> gps_time_s(np.array([1_700_000_000_500_000_000]), True).tolist()
    [384035218.5]
    """
    if not is_unix:
        return np.asarray(1e-9 * stamps_ns)
    seconds, rest_ns = np.divmod(stamps_ns, 10**9)
    leaps = _LEAPS[np.maximum(np.searchsorted(_LEAPS[:, 0], seconds, side="right") - 1, 0), 1]
    return np.asarray((seconds - _GPS_EPOCH_S + leaps - _LAS_OFFSET_S) + 1e-9 * rest_ns)


def unix_time_ns(gps_s: Floats) -> Longs:
    """(N,) Unix times, ns, of adjusted standard GPS times (N,), s: the inverse of `gps_time_s`, to the last bits of a double.

    >>> unix_time_ns(np.array([384035218.5])).tolist()
    [1700000000500000000]
    """
    seconds, rest = np.divmod(gps_s, 1.0)
    ahead = seconds.astype(np.int64) + _GPS_EPOCH_S + _LAS_OFFSET_S
    leaps = _LEAPS[np.maximum(np.searchsorted(_LEAPS.sum(axis=1), ahead, side="right") - 1, 0), 1]
    return np.asarray((ahead - leaps) * 10**9 + np.rint(1e9 * rest).astype(np.int64))
