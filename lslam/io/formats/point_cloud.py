"""A point cloud as files hold it, and the table of field names that drivers and file formats use."""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lslam.core.arrays import Floats, Longs
from lslam.core.errors import InputError
from lslam.core.types.scan import NO_RING, has_return
from lslam.io.formats.time_columns import UNIT_OF, UNITS

AXES = ("x", "y", "z")
# Names as `plain_name` makes them, the likeliest first. docs/conventions.md, "Fields of points", says whose they are.
AXIS_NAMES = {
    axis: (axis, f"pos_{axis}", f"position_{axis}", f"point_{axis}", f"p{axis}", f"{axis}_m") for axis in AXES
}
INTENSITY_NAMES = (
    "intensity",
    "intensities",
    "i",
    "reflectivity",
    "reflectance",
    "remission",
    "remittance",
    "amplitude",
    "signal",
    "echo_intensity",
)
# Nothing else is called so; the others are rings when their values can be.
_SURE_RING_NAMES = ("ring", "rings", "ring_id", "ring_index")
RING_NAMES = (
    *_SURE_RING_NAMES,
    "channel",
    "line",
    "laser_id",
    "channel_id",
    "line_id",
    "line_index",
    "laser",
    "laser_number",
    "beam",
    "beam_id",
    "beam_index",
    "layer",
    "row",
    "scan_line",
    "scanline",
    "shorter_side",
)
TIME_NAMES = (
    "t",
    "time",
    "times",
    "timestamp",
    "timestamps",
    "time_stamp",
    "offset_time",
    "time_offset",
    "timeoffset",
    "stamp",
    "ts",
    "point_time_offset",
    "relative_timestamp",
    "relative_time",
    "rel_time",
    "point_time",
    "point_timestamp",
    "gps_time",
    "gpstime",
    "utc_time",
    "delta_time",
    "delta_t",
    "dt",
    "lidar_timestamp",
    "sensor_timestamp",
    "firing_time",
    "fire_time",
    "capture_time",
    "offset_ns",
    "offset_us",
    "curvature",
)
# The likeliest first; Livox's `tag` says how sure a return is.
LABEL_NAMES = (
    "label",
    "labels",
    "semantic",
    "semantics",
    "semantic_label",
    "semantic_id",
    "semantic_class",
    "sem_label",
    "sem_class",
    "label_id",
    "class",
    "class_id",
    "class_label",
    "classification",
    "category",
    "tag",
)
# FAST-LIO's clouds keep ms in a field that other software fills with the curvature of the surface.
_DOUBTFUL_TIMES = {"curvature": "ms"}
# Before `_sec` and `_nsec`, where it is none of `TIME_NAMES`.
_CLOCKS = ("", "lidar", "sensor", "point", "utc", "gps", "header", "epoch")
SHORTER_SIDE = "(shorter side)"
# A field of another name than ring with fewer values numbers the heads of a sensor, with more its columns; the values of a
# small cloud say nothing.
_FEWEST_RINGS, _MOST_RINGS, _TOO_SMALL = 4, 300, 100


@dataclass(frozen=True)
class TimeColumn:
    """A field, or two together, that may hold per-point times.

    name : in the file; values : (N,) as stored; unit : `s`, `ms`, `us` or `ns`, empty where the name says none
    is_doubtful : other software uses the name for something else
    """

    name: str
    values: NDArray[Any]
    unit: str = ""
    is_doubtful: bool = False

    @property
    def is_constant(self) -> bool:
        """Whether all points have one value: the driver did not fill the field."""
        return len(self.values) > 1 and bool((self.values == self.values[0]).all())


@dataclass(frozen=True)
class PointCloud:
    """Content of a point file.

    points : (N, 3) float32 (of maps float64), m; intensity : (N,) float32 or None
    rings : (N,) uint16, `NO_RING` for points without one, or None
    labels : (N,) uint16, class of each point, or None
    clocks : candidates for per-point times, the likeliest first; fields : names of the fields used; unread : of all others
    """

    points: NDArray[Any]
    intensity: NDArray[np.float32] | None = None
    rings: NDArray[np.uint16] | None = None
    labels: NDArray[np.uint16] | None = None
    clocks: tuple[TimeColumn, ...] = ()
    fields: tuple[str, ...] = ()
    unread: tuple[str, ...] = ()

    def __len__(self) -> int:
        return len(self.points)

    @property
    def times(self) -> NDArray[Any] | None:
        """(N,) per-point times as stored, of any type and unit, from the most likely field; None without one."""
        return self.clocks[0].values if self.clocks else None

    def select(self, mask: NDArray[Any]) -> PointCloud:
        """Cloud of the points that `mask` (bool or indices) keeps, with all their fields."""
        return replace(
            self,
            points=self.points[mask],
            intensity=None if self.intensity is None else self.intensity[mask],
            rings=None if self.rings is None else self.rings[mask],
            labels=None if self.labels is None else self.labels[mask],
            clocks=tuple(replace(clock, values=clock.values[mask]) for clock in self.clocks),
        )


def ring_column(rows: int, cols: int) -> dict[str, NDArray[Any]]:
    """Ring of each point of an organised cloud, as a column along its shorter side; empty for an unorganised cloud."""
    if min(rows, cols) < 2:
        return {}
    return {SHORTER_SIDE: np.asarray(np.divmod(np.arange(rows * cols), cols)[0 if rows <= cols else 1], np.uint32)}


def beyond(count: int, more: int) -> dict[str, NDArray[Any]]:
    """Column without values whose name states that points follow behind those that the header counts; empty if none do."""
    return {f"{more} points behind the {count} of the header": np.zeros(0)} if more > 0 else {}


def packed_columns(
    path: Path,
    kind: str,
    names: Sequence[str],
    dtype: np.dtype[Any],
    count: int,
    data: memoryview,
    at: int = 0,
    *,
    is_last: bool = True,
) -> dict[str, NDArray[Any]]:
    """Read `count` records of `dtype` from byte `at` on: one array per field. Raises InputError when the data end early.

    is_last : nothing else follows; trailing zeros that pad a file are no points
    """
    record = dtype.itemsize
    room = max(len(data) - at, 0)
    if room < count * record:
        whole = room // record
        raise InputError(f"{path}: {kind} header says {count} points of {record} bytes, the file holds {whole}")
    table = np.ndarray((count,), dtype, data, at if count else 0)
    rest = np.frombuffer(data, np.uint8)[at + count * record :]
    more = beyond(count, len(rest) // max(record, 1)) if is_last and rest.any() else {}
    return {name: table[str(k)] for k, name in enumerate(names)} | more


def text_columns(table: Floats, names: Sequence[str], kinds: Sequence[np.dtype[Any]]) -> dict[str, NDArray[Any]]:
    """Numeric columns (N, K) of a text file by field. Coordinates stay float64 whatever type a header states."""
    columns, k = {}, 0
    for name, kind in zip(names, kinds, strict=True):
        end = k + math.prod(kind.shape)
        values = table[:, k:end].reshape(len(table), *kind.shape)
        columns[name] = values if name.lower() in AXES or kind.base.kind != "f" else values.astype(kind.base)
        k = end
    return columns


def float_table(points: NDArray[Any], intensity: NDArray[Any] | None) -> NDArray[np.float32]:
    """(N, 3) points, or (N, 4) with their intensity, as files hold them."""
    table = np.empty((len(points), 3 if intensity is None else 4), "<f4")
    table[:, :3] = points
    if intensity is not None:
        table[:, 3] = intensity
    return table


def cloud_from_fields(
    path: Path, columns: Mapping[str, NDArray[Any]], kind: type[np.floating[Any]] = np.float32
) -> PointCloud:
    """Collect x, y, z and the fields known by name from one array per field, (N,) or, where a field repeats, (N, K).

    kind : of the points: float32 for scans, float64 for maps. Raises InputError naming the fields where x, y or z is missing.
    """
    columns = {name: values for name, values in columns.items() if values.ndim == 1 or values.shape[1]}
    names: dict[str, str] = {}
    for name in columns:
        names.setdefault(plain_name(name), name)
    axes = [_first(names, AXIS_NAMES[axis]) for axis in "xyz"]
    missing = [axis for axis, name in zip("xyz", axes, strict=True) if name is None]
    if missing:
        raise InputError(f"{path}: no field {', '.join(missing)}; the file has {', '.join(columns) or 'no fields'}")
    first = {name: values if values.ndim == 1 else values[:, 0] for name, values in columns.items()}
    points = np.empty((len(first[axes[0] or ""]), 3), kind)
    with np.errstate(over="ignore"):  # farther than `kind` can tell is no place: infinite
        for k, axis in enumerate(axes):
            points[:, k] = first[axis or ""]
    intensity = _first(names, INTENSITY_NAMES)
    ring, rings = _find_rings(points, {names[plain]: first[names[plain]] for plain in RING_NAMES if plain in names})
    label, labels = _find_labels({names[plain]: first[names[plain]] for plain in LABEL_NAMES if plain in names})
    fields = [name for name in (*axes, intensity, ring, label) if name is not None]
    return PointCloud(
        points,
        None if intensity is None else np.ascontiguousarray(first[intensity], np.float32),
        rings,
        labels,
        tuple(_clocks(names, columns)),
        tuple(fields),
        tuple(name for name in columns if name not in (*fields, SHORTER_SIDE) and plain_name(name)),
    )


def plain_name(name: str) -> str:
    """`name` in lower case with one underscore between words, and without CloudCompare's `scalar_`."""
    parted = re.sub(r"(?<=[a-z])(?=[A-Z])", "_", name)
    return re.sub(r"[^a-z0-9]+", "_", parted.lower()).strip("_").removeprefix("scalar_")


def _first(names: Mapping[str, str], plain_names: tuple[str, ...]) -> str | None:
    """The name of the first of `plain_names` among the keys of `names`; None without any."""
    return next((names[plain] for plain in plain_names if plain in names), None)


def _find_rings(
    points: NDArray[np.float32], candidates: Mapping[str, NDArray[Any]]
) -> tuple[str | None, NDArray[np.uint16] | None]:
    """Name and uint16 values of the first field that can be rings, NO_RING where it is none; None and None without one."""
    for name, values in candidates.items():
        if np.can_cast(values.dtype, np.uint16):
            rings = values.astype(np.uint16)
        else:
            with np.errstate(invalid="ignore"):
                is_ring = (values >= 0) & (values < NO_RING) & (np.floor(values) == values)
            rings = np.where(is_ring, values, NO_RING).astype(np.uint16)
            if not is_ring.all():
                measured = has_return(points)
                if 2 * np.count_nonzero(is_ring & measured) < np.count_nonzero(measured):
                    continue
        if plain_name(name) not in _SURE_RING_NAMES and len(rings) > _TOO_SMALL:
            count = np.count_nonzero(np.bincount(rings[rings != NO_RING]))
            if not _FEWEST_RINGS <= count <= _MOST_RINGS:
                continue
        return name, rings
    return None, None


def _find_labels(candidates: Mapping[str, NDArray[Any]]) -> tuple[str | None, NDArray[np.uint16] | None]:
    """The first of the fields whose values are whole numbers, of which the lower 16 bits are the class, as SemanticKITTI's."""
    for name, values in candidates.items():
        whole = _integers(values)
        if whole is not None:
            return name, whole.astype(np.uint16)
    return None, None


def _clocks(names: Mapping[str, str], columns: Mapping[str, NDArray[Any]]) -> Iterator[TimeColumn]:
    """Candidates for per-point times: pairs of seconds and fraction first, then single fields in the order of the table."""
    parted = {plain: _part_unit(plain) for plain in names}
    by_unit = {part: names[plain] for plain, part in parted.items()}
    for (clock, unit), name in by_unit.items():
        fine = next((u for u in ("ns", "us", "ms") if unit == "s" and (clock, u) in by_unit), None)
        if fine is not None and (clock in _CLOCKS or clock in TIME_NAMES):
            other = by_unit[clock, fine]
            yield from _seconds_and(fine, f"{name} + {other}", columns[name], columns[other])
    known = [plain for plain in names if parted[plain][0] in TIME_NAMES]
    for plain in sorted(known, key=lambda plain: (TIME_NAMES.index(parted[plain][0]), plain)):
        name, (clock, unit) = names[plain], parted[plain]
        values = columns[name]
        if values.ndim == 2 and values.shape[1] == 2:
            yield from _two_words(name, values)
        elif values.ndim == 1 and values.dtype.kind in "fiu":
            is_doubtful = clock in _DOUBTFUL_TIMES
            yield TimeColumn(name, values, unit or _DOUBTFUL_TIMES.get(clock, ""), is_doubtful)


def _part_unit(plain: str) -> tuple[str, str]:
    """Split a unit off a field's name: `time_offset_ns` -> ("time_offset", "ns"); no unit where the last word is none."""
    if plain in TIME_NAMES:
        return plain, ""
    clock, _, word = plain.rpartition("_")
    return (clock, UNIT_OF[word]) if word in UNIT_OF and (clock or len(word) > 2) else (plain, "")


def _seconds_and(fine: str, name: str, seconds: NDArray[Any], parts: NDArray[Any]) -> Iterator[TimeColumn]:
    """Time column, ns, from whole seconds and `parts` of a second in the unit `fine`; none where the values do not fit."""
    whole, part = _integers(seconds), _integers(parts)
    if whole is None or part is None or 2 * np.count_nonzero((part >= 0) & (part < 10**9 // UNITS[fine])) < len(part):
        return
    yield TimeColumn(name, whole * 10**9 + part * UNITS[fine], "ns")


def _two_words(name: str, values: NDArray[Any]) -> Iterator[TimeColumn]:
    """Interpretations of a field of two 32-bit numbers, judged by its content."""
    words = _integers(values)
    if words is None or (values.dtype.kind in "iu" and values.dtype.itemsize != 4):
        return
    low, high = (words[:, k].astype(np.uint32).astype(np.uint64) for k in (0, 1))
    shift = np.uint64(32)
    yield TimeColumn(name, (high << shift) | low)
    yield from _seconds_and("ns", f"{name} (s, ns)", words[:, 0], words[:, 1])
    yield TimeColumn(f"{name} (high, low)", (low << shift) | high)
    yield TimeColumn(f"{name} (float64)", ((high << shift) | low).view(np.float64))


def _integers(values: NDArray[Any]) -> Longs | None:
    """The values as int64, 0 where they are not finite; None where some have a fraction or none are numbers."""
    if values.dtype.kind in "iu":
        return values.astype(np.int64)
    if values.dtype.kind != "f":
        return None
    finite = np.where(np.isfinite(values) & (np.abs(values) < 2.0**62), values, 0)
    whole: Longs = finite.astype(np.int64)
    return whole if (whole == finite).all() else None
