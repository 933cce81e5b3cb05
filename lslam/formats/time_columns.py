"""The time of a table's rows: one column, seconds beside their fraction, with or without names, told from a mere index.

One rule for trajectories, IMU, fixes and stamps files. A name proposes; what stands in the column confirms.
"""

from __future__ import annotations

import re
from collections.abc import Collection
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lslam.errors import InputError
from lslam.formats.pose_rows import date_to_ns, seconds_to_ns
from lslam.formats.text_tables import TextTable

Floats = NDArray[np.float64]
UNITS_NS = {
    "ns": 1, "nsec": 1, "nsecs": 1, "nanosec": 1, "nanosecs": 1, "nanosecond": 1, "nanoseconds": 1, "nanos": 1,
    "us": 1_000, "usec": 1_000, "usecs": 1_000, "microsec": 1_000, "microsecs": 1_000, "microseconds": 1_000,
    "ms": 1_000_000, "msec": 1_000_000, "msecs": 1_000_000, "milliseconds": 1_000_000,
    "s": 1_000_000_000, "sec": 1_000_000_000, "secs": 1_000_000_000, "second": 1_000_000_000, "seconds": 1_000_000_000,
}  # fmt: skip
SECOND_NS = 1_000_000_000
_STAMPS = ("stamp", "timestamp", "stamps", "timestamps")
_TIMES = ("t", "time", "times", "datetime", "epoch", "ts", "utc")
_COMPACT = re.compile(r"(?:time|stamp|timestamp)(ns|us|ms|s)")
# Poses, samples and scans are less than a minute apart.
_LONGEST_STEP_S = 60.0
# Ranks of columns by name.
_STAMPED, _TIMED, _ENDING = 0, 1, 2


@dataclass(frozen=True)
class TimeColumns:
    """stamps_ns : (N,); columns : that hold them, one or two; others : names of the columns that might have been the time"""

    stamps_ns: NDArray[np.int64]
    columns: tuple[int, ...]
    others: tuple[str, ...] = ()


def tokens_of(name: str) -> list[str]:
    """Words of a column's name in small letters, without what stands in brackets.

    >>> tokens_of("/odom/header/stamp.sec [s]"), tokens_of("%time")
    (['odom', 'header', 'stamp', 'sec'], ['time'])
    """
    return [word for word in re.split(r"[^a-z0-9]+", re.sub(r"[\[(].*?[\])]", "", name.lower())) if word]


def find_clock(table: TextTable, taken: Collection[int] = (), default_ns: int | None = None) -> TimeColumns | None:
    """The time of the rows, by names or, where there are none, by the first columns; None when no column is a time.

    Parameters
    ----------
    taken : columns that are something else
    default_ns : nanoseconds in a unit where the name states none; by size and step when None

    Raises
    ------
    InputError with the line of a cell that is no time.
    """
    candidates = _by_name(table, taken) if table.names else _by_place(table, taken)
    good = [c for c in candidates if _increases(_approximate(table, c))]
    # An index increases as well: it is the time only where nothing else is.
    chosen = next((c for c in good if not (len(c) == 1 and is_index(table.numbers(c[0])))), None)
    chosen = chosen or next(iter(good), None) or next(iter(candidates), None)
    if chosen is None:
        return None
    others = {c for candidate in candidates for c in candidate} - set(chosen)
    names = tuple(table.names[c] for c in sorted(others)) if table.names else ()
    return TimeColumns(_stamps(table, chosen, default_ns), chosen, names)


def is_index(values: Floats) -> bool:
    """Whether a column counts its rows: whole numbers one apart, three at least, smaller than any time since 1970."""
    return len(values) > 2 and bool(np.all(np.diff(values) == 1)) and abs(values[0]) < 1e8


def is_fraction(whole: Floats, rest: Floats, is_named: bool, scale: int = 1) -> bool:
    """Whether `rest` (N,), in units of `scale` ns, is the fraction of the whole seconds `whole` (N,).

    Without a name for it, it must reach beyond a million, and not merely count.
    """
    if (
        not len(whole)
        or len(rest) != len(whole)
        or not (np.all(whole == np.rint(whole)) and np.all(rest == np.rint(rest)))
    ):
        return False
    if rest.min() < 0 or rest.max() * scale >= SECOND_NS or np.abs(whole).max() >= 1e11:
        return False
    return is_named or (rest.max() >= 1e6 and len(rest) > 2 and not is_index(rest) and _increases(whole + rest * 1e-9))


def _by_name(table: TextTable, taken: Collection[int]) -> list[tuple[int, ...]]:
    words = [tokens_of(name) for name in table.names]
    width = len(table.cells[0]) if table.cells else len(words)
    free = [k for k in range(min(len(words), width)) if k not in taken]
    ranked: list[tuple[int, int, tuple[int, ...]]] = []
    for k in free:
        # pandas writes its index without a name.
        rank = _rank(words[k]) if words[k] else (_ENDING if k == 0 else None)
        if rank is None:
            continue
        rest = _fraction_of(table, words, k, free)
        if rest is not None:
            ranked.append((rank, -1, (k, rest)))
        elif not (_is_part(words[k]) and any(k in columns for _, _, columns in ranked)):
            ranked.append((rank, k, (k,)))
    return [columns for _, _, columns in sorted(ranked)]


def _rank(words: list[str]) -> int | None:
    """How likely a column of this name is the time of the row, 0 first; None when it is no time."""
    core = words[:-1] if len(words) > 1 and words[-1] in UNITS_NS else words
    if "header" in core or core[-1] in _STAMPS:
        return _STAMPED if "header" not in core or core[-1] in ("stamp", *UNITS_NS) else None
    is_compact = _COMPACT.fullmatch(core[0]) is not None
    if len(core) == 1 and (core[0] in _TIMES or core[0] in UNITS_NS or is_compact):
        return _TIMED
    return _ENDING if core[-1] in ("t", "time") or core[-1].endswith(("time", "timestamp")) else None


def _is_part(words: list[str]) -> bool:
    return bool(words) and UNITS_NS.get(words[-1], SECOND_NS) < SECOND_NS


def _fraction_of(table: TextTable, words: list[list[str]], k: int, free: list[int]) -> int | None:
    """The column of the fractions of the seconds in column `k`: of the same name but the unit, else the next column."""
    scale_ns = _named_scale(table.names[k])
    if scale_ns is not None and scale_ns != SECOND_NS:
        return None
    whole = table.numbers(k)
    known = np.isfinite(whole)
    stem = words[k][:-1] if words[k] and words[k][-1] in UNITS_NS else words[k]
    for j in free:
        if j != k and _is_part(words[j]) and words[j][:-1] == stem:
            rest = table.numbers(j)
            both = known & np.isfinite(rest)
            if is_fraction(whole[both], rest[both], True, UNITS_NS[words[j][-1]]):
                return j
    if k + 1 in free and words[k + 1] and _rank(words[k + 1]) is None:
        rest = table.numbers(k + 1)
        both = known & np.isfinite(rest)
        if is_fraction(whole[both], rest[both], False):
            return k + 1
    return None


def _by_place(table: TextTable, taken: Collection[int]) -> list[tuple[int, ...]]:
    """First columns without names: a time, seconds and nanoseconds, and either behind an index."""
    width = min((len(cells) for cells in table.cells[:100]), default=0)
    free = []
    for k in range(min(width, 3)):
        if k in taken:
            break
        free.append(k)
    numbers = [table.numbers(k) for k in free]
    out: list[tuple[int, ...]] = []
    for k in range(len(free)):
        if k and not is_index(numbers[k - 1]):
            break
        if k + 1 < len(free) and is_fraction(numbers[k], numbers[k + 1], False):
            out.append((k, k + 1))
        else:
            out.append((k,))
    return out


def _approximate(table: TextTable, columns: tuple[int, ...]) -> Floats:
    """(N,) of the columns in one unit, for comparing rows; dates count as increasing."""
    whole = table.numbers(columns[0])
    if len(columns) == 1:
        return whole if np.isfinite(whole).any() else _dates(table, columns[0])
    scale = (_named_scale(table.names[columns[1]]) if table.names else None) or 1
    rest = table.numbers(columns[1])
    with np.errstate(invalid="ignore"):
        return np.asarray(whole * SECOND_NS + rest * scale)


def _dates(table: TextTable, column: int) -> Floats:
    stamps = [_date(table, i, column) for i in range(len(table.rows))]
    return np.array([float("nan") if ns is None else float(ns) for ns in stamps])


def _date(table: TextTable, i: int, column: int) -> int | None:
    """Nanoseconds of a cell of row `i` that is a date, else None."""
    cells = table.cells[i]
    try:
        return date_to_ns(cells[column]) if column < len(cells) else None
    except ValueError as error:
        raise InputError(f"{table.path}, line {table.rows[i].number}: {cells[column]!r} is no time: {error}") from None


def _increases(values: Floats) -> bool:
    """Whether all are numbers and hardly any stands behind the one before: lines may be wrong, clocks not."""
    if not len(values) or not np.isfinite(values).all():
        return False
    return len(values) < 2 or float(np.mean(np.diff(values) > 0)) > 0.9


def _stamps(table: TextTable, columns: tuple[int, ...], default_ns: int | None) -> NDArray[np.int64]:
    first = columns[0]
    name = table.names[first] if table.names else ""
    named_ns = _named_scale(name)
    scale = SECOND_NS if len(columns) == 2 else named_ns or default_ns or unit_by_size(table.numbers(first))
    part = 1
    if len(columns) == 2 and table.names:
        part = _named_scale(table.names[columns[1]]) or 1
    out = np.empty(len(table.rows), np.int64)
    for i, (row, cells) in enumerate(zip(table.rows, table.cells, strict=True)):
        text = cells[first] if first < len(cells) else ""
        date = _date(table, i, first)
        out[i] = seconds_to_ns(text, table.path, row.number, scale) if date is None else date
        if named_ns == 1 and date is None and re.fullmatch(r"[-+]?\d*\.\d*[1-9]\d*", text):
            raise InputError(f"{table.path}, line {row.number}: {text!r} is no whole number of nanoseconds")
        if len(columns) == 2:
            rest = cells[columns[1]] if columns[1] < len(cells) else ""
            out[i] += seconds_to_ns(rest, table.path, row.number, part)
    return out


def _named_scale(name: str) -> int | None:
    """Nanoseconds in the unit that a column's name states, in brackets or as its last word; None when it states none."""
    bracket = re.search(r"[\[(]\s*(\w+)\s*[\])]", name.lower())
    if bracket and bracket.group(1) in UNITS_NS:
        return UNITS_NS[bracket.group(1)]
    words = tokens_of(name)
    if not words:
        return None
    if words[-1] in UNITS_NS:
        return UNITS_NS[words[-1]]
    compact = _COMPACT.fullmatch(words[-1])
    return UNITS_NS[compact.group(1)] if compact else None


def unit_by_size(values: Floats) -> int:
    """Nanoseconds in one unit of a column of times (N,).

    Times since 1970 have 10 digits in s, 13 in ms, 16 in us, 19 in ns. Other whole numbers that lie more than a minute apart
    as seconds are in the unit in which they lie about 30 ms apart.
    """
    known = values[np.isfinite(values)]
    size = float(np.abs(known).max()) if len(known) else 0.0
    if size >= 1e17:
        return 1
    steps = np.diff(known)
    step = float(np.median(steps[steps > 0])) if (steps > 0).any() else 0.0
    if step == 0.0:
        return next((ns for limit, ns in ((1e14, 1_000), (1e11, 1_000_000)) if size >= limit), SECOND_NS)
    for least, ns in ((1e15, 1_000), (1e12, 1_000_000)):
        if least <= size < 10 * least and step * ns < _LONGEST_STEP_S * SECOND_NS:
            return ns
    if size >= 1e14:
        return 1
    if size < 1e11 and (step < _LONGEST_STEP_S or not np.all(known == np.rint(known))):
        return SECOND_NS
    return min((1, 1_000, 1_000_000), key=lambda ns: abs(np.log10(step * ns / 3e7)))
