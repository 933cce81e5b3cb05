"""Records of points without a header, in `.bin` files and plain NumPy arrays: recognised by their values, or stated.

A `.bin` file does not say what a point is. Four float32, as KITTI writes them, are assumed only where the values allow it; other
records are tried on several files together. A wrong record size mixes the columns, which shows: coordinates that no sensor
measures, negative intensities, columns whose values depend on the number of the row.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

# Records of mixed types: of Livox, Ouster, Velodyne, Aeva, Hesai and RoboSense drivers, packed and padded as PCL does.
_MIXED = (
    "x y z intensity:u1 _:u1 _:u1 time:u4",
    "x y z intensity time:u4",
    "x y z intensity ring:u2 time",
    "x y z intensity ring:u2 _:u2 time",
    "x y z intensity time:u4 ring:u2 _:u2",
    "x y z intensity time:u4 _:u2 ring:u2 _:u2",
    "x y z intensity ring:u2 time:f8",
    "x y z intensity _ time:u4 _:u1 _",
    "x y z _ intensity ring:u2 _:u2 time _",
    "x y z _ intensity time:u4 _:u2 ring:u2 _:u4 _ _:f8 _",
    "x y z _ intensity _ time:f8 ring:u2 _:u2 _ _ _",
)
_COLUMNS_F4, _COLUMNS_F8 = (3, 5, 6, 7, 8, 9, 10), (3, 4, 5, 6, 7, 8)
_MIN_POINTS = 64
_MOST_BYTES = 1 << 20  # of a file that are looked at
_LARGEST_M, _SMALLEST_M = 1e7, 1e-12  # of a coordinate that is not 0
_RARE = 0.01
_PHASES = range(2, 9)
_PERIODS_S = (0.02, 0.25)  # a sweep in whatever unit; in seconds it may be longer
_LONGEST_S = 1.2
WAY_OUT = (
    'state the record in sequence.toml, for example bin_record = "x y z intensity ring:u2 time:f8" '
    "(float32 where no type is named, _ for what is not read)"
)


@dataclass(frozen=True)
class PointRecord:
    """What a point consists of: a name and a NumPy type code for each of its columns; `_` names what is not read."""

    names: tuple[str, ...]
    types: tuple[str, ...]

    @cached_property
    def dtype(self) -> np.dtype[Any]:
        """Packed, its fields numbered."""
        return np.dtype([(str(k), code) for k, code in enumerate(self.types)])

    @property
    def size(self) -> int:
        """Bytes of a point."""
        return self.dtype.itemsize

    def __str__(self) -> str:
        return " ".join(
            name if code == "<f4" else f"{name}:{code.lstrip('<|')}"
            for name, code in zip(self.names, self.types, strict=True)
        )

    def table(self, raw: NDArray[np.uint8]) -> NDArray[Any]:
        """Points of bytes, whole ones alone."""
        return raw[: len(raw) // self.size * self.size].view(self.dtype)

    def columns(self, raw: NDArray[np.uint8]) -> dict[str, NDArray[Any]]:
        """The named columns of bytes."""
        table = self.table(raw)
        return {name: table[str(k)] for k, name in enumerate(self.names) if name != "_"}

    def unread(self) -> str:
        """Which columns are not read, as words; empty when all are."""
        which = [str(k + 1) for k, name in enumerate(self.names) if name == "_"]
        return f"column{'s' if len(which) > 1 else ''} {', '.join(which)} not read" if which else ""


def parse_record(text: str) -> PointRecord:
    """A record from words like `x y z intensity ring:u2 time:f8`. Raises ValueError with what is wrong."""
    words = [re.fullmatch(r"([A-Za-z_]\w*)(?::([<>]?)([fiu])([1248]))?", word) for word in text.split()]
    if not words or not all(words) or any(word and word[0].endswith("f1") for word in words):
        raise ValueError("names of columns, each with a type like :f4, :f8, :u2 where it is no float32")
    names = tuple(word[1] for word in words if word)
    types = tuple(f"{word[2] or '<'}{word[3] or 'f'}{word[4] or '4'}" for word in words if word)
    named = [name.lower() for name in names if name != "_"]
    if len(set(named)) < len(named) or not {"x", "y", "z"} <= set(named):
        raise ValueError("columns with names of their own, x, y and z among them")
    return PointRecord(names, tuple(np.dtype(code).str for code in types))


KITTI = parse_record("x y z intensity")


def is_record(value: Any) -> bool:
    """Whether `value` is text that states a record."""
    try:
        parse_record(value)
    except (AttributeError, TypeError, ValueError):
        return False
    return True


@dataclass(frozen=True)
class Recognition:
    """What the bytes of files are.

    record : of their points, None where none fits or several do; reason : why it is not KITTI's, empty where it is
    fitting : records that the values allow
    """

    record: PointRecord | None
    reason: str = ""
    fitting: tuple[PointRecord, ...] = ()


def recognise(files: Sequence[NDArray[np.uint8]]) -> Recognition:
    """The record of the points in these files, decided on all of them together.

    KITTI's is taken unless the sizes of most files or the values contradict it. Few points decide nothing.
    """
    files = [raw for raw in files if len(raw)]
    if not files:
        return Recognition(KITTI)
    grave, slight = (
        _faults(KITTI, files) if _divides(KITTI, files) else (f"{len(files[0])} bytes are no multiple of 16", "")
    )
    if not grave and not slight:
        return Recognition(KITTI)
    fitting = []
    for candidate in _candidates(files):
        if _divides(candidate, files) and not any(_faults(candidate, files)) and len(_valid(candidate, files)):
            fitting.append(candidate)
    # Two points of a record are no record of twice its size.
    fitting = [r for r in fitting if not any(r.size % s.size == 0 and r.size > s.size for s in fitting)]
    if len(fitting) == 1:
        return Recognition(fitting[0], f"as {KITTI} of {KITTI.size} bytes {grave or slight}", tuple(fitting))
    return Recognition(None if grave else KITTI, grave, tuple(fitting))


def name_columns(tables: Sequence[NDArray[Any]]) -> tuple[str, ...]:
    """Names of the columns of arrays (N, K), x y z first, by their values in all of the arrays; `_` for those unknown.

    A ring is a small whole number that goes with the elevation; times run through a sweep in the order of the points; the first
    column of other values that are not negative is the intensity. Of four columns the last is the intensity where it is neither.
    """
    with np.errstate(all="ignore"):
        return _names([_rows(np.asarray(table, np.float64)) for table in tables], tables[0].shape[1])


def _names(kept: Sequence[Floats], count: int) -> tuple[str, ...]:
    names = ["x", "y", "z"]
    columns = range(3, count)
    rings = [k for k in columns if _is_ring(kept, k)]
    for k in columns:
        shades = [c for c in columns if c not in rings and _is_shade(kept, c)]
        if k in rings:
            names.append("_" if "ring" in names else "ring")
        elif "time" not in names and all(_is_time(table[:, k]) for table in kept):
            names.append("time")
        elif "intensity" not in names and (k in shades or len(columns) == 1):
            names.append("intensity")
        else:
            names.append("_")
    return tuple(names)


def named_table(table: NDArray[Any], names: Sequence[str]) -> Mapping[str, NDArray[Any]]:
    """Columns of an array (N, K) by name, without those that are not read."""
    return {name: table[:, k] for k, name in enumerate(names) if name != "_"}


def _divides(record: PointRecord, files: Sequence[NDArray[np.uint8]]) -> bool:
    """Of most files: one may be cut off."""
    return 2 * sum(len(raw) % record.size == 0 for raw in files) > len(files)


def _candidates(files: Sequence[NDArray[np.uint8]]) -> list[PointRecord]:
    """Records of one type with their columns named by the values, and those of mixed types."""
    found = [parse_record(text) for text in _MIXED]
    for code, counts in (("<f4", _COLUMNS_F4), ("<f8", _COLUMNS_F8)):
        for count in counts:
            plain = PointRecord(("_",) * count, (code,) * count)
            whole = [raw for raw in files if len(raw) % plain.size == 0]
            if _divides(plain, files):
                names = name_columns([plain.table(raw[:_MOST_BYTES]).view(code).reshape(-1, count) for raw in whole])
                # Columns that mean nothing do not confirm a record.
                if count == 3 or {"intensity", "ring", "time"} & set(names):
                    found.append(PointRecord(names, plain.types))
    return found


def _matrices(record: PointRecord, files: Sequence[NDArray[np.uint8]]) -> list[Floats]:
    """(N, K) of each whole file."""
    tables = [record.table(raw[:_MOST_BYTES]) for raw in files if len(raw) % record.size == 0]
    return [np.column_stack([table[name].astype(np.float64) for name in table.dtype.names or ()]) for table in tables]


def _rows(table: Floats) -> Floats:
    """Rows of points that were measured: finite and not the origin."""
    points = table[:, :3]
    return np.asarray(table[np.isfinite(points).all(1) & (points != 0).any(1)], np.float64)


def _valid(record: PointRecord, files: Sequence[NDArray[np.uint8]]) -> Floats:
    with np.errstate(all="ignore"):
        rows = np.concatenate([_rows(table) for table in _matrices(record, files)])
    return rows if len(rows) >= _MIN_POINTS else rows[:0]


def _faults(record: PointRecord, files: Sequence[NDArray[np.uint8]]) -> tuple[str, str]:
    """What speaks against the record: what no measurement can be, and what is only unlikely; both empty when nothing does."""
    with np.errstate(all="ignore"):
        tables = _matrices(record, files)
        rows = [_rows(table) for table in tables]
        everything = np.concatenate(rows)
        if len(everything) < _MIN_POINTS:
            return "", ""
        return _grave(record, rows, everything), _slight(everything[:, :3], rows)


def _grave(record: PointRecord, rows: list[Floats], everything: Floats) -> str:
    points = everything[:, :3]
    size = np.abs(points)
    floats = [k for k, code in enumerate(record.types) if "f" in code]
    tiny = (np.abs(everything[:, floats]) < _SMALLEST_M) & (everything[:, floats] != 0)
    # NaN in one coordinate alone marks a point of some drivers; bytes that are no numbers are too large or too small as well.
    if max(np.mean((size > _LARGEST_M).any(1)), np.mean(tiny.any(1))) > _RARE:
        return "the values are no coordinates"
    names = record.names
    if "intensity" in names:
        shade = everything[:, names.index("intensity")]
        negative = float(np.mean((shade < 0) & (shade != -1)))
        if negative > _RARE and not all(_is_time(table[:, names.index("intensity")]) for table in rows):
            return f"{negative:.0%} of the intensities are negative"
    if "time" in names and not all(_is_time(table[:, names.index("time")]) for table in rows):
        return "the times do not run through a sweep"
    if "ring" in names and not _is_ring(rows, names.index("ring")):
        return "the rings do not go with the elevation"
    return ""


def _slight(points: Floats, rows: list[Floats]) -> str:
    level = np.hypot(points[:, 0], points[:, 1])
    if np.mean(np.abs(points[:, 2]) > 6 * level) > 0.2:
        return "a fifth of the points is straight above or below"
    for axis in "xy":
        column = points[:, "xy".index(axis)]
        for what, share in (("0", np.mean(column == 0)), ("whole numbers", np.mean(column == np.round(column)))):
            if 0.05 < share < 0.95 or (what == "0" and share > 0.5):
                return f"{share:.0%} of {axis} are {what}"
        if any(_depends_on_row([table[:, "xy".index(axis)] for table in rows], m) for m in _PHASES):
            return f"{axis} depends on the number of the row"
    return ""


def _depends_on_row(columns: list[Floats], period: int) -> bool:
    """Whether every `period`-th value is of another kind: of another size, or of another sign."""
    parts = [np.concatenate([column[k::period] for column in columns]) for k in range(period)]
    least = min(len(part) for part in parts)
    if least < _MIN_POINTS:
        return False
    negative = [float(np.mean(part < 0)) for part in parts]
    sizes = [float(np.median(np.abs(part))) for part in parts]
    return max(negative) - min(negative) > 0.25 + 3 / least**0.5 or max(sizes) > 8 * min(sizes)


def _is_shade(tables: Sequence[Floats], k: int) -> bool:
    values = np.concatenate([table[:, k] for table in tables])
    if not len(values):
        return False
    lengths = np.concatenate([np.linalg.norm(table[:, :3], axis=1) for table in tables])
    is_range = bool(np.mean(np.abs(values - lengths) < 0.01 * lengths) > 0.9)
    return bool(np.isfinite(values).all() and np.mean((values < 0) & (values != -1)) <= _RARE) and not is_range


def _is_ring(tables: Sequence[Floats], k: int) -> bool:
    """Whole numbers to 255 within which the elevation varies less than in all."""
    values = np.concatenate([table[:, k] for table in tables])
    if len(values) < _MIN_POINTS or not ((values == np.round(values)) & (values >= 0) & (values <= 255)).all():
        return False
    points = np.concatenate([table[:, :3] for table in tables])
    elevation = np.arctan2(points[:, 2], np.hypot(points[:, 0], points[:, 1]))
    groups = [elevation[values == ring] for ring in np.unique(values)]
    within = sum(float(np.abs(group - np.median(group)).sum()) for group in groups) / len(values)
    return len(groups) > 1 and within < 0.4 * float(np.abs(elevation - np.median(elevation)).mean())


def _is_time(values: Floats) -> bool:
    """Numbers that run through a sweep, in whatever unit, in the order of the points or of those of each ring."""
    if len(values) < _MIN_POINTS or not np.isfinite(values).all():
        return False
    low, high = float(values.min()), float(values.max())
    span = high - low
    if not (
        _PERIODS_S[0] <= span <= _LONGEST_S
        or any(_PERIODS_S[0] <= span * u <= _PERIODS_S[1] for u in (1e-3, 1e-6, 1e-9))
    ):
        return False
    steps = np.diff(values)
    filled = np.histogram(values, 10, (low, high))[0] > _RARE * len(values)
    back = min(float(np.mean(steps < 0)), float(np.mean(steps > 0)))
    return back < 0.05 and filled.sum() >= 5 and len(np.unique(values)) >= 20
