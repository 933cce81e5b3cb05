"""Time columns of a table: one column, or seconds and their fraction, with or without names, and not a mere index.

One rule for trajectories, IMU, fixes and stamps files. A column's name proposes it, its values confirm it.
"""

from __future__ import annotations

import logging
import re
from collections.abc import Collection
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np

from lslam.core.arrays import Floats, Longs
from lslam.core.errors import InputError
from lslam.io.formats.text_tables import Row, TextTable, date_to_ns, read_rows, seconds_to_ns, text_table
from lslam.io.remote import as_path

log = logging.getLogger("lslam")
# The columns of a time, one or two, and the nanoseconds in the unit of each, None where nothing states it.
Units = dict[int, int | None]
UNITS = {"s": 10**9, "ms": 10**6, "us": 10**3, "ns": 1}  # ns
_UNIT_WORDS = {
    "s": ("sec", "secs", "second", "seconds"),
    "ms": ("msec", "msecs", "millis", "milliseconds"),
    "us": ("usec", "usecs", "micros", "microsec", "microsecs", "microseconds"),
    "ns": ("nsec", "nsecs", "nanos", "nanosec", "nanosecs", "nanosecond", "nanoseconds"),
}
UNIT_OF = {word: unit for unit, words in _UNIT_WORDS.items() for word in (unit, *words)}
UNITS_NS = {word: UNITS[unit] for word, unit in UNIT_OF.items()}
SECOND_NS = 1_000_000_000
_TIMES = ("t", "time", "times", "datetime", "epoch", "ts", "utc")
# Poses, samples and scans are less than a minute apart.
_LONGEST_STEP_S = 60.0
# Ranks of columns by name.
_STAMPED, _TIMED, _ENDING = 0, 1, 2


class RowTimes(NamedTuple):
    """Stamps (N,) of a table's rows, ns; note : columns used, and other candidates; columns : all of these."""

    stamps_ns: Longs
    note: str
    columns: set[int]


def tokens_of(name: str) -> list[str]:
    """Words of a column's name in small letters, without what stands in brackets.

    >>> tokens_of("/odom/header/stamp.sec [s]"), tokens_of("%time")
    (['odom', 'header', 'stamp', 'sec'], ['time'])
    """
    return [word for word in re.split(r"[^a-z0-9]+", re.sub(r"[\[(].*?[\])]", "", name.lower())) if word]


def find_clock(table: TextTable, other_columns: Collection[int] = (), default_ns: int | None = None) -> RowTimes | None:
    """Find the times of the rows, by column names or, without names, in the first columns; None when no column is a time.

    other_columns : columns used otherwise; default_ns : ns in a unit where the name states none, by size and step when None
    Raises InputError with the line of a cell that is no time.
    """
    candidates = _by_name(table, other_columns) if table.names else _by_place(table, other_columns)
    good = [c for c in candidates if _increases(np.sum([table.numbers(k) * (c[k] or 1) for k in c], axis=0))]
    # An index increases as well: it is the time only where nothing else is.
    is_dated = any(_is_since_1970(table.numbers(next(iter(c)))) for c in good)
    good.sort(key=lambda c: len(c) == 1 and is_index(table.numbers(*c), is_dated))
    chosen = next(iter(good or candidates), None)
    if chosen is None:
        return None
    others = {k for candidate in candidates for k in candidate if k not in chosen}
    # The index of pandas has no name.
    named = [table.names[k] for k in sorted(others) if table.names and table.names[k]]
    note = ""
    if named:
        note = f"the time is {' and '.join(table.names[k] for k in chosen)}; left out: {', '.join(named)}"
    return RowTimes(_stamps(table, chosen, default_ns), note, others.union(chosen))


def read_times(path: str | Path) -> Longs:
    """Stamps (N,) int64 ns that increase, as of KITTI's `times.txt`. Raises InputError for a file without any."""
    stamps = read_stamps(as_path(path), must_increase=True)
    if not len(stamps):
        raise InputError(f"{path} holds no times")
    return stamps


def read_stamps(path: Path, must_increase: bool = False) -> Longs:
    """(N,) int64 ns of a text file, one stamp a line.

    The time is in the column that a header names, else in the first one or two; an index before it and columns after it
    are ignored. Seconds may be decimal or scientific (KITTI's times.txt), whole numbers of nanoseconds, or dates such as
    `2011-09-26 13:04:32.349659964` (KITTI raw, taken as UTC), which keep all nine digits.
    must_increase : raise InputError for a stamp that does not increase. Raises InputError naming file and line.
    """
    rows, comments = read_rows(path)
    table = text_table(path, [Row(k, text) for k, line, _ in rows if (text := line.split("#")[0].strip())], comments)
    if not table.rows:
        return np.zeros(0, np.int64)
    clock = find_clock(table) or find_clock(replace(table, names=()))
    if clock is None:
        raise table.error(0, "no column is a time (s, ns or date)")
    beside = max(clock.columns) + 1
    if clock.note:
        log.info("%s: %s", path, clock.note)
    elif not table.names and not (clock.stamps_ns % SECOND_NS).any() and table.numbers(beside)[:1] >= 0:
        log.warning(
            "%s: whole seconds, column %d beside them is not read: if it is their fraction, name the columns (sec,usec)",
            path,
            beside + 1,
        )
    if must_increase:
        table.check_increasing(clock.stamps_ns)
    return clock.stamps_ns


def is_index(values: Floats, is_beside_date: bool = False) -> bool:
    """Whether a column counts rows: at least three whole numbers, smaller than any time since 1970, that rise by one.

    Larger steps are allowed if they are rare (lost rows), or if the column stands beside times since 1970.
    """
    steps = np.diff(values)
    is_count = (
        len(values) > 2 and bool(np.all((steps >= 1) & (values[1:] == np.rint(values[1:])))) and abs(values[0]) < 1e8
    )
    return is_count and (is_beside_date or float(np.mean(steps == 1)) > 0.5)


def unread_columns(table: TextTable, columns: Collection[int]) -> list[str]:
    """Names of the columns that are not in `columns` and do not merely count the rows."""
    others = [k for k, name in enumerate(table.names) if name and k not in columns]
    return [table.names[k] for k in others if not is_index(table.numbers(k))]


def unit_of_fraction(whole: Floats, rest: Floats, unit_ns: int | None = None) -> int | None:
    """Unit, ns, in which `rest` (N,) is the fraction of the whole seconds `whole` (N,); None when it is none.

    unit_ns : unit by the name of `rest`. Without it, fractions are whole ns that exceed a million and are no
    mere count; where the seconds repeat, also decimals of a second, or whole ms or us. Rows without a number are ignored.
    """
    both = np.isfinite(whole) & np.isfinite(rest)
    whole, rest = whole[both], rest[both]
    if not len(whole) or np.any(whole != np.rint(whole)) or rest.min() < 0 or np.abs(whole).max() >= 1e11:
        return None
    is_whole = not np.any(rest != np.rint(rest))
    if unit_ns is not None:
        return unit_ns if is_whole and rest.max() * unit_ns < SECOND_NS else None
    # As many ms or us as make a second at least, or the decimals.
    largest = 1 if not is_whole else next((n for n in (10**3, 10**6, SECOND_NS) if rest.max() < n), 0)
    is_long = (len(rest) > 2 and not is_index(rest)) or _is_since_1970(whole)
    if not is_long or rest.max() >= largest or (largest < SECOND_NS and _increases(whole)):
        return None
    return SECOND_NS // largest if _increases(whole + rest / largest) else None


def _is_since_1970(values: Floats) -> bool:
    """Whether a column has the size of times since 1970 in seconds, which have ten digits, or in finer units."""
    return bool(len(values)) and bool(np.all(values >= SECOND_NS))


def unit_ns_of(name: str) -> int | None:
    """Nanoseconds in the unit that a column's name states, in brackets or as its last word; None when it states none."""
    bracket = re.search(r"[\[(]\s*(\w+)\s*[\])]", name.lower())
    words = [bracket.group(1)] if bracket and bracket.group(1) in UNITS_NS else tokens_of(name)
    return UNITS_NS.get(words[-1]) if words else None


def _by_name(table: TextTable, other_columns: Collection[int]) -> list[Units]:
    """Time columns by name, the likeliest first: units (ns or None) by column, two columns for seconds and fraction."""
    words = [tokens_of(name) for name in table.names]
    width = len(table.rows[0].cells) if table.rows else len(words)
    free = [k for k in range(min(len(words), width)) if k not in other_columns]
    ranked: list[tuple[int, bool, int, Units]] = []
    for k in free:
        # pandas writes its index without a name.
        rank = _rank(words[k]) if words[k] else (_ENDING if k == 0 else None)
        if rank is not None:
            units = _with_fraction(table, words, k, free)
            ranked.append((rank, len(units) == 1, k, units))
    fractions = {j for _, _, k, units in ranked for j in units if j != k}
    return [units for _, _, k, units in sorted(ranked, key=lambda row: row[:3]) if k not in fractions]


def _rank(words: list[str]) -> int | None:
    """Rank of a column's name as a time, 0 for the most likely; None when it is no time."""
    core = words[:-1] if len(words) > 1 and words[-1] in UNITS_NS else words
    if core[-1] in ("stamp", "timestamp", "stamps", "timestamps"):
        return _STAMPED
    if "header" in core:
        return None
    if len(core) == 1 and (core[0] in _TIMES or core[0] in UNITS_NS):
        return _TIMED
    return _ENDING if core[-1] == "t" or core[-1].endswith(("time", "timestamp")) else None


def _with_fraction(table: TextTable, words: list[list[str]], k: int, free: list[int]) -> Units:
    """Unit, ns, of column `k` (None if unknown), and of the column with its fractions of a second, if there is one in `free`.

    That column has the same name except for the unit, or is the next one; words : of all names.
    """
    stated_ns = unit_ns_of(table.names[k])
    if stated_ns not in (None, SECOND_NS):
        return {k: stated_ns}
    stem = words[k][:-1] if words[k] and words[k][-1] in UNITS_NS else words[k]
    parts: Units = {
        j: UNITS_NS[words[j][-1]]
        for j in free
        if words[j] and UNITS_NS.get(words[j][-1], SECOND_NS) < SECOND_NS and words[j][:-1] == stem
    }
    if k + 1 in free and words[k + 1] and _rank(words[k + 1]) is None:
        parts[k + 1] = None
    whole = table.numbers(k)
    for j, stated in parts.items():
        unit_ns = unit_of_fraction(whole, table.numbers(j), stated)
        if unit_ns is not None:
            return {k: SECOND_NS, j: unit_ns}
    return {k: stated_ns}


def _by_place(table: TextTable, other_columns: Collection[int]) -> list[Units]:
    """Time columns of a table without names: a time, or seconds and nanoseconds, perhaps after an index or a text."""
    width = min([3, *other_columns, *(len(row.cells) for row in table.rows)]) if table.rows else 0
    numbers = [table.numbers(k) for k in range(width)]
    out: list[Units] = []
    for k in range(width):
        if np.isnan(numbers[k]).all() and k + 1 < width:
            continue
        if out and not is_index(numbers[k - 1], _is_since_1970(numbers[k])):
            break
        unit_ns = unit_of_fraction(numbers[k], numbers[k + 1]) if k + 1 < width else None
        out.append({k: None} if unit_ns is None else {k: SECOND_NS, k + 1: unit_ns})
    return out


def _increases(values: Floats) -> bool:
    """Whether all values are numbers and nearly all increase: single lines may be wrong, clocks are not."""
    if not len(values) or not np.isfinite(values).all():
        return False
    return len(values) < 2 or float(np.mean(np.diff(values) > 0)) > 0.9


def _stamps(table: TextTable, units: Units, default_ns: int | None) -> Longs:
    """(N,) ns, sum of the time columns in `units`; raises InputError naming the line of a cell that is no time."""
    out = np.zeros(len(table.rows), np.int64)
    for column, stated_ns in units.items():
        texts = [row.cells[column] if column < len(row.cells) else "" for row in table.rows]
        unit_ns = stated_ns or default_ns or unit_by_size(table.numbers(column), any("." in text for text in texts))
        for k, text in enumerate(texts):
            try:
                date_ns = date_to_ns(text)
            except ValueError as error:
                raise table.error(k, f"{text!r} is no time: {error}") from None
            out[k] += seconds_to_ns(text, table.path, table.rows[k].number, unit_ns) if date_ns is None else date_ns
            if stated_ns == 1 and date_ns is None and re.fullmatch(r"[-+]?\d*\.\d*[1-9]\d*", text):
                raise table.error(k, f"{text!r} is no whole number of nanoseconds")
    return out


def unit_by_size(values: Floats, is_decimal: bool = False) -> int:
    """Unit, ns, of a column of times (N,), by their size and step; is_decimal : written with a decimal point.

    Times since 1970 have 10 digits in s, 13 in ms, 16 in us, 19 in ns. Other whole numbers more than a minute apart in
    seconds have the unit in which their step is closest to 30 ms, unless they are written with a decimal point.
    """
    values = values[np.isfinite(values)]
    size = float(np.abs(values).max()) if len(values) else 0.0
    steps = np.diff(values)
    step = float(np.median(steps[steps > 0])) if (steps > 0).any() else 0.0
    for least, ns in ((1e15, 1_000), (1e12, 1_000_000)):
        if least <= size < 10 * least and step * ns < _LONGEST_STEP_S * SECOND_NS:
            return ns
    if size >= 1e14:
        return 1
    if size < 1e11 and (is_decimal or step < _LONGEST_STEP_S or np.any(values != np.rint(values))):
        return SECOND_NS
    return min((1, 1_000, 1_000_000), key=lambda ns: abs(np.log10(max(step, 1.0) * ns / 3e7)))
