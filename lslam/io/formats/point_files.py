"""Point files by suffix: clouds in `.bin`, PCD, PLY and NumPy; maps in PLY, PCD, LAS and LAZ, written block by block."""

from __future__ import annotations

import logging
import mmap
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from tokenize import TokenError
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lslam.core.arrays import Floats
from lslam.core.errors import InputError, UsageError, input_errors
from lslam.core.types.cloud import BLOCK, TIME_NS, ArrayCloud, Cloud, CloudBlock, Columns
from lslam.core.untrusted import MISFIT
from lslam.io.formats.atomic import atomic_write
from lslam.io.formats.las_files import open_las, read_las, write_las
from lslam.io.formats.pcd_files import packed_colour, pcd_columns, pcd_header
from lslam.io.formats.ply_files import ply_columns, ply_header
from lslam.io.formats.point_cloud import AXES, PointCloud, cloud_from_fields, float_table
from lslam.io.formats.point_records import KITTI, WAY_OUT, PointRecord, name_columns, recognise
from lslam.io.formats.state_files import HEADERS
from lslam.io.remote import RemotePath

LABELS = "labels"  # SemanticKITTI's folder
SUFFIXES = (".bin", ".pcd", ".ply", ".npy")
MAP_SUFFIXES = (".ply", ".pcd", ".las", ".laz")
_MOST_COLUMNS = 64
_PLACES = ("xyz", "point", "points", "position", "positions")
# Coordinates beyond are those of a projection; of a map they shall lie in finer steps.
LARGE_M, COARSE_M = 1e5, 0.01
_FEW = 8
_COLOURS = ("red", "green", "blue")
log = logging.getLogger("lslam")


def read_points(path: Path, record: PointRecord | None = None) -> PointCloud:
    """Read one point file, chosen by its suffix; NaN, Inf and zero points are kept as they are.

    record : of a `.bin` file or of a plain NumPy array; None detects it. Raises InputError naming the file and the place.
    """
    return cloud_from_fields(path, _read_columns(path, record))


def _read_columns(path: Path, record: PointRecord | None = None) -> Mapping[str, NDArray[Any]]:
    """Columns of a point file by name; record : of `.bin` and `.npy` files, None to detect it. Raises InputError."""
    suffix = path.suffix.lower()
    if suffix == ".bin":
        raw = read_bytes(path)
        record = record or record_of({path: raw})[0]
        check_size(path, raw, record)
        return record.columns(raw)
    if suffix == ".npy":
        return _npy_columns(path, record)
    if suffix in _COLUMNS:
        return _COLUMNS[suffix](path)
    raise InputError(f"{path}: no point file lslam reads; known suffixes: {', '.join(SUFFIXES)}")


def read_bytes(path: Path) -> NDArray[np.uint8]:
    """All bytes of a file. Raises InputError naming it when it cannot be read."""
    with input_errors(path):
        if isinstance(path, RemotePath):
            return np.frombuffer(bytearray(path.read_bytes()), np.uint8)
        with path.open("rb") as stream:
            return np.fromfile(stream, np.uint8)


def check_size(path: Path, raw: NDArray[np.uint8], record: PointRecord) -> None:
    """Raise InputError when the size of a file is no multiple of the size of a point, bytes."""
    if len(raw) % record.size:
        what = "x, y, z, intensity as float32" if record == KITTI else str(record)
        raise InputError(
            f"{path}: {len(raw)} bytes are no multiple of {record.size} ({what}): the file is truncated after point "
            f"{len(raw) // record.size}, or its records are of {_other_sizes(len(raw), record)} bytes: {WAY_OUT}"
        )


def record_of(files: Mapping[Path, NDArray[np.uint8]]) -> tuple[PointRecord, str]:
    """Detect the point record of `.bin` files by their values.

    The second result is the reason why it is not KITTI's; it is empty if it is.

    Raises InputError with the sizes that would fit when no record fits or several do.
    """
    recognition = recognise(list(files.values()))
    if recognition.record is not None:
        return recognition.record, recognition.reason
    path, raw = next((path, raw) for path, raw in files.items() if len(raw))
    if recognition.fitting:
        records = " or ".join(f"{record.size} bytes ({record})" for record in recognition.fitting)
        could = f"its values allow records of {records}"
    else:
        check_size(path, raw, KITTI)
        could = f"it could be truncated, or its records are of {_other_sizes(len(raw), KITTI)} bytes"
    raise InputError(f"{path}: as {KITTI} of {KITTI.size} bytes {recognition.reason}; {could}: {WAY_OUT}")


def _other_sizes(size: int, record: PointRecord) -> str:
    """Other point sizes, bytes, that divide the size of a file, for a message."""
    sizes = [str(k) for k in range(12, 65) if k != record.size and size % k == 0]
    return ", ".join(sizes) or "another number of"


def write_bin(path: Path, points: NDArray[Any], intensity: NDArray[Any] | None = None) -> None:
    """Write points (N, 3), m, and intensity (N,), or zeros, as KITTI's records, atomically.

    Raises UsageError on arrays that do not match, OutputError when the file cannot be written.
    """
    if np.ndim(points) != 2 or np.shape(points)[1] != 3 or (intensity is not None and len(intensity) != len(points)):
        raise UsageError(f"{path}: points must be (N, 3) and intensity (N,), not {np.shape(points)}")
    with atomic_write(path) as stream:
        stream.write(float_table(points, np.zeros(len(points)) if intensity is None else intensity).data)


def read_labels(path: Path, count: int) -> NDArray[np.uint16]:
    """Classes (count,) of the points of a scan: the lower 16 bits of SemanticKITTI's labels; the upper ones are instances.

    Raises InputError when the file cannot be read, or holds another number of labels.
    """
    raw = read_bytes(path)
    if len(raw) != 4 * count:
        raise InputError(f"{path}: {len(raw)} bytes are no labels of {count} points, 4 bytes each")
    return raw.view("<u4").astype(np.uint16)


def write_labels(path: Path, labels: NDArray[np.uint16]) -> None:
    """Write the classes of a scan's points as SemanticKITTI does, atomically. Raises OutputError."""
    with atomic_write(path) as stream:
        stream.write(labels.astype("<u4").data)


def read_array(path: Path) -> NDArray[Any]:
    """Read the array of points in a .npy file: structured (N,), or numbers (N, K); organised clouds become (N, K) row by row.

    Raises InputError for anything else.
    """
    kinds = (*MISFIT, EOFError, SyntaxError, MemoryError, TokenError)
    with input_errors(path, *kinds, as_what="a NumPy array"), HEADERS, path.open("rb") as stream:
        table = np.lib.format.read_array(stream, allow_pickle=False)
    if table.dtype.names:
        flat: NDArray[Any] = table.ravel()
        return flat
    # Organised clouds (rows, cols, K) are flattened row by row.
    if table.ndim not in (2, 3) or not 3 <= table.shape[-1] <= _MOST_COLUMNS or table.dtype.kind not in "fiu":
        raise InputError(
            f"{path}: array of shape {table.shape} and type {table.dtype}, expected (N, 3), (N, 4) or up to "
            f"(N, {_MOST_COLUMNS}) numbers"
        )
    return np.asarray(table.reshape(-1, table.shape[-1]))


def _npy_columns(path: Path, record: PointRecord | None) -> Mapping[str, NDArray[Any]]:
    """Columns by name of a NumPy file, named by `record`, its fields or values; InputError if numbers of columns differ."""
    table = read_array(path)
    if table.dtype.names:
        return _of_structure(table)
    names = name_columns([table]) if record is None else record.names
    if len(names) != table.shape[1]:
        raise InputError(f"{path}: {table.shape[1]} columns where {' '.join(names)} are {len(names)}")
    return {name: table[:, k] for k, name in enumerate(names) if name != "_"}


def _of_structure(table: NDArray[Any]) -> dict[str, NDArray[Any]]:
    """Fields of a structured array, one number each. A field of three numbers is x, y and z if no field has these names."""
    numbers = [name for name in table.dtype.names or () if table[name].dtype.kind in "fiu"]
    columns = {name: table[name] for name in numbers if table[name].ndim == 1}
    is_placed = "x" in map(str.lower, columns)
    for name in () if is_placed else numbers:
        if name.lower() in _PLACES and table[name].shape[1:] == (3,):
            columns |= {axis: table[name][:, k] for k, axis in enumerate(AXES)}
    return columns


def _text_columns(path: Path) -> dict[str, NDArray[Any]]:
    """Columns x y z intensity of a KITTI raw `extract` scan, one point per line; InputError for another number."""
    with input_errors(path, ValueError, as_what="lines of x y z intensity"):
        text = path.read_text(encoding="ascii")
        table = np.loadtxt(text.splitlines(), np.float32, ndmin=2) if text.strip() else np.zeros((0, 4), np.float32)
    if table.shape[1] != 4:
        raise InputError(f"{path}: {table.shape[1]} numbers a line where x y z intensity are 4")
    return dict(zip(KITTI.names, table.T, strict=True))


_COLUMNS = {".pcd": pcd_columns, ".ply": ply_columns, ".txt": _text_columns}


def write_cloud(path: Path, cloud: Cloud, *, comment: str = "", wkt: str = "") -> None:
    """Write a cloud, m, atomically and block by block: .ply and .pcd store float32, .las and .laz millimetres.

    Further columns follow, `time` in s.

    comment : for PLY headers; wkt : coordinate reference system, for LAS. Raises UsageError on another suffix, OutputError.
    """
    suffix = path.suffix.lower()
    if suffix in (".las", ".laz"):
        write_las(path, cloud, wkt)
        return
    if suffix not in MAP_SUFFIXES:
        raise UsageError(f"{path}: no map file lslam writes; known suffixes: {', '.join(MAP_SUFFIXES)}")
    is_ply = suffix == ".ply"
    pack = dict if is_ply else packed_colour
    kind = _record_type(cloud, pack)
    with atomic_write(path) as stream:
        stream.write(ply_header(len(cloud), kind, comment) if is_ply else pcd_header(len(cloud), kind))
        for block in cloud.blocks():
            stream.write(_records(block, kind, pack).tobytes())


def write_ply(
    path: Path,
    points: NDArray[Any],
    intensity: NDArray[Any] | None = None,
    comment: str = "",
    *,
    scalars: Mapping[str, NDArray[Any]] | None = None,
    colours: NDArray[np.uint8] | None = None,
) -> None:
    """Write points (N, 3), m, intensity (N,) and further `scalars` (N,) by name as float32, binary little endian, atomically.

    colours : (N, 3) red, green, blue, which viewers show at once
    """
    columns: dict[str, NDArray[Any]] = {name: v.astype(np.float32) for name, v in (scalars or {}).items()}
    columns |= {} if colours is None else dict(zip(_COLOURS, np.transpose(colours), strict=True))
    write_cloud(path, replace(ArrayCloud.of(points, intensity), columns=columns), comment=comment)


def _record_type(cloud: Cloud, pack: Callable[[Columns], Columns]) -> np.dtype[Any]:
    """Record of a point in PLY and PCD, its columns packed; times are seconds, since neither has integers of 64 bits."""
    names = [*AXES, "intensity"] if cloud.has_intensity else AXES
    columns = pack({name: np.empty(0, kind) for name, kind in cloud.column_types.items()})
    further = [
        ("time", "<f8") if name == TIME_NS else (name, values.dtype.newbyteorder("<"))
        for name, values in columns.items()
    ]
    return np.dtype([*((name, "<f4") for name in names), *further])


def _records(block: CloudBlock, kind: np.dtype[Any], pack: Callable[[Columns], Columns]) -> NDArray[Any]:
    """Structured array of the points of a block, of type `kind`; pack : converts the columns."""
    columns = pack(block.columns)
    values = {**dict(zip(AXES, block.points.T, strict=True)), "intensity": block.intensity, **columns}
    if TIME_NS in values:
        values["time"] = 1e-9 * block.columns[TIME_NS]
    table = np.empty(len(block), kind)
    for name in kind.names or ():
        table[name] = values[name]
    return table


def read_cloud(path: Path) -> ArrayCloud:
    """Read any map or point file whole as float64, m; warns of large coordinates with a coarse resolution.

    Raises InputError naming the file when it is missing, damaged or of another kind.
    """
    if path.suffix.lower() in (".las", ".laz"):
        cloud = read_las(path)[0]
    else:
        read = cloud_from_fields(path, _read_columns(path), np.float64)
        cloud = ArrayCloud.of(read.points, read.intensity)
    step = coordinate_step(cloud.points)
    if step > COARSE_M:
        log.warning(
            "%s: its coordinates lie in steps of %.3g m, too coarse so far from the origin: write "
            "them as double, or less an offset",
            path,
            step,
        )
    return cloud


def open_map(path: Path, attributes: Collection[str]) -> Cloud:
    """Open a map that lslam wrote, with the columns of its points, in the coordinates of the file, m.

    attributes : of its points, as its note names them. Of PLY, LAS and LAZ no more is held than a block; PCD is read whole.
    Raises InputError naming the file when it is missing, damaged or of another kind, of LAS while its blocks are read.
    """
    suffix = path.suffix.lower()
    if suffix in (".las", ".laz"):
        return open_las(path, attributes)
    if suffix != ".ply":
        fields = dict(_read_columns(path))
    else:
        with input_errors(path, ValueError, as_what="a map"), path.open("rb") as stream:
            fields = ply_columns(path, mmap.mmap(stream.fileno(), 0, access=mmap.ACCESS_READ))
    if missing := [axis for axis in AXES if axis not in fields]:
        raise InputError(f"{path}: no field {', '.join(missing)}; the file has {', '.join(fields) or 'no fields'}")
    if "rgb" in fields:
        pack = np.ascontiguousarray(fields["rgb"]).view(np.uint32)
        fields |= {name: (pack >> shift).astype(np.uint8) for name, shift in zip(_COLOURS, (16, 8, 0), strict=True)}
    return ColumnCloud(fields, attributes)


def coordinate_step(points: Floats) -> float:
    """Quantisation step of the coordinates, m: the largest of the axes; 0 for small coordinates."""
    steps = [0.0]
    for column in points.T:
        values = np.unique(column[np.isfinite(column)])
        if len(values) >= _FEW and np.abs(values).max() > LARGE_M:
            between = np.diff(values)
            counted = between / between.min()
            if np.abs(counted - np.round(counted)).max() < 0.01:
                steps.append(float(between.min()))
    return max(steps)


class ColumnCloud:
    """A cloud of named columns (N,), which may be mapped from a file: `x`, `y`, `z`, `intensity`, colours and attributes."""

    def __init__(self, columns: Mapping[str, NDArray[Any]], attributes: Collection[str]) -> None:
        self._columns = columns
        # Times are seconds in the file.
        self._names = {
            TIME_NS if name == "time" else name: name for name in (*attributes, *_COLOURS) if name in columns
        }
        types = {name: columns[own].dtype.newbyteorder("=") for name, own in self._names.items()}
        self.column_types = types | ({TIME_NS: np.dtype(np.int64)} if TIME_NS in types else {})

    def __len__(self) -> int:
        return len(self._columns["x"])

    @property
    def has_intensity(self) -> bool:
        """Whether there are intensities."""
        return "intensity" in self._columns

    def blocks(self) -> Iterator[CloudBlock]:
        """All points, as arrays of their own."""
        for begin in range(0, len(self), BLOCK):
            part = {name: column[begin : begin + BLOCK] for name, column in self._columns.items()}
            points = np.column_stack([part[axis].astype(np.float64) for axis in AXES])
            intensity = part["intensity"].astype(np.float32) if self.has_intensity else None
            values = {
                name: np.rint(1e9 * part[own]) if name == TIME_NS else part[own] for name, own in self._names.items()
            }
            yield CloudBlock(points, intensity, {name: v.astype(self.column_types[name]) for name, v in values.items()})


class MapCloud:
    """One map of one or several files of a kind, of which one is open at a time; raises as `open_map`.

    attributes : of its points; to_world : takes points (N, 3) of the files, m, to those of the cloud
    """

    def __init__(
        self, paths: Sequence[Path], attributes: Collection[str], to_world: Callable[[Floats], Floats]
    ) -> None:
        self._paths, self._attributes, self._to_world = paths, attributes, to_world
        self._size, self.has_intensity = 0, True
        known: list[Mapping[str, np.dtype[Any]]] = []
        for part in self._parts():
            self._size += len(part)
            self.has_intensity &= part.has_intensity
            known.append(part.column_types)
        self.column_types = {name: kind for name, kind in known[0].items() if all(name in one for one in known)}

    def _parts(self) -> Iterator[Cloud]:
        """The clouds of the files, each opened in its turn."""
        return (open_map(path, self._attributes) for path in self._paths)

    def __len__(self) -> int:
        return self._size

    def blocks(self) -> Iterator[CloudBlock]:
        """The blocks of one file after the other."""
        for part in self._parts():
            for block in part.blocks():
                columns = {name: block.columns[name] for name in self.column_types}
                intensity = block.intensity if self.has_intensity else None
                yield CloudBlock(self._to_world(block.points), intensity, columns)
