"""Lines of text to numbers, stamps and poses, and back: what all trajectory formats share."""

from __future__ import annotations

import calendar
import re
from collections.abc import Iterator
from decimal import ROUND_HALF_EVEN, Decimal
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from lslam.errors import InputError, cause
from lslam.formats.atomic import atomic_write
from lslam.geometry import so3
from lslam.types.trajectory import Trajectory
from lslam.untrusted import decimal_number

Floats = NDArray[np.float64]
LARGEST_NS = 2**62
_DATE = re.compile(r"(\d{4})-(\d\d)-(\d\d)[ T](\d\d):(\d\d):(\d\d)(?:\.(\d{1,9}))?\s*(?:Z|UTC|([+-])(\d\d):?(\d\d))?$")
# Whole numbers from here on are nanoseconds: as seconds they would lie 3 million years ahead.
_NS_FROM = 10**14


class Row(NamedTuple):
    """One line that carries data: its number in the file, from 1, and its text."""

    number: int
    text: str


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


def check_finite(values: Floats, rows: list[Row], path: Path) -> None:
    """InputError with the first line that holds NaN or infinity."""
    bad = np.flatnonzero(~np.isfinite(values).all(axis=1))
    if len(bad):
        raise InputError(f"{path}, line {rows[bad[0]].number}: NaN or infinity; remove that pose")


def check_increasing(stamps_ns: NDArray[np.int64], rows: list[Row], path: Path) -> None:
    """InputError with the first line whose stamp is not after the one before."""
    wrong = np.flatnonzero(np.diff(stamps_ns) <= 0)
    if len(wrong):
        i = int(wrong[0]) + 1
        now, before = seconds_text(int(stamps_ns[i])), seconds_text(int(stamps_ns[i - 1]))
        how = "repeats the stamp of the line before" if now == before else f"goes back in time from {before} s"
        raise InputError(f"{path}, line {rows[i].number}: {now} s {how}; sort the poses and keep one per stamp")


def seconds_to_ns(text: str, path: Path, line: int, scale: int = 1_000_000_000) -> int:
    """Exact integer ns of a decimal number in a unit of `scale` ns (seconds by default)."""
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


def pose_texts(trajectory: Trajectory, order: str) -> Iterator[list[str]]:
    """Cells of each pose: the position and the quaternion in the order `xyzw` or `wxyz`."""
    q = so3.to_quaternion(trajectory.poses[:, :3, :3])[:, ["xyzw".index(axis) for axis in order]]
    for position, rotation in zip(trajectory.positions.tolist(), q.tolist(), strict=True):
        yield [*(f"{v:.9f}" for v in position), *(f"{v:.12f}" for v in rotation)]


def frame_in(comments: list[str]) -> str | None:
    """The frame that a comment states as `frame: NAME`, or None."""
    for comment in comments:
        found = re.search(r"(?<![A-Za-z_])frame\s*[:=]\s*([A-Za-z_]\w*)", comment)
        if found:
            return found.group(1)
    return None


def write_lines(path: str | Path, lines: list[str]) -> None:
    """Write a text file, atomically; names that are no text are escaped."""
    with atomic_write(Path(path)) as stream:
        stream.writelines(f"{line}\n".encode("utf-8", "backslashreplace") for line in lines)


def parse_stamp(text: str) -> int:
    """Nanoseconds of one stamp in any of the three notations; ValueError when it is none.

    >>> parse_stamp("1.036224e-01"), parse_stamp("1670403902235281229"), parse_stamp("1970-01-01 00:00:01.000000002")
    (103622400, 1670403902235281229, 1000000002)
    """
    date = date_to_ns(text)
    if date is not None:
        return date
    value = decimal_number(text)
    whole = value == value.to_integral_value()
    if whole and abs(value) >= _NS_FROM:
        return int(value)
    ns = int((value * 10**9).to_integral_value())
    if abs(ns) >= 2**63:
        raise ValueError(f"no time: {text!r}")
    return ns


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
