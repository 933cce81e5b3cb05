"""Point records without a header, in `.bin` files and plain NumPy arrays: detected from their values, or stated.

A `.bin` file does not say what a point is. Four float32, as KITTI writes them, are assumed only where the values allow it; other
records are tried on several files together. A wrong record size mixes the columns, which shows: coordinates that no sensor
measures, negative intensities, columns whose values depend on the number of the row.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lslam.core.arrays import Floats

# Records of mixed types: of Livox, Ouster, Velodyne, Aeva, Hesai and RoboSense drivers, packed and padded as PCL does.
_MIXED_RECORDS = (
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
        """Packed NumPy type with numbered fields."""
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

    def columns(self, raw: NDArray[np.uint8]) -> dict[str, NDArray[Any]]:
        """The named columns of bytes."""
        table = raw.view(self.dtype)
        return {name: table[str(k)] for k, name in enumerate(self.names) if name != "_"}

    def unread(self) -> str:
        """Columns that are not read, as words; empty when all are."""
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


@dataclass(frozen=True)
class Recognition:
    """Result of `recognise`: `record`, None unless exactly one fits; `fitting`, all that fit; `reason` why it is not KITTI's."""

    record: PointRecord | None
    reason: str = ""
    fitting: tuple[PointRecord, ...] = ()


@np.errstate(all="ignore")
def recognise(files: Sequence[NDArray[np.uint8]]) -> Recognition:
    """Detect the record of the files: KITTI's unless their sizes or values contradict it. Short files are skipped."""
    files = [raw for raw in files if len(raw) >= KITTI.size]
    if not files:
        return Recognition(KITTI)
    grave, slight = _faults(KITTI, files) or ("", "")
    if not grave and not slight:
        return Recognition(KITTI)
    fitting = [record for record in _candidates(files) if _faults(record, files) == ("", "")]
    # Two points of a record are no record of twice its size.
    fitting = [r for r in fitting if not any(r.size % s.size == 0 and r.size > s.size for s in fitting)]
    if len(fitting) == 1:
        return Recognition(fitting[0], f"as {KITTI} of {KITTI.size} bytes {grave or slight}", tuple(fitting))
    return Recognition(None if grave else KITTI, grave, tuple(fitting))


@np.errstate(all="ignore")
def name_columns(tables: Sequence[NDArray[Any]]) -> tuple[str, ...]:
    """Names of the columns of arrays (N, K), x y z first, by their values in all of the arrays; `_` for those unknown.

    A ring is a small whole number that correlates with the elevation; times increase through a sweep in the order of the points;
    the first column of other non-negative values is the intensity. The last of four columns is the intensity if it is neither.
    """
    scans = [_valid_rows(np.asarray(table, np.float64)) for table in tables]
    names = ["x", "y", "z"]
    count = tables[0].shape[1]
    for k in range(3, count):
        if _is_ring(scans, k):
            name = "ring"
        elif all(_is_time(scan[:, k]) for scan in scans):
            name = "time"
        else:
            name = "intensity" if count == 4 or _is_intensity(scans, k) else "_"
        names.append("_" if name in names else name)
    return tuple(names)


def _whole(record: PointRecord, files: Sequence[NDArray[np.uint8]]) -> list[Floats]:
    """Whole points (N, K) of each file; empty unless most files hold whole points, since one may be cut off."""
    whole = [raw[: _MOST_BYTES // record.size * record.size] for raw in files if len(raw) % record.size == 0]
    if 2 * len(whole) <= len(files):
        return []
    tables = [raw.view(record.dtype) for raw in whole]
    return [np.column_stack([table[str(k)].astype(np.float64) for k in range(len(record.names))]) for table in tables]


def _valid_rows(table: Floats) -> Floats:
    """Rows whose points are finite and not the origin."""
    points = table[:, :3]
    return np.asarray(table[np.isfinite(points).all(1) & (points != 0).any(1)])


def _candidates(files: Sequence[NDArray[np.uint8]]) -> list[PointRecord]:
    """Records of mixed types, and those of one type with their columns named by the values."""
    candidates = [parse_record(text) for text in _MIXED_RECORDS]
    for code, counts in (("<f4", _COLUMNS_F4), ("<f8", _COLUMNS_F8), (">f4", (3, 4, *_COLUMNS_F4[1:]))):
        for count in counts:
            tables = _whole(PointRecord(("_",) * count, (code,) * count), files)
            names = name_columns(tables) if tables else ()
            # Columns that mean nothing do not confirm a record.
            if names and (count == 3 or set(names[3:]) != {"_"}):
                candidates.append(PointRecord(names, (code,) * count))
    return candidates


def _faults(record: PointRecord, files: Sequence[NDArray[np.uint8]]) -> tuple[str, str] | None:
    """Impossible values, and unlikely ones, each in words or empty; None for too few points to judge."""
    tables = _whole(record, files)
    if not tables:
        return f"{len(files[0])} bytes are no multiple of {record.size}", ""
    scans = [_valid_rows(table) for table in tables]
    if sum(map(len, scans)) < _MIN_POINTS:
        return None
    return _impossible(record, scans), _unlikely(scans)


def _impossible(record: PointRecord, scans: list[Floats]) -> str:
    """Reason why the values of the scans cannot be measurements of the record, in words; empty if they can."""
    rows = np.concatenate(scans)
    columns = {name: k for k, name in enumerate(record.names)}
    floats = rows[:, ["f" in code for code in record.types]]
    is_tiny = ((np.abs(floats) < _SMALLEST_M) & (floats != 0)).any(1)
    is_large = (np.abs(rows[:, :3]) > _LARGEST_M).any(1)
    # NaN in one coordinate alone marks a point of some drivers. Bytes that are no numbers are of all sizes; where nearly all
    # points lie too far, the record is right and the scan is of no use.
    if _RARE < is_large.mean() < 1 - _RARE or is_tiny.mean() > _RARE:
        return "the values are no coordinates"
    if "intensity" in columns:
        k = columns["intensity"]
        negative = _negative(rows[:, k])
        if negative > _RARE and not all(_is_time(scan[:, k]) for scan in scans):
            return f"{negative:.0%} of the intensities are negative"
    if "time" in columns and not all(_is_time(scan[:, columns["time"]]) for scan in scans):
        return "the times do not run through a sweep"
    if "ring" in columns and not _is_ring(scans, columns["ring"]):
        return "the rings do not go with the elevation"
    return ""


def _unlikely(scans: list[Floats]) -> str:
    """Reason why the coordinates of the scans are implausible, in words; empty if they are not."""
    points = np.concatenate(scans)[:, :3]
    if np.mean(np.abs(points[:, 2]) > 6 * np.hypot(points[:, 0], points[:, 1])) > 0.2:
        return "a fifth of the points is straight above or below"
    for k, axis in enumerate("xy"):
        zeros, whole = (float(np.mean(points[:, k] == other)) for other in (0, np.round(points[:, k])))
        if zeros > 0.05:
            return f"{zeros:.0%} of {axis} are 0"
        if 0.05 < whole < 0.95:
            return f"{whole:.0%} of {axis} are whole numbers"
        if any(_depends_on_row([scan[:, k] for scan in scans], period) for period in _PHASES):
            return f"{axis} depends on the number of the row"
    return ""


def _depends_on_row(columns: list[Floats], period: int) -> bool:
    """Whether every `period`-th value differs from the others in magnitude or sign; False where too few values tell."""
    parts = [np.concatenate([column[k::period] for column in columns]) for k in range(period)]
    least = min(len(part) for part in parts)
    if least < _MIN_POINTS:
        return False
    negative = [float(np.mean(part < 0)) for part in parts]
    sizes = [float(np.median(np.abs(part))) for part in parts]
    return max(negative) - min(negative) > 0.25 + 3 / least**0.5 or max(sizes) > 8 * min(sizes)


def _negative(values: Floats) -> float:
    """Share of negative values; -1 marks a missing value and is not counted as one."""
    return float(np.mean((values < 0) & (values != -1)))


def _is_intensity(scans: Sequence[Floats], k: int) -> bool:
    """Whether column k may be the intensity: not negative, and not the range."""
    rows = np.concatenate(scans)
    lengths = np.linalg.norm(rows[:, :3], axis=1)
    is_range = np.mean(np.abs(rows[:, k] - lengths) < 0.01 * lengths) > 0.9
    return bool(len(rows) and np.isfinite(rows[:, k]).all() and _negative(rows[:, k]) <= _RARE and not is_range)


def _is_ring(scans: Sequence[Floats], k: int) -> bool:
    """Whole numbers to 255 within which the elevation varies less than in all."""
    rows = np.concatenate(scans)
    values = rows[:, k]
    if len(values) < _MIN_POINTS or not ((values == np.round(values)) & (values >= 0) & (values <= 255)).all():
        return False
    elevation = np.arctan2(rows[:, 2], np.hypot(rows[:, 0], rows[:, 1]))
    groups = [elevation[values == ring] for ring in np.unique(values)]
    within = sum(float(np.abs(group - np.median(group)).sum()) for group in groups) / len(values)
    return len(groups) > 1 and within < 0.4 * float(np.abs(elevation - np.median(elevation)).mean())


def _is_time(values: Floats) -> bool:
    """True for numbers that run through a sweep, in whatever unit, in the order of the points or of those of each ring."""
    if len(values) < _MIN_POINTS or not np.isfinite(values).all():
        return False
    low, high = float(values.min()), float(values.max())
    span, (shortest, longest) = high - low, _PERIODS_S
    fine_spans = [span * unit for unit in (1e-3, 1e-6, 1e-9)]
    if not (shortest <= span <= _LONGEST_S or any(shortest <= fine <= longest for fine in fine_spans)):
        return False
    steps = np.diff(values)
    filled = np.histogram(values, 10, (low, high))[0] > _RARE * len(values)
    back = min(float(np.mean(steps < 0)), float(np.mean(steps > 0)))
    return back < 0.05 and filled.sum() >= 5 and len(np.unique(values)) >= 20
