"""Stamps of scans: seconds, nanoseconds or KITTI's dates, one per line, read without rounding."""

from __future__ import annotations

import calendar
import re
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from lslam.errors import InputError, cause
from lslam.untrusted import decimal_number

_DATE = re.compile(r"(\d{4})-(\d\d)-(\d\d)[ T](\d\d):(\d\d):(\d\d)(?:\.(\d{1,9}))?$")
# Whole numbers from here on are nanoseconds: as seconds they would lie 3 million years ahead.
_NS_FROM = 10**14


def read_stamps(path: Path) -> NDArray[np.int64]:
    """(N,) int64 ns from a text file: the first column of each line, `#` comments and a header line aside.

    Seconds may be decimal or scientific (KITTI's times.txt), whole numbers of 15 digits and more are ns, dates such as
    `2011-09-26 13:04:32.349659964` (KITTI raw, taken as UTC) keep all nine digits.
    Raises InputError naming file and line.
    """
    try:
        lines = path.read_text(encoding="utf-8").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"{path} cannot be read: {cause(error)}") from None
    stamps: list[int] = []
    headed = False
    for number, line in enumerate(lines, 1):
        text = line.split("#")[0].strip()
        if not text:
            continue
        try:
            stamps.append(parse_stamp(text if _DATE.match(text) else re.split(r"[,;\s]+", text)[0]))
        except ValueError:
            if stamps or headed:
                raise InputError(f"{path}, line {number}: {text[:40]!r} is no time (s, ns or date)") from None
            headed = True
    return np.array(stamps, np.int64)


def parse_stamp(text: str) -> int:
    """Nanoseconds of one stamp in any of the three notations; ValueError when it is none.

    >>> parse_stamp("1.036224e-01"), parse_stamp("1670403902235281229"), parse_stamp("1970-01-01 00:00:01.000000002")
    (103622400, 1670403902235281229, 1000000002)
    """
    date = _DATE.match(text)
    if date:
        fields = [int(v) for v in date.groups()[:6]]
        if not 1 <= fields[1] <= 12:
            raise ValueError(f"no month {fields[1]}")
        ns = calendar.timegm((*fields, 0, 0, 0)) * 10**9 + int((date.group(7) or "").ljust(9, "0"))
        if abs(ns) >= 2**63:
            raise ValueError(f"the year {fields[0]} is out of range")
        return ns
    value = decimal_number(text)
    whole = value == value.to_integral_value()
    if whole and abs(value) >= _NS_FROM:
        return int(value)
    ns = int((value * 10**9).to_integral_value())
    if abs(ns) >= 2**63:
        raise ValueError(f"no time: {text!r}")
    return ns
