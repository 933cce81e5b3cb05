"""Stamps in the names of scan files, in whatever unit and form: it is found from all names together, and said."""

from __future__ import annotations

import re
from collections.abc import Iterator
from datetime import datetime
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Stamps = NDArray[np.int64]

_UNITS = {"nanoseconds": 1, "microseconds": 10**3, "milliseconds": 10**6, "seconds": 10**9}
_EARLIEST_NS, _LATEST_NS = 10**17, 41 * 10**17  # 1973, where seconds have nine digits, to 2099
_DATE = re.compile(
    r"(?<!\d)(\d{4})([-_]?)(\d\d)\2(\d\d)[T _-]?(\d\d)([-_:.]?)(\d\d)\6(\d\d)(?:[.,_-]?(\d{1,9}))?"
    r"(Z|[+-]\d\d:?\d\d)?(?!\d)"
)
# Numbers that lie so far apart count no scans; in their unit scans follow each other at 1 to 100 Hz.
_NO_COUNT = 10_000
_SHORTEST_NS, _LONGEST_NS, _MINUTE_NS = 10**7, 10**9, 60 * 10**9
_CLEARLY = 0.5


class NameStamps(NamedTuple):
    """Stamps (N,) ns of the files in their order, and what the names hold, in words; None where stamps repeat."""

    stamps_ns: Stamps | None
    words: str


def stamps_in_names(files: list[Path]) -> NameStamps | None:
    """Stamps of scan files by their names: dates, or one number since 1970 in s, ms, us or ns, or seconds and their fraction.

    Numbers may stand behind or before other words and numbers. None when the names hold no times; the finest that differ in
    all names count.
    """
    stems = [path.stem for path in files]
    # No name holds a zero byte.
    shapes = {re.sub(r"\d+", "\0", stem) for stem in stems}
    readings = list(_dates(stems))
    if len(shapes) == 1:
        shape = shapes.pop()
        groups = [list(column) for column in zip(*(re.findall(r"\d+", stem) for stem in stems), strict=True)]
        readings += [*_pairs(groups, shape.split("\0")[1:-1]), *_numbers(groups)]
    for stamps, words in readings:
        if len(np.unique(stamps)) == len(stamps):
            return NameStamps(np.array(stamps, np.int64), words)
    return NameStamps(None, readings[0][1]) if readings else None


def _dates(stems: list[str]) -> Iterator[tuple[list[int], str]]:
    begins, fractions, counts = [], [], []
    for stem in stems:
        match = _DATE.search(stem)
        if match is None:
            return
        year, _, month, day, hour, separator, minute, second, fraction, zone = match.groups()
        try:
            begin = datetime.fromisoformat(f"{year}-{month}-{day}T{hour}:{minute}:{second}{zone or 'Z'}")
        except ValueError:
            return
        begins.append(int(begin.timestamp()) * 10**9)
        fractions.append(fraction or "")
        counts.append("".join((hour, separator, minute, second)))
    # A number behind the day, or behind the second, that counts the files is none of the time.
    if all(count.isdigit() and count.startswith("0000") for count in counts) and _counts(counts):
        return
    if all(fractions) and _counts(fractions):
        fractions = [""] * len(fractions)
    stamps = [begin + int(fraction.ljust(9, "0")) for begin, fraction in zip(begins, fractions, strict=True)]
    if min(stamps) >= _EARLIEST_NS and max(stamps) <= _LATEST_NS:
        yield stamps, "dates, UTC where they state no other zone"


def _pairs(groups: list[list[str]], between: list[str]) -> Iterator[tuple[list[int], str]]:
    """Seconds and the number behind them."""
    for (whole, rest), separator in zip(pairwise(groups), between, strict=True):
        lengths = {len(text) for text in rest}
        if separator not in tuple("._-,") or max(lengths) > 9 or max(map(len, whole)) > 10 or _counts(rest):
            continue
        decimals = [int(a) * 10**9 + int(b.ljust(9, "0")) for a, b in zip(whole, rest, strict=True)]
        unit = min((n for n in _UNITS if n != "seconds"), key=lambda n: _unevenness(_in_unit(whole, rest, _UNITS[n])))
        units = _in_unit(whole, rest, _UNITS[unit])
        a, b = _unevenness(decimals), _unevenness(units)
        is_decimal = a < b if min(a, b) < _CLEARLY * max(a, b) else max(lengths) < 9
        if len(lengths) == 1:
            stamps, words = decimals, f"seconds and {len(rest[0])} decimals"
        elif is_decimal or any(text[0] == "0" and text != "0" for text in rest):
            stamps, words = decimals, "decimal seconds"
        else:
            stamps, words = units, f"seconds and {unit} without leading zeros"
        if _is_time(whole, 10**9):
            yield stamps, words
        elif len(groups) == 2 and (
            lengths == {9} or (separator == "." and len(set(rest)) > 1 and min(a, b) < _CLEARLY and _is_rate(stamps))
        ):
            yield stamps, f"{words} of a clock that began elsewhere"


def _in_unit(whole: list[str], rest: list[str], unit_ns: int) -> list[int]:
    return [int(a) * 10**9 + int(b) * unit_ns for a, b in zip(whole, rest, strict=True)]


def _numbers(groups: list[list[str]]) -> list[tuple[list[int], str]]:
    since_1970 = [
        ([int(text) * scale for text in texts], f"{unit} since 1970")
        for unit, scale in _UNITS.items()
        for texts in groups
        if _is_time(texts, scale) and (len(texts) == 1 or len(set(texts)) > 1)
    ]
    varying = [texts for texts in groups if len(set(texts)) > 1]
    others: list[tuple[list[int], str]] = []
    if len(varying) == 1 and len(varying[0]) > 2 and max(map(len, varying[0])) < 19:
        values = [int(text) for text in varying[0]]
        for unit, scale in _UNITS.items():
            stamps = [value * scale for value in values]
            if _step_ns(values) >= _NO_COUNT and max(stamps) < _EARLIEST_NS and _is_rate(stamps):
                others.append((stamps, f"{unit} of a clock that began elsewhere"))
    # Scans hardly lie more than a minute apart.
    return sorted([*since_1970, *others], key=lambda reading: _step_ns(reading[0]) > _MINUTE_NS)


def _is_time(texts: list[str], scale: int) -> bool:
    return all(len(text) < 20 and _EARLIEST_NS <= int(text) * scale <= _LATEST_NS for text in texts)


def _counts(texts: list[str]) -> bool:
    """Whether numbers only count the files."""
    return len(texts) > 2 and bool((np.diff([int(text) for text in texts]) == 1).all())


def _step_ns(stamps: list[int]) -> float:
    """The median interval, 0 of a single stamp."""
    return float(np.median(np.diff(np.sort(np.array(stamps, np.int64))))) if len(stamps) > 1 else 0.0


def _is_rate(stamps: list[int]) -> bool:
    return _SHORTEST_NS <= _step_ns(stamps) <= _LONGEST_NS


def _unevenness(stamps: list[int]) -> float:
    """Mean deviation of the intervals from their median, in medians."""
    steps = np.diff(np.sort(np.array(stamps, np.int64))).astype(np.float64)
    middle = float(np.median(steps)) if len(steps) else 0.0
    return float(np.mean(np.abs(steps - middle))) / middle if middle > 0 else np.inf
