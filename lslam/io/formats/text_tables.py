"""Text as data: stamps, and tables of rows of cells between commas, semicolons, tabs or blanks, with or without names."""

from __future__ import annotations

import calendar
import csv
import re
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from datetime import UTC, datetime, timedelta
from decimal import ROUND_HALF_EVEN, Decimal
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

import numpy as np

from lslam.core.arrays import Bools, Floats, Longs
from lslam.core.errors import InputError, cause

LARGEST_NS = 2**62
DAY = r"\d{4}[-/]\d\d[-/]\d\d"
_DATE = re.compile(
    r"(\d{4})[-/](\d\d)[-/](\d\d)[ T](\d\d):(\d\d):(\d\d)(?:\.(\d{1,9}))?\s*(?:Z|UTC|([+-])(\d\d):?(\d\d))?$"
)
# Unix time has had 10 digits before the point since 2001-09-09; no sensor has been switched on for so many seconds.
_FIRST_NS = 10**18
_EPOCH = datetime(1970, 1, 1, tzinfo=UTC)
_DECIMAL_COMMA = re.compile(r"[-+]?\d*,\d+(?:[eE][-+]?\d+)?")
_DATE_AND_TIME = re.compile(rf"({DAY}) (\d\d:\S+)")
# What tools write where a number is missing.
_MISSING = frozenset(("", "nan", "+nan", "-nan", "null", "none", "na", "n/a", "<na>"))


class Row(NamedTuple):
    """One line that carries data: its number in the file, from 1, its text, and its cells."""

    number: int
    text: str
    cells: Sequence[str] = ()


@dataclass(frozen=True)
class TextTable:
    """Cells of a text file.

    names : (K,) of the columns as the file has them, empty without a header; rows : (N,) lines below it
    separator : between cells, None for blanks; first : the first line that is no comment; comments : those that are
    """

    path: Path
    names: tuple[str, ...]
    rows: list[Row]
    separator: str | None
    first: str
    comments: list[str]

    def error(self, k: int, what: str) -> InputError:
        """An InputError about row `k`, naming file and line."""
        return InputError(f"{self.path}, line {self.rows[k].number}: {what}")

    def numbers(self, column: int) -> Floats:
        """(N,) float64 of a column, dates in seconds, NaN for missing cells and texts."""
        cells = (row.cells[column] if column < len(row.cells) else "" for row in self.rows)
        return np.array([_number(cell) for cell in cells], np.float64)

    def values(self, columns: list[int]) -> Floats:
        """(N, K) float64 of columns, NaN where a cell is empty. Raises InputError naming the line of a cell that is text."""
        values = np.empty((len(self.rows), len(columns)))
        for k, (_, text, cells) in enumerate(self.rows):
            try:
                values[k] = [float("nan") if cells[c].lower() in _MISSING else float(cells[c]) for c in columns]
            except ValueError:
                raise self.error(k, f"not a number in {text[:60]!r}") from None
        return values

    def lost_rows(self, values: Floats, what: str) -> Bools:
        """(N,) whether rows of pose `values` (N, K) have NaN; `what` names the values in messages.

        Raises InputError when all rows do, and naming the line of an infinite value.
        """
        lost = np.asarray(np.isnan(values).any(axis=1), np.bool_)
        if lost.all():
            raise InputError(f"{self.path}: every row holds {what}: there is no pose")
        infinite = np.flatnonzero(~lost & np.isinf(values).any(axis=1))
        if len(infinite):
            raise self.error(int(infinite[0]), "NaN or infinity; remove that pose")
        return lost

    def check_widths(self, width: int, whose: str, is_least: bool = False) -> None:
        """Raise InputError naming the first line with fewer cells than required, or, unless `is_least`, with more."""
        for k, row in enumerate(self.rows):
            if len(row.cells) < width or (len(row.cells) > width and not is_least):
                raise self.error(k, f"{len(row.cells)} columns where {whose} has {width}")

    def check_increasing(self, stamps_ns: Longs) -> None:
        """Raise InputError naming the first line whose stamp does not increase."""
        wrong = np.flatnonzero(np.diff(stamps_ns) <= 0)
        if len(wrong):
            k = int(wrong[0]) + 1
            now, before = seconds_text(int(stamps_ns[k])), seconds_text(int(stamps_ns[k - 1]))
            how = "repeats the stamp of the line before" if now == before else f"goes back in time from {before} s"
            raise self.error(k, f"{now} s {how}; sort the poses and keep one per stamp")

    def select(self, mask: Bools) -> TextTable:
        """Table of the rows where `mask` (N,) is true."""
        return replace(self, rows=[self.rows[k] for k in np.flatnonzero(mask).tolist()])


def read_table(path: Path) -> TextTable:
    """The table in a text file; InputError when it cannot be read as text."""
    return text_table(path, *read_rows(path))


def read_rows(path: Path) -> tuple[list[Row], list[str]]:
    """Data lines and comment lines (with `#`, `%` or `//`) of a text file; InputError when it cannot be read as text."""
    try:
        text = path.read_text(encoding="utf-8-sig")
    except FileNotFoundError:
        raise InputError(f"{path} does not exist") from None
    except UnicodeDecodeError:
        raise InputError(f"{path} is not a text file: a trajectory or a table of times is expected") from None
    except OSError as error:
        raise InputError(f"{path} cannot be read: {cause(error)}") from None
    rows, comments = [], []
    for number, line in enumerate(text.splitlines(), start=1):
        stripped = line.strip()
        if stripped.startswith(("#", "%", "//")):
            comments.append(stripped)
        elif stripped:
            rows.append(Row(number, stripped))
    return rows, comments


def looks_like_header(line: str) -> bool:
    """Whether `line` begins with a name, or is empty before one (the index of pandas), and holds no number or date."""
    cells = split_cells(line.strip(), separator_of(line.strip()))
    name = next(filter(None, cells[:2]), "")
    is_name = re.match(r"[A-Za-z_/]|\.[A-Za-z]", name) is not None and name.lower() not in ("nan", "inf", "infinity")
    return is_name and not np.isfinite([_number(cell) for cell in cells]).any()


def separator_of(text: str) -> str | None:
    """Separator of the cells of a line: a semicolon, a tab or a comma, else blanks (None)."""
    return next((s for s in (";", "\t", ",") if s in text), None)


def split_cells(text: str, separator: str | None) -> list[str]:
    """Cells of a line, without quotes; decimal commas become points unless the comma is the separator (None: blanks).

    >>> split_cells("1700000000,5; 2", ";"), split_cells("2011-09-26 13:04:32.5 7", None)
    (['1700000000.5', '2'], ['2011-09-26T13:04:32.5', '7'])
    >>> split_cells('1, "base, left", 2', ",")
    ['1', 'base, left', '2']
    """
    if separator is None:
        text = _DATE_AND_TIME.sub(r"\1T\2", text, count=1)
    cells = [cell.strip().strip("\"'") for cell in _cells_of(text, separator)]
    if separator != ",":
        cells = [cell.replace(",", ".") if _DECIMAL_COMMA.fullmatch(cell) else cell for cell in cells]
    return cells


def _cells_of(text: str, separator: str | None) -> list[str]:
    """Split at separators, except within quotes."""
    if separator is not None and '"' in text:
        with suppress(csv.Error):
            return next(csv.reader([text], delimiter=separator, skipinitialspace=True))
    return text.split(separator)


def text_table(path: Path, rows: list[Row], comments: list[str]) -> TextTable:
    """Table of a file's data lines and comments; names come from the first line, or from a comment with as many words."""
    first = header = rows[0].text if rows else ""
    if looks_like_header(header):
        rows = rows[1:]
    elif rows:
        header = ""
    else:
        header = comments[0].lstrip("#% ") if comments else ""
    separator = separator_of(rows[0].text) if rows else None
    rows = [row._replace(cells=split_cells(row.text, separator)) for row in rows]
    names = split_cells(header, separator_of(header)) if header else []
    if rows and not names:
        names = _names_in(comments, len(rows[0].cells))
    rows, names = _whole_dates(rows, names)
    return TextTable(path, tuple(names), rows, separator, first, comments)


def _whole_dates(rows: list[Row], names: list[str]) -> tuple[list[Row], list[str]]:
    """Rows and names after merging a column of days with the time of day in the next column."""
    cells = rows[0].cells if rows else []
    for k, (day, time) in enumerate(pairwise(cells)):
        if re.fullmatch(DAY, day) and re.match(r"\d\d:", time):
            rows = [r._replace(cells=[*r.cells[:k], "T".join(r.cells[k : k + 2]), *r.cells[k + 2 :]]) for r in rows]
            return rows, [*names[:k], "datetime", *names[k + 2 :]] if len(names) == len(cells) else names
    return rows, names


def _names_in(comments: list[str], width: int) -> list[str]:
    """Names of the columns in the first comment that lists as many as there are; empty without."""
    for comment in comments:
        text = comment.lstrip("#%/ ")
        for separator in (separator_of(text), None):
            names = split_cells(text, separator)
            if len(names) == width > 1 and looks_like_header(text):
                return names
    return []


def _number(text: str) -> float:
    """A number, or a date in seconds since 1970; NaN for anything else."""
    try:
        return float(text)
    except ValueError:
        pass
    try:
        date_ns = date_to_ns(text)
    except ValueError:
        return float("nan")
    return float("nan") if date_ns is None else date_ns * 1e-9


def seconds_to_ns(text: str, path: Path, line: int, scale: int = 1_000_000_000) -> int:
    """Exact integer ns of a decimal number in units of `scale` ns (default s); InputError if not finite or too large."""
    try:
        value = Decimal(text)
        is_finite = value.is_finite()
        # Compared before it becomes an integer: 1e999999 would have a million digits.
        if is_finite and abs(value) <= LARGEST_NS and abs(value * scale) <= LARGEST_NS:
            return int((value * scale).to_integral_value(ROUND_HALF_EVEN))
    except (ArithmeticError, ValueError):
        is_finite = False
    if not is_finite:
        raise InputError(f"{path}, line {line}: {text!r} is no time")
    raise InputError(f"{path}, line {line}: time {text} is out of range (seconds expected)")


def seconds_text(stamp_ns: int) -> str:
    """Seconds with 9 decimals, by integers only.

    >>> seconds_text(1317042272349659964)
    '1317042272.349659964'
    """
    whole, rest = divmod(abs(stamp_ns), 1_000_000_000)
    return f"{'-' if stamp_ns < 0 else ''}{whole}.{rest:09d}"


def date_to_ns(text: str) -> int | None:
    """Nanoseconds since 1970 of a date with a time of day, UTC unless it states an offset; None when it is no date.

    Raises ValueError for a month or year that there is not.

    >>> date_to_ns("1970-01-01T01:00:01.5+01:00"), date_to_ns("12.5")
    (1500000000, None)
    """
    date = _DATE.match(text)
    if date is None:
        return None
    fields = [int(v) for v in date.groups()[:6]]
    if not 1 <= fields[1] <= 12:
        raise ValueError(f"no month {fields[1]}")
    ns = calendar.timegm((*fields, 0, 0, 0)) * 10**9 + int((date.group(7) or "").ljust(9, "0"))
    if date.group(8):
        ns -= int(f"{date.group(8)}1") * (int(date.group(9)) * 3600 + int(date.group(10)) * 60) * 10**9
    if abs(ns) >= 2**63:
        raise ValueError(f"the year {fields[0]} is out of range")
    return ns


def is_unix_time(first_ns: int) -> bool:
    """True when a clock whose earliest stamp is `first_ns` can be Unix time."""
    return first_ns >= _FIRST_NS


def utc_of(stamps_ns: Longs) -> list[datetime] | None:
    """UTC times of stamps (N,), ns, to the microsecond; None when they are no Unix time."""
    if not len(stamps_ns) or not is_unix_time(int(np.min(stamps_ns))):
        return None
    return [_EPOCH + timedelta(microseconds=int(stamp) // 1000) for stamp in stamps_ns]
