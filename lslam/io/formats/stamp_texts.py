"""Stamps as text: seconds and dates to int64 ns without passing through a float, and back."""

from __future__ import annotations

import calendar
import re
from datetime import UTC, datetime, timedelta
from decimal import ROUND_HALF_EVEN, Decimal
from pathlib import Path

import numpy as np

from lslam.core.errors import InputError
from lslam.core.types.arrays import Longs

LARGEST_NS = 2**62
DAY = r"\d{4}[-/]\d\d[-/]\d\d"
_DATE = re.compile(
    r"(\d{4})[-/](\d\d)[-/](\d\d)[ T](\d\d):(\d\d):(\d\d)(?:\.(\d{1,9}))?\s*(?:Z|UTC|([+-])(\d\d):?(\d\d))?$"
)
# Unix time has had 10 digits before the point since 2001-09-09; no sensor has been switched on for so many seconds.
_FIRST_NS = 10**18
_EPOCH = datetime(1970, 1, 1, tzinfo=UTC)


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


def utc_of(stamps_ns: Longs) -> list[datetime] | None:
    """The instants of stamps (N,) ns, to the microsecond, or None when they are no Unix time: they tell no date then."""
    if not len(stamps_ns) or int(np.min(stamps_ns)) < _FIRST_NS:
        return None
    return [_EPOCH + timedelta(microseconds=int(stamp) // 1000) for stamp in stamps_ns]
